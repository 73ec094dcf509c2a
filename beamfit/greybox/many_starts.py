"""The former place of `beamfit.greybox.descend`."""

from beamfit.greybox.descend import Found, descend_all, descend_one

__all__ = ["Found", "descend_all", "descend_one"]
