"""Each decay of a study predicted by the others: whether first principles so scaled hold."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from beamfit.quantity import Quantity
from beamfit.studies.decay.expansion import lifetime_of
from beamfit.studies.decay.scales import SEPARABLE, ScaleFit, spread_of_scales


class HeldBack(NamedTuple):
    """A decay as the others predict it.

    Attributes
    ----------
    name : str
        Of the decay.
    predicted : Quantity
        Lifetime at its mean current, h, from a fit to the other decays; the error is that of the
        scales and of this decay's pressure reading.
    measured : Quantity
        What the decay itself says, h.
    pull : float
        Predicted less measured loss rate, in standard errors of both.
    """

    name: str
    predicted: Quantity
    measured: Quantity
    pull: float


# A decay that leaves less than this of one to the others is known by nothing else.
LEAST = 1e-6


def predict_held_back(fit: ScaleFit) -> tuple[HeldBack, ...]:
    """Predict the lifetime of each decay by a fit to all the others.

    Parameters
    ----------
    fit : ScaleFit
        Of all decays.

    Returns
    -------
    tuple of HeldBack
        In the order of the decays. Those that say nothing of the loss, and those without which the
        scales do not predict them, are left out.

    Notes
    -----
    Least squares linear about the fit: with H = J (JᵀJ)⁻¹ Jᵀ of one decay's whitened rows J and its
    residuals r, those of the fit without it are (1 - H)⁻¹ r, with the covariance (1 - H)⁻¹: R. D.
    Cook and S. Weisberg, Residuals and Influence in Regression (1982), section 2.2.

    Examples
    --------
    >>> import beamfit
    >>> from beamfit.studies.decay.scales import fit_scales
    >>> from beamfit.studies.decay.study import Machine, study_record
    >>> path = "lattices/spear3_2003.toml"
    >>> machine = Machine(beamfit.read_ring(path), beamfit.read_operation(path))
    >>> record = beamfit.read_decay_record("measurements/spear3_shift_simulated.csv")
    >>> found = predict_held_back(fit_scales(study_record(record).decays, machine))
    >>> print(found[3].predicted, "predicted,", found[3].measured, "measured")
    9.83 ± 0.14 h predicted, 9.739034 ± 0.000099 h measured
    """
    measured = fit.measured
    weight, left, rows = fit.about(fit.terms, measured)
    half = spread_of_scales(fit.fit).half
    found = []
    for k, name in enumerate(fit.names):
        root, own = np.asarray(measured.root[k]), rows[k] @ half
        rest = np.eye(2) - own @ own.T
        if not np.any(root) or np.linalg.eigvalsh(rest)[0] < LEAST:
            continue
        back = np.linalg.inv(weight[k])
        whole = back @ np.linalg.inv(rest) @ back.T * fit.error_scale**2
        off = (back @ np.linalg.solve(rest, left[k]))[1]
        reading = np.linalg.inv(root)[1]
        rate, error = measured.parts[k, 1], fit.error_scale * np.linalg.norm(reading)
        spread = np.sqrt(max(whole[1, 1] - error**2, 0.0))
        if not spread < SEPARABLE * rate:
            continue
        found.append(
            HeldBack(
                name,
                lifetime_of(rate + off, spread),
                lifetime_of(rate, error),
                float(off / np.sqrt(whole[1, 1])),
            )
        )
    return tuple(found)
