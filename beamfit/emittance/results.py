"""Result of a fit for one plane: quantities, status, message, points and a table."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from beamfit.answer import Row, Table, answer, cell, json_of, labelled, shown
from beamfit.emittance.model import SIGMA
from beamfit.errors import Status
from beamfit.optics.beam import BeamMatrix
from beamfit.quantity import Quantity, display_unit

if TYPE_CHECKING:
    from beamfit.greybox.fit import FittedVariable


def in_words(settings: Mapping[str, float], units: Mapping[str, str], digits: int = 4) -> str:
    """Write settings of magnets or knobs with their units; a unit may be "".

    Examples
    --------
    >>> in_words({"Q1": 1.5, "Q2": -2.0}, {"Q1": "A", "Q2": "kG"})
    'Q1 = 1.5 A, Q2 = -2 kG'
    """
    return ", ".join(f"{n} = {v:.{digits}g} {units[n]}".rstrip() for n, v in settings.items())


@shown
class Points(NamedTuple):
    """Points of a fit, each array of shape (n,).

    Attributes
    ----------
    settings : dict of str to ndarray
        Magnet name to setting.
    units : dict of str to str
        Magnet name to the unit of its settings.
    screen : tuple of str
        Screen of each point.
    size, error, model : ndarray
        Measured rms size, its error as used, and the fitted size, m.
    weighed : ndarray
        Size at which the error of size² is taken, m: the model's, or the measured one.
    relative : float
        1 where errors are a share of that size, 0 where they are fixed.
    pull : ndarray
        Residual of the fitted quantity over its error as used.
    outlier_probability : ndarray
        Probability that each reading is bad.
    r11, r12 : ndarray
        Transfer-matrix elements from the start to the screen (R12 in m).
    known : ndarray
        Size² from dispersion and resolution, m².
    """

    settings: dict[str, np.ndarray]
    units: dict[str, str]
    screen: tuple[str, ...]
    size: np.ndarray
    error: np.ndarray
    model: np.ndarray
    weighed: np.ndarray
    relative: float
    pull: np.ndarray
    outlier_probability: np.ndarray
    r11: np.ndarray
    r12: np.ndarray
    known: np.ndarray

    def with_model(self, model: np.ndarray, squared: bool) -> Points:
        """Set the fitted sizes, with the pulls of size² or of the size."""
        pull = (self.size - model) / self.error
        if squared:
            pull = (self.size**2 - model**2) / (2.0 * self.weighed * self.error)
        return self._replace(model=model, pull=pull)

    def where(self, i: int) -> str:
        """The settings of a point, in words."""
        settings = in_words({n: v[i] for n, v in self.settings.items()}, self.units)
        screen = f"screen {self.screen[i]}" if len(set(self.screen)) > 1 else ""
        return ", ".join(filter(None, (settings, screen)))


@shown
class Parameter(NamedTuple):
    """A parameter fitted besides the beam: of a calibration, or k1 of a network.

    Attributes
    ----------
    name : str
        Name for users, such as "Q2.slope".
    value : Quantity
        With an error only if data and priors determine it.
    status : Status
        ``converged``, ``unidentified``, or ``at_limit`` for a parameter at a bound.
    state : str
        ``free``, ``lower`` or ``upper``.
    lower, upper : float
        Bounds; infinite if there is none.
    prior : tuple of float, or None
        Mean and standard deviation.
    multiplier : float
        d(χ²/2)/d(bound) at a bound.
    """

    name: str
    value: Quantity
    status: Status
    state: str = "free"
    lower: float = -math.inf
    upper: float = math.inf
    prior: tuple[float, float] | None = None
    multiplier: float = 0.0

    @classmethod
    def of(
        cls,
        name: str,
        v: FittedVariable,
        unit: str,
        prior: tuple[float, float] | None = None,
        settled: bool = True,
    ) -> Parameter:
        """Parameter from a fit, with its error if a converged fit determines it."""
        status = Status.unidentified if v.state == "free" else Status.at_limit
        value = Quantity(v.value, None, unit)
        if settled and v.state == "free" and math.isfinite(v.error):
            status, value = Status.converged, Quantity(v.value, v.error, unit, v.error_raw)
        return cls(name, value, status, v.state, v.lower, v.upper, prior, v.reduced_gradient)


@shown
class ScreenTwiss(NamedTuple):
    """The beam at the screen, with every magnet at the lattice's own setting.

    Attributes
    ----------
    name : str
        Name of the screen.
    settings : dict of str to float
        Settings of the magnets.
    units : dict of str to str
        Their units.
    beta, alpha : Quantity
        Twiss parameters.
    size : Quantity
        Rms size without dispersion and resolution, m.
    """

    name: str
    settings: dict[str, float]
    units: dict[str, str]
    beta: Quantity
    alpha: Quantity
    size: Quantity


@shown
@dataclass(frozen=True)
class Identifiability:
    """Evidence on what a scan determines.

    Attributes
    ----------
    determined : bool
        Whether the emittance is determined.
    singular_values : tuple of float
        Singular values of the scaled design (σ11, σ12, σ22 in units of themselves), in standard
        errors.
    condition : float or None
        Largest over smallest; None if infinite.
    waist_bracketed : bool or None
        Whether sizes rise on both sides of the smallest; None for a scan of several magnets.
    phase_coverage : float or None
        Betatron phase covered by the scan, degrees of 180.
    probability : dict of str to float
        Probability of a beam, and of each rival.
    undetermined : tuple of str
        Directions that the data do not determine, in words.
    next_measurement : str or None
        Single measurement that reduces the error most, in words.
    """

    determined: bool
    probability: dict[str, float]
    singular_values: tuple[float, ...]
    condition: float | None
    waist_bracketed: bool | None
    phase_coverage: float | None
    undetermined: tuple[str, ...]
    next_measurement: str | None

    def to_json(self) -> dict[str, Any]:
        """Give the ``identifiability`` object of the JSON contract."""
        return {
            "verdict": "determined" if self.determined else "unidentified",
            "singular_values": list(self.singular_values),
            "condition": self.condition,
            "waist_bracketed": self.waist_bracketed,
            "phase_coverage_deg": self.phase_coverage,
            "probability": self.probability,
            "undetermined": list(self.undetermined),
            "next_measurement": self.next_measurement,
        }


@answer
@dataclass(frozen=True, eq=False)
class PlaneFit:
    """The fitted beam of one plane at the start of the line.

    Attributes
    ----------
    plane : str
        "x" or "y".
    status : Status
        Status of the fit; ``message`` gives the reason and what to do.
    emittance, normalized_emittance : Quantity
        Geometric and normalised emittance, m.
    beta, alpha : Quantity
        Twiss parameters at the start of the line, m and 1.
    sigma : tuple of Quantity
        σ11 (m²), σ12 (m rad), σ22 (rad²).
    screen : ScreenTwiss
        The same beam at the screen.
    mismatch : Quantity or None
        BMAG to the lattice's design Twiss.
    chi2 : float or None
        χ²; None if the noise was inferred from the residuals.
    dof : int
        Number of points minus three.
    rms_residual : Quantity
        Rms of measured minus fitted size, m.
    covariance : ndarray
        Shape (3, 3), of σ11, σ12, σ22, unscaled (``error_raw``); NaN if not determined.
    error_scale : float
        The emittance's error over that from the stated errors alone.
    noise : str
        Source of the errors, in words.
    method, weights : str
        As for `beamfit.fit_emittance`.
    identifiability : Identifiability
        Evidence on what the data determine.
    points : Points
        The points of the fit.
    holds : str
        Contributions that the errors include: statistics only, or also given systematics.
    """

    plane: str
    status: Status
    message: str
    emittance: Quantity
    normalized_emittance: Quantity
    beta: Quantity
    alpha: Quantity
    sigma: tuple[Quantity, Quantity, Quantity]
    screen: ScreenTwiss
    mismatch: Quantity | None
    chi2: float | None
    dof: int
    rms_residual: Quantity
    covariance: np.ndarray
    error_scale: float
    noise: str
    method: str
    weights: str
    identifiability: Identifiability
    points: Points
    holds: str = "statistics only"

    @property
    def quantities(self) -> dict[str, Quantity]:
        """Each number with an error, by its name in JSON."""
        names = ("emittance", "normalized_emittance", "beta", "alpha")
        found = {name: getattr(self, name) for name in names}
        found |= zip(SIGMA, self.sigma, strict=True)
        at_screen = {f"screen_{n}": getattr(self.screen, n) for n in ("beta", "alpha", "size")}
        return found | at_screen | {"rms_residual": self.rms_residual}

    @property
    def words(self) -> str:
        """The normalised emittance, or its interval if it is not determined, in words."""
        if self.status is not Status.unidentified:
            return f"normalised emittance {self.normalized_emittance}"
        has_interval = self.normalized_emittance.interval_95 is not None
        return f"normalised emittance {_interval(self)} (95 %)" if has_interval else ""

    @property
    def headline(self) -> str:
        """The plane, its status and its emittance in one line."""
        words = f": {self.words}" if self.words else ""
        with_error = self.status is not Status.unidentified and self.emittance.error is not None
        return f"{self.plane} {cell(self.status)}{words}{f' ({self.holds})' if with_error else ''}"

    def tables(self) -> tuple[Table, ...]:
        """Table of all numbers."""
        return (labelled("", [self.plane], result_rows((self,))),)

    @property
    def beam(self) -> BeamMatrix:
        """The beam matrix at the start of the line.

        Raises
        ------
        InputError
            If no positive definite matrix fits the data (status ``unidentified``).
        """
        return BeamMatrix.from_sigma(*(q.value for q in self.sigma))

    def to_json(self) -> dict[str, Any]:
        """Give one entry of ``results`` in the JSON contract."""
        p, screen = self.points, self.screen
        names = ("emittance", "normalized_emittance", "beta", "alpha", "chi2", "dof")
        names += ("rms_residual", "error_scale", "noise", "method", "weights", "mismatch")
        names += ("identifiability",)
        entry = {name: getattr(self, name) for name in ("plane", "status", "message", *names)}
        entry |= zip(SIGMA, self.sigma, strict=True)
        entry["covariance"] = self.covariance if np.isfinite(self.covariance).all() else None
        points = {name: getattr(p, name) for name in ("settings", "units", "screen", "pull")}
        sizes = {f"{name}_m": getattr(p, name) for name in ("size", "error", "model")}
        points |= sizes | {"outlier_probability": p.outlier_probability}
        return json_of(entry | {"screen": screen, "points": points})


def result_rows(planes: tuple[PlaneFit, ...]) -> list[Row]:
    """Rows of all numbers of a result, with one value per plane, in reading order."""
    screen = planes[0].screen
    at_screen = f"at {screen.name}"
    settings = in_words(screen.settings, screen.units) or "-"
    # Without a determined emittance, the interval is all that is known.
    interval_only = not any(p.emittance.determined for p in planes)
    interval = "normalised emittance, 95 % interval" if interval_only else "  95 % interval"
    rows: list[tuple[str, Callable[[PlaneFit], object], bool]] = [
        ("status", lambda p: p.status, False),
        ("normalised emittance", lambda p: p.normalized_emittance, True),
        (interval, _interval, True),
        ("  error includes", lambda p: p.holds if p.emittance.determined else None, False),
        ("geometric emittance", lambda p: p.emittance, False),
        ("beta at the start", lambda p: p.beta, True),
        ("alpha at the start", lambda p: p.alpha, True),
        ("sigma11", lambda p: p.sigma[0], False),
        ("sigma12", lambda p: p.sigma[1], False),
        ("sigma22", lambda p: p.sigma[2], False),
        (f"beta {at_screen}", lambda p: p.screen.beta, False),
        (f"alpha {at_screen}", lambda p: p.screen.alpha, False),
        (f"size {at_screen}", lambda p: p.screen.size, True),
        (f"{at_screen}, for", lambda p: settings, False),
    ]
    if any(p.mismatch is not None for p in planes):
        rows.append(("mismatch BMAG", lambda p: p.mismatch, True))
    rows += [
        ("chi2/dof", _chi2, True),
        ("rms residual", lambda p: f"{p.rms_residual.value * 1e6:.3g} µm", False),
        ("errors", lambda p: p.noise, False),
        ("waist bracketed", lambda p: p.identifiability.waist_bracketed, False),
        ("phase advance covered", lambda p: degrees(p.identifiability.phase_coverage), False),
        ("P(beam)", lambda p: f"{p.identifiability.probability['beam']:.4f}", False),
    ]
    return [Row(label, [value(p) for p in planes], quoted) for label, value, quoted in rows]


def _interval(p: PlaneFit) -> str | None:
    """Central 95 % of the normalised emittance, in words; None if unknown."""
    q = p.normalized_emittance
    if q.interval_95 is None:
        return None
    low, high = q.interval_95
    factor, unit = display_unit(abs(high), q.unit)
    if q.error is None:
        start = f"{low / factor:.3g} to" if low > 0 else "below"
        return f"{start} {high / factor:.3g} {unit}"
    places = max(1 - math.floor(math.log10(0.5 * (high - low) / factor)), 0)
    return f"{low / factor:.{places}f} to {high / factor:.{places}f} {unit}"


def _chi2(p: PlaneFit) -> str:
    """χ² per degree of freedom, in words."""
    if p.chi2 is None or not p.dof:
        return f"not testable ({p.dof} dof)"
    return f"{p.chi2:.2f}/{p.dof} = {p.chi2 / p.dof:.2f}"


def degrees(value: float | None) -> str:
    """Write a phase coverage in degrees of 180."""
    return "-" if value is None else f"{value:.0f}° of 180°"


def parameter_table(parameters: tuple[Parameter, ...], note: str = "") -> Table:
    """Table of value, bounds, prior and state of each parameter fitted besides the beam."""
    rows = []
    for p in parameters:
        bounded = abs(p.lower) < 1e300 or abs(p.upper) < 1e300
        state = f"{p.state} bound, multiplier {p.multiplier:.2g}" if p.state != "free" else "free"
        value = cell(p.value).replace("(not determined)", "(open)")
        prior = f"{p.prior[0]:.6g} ± {p.prior[1]:.3g}" if p.prior else "-"
        limits = f"{p.lower:.6g} to {p.upper:.6g}" if bounded else "-"
        rows.append([p.name, value, limits, prior, state])
    header = ["", "value", "bounds", "prior", "state"]
    return Table("Other fitted parameters", header, rows, note)
