"""Result of a search for settings, and the rules of its verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from beamfit.answer import answer
from beamfit.emittance.results import in_words
from beamfit.emittance.wishes import SAME_ENERGY, Beam, Target
from beamfit.quantity import Quantity
from beamfit.status import Status
from beamfit.table import Table, cell, json_of
from beamfit.verdict import Finding, judge

# A wish is met within the usual error of a measured size, or of the emittance growth of a mismatch.
MET = 0.02
# What squares of a micrometre or a microradian, or BMAG - 1, come to by rounding.
EXACT = 1e-9
SHOWN = {
    "size": (1e6, " µm"),
    "divergence": (1e6, " µrad"),
    "beta": (1.0, " m"),
    "alpha": (1.0, ""),
}
CALIBRATED = (
    "The beam was fitted together with the calibration, and only the beam's covariance is in the "
    "file: the two are correlated, and without that the errors here are too large, on the GTF line "
    "1.2 to 4.6 times."
)


class PlaneBeam(NamedTuple):
    """The beam predicted at the screen in one plane."""

    plane: str
    size: Quantity
    divergence: Quantity
    beta: Quantity
    alpha: Quantity


class Minimum(NamedTuple):
    """Settings at which the objective has a minimum, and its value there."""

    settings: dict[str, float]
    objective: float


@answer
@dataclass(frozen=True)
class Setpoint:
    """The best settings found, what they give, and how sure that is.

    Attributes
    ----------
    status : Status
        ``converged`` where the wish is met; ``at_limit`` where a limit keeps it from being met
        better; ``infeasible`` where no setting near by comes nearer; ``not_converged`` where the
        search came to no optimum.
    message : str
        What is reached, what holds it, and what to do.
    best : Minimum
        The best settings: always those of the lowest objective found.
    others : tuple of Minimum
        Further local minima, best first.
    setting_error : dict of str to float or None
        How far the best setting moves with one standard deviation of the beam.
    limits : tuple of str
        Magnets whose setting ends on a limit.
    screen : str
        Where.
    predicted : tuple of PlaneBeam
        The beam there, with the beam's uncertainty carried along.
    targets : tuple of Target
        What was wanted.
    units : dict of str to str
        Of the settings.
    energy : float
        Total energy of the beam, MeV.
    line : str
        Name of the line.
    notes : tuple of str
        What to know of the beam and its errors.
    doubts : dict of str to str
        A warning for each plane whose beam the fit does not determine.
    """

    status: Status
    message: str
    best: Minimum
    others: tuple[Minimum, ...]
    setting_error: dict[str, float | None]
    limits: tuple[str, ...]
    screen: str
    predicted: tuple[PlaneBeam, ...]
    targets: tuple[Target, ...]
    units: dict[str, str]
    energy: float
    line: str
    notes: tuple[str, ...]
    doubts: Mapping[str, str]

    @property
    def headline(self) -> str:
        """The settings found, in a line."""
        return f"{cell(self.status)}: {in_words(self.best.settings, self.units)}"

    def to_json(self) -> dict[str, Any]:
        """Give the entry of ``results`` of the JSON contract; size and so on of the first plane."""
        planes = {p.plane: {k: getattr(p, k) for k in SHOWN} for p in self.predicted}
        found = {
            "status": self.status,
            "message": " ".join([self.message, *self.notes, *self.doubts.values()]),
            "settings": self.best.settings,
            "units": self.units,
            "setting_errors": self.setting_error,
            "objective": self.best.objective,
            "screen": self.screen,
            "energy": Quantity(self.energy, None, "MeV"),
            **planes[self.targets[0].plane],
            "planes": planes,
            "targets": self.targets,
            "other_minima": self.others,
            "at_limit": self.limits,
            "beam_undetermined": list(self.doubts),
        }
        return json_of(found)

    def tables(self) -> tuple[Table, ...]:
        """Lay out the settings with what they give, and the other minima if there are any."""
        rows = []
        for name, value in self.best.settings.items():
            unit, error = self.units[name], self.setting_error[name]
            moved = "-" if error is None else f"{error:.2g} {unit}"
            rows.append([name, f"{value:.6g} {unit}", moved])
        rows.append(["objective", _written(self.best.objective)])
        for p in self.predicted:
            rows += [[f"{key} {p.plane}", _shown(key, getattr(p, key))] for key in SHOWN]
        title = f"Best settings of {self.line} for the beam at {self.screen}"
        best = Table(title, ["", "setting", "± from the beam"], rows)
        others = [
            [f"  {in_words(m.settings, self.units, 5)}: objective {_written(m.objective)}"]
            for m in self.others[:5]
        ]
        return (best, Table("Other minima", [], others)) if others else (best,)


def _written(objective: float) -> str:
    """Write an objective; below the rounding of the search all wishes are met."""
    return f"{objective:.6g}" if objective >= EXACT else "0"


class SetPointEvidence(NamedTuple):
    """Evidence for the verdict on a set point.

    Attributes
    ----------
    reached : str
        What is reached of the wishes, in words.
    misses : tuple of float
        Of each wish: relative distance, or BMAG - 1.
    objective : float
        Sum of squares.
    optimum : bool
        Whether the core found an optimum there.
    held : tuple of str
        Magnets that would go further if their limits let them.
    """

    reached: str
    misses: tuple[float, ...]
    objective: float
    optimum: bool
    held: tuple[str, ...]


def _exact(e: SetPointEvidence) -> Finding | None:
    return Finding(Status.converged, e.reached) if e.objective < EXACT else None


def _restless(e: SetPointEvidence) -> Finding | None:
    if e.optimum:
        return None
    return Finding(
        Status.not_converged,
        f"{e.reached} That is the best point found, but the objective still falls there, or jumps "
        "as a magnet changes sign:",
        "narrow the limits around it, or search again with another seed.",
    )


def _at_limit(e: SetPointEvidence) -> Finding | None:
    if not e.held:
        return None
    return Finding(
        Status.at_limit,
        f"{e.reached} {', '.join(e.held)} at a limit:",
        "a wider one would do better.",
    )


def _out_of_reach(e: SetPointEvidence) -> Finding | None:
    if max(e.misses) <= MET:
        return None
    why = "the wishes contradict one another" if len(e.misses) > 1 else "the beam does not allow it"
    return Finding(
        Status.infeasible,
        f"{e.reached} That is the nearest found, and no limit holds it: {why}.",
        "Vary another magnet, or ask for less.",
    )


def _met(e: SetPointEvidence) -> Finding:
    return Finding(Status.converged, e.reached)


RULES = (_exact, _restless, _at_limit, _out_of_reach, _met)


def verdict_on(
    e: SetPointEvidence, minima: Sequence[Minimum], units: Mapping[str, str]
) -> tuple[Status, str]:
    """Judge the best point, and name the next minimum.

    Parameters
    ----------
    e : SetPointEvidence
        Of the best point.
    minima : sequence of Minimum
        Best first.
    units : mapping of str to str
        Of the settings.

    Returns
    -------
    tuple of Status and str
    """
    found = judge(e, RULES)
    if len(minima) < 2:
        return found.status, found.message
    best, other = minima[:2]
    alike = other.objective - best.objective < 1e-6 * (1.0 + best.objective)
    lead = "Other settings do as well, such as" if alike else "The next local minimum is"
    at = in_words(other.settings, units)
    return found.status, f"{found.message} {lead} {at} (objective {_written(other.objective)})."


def reached_words(
    targets: Sequence[Target], predicted: Sequence[PlaneBeam], misses: Sequence[float]
) -> str:
    """Say what is reached of each size and divergence, and of the matches together."""
    by_plane = {p.plane: p for p in predicted}
    alone = [np.ndim(t.value) == 0 for t in targets]
    said = [
        f"{t.kind} {t.plane} {_micro(t, getattr(by_plane[t.plane], t.kind))}"
        for t, own in zip(targets, alone, strict=True)
        if own
    ]
    if not all(alone):
        mismatch = sum(m for m, own in zip(misses, alone, strict=True) if not own)
        said.append(f"BMAG - 1 = {mismatch:.3g} over the planes asked for")
    words = "; ".join(said)
    return words[0].upper() + words[1:] + "."


def notes_on(beams: Mapping[str, Beam], energy: float, lattice: float) -> tuple[str, ...]:
    """Say what to know of the beams, one sentence each.

    Parameters
    ----------
    beams : mapping of str to Beam
        Those asked for.
    energy, lattice : float
        The energy used, and the line's own, MeV.
    """
    said = []
    if abs(energy - lattice) > SAME_ENERGY * lattice:
        said.append(f"At {energy:g} MeV, the energy of the scan; the lattice has {lattice:g} MeV.")
    if any(beam.calibration and beam.covariance is not None for beam in beams.values()):
        said.append(CALIBRATED)
    if all(beam.covariance is None and beam.doubt is None for beam in beams.values()):
        said.append("No errors: pass --fit to include the beam's.")
    return tuple(said)


def doubts_on(beams: Mapping[str, Beam]) -> dict[str, str]:
    """Warn of every plane whose beam the fit does not determine."""
    return {
        plane: f"The fit does not determine the beam of plane {plane}: {beam.doubt.rstrip('.')}. "
        "The settings are for its numbers as they stand."
        for plane, beam in beams.items()
        if beam.doubt is not None
    }


def _micro(target: Target, got: Quantity) -> str:
    factor, unit = SHOWN[target.kind]
    error = "" if got.error is None else f" ± {factor * got.error:.2g}"
    return f"{factor * got.value:.4g}{error}{unit} for {factor * target.value:.4g} wanted"


def _shown(key: str, q: Quantity) -> str:
    """A predicted number; one without an error is a prediction all the same."""
    factor, unit = SHOWN[key]
    if q.error is None:
        return f"{factor * q.value:.5g}{unit}"
    return f"{Quantity(factor * q.value, factor * q.error, '1')}{unit}"
