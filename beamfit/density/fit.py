"""The density fit: from a scan with profiles to emittance against charge with its error."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import ndtr

from beamfit.answer import Table, answer, cell, json_of
from beamfit.density.charge import FINE, ChargeParts, charge_parts, negative_charge, refine
from beamfit.density.profiles import MeanProfile, mean_profiles
from beamfit.density.tomography import GRID, Densities, tomography
from beamfit.emittance.fit import fit_emittance
from beamfit.emittance.model import phase_coverage
from beamfit.emittance.results import PlaneFit, in_words
from beamfit.emittance.scan import QuadScan
from beamfit.emittance.sigma import fit_sizes
from beamfit.errors import Finding, InputError, Judged, Status, expect, judge
from beamfit.noise.model import Noise
from beamfit.optics.beamline import Beamline
from beamfit.particles import beta_gamma
from beamfit.quantity import Quantity, percent
from beamfit.statistics import of_use, quantity_of_draws

# Shares of the charge whose emittance is given, and number of draws of the density.
SHARES = (0.5, 0.68, 0.9, 0.95, 1.0)
DRAWS = 256
# Smallest phase advance, degrees, for a density: three phases 30 degrees apart. The full range is
# 180.
MIN_PHASE = 60.0
# No density has negative charge. Number of independent places within 3 rms, at lengths of 0.6 rms,
# in any of which noise may ask for it; and smallest probability of that by chance.
PLACES = 25
MIN_CHANCE = 0.01
# A window cuts the beam if more than this share of the mean square probably lies beyond it: 5 % of
# an emittance. That is so for a Gaussian within 2.5 rms.
MAX_BEYOND = 0.1
# Smallest share of the charge that a window cutting the beam leaves undetermined.
OPEN_WHEN_CUT = 0.95
# Statuses of planes, from the mildest to the most severe.
SEVERITY = (Status.converged, Status.poor_fit, Status.unidentified)


@answer
@dataclass(frozen=True, eq=False)
class PlaneDensity(Judged):
    """The density of one plane.

    Attributes
    ----------
    plane : str
        "x" or "y".
    profiles : tuple of MeanProfile
        Fitted profiles, one for each setting.
    labels : tuple of str
        Settings of the profiles.
    sizes : PlaneFit
        Fit of the sizes of the scan alone.
    densities : Densities or None
        Draws of the density; None if no beam was found.
    boost : float
        βγ.
    phase : float
        Phase advance over the settings, degrees.
    notes : tuple of str
        Profiles that were left out.
    """

    plane: str
    profiles: tuple[MeanProfile, ...]
    labels: tuple[str, ...]
    sizes: PlaneFit
    densities: Densities | None
    boost: float
    phase: float
    notes: tuple[str, ...] = ()

    @cached_property
    def parts(self) -> ChargeParts:
        """Core and halo of every draw, with normalised emittances, m."""
        parts = charge_parts(self.densities.values, SHARES)
        unit = self.boost * abs(np.linalg.det(self.densities.frame)) * self.densities.growth
        return parts._replace(emittance=parts.emittance * unit[:, None], rms=parts.rms * unit)

    @property
    def cut(self) -> tuple[int, ...]:
        """Indices of profiles whose window cuts the beam."""
        return tuple(int(k) for k in np.flatnonzero(self.beyond > MAX_BEYOND))

    @cached_property
    def beyond(self) -> np.ndarray:
        """Share of the mean square that probably lies beyond each window, shape (k,)."""
        d = self.densities
        if d is None:
            return np.zeros(len(self.profiles))
        found = []
        for k, direction in enumerate(d.bins.direction):
            position = d.bins.position[d.bins.profile == k]
            at = GRID @ direction
            outside = (at < position[0]) | (at > position[-1])
            found.append((d.values @ (outside * at**2)) / (d.values @ at**2))
        return np.median(found, axis=1)

    @cached_property
    def by_chance(self) -> float:
        """Probability that profiles of a density ask for as much negative charge by chance."""
        if self.densities is None:
            return 1.0
        return min(1.0, PLACES * float(ndtr(-negative_charge(self.densities.values))))

    @cached_property
    def finding(self) -> Finding:
        """Status with its sentences."""
        return judge(self, RULES)

    @cached_property
    def emittance(self) -> dict[str, Quantity]:
        """Normalised rms emittance of 50, 68, 90, 95 and 100 % of the charge, m.

        A share without an error is not determined: all without a density, and 95 % and more where
        windows cut the beam.
        """
        return {
            percent(share): self._quantity(
                lambda parts, k=k: parts.emittance[:, k], "m", share >= OPEN_WHEN_CUT
            )
            for k, share in enumerate(SHARES)
        }

    @cached_property
    def halo(self) -> Quantity:
        """Share of the charge beyond 3 rms."""
        return self._quantity(lambda parts: parts.halo, "1", True)

    @cached_property
    def brightness(self) -> Quantity:
        """Share of the charge within one rms over its area in normalised phase space, 1/m."""
        return self._quantity(lambda parts: parts.core / (math.pi * parts.rms), "1/m", False)

    def _quantity(
        self, function: Callable[[ChargeParts], np.ndarray], unit: str, tail: bool
    ) -> Quantity:
        """Quantity from the draws, without an error where the profiles do not determine it."""
        if self.densities is None:
            return Quantity(math.nan, None, unit)
        q = quantity_of_draws(function(self.parts), unit)
        determined = self.status is Status.converged and not (tail and self.cut)
        return q if determined and of_use(q.interval_95) else q.open()

    @cached_property
    def density(self) -> np.ndarray:
        """Mean density on `charge.FINE_AXIS`, per area of the frame, shape (m, m)."""
        mean = refine(self.densities.values.mean(axis=0)[None])[0] / FINE**2
        return mean.reshape(round(math.sqrt(mean.size)), -1)

    def to_json(self) -> dict[str, Any]:
        """Give the entry of ``results`` of the JSON contract."""
        d = self.densities
        found = {
            "plane": self.plane,
            "status": self.status,
            "message": " ".join([self.message, *self.notes]),
            "normalized_emittance": self.emittance,
            "halo": self.halo,
            "core_brightness": self.brightness,
            "phase_seen_deg": self.phase,
            "profiles": len(self.profiles),
            "beyond_window": None if d is None else list(map(float, self.beyond)),
            "by_chance": None if d is None else self.by_chance,
            "scatter": None if d is None else d.scatter,
        }
        return json_of(found)


def fit_density(
    scan: QuadScan,
    line: Beamline | None = None,
    *,
    noise: Noise | None = None,
    draws: int = DRAWS,
    seed: int = 1,
) -> DensityFit:
    """Find the density of a beam in phase space from the profiles of a scan.

    Parameters
    ----------
    scan : QuadScan or path
        A scan with ``profiles``, from a file of emittance_gui or a table of profiles.
    line : Beamline or path, optional
        Beamline from the point of the density to the screens; None for rows with matrices.
    noise : Noise, optional
        Noise model, whose scatter of settings stretches profiles; `beamfit.Noise()` if None.
    draws, seed : int
        Number of draws of the density, and seed of their random numbers.

    Returns
    -------
    DensityFit
        Emittance against charge of each plane, with errors; `print` it.

    Raises
    ------
    InputError
        If the scan has no profiles at three settings of a plane.

    Notes
    -----
    The posterior of a Gaussian process in the phase space of the rms beam; see `tomography` and
    docs/density.md.

    Examples
    --------
    >>> from beamfit.emittance.scan import Profile
    >>> angle = np.radians([0.0, 35, 70, 105, 140])  # of a beam of 0.1 mm and 1e-5
    >>> size = 1e-4 * np.array([1.0, 2, 1.5, 1, 2.5])
    >>> rows = 1e4 * size[:, None] * np.column_stack([np.cos(angle), 10.0 * np.sin(angle)])
    >>> x = np.linspace(-1.5e-3, 1.5e-3, 201)
    >>> shots = [Profile("x", i, x, np.exp(-0.5 * (x / s) ** 2), None) for i, s in enumerate(size)]
    >>> scan = QuadScan({}, {}, {"x": size}, energy=135.0, transfer={"x": rows},
    ...                 profiles=tuple(shots))
    >>> found = fit_density(scan)["x"]
    >>> found.status.value, abs(found.emittance["90 %"].value / (264.2 * 0.744e-9) - 1) < 0.03
    ('converged', True)
    """
    expect(scan, QuadScan, "beamfit.read_quad_scan(path)")
    if not scan.profiles:
        expected = "an emittance_gui file, or columns position_um and counts_x, a line a bin"
        raise scan.unusable("a scan of sizes, without profiles", expected)
    noise = noise or Noise()
    fit = fit_emittance(scan, line, noise=noise)
    scan, seen = fit.scan, fit.seen
    r11, r12, variance = seen.elements
    boost, planes, excluded = beta_gamma(seen.energy, seen.line.mass), [], []
    for plane in scan.planes:
        profiles, notes = mean_profiles(scan, plane)
        if len(profiles) < 3:
            excluded += notes
            continue
        i, at = "xy".index(plane), [p.row for p in profiles]
        rows = np.column_stack([r11[i, at], r12[i, at]])
        resolution = np.sqrt(np.maximum(variance[i, at], 0.0))
        densities, phase = _densities(profiles, rows, resolution, noise, draws, seed)
        labels = tuple(_label(scan, row) for row in at)
        planes.append(PlaneDensity(plane, tuple(profiles), labels, fit[plane], densities, boost,
                                   phase, tuple(notes)))  # fmt: skip
    if not planes:
        found = " ".join(["profiles that show a beam at fewer than three settings.", *excluded])
        raise scan.unusable(found.rstrip("."), "five settings with such profiles")
    return DensityFit(scan, tuple(planes))


def _densities(
    profiles: list[MeanProfile],
    rows: np.ndarray,
    resolution: np.ndarray,
    noise: Noise,
    draws: int,
    seed: int,
) -> tuple[Densities | None, float]:
    """Draw densities, and give the phase advance covered; None and 0 if no beam is found."""
    size = np.sqrt(np.maximum([p.size**2 for p in profiles] - resolution**2, 1e-2 * resolution**2))
    found = fit_sizes(*rows.T, size, size)
    if not bool(found.positive):
        return None, 0.0
    s11, s12, s22 = np.asarray(found.sigma)
    frame = np.linalg.cholesky(np.array([[s11, s12], [s12, s22]]))
    try:
        densities = tomography(profiles, rows, frame, resolution=resolution, noise=noise,
                               draws=draws, seed=seed)  # fmt: skip
    except np.linalg.LinAlgError:
        return None, 0.0
    s11, s12, s22 = (densities.frame @ densities.frame.T)[[0, 0, 1], [0, 1, 1]]
    emittance = math.sqrt(s11 * s22 - s12**2)
    return densities, phase_coverage(*rows.T, s11 / emittance, -s12 / emittance)


def _label(scan: QuadScan, row: int) -> str:
    named = in_words({n: v[row] for n, v in scan.settings.items()}, scan.units)
    return named or (scan.screen[row] if scan.screen else f"row {row + 1}")


def _sizes(plane: PlaneDensity) -> Finding | None:
    """Find that sizes determine no emittance; then no density is given either.

    The density takes its scale from the sizes, and is linear in it; the posterior of the scan
    includes that the scale is skew.
    """
    if plane.sizes.identifiability.determined:
        return None
    return Finding(plane.sizes.status, f"{plane.plane}: {plane.sizes.message}")


def _no_beam(plane: PlaneDensity) -> Finding | None:
    if plane.densities is not None:
        return None
    cause = f"The sizes of the profiles in {plane.plane} give no emittance: the waist is not "
    cause += "bracketed, or they are of no beam through this line."
    return Finding(Status.unidentified, cause, "Scan on both sides of the waist; check the line.")


def _few_phases(plane: PlaneDensity) -> Finding | None:
    if plane.phase >= MIN_PHASE:
        return None
    cause = f"Profiles in {plane.plane} see {plane.phase:.0f}° of phase, {MIN_PHASE:.0f}° are "
    cause += "needed: what stands between them could hide any shape."
    return Finding(Status.unidentified, cause, "Scan further on both sides of the waist.")


def _wide(plane: PlaneDensity) -> Finding | None:
    emittance = quantity_of_draws(plane.parts.emittance[:, SHARES.index(0.9)], "m")
    if of_use(emittance.interval_95):
        return None
    cause = f"The profiles in {plane.plane} leave the emittance of 90 % of the charge open."
    where = f" The window cuts the beam at {plane.labels[plane.cut[0]]}." if plane.cut else ""
    return Finding(Status.unidentified, cause + where, "Widen the window, and scan further.")


def _contradiction(plane: PlaneDensity) -> Finding | None:
    if plane.by_chance >= MIN_CHANCE:
        return None
    cause = (
        f"No density gives these profiles in {plane.plane}: they ask for negative charge, which "
        f"chance does with P = {plane.by_chance:.1g}. The profile at "
        f"{plane.labels[plane.densities.worst]} departs most."
    )
    return Finding(Status.poor_fit, cause, "Look at that profile, and measure it again.")


def _found(plane: PlaneDensity) -> Finding:
    missing = 180.0 - plane.phase
    cause = (
        f"{plane.phase:.0f}° of phase are seen in {plane.plane}; what {missing:.0f}° could hide "
        "is in the errors."
    )
    if plane.cut:
        where = plane.labels[plane.cut[0]]
        cause += f" The window cuts the beam at {where}: what lies beyond it is not known."
        return Finding(Status.converged, cause, "Widen the window for 95 % of the charge and all.")
    return Finding(Status.converged, cause)


# In order of severity.
RULES = (_contradiction, _sizes, _no_beam, _few_phases, _wide, _found)


@answer
@dataclass(frozen=True, eq=False)
class DensityFit:
    """Densities of the planes of a scan.

    Attributes
    ----------
    scan : QuadScan
        The fitted scan.
    planes : tuple of PlaneDensity
        One for each plane with profiles at three settings or more.
    stored : dict of str to dict of str to Quantity
        Normalised emittance in the file, by size method and plane, for comparison.

    Examples
    --------
    >>> import beamfit
    >>> scan = beamfit.read_quad_scan("measurements/profiles_simulated.csv")
    >>> fit = beamfit.fit_density(scan, beamfit.load_lattice("lattices/lcls_otr2.toml"))
    >>> fit.status.value, f"{1e6 * fit['x'].emittance['90 %'].value:.1f} µm"
    ('converged', '0.6 µm')
    """

    scan: QuadScan
    planes: tuple[PlaneDensity, ...]
    stored: Mapping[str, Mapping[str, Quantity]] = field(default_factory=dict)

    def __getitem__(self, plane: str) -> PlaneDensity:
        """Give the density of a plane."""
        found = {p.plane: p for p in self.planes}
        if plane not in found:
            raise InputError(f"no density in '{plane}'", ", ".join(found))
        return found[plane]

    def __iter__(self) -> Iterator[PlaneDensity]:
        return iter(self.planes)

    @property
    def status(self) -> Status:
        """Most severe status of the planes."""
        return max((p.status for p in self.planes), key=SEVERITY.index)

    @property
    def headline(self) -> str:
        """Verdict, and emittances of 90 % of the charge."""
        emittances = ", ".join(f"{p.plane} {p.emittance['90 %']}" for p in self.planes)
        return f"{cell(self.status)}: normalised emittance of 90 % of the charge {emittances}"

    @property
    def message(self) -> str:
        """Messages of the planes."""
        return " ".join(p.message for p in self.planes)

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on the file and on excluded profiles."""
        return (*self.scan.notes, *(note for p in self.planes for note in p.notes))

    def to_json(self) -> dict[str, Any]:
        """Give the planes in the JSON contract."""
        return {"status": self.status, "message": self.message,
                "planes": [p.to_json() for p in self.planes]}  # fmt: skip

    def tables(self) -> tuple[Table, ...]:
        """Lay out emittance against charge, halo and core of each plane."""
        return tuple(_table(p) for p in self.planes)


def _table(plane: PlaneDensity) -> Table:
    rows: list[list[Any]] = [
        [f"emittance of {share} of the charge", cell(q), cell(q.interval_words)]
        for share, q in plane.emittance.items()
    ]
    further: Mapping[str, Quantity] = {
        "share beyond 3 rms": plane.halo,
        "core brightness": plane.brightness,
    }
    rows += [[name, cell(q), cell(q.interval_words)] for name, q in further.items()]
    title = f"Normalised emittance in {plane.plane}, from {len(plane.profiles)} profiles"
    return Table(title, ["", "value", "95 % interval"], rows)
