"""The former place of `beamfit.greybox.covariance`."""

from beamfit.greybox.covariance import MOST_SHARE, Spread, spread_of

__all__ = ["MOST_SHARE", "Spread", "spread_of"]
