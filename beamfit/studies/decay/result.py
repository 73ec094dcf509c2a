"""What a decay fit returns: quantities with errors, a status, and a verdict on a and b."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from beamfit.quantity import Quantity, Status

if TYPE_CHECKING:
    from beamfit.sampling.posterior import Posterior
    from beamfit.sampling.priors import Distribution
    from beamfit.studies.decay.record import DecayRecord

__all__ = ["DecayFit", "Separability"]

QUANTITIES = ("a", "b", "i0", "lifetime_start", "lifetime_end", "lifetime_mean")


@dataclass(frozen=True)
class Separability:
    """Whether the record tells a from b.

    Parameters
    ----------
    separable : bool
        Whether the share of a in the loss is known to better than 0.2.
    share, share_error : float or None
        Share of a in the loss at the mean current (0: all gas-like, 1: all Touschek-like), and
        its standard deviation.
    correlation : float or None
        Correlation of a and b; near -1 on every record, also where both are well determined.
    residual_correlation : float or None
        Correlation of neighbouring residuals.
    error_inflation : float
        By how much correlated residuals make the true errors larger than those stated.
    """

    separable: bool
    share: float | None
    share_error: float | None
    correlation: float | None
    residual_correlation: float | None
    error_inflation: float

    def to_json(self) -> dict[str, Any]:
        """Return the fields as JSON's types."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class DecayFit:
    """The result of `fit_decay`.

    Parameters
    ----------
    record : str
        Name of the record.
    status : Status
        `converged`; `poor_fit` if chi² is improbable (below 1e-3); `infeasible` if a or b is
        negative by more than its error allows; `unidentified` if a and b, or the lifetime
        itself, are not determined; `not_finite` if the search failed.
    message : str
        One sentence or two of cause and remedy.
    i0, a, b : Quantity
        Current at the first reading, mA, and the coefficients of dI/dt = -a I² - b I.
    lifetime_start, lifetime_end, lifetime_mean : Quantity
        Lifetime 1/(a I + b) at the first and last reading and at the mean current, h.
    mean_current : float
        Mean current of the record, mA.
    chi2 : float
        Weighted sum of squares. Without errors in the record the noise is inferred from the
        residuals, and chi2 equals dof.
    dof : int
        Readings less parameters.
    rms_residual : float
        Root mean square of the residuals, mA.
    noise_inferred : bool
        Whether the record came without errors.
    residuals : array, shape (n,)
        Model minus reading, mA.
    identifiability : Separability
        Whether the record tells a from b.
    readings : DecayRecord, optional
        What was fitted.
    shaped : bool
        Whether a was given a dependence on the current.

    Examples
    --------
    >>> from beamfit.studies.decay.fit import fit_decay
    >>> from beamfit.studies.decay.record import DecayRecord
    >>> hours = np.linspace(0.0, 36000.0, 40)
    >>> fit = fit_decay(DecayRecord(hours, 100.0 / (1.0 + 100.0 * 1e-7 * hours)))
    >>> isinstance(fit, DecayFit), f"{fit.a.value:.2e}"
    (True, '1.00e-07')
    """

    record: str
    status: Status
    message: str
    i0: Quantity
    a: Quantity
    b: Quantity
    lifetime_start: Quantity
    lifetime_end: Quantity
    lifetime_mean: Quantity
    mean_current: float
    chi2: float
    dof: int
    rms_residual: float
    noise_inferred: bool
    residuals: np.ndarray
    identifiability: Separability
    readings: DecayRecord | None = None
    shaped: bool = False

    def sample(
        self,
        *,
        noise: str | None = None,
        outliers: bool = False,
        priors: Mapping[str, Distribution] | None = None,
        **options: Any,
    ) -> Posterior:
        """Draw I0, a and b from their posterior, flat above zero; lifetimes are derived.

        Parameters
        ----------
        noise : {"known", "inferred"}, optional
            Whether the errors are right, or right up to a common factor that is inferred. By
            default they are inferred where the record has none or the fit enlarged them.
        outliers : bool
            Let an unknown fraction of the readings be outliers.
        priors : mapping of str to distribution, optional
            On ``i0``, ``a`` or ``b``: `Normal`, `LogNormal`, `Uniform`, `HalfNormal` of
            `beamfit.sampling.priors`, or a frozen one of scipy.stats.
        **options
            ``seed, target_ess, budget, walkers, store, provenance, progress`` of
            `beamfit.sampling.ensemble.draw`.

        Returns
        -------
        Posterior

        Raises
        ------
        InputError
            As `beamfit.studies.decay.posterior.decay_target` and `draw`.

        Examples
        --------
        >>> from beamfit.studies.decay.fit import fit_decay
        >>> from beamfit.studies.decay.record import DecayRecord
        >>> t = np.linspace(0, 8 * 3600, 100)
        >>> noise = 1e-2 * np.random.default_rng(1).normal(size=t.size)
        >>> fit = fit_decay(DecayRecord(t, 100.0 / (1.0 + 100.0 * 1e-7 * t) + noise))
        >>> posterior = fit.sample(seed=1)
        >>> posterior.status.value, bool(posterior.values("b").min() >= 0)
        ('converged', True)
        """
        from beamfit.sampling.ensemble import draw
        from beamfit.studies.decay.posterior import decay_target

        return draw(decay_target(self, noise, outliers, priors), **options)

    def __str__(self) -> str:
        rows = [f"{self.record}: {self.status}. {self.message}"]
        rows += [f"  {name:15s} {getattr(self, name)}" for name in QUANTITIES]
        rows.append(
            f"  chi²/dof {self.chi2:.4g}/{self.dof}, residual {self.rms_residual:.3g} mA rms"
        )
        return "\n".join(rows)

    def to_json(self) -> dict[str, Any]:
        """Return the result as one JSON object, as `beamfit lifetime --json` prints it."""
        return {
            "record": self.record,
            "status": self.status.value,
            "message": self.message,
            **{name: getattr(self, name).to_json() for name in QUANTITIES},
            "mean_current": {"value": self.mean_current, "error": None, "unit": "mA"},
            "chi2": self.chi2,
            "dof": self.dof,
            "rms_residual": {"value": self.rms_residual, "error": None, "unit": "mA"},
            "noise_inferred": self.noise_inferred,
            "identifiability": self.identifiability.to_json(),
        }
