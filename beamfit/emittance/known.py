"""A scan seen through its line as it is: what every scenario starts from and is judged by."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import numpy as np

from beamfit.compile_cache import SELDOM
from beamfit.emittance.comparison import PlanePosterior, PlaneSizes, compare
from beamfit.emittance.results import Points
from beamfit.emittance.scan import QuadScan, check_names
from beamfit.emittance.statement import Scenario, Seen, Work, beam_problem
from beamfit.emittance.transport import (
    check_gradients,
    look_through,
    names_of,
    rows_line,
    scan_rows,
    scanned_line,
)
from beamfit.emittance.verdict import MOST_NAMED
from beamfit.noise.model import Noise
from beamfit.noise.sizes import ShotMeans, evened, means_of
from beamfit.optics.beamline import Beamline
from beamfit.optics.calibration import SETTING_UNITS

# The residual: the report's ``error_linear`` or ``error_nonlinear``.
METHODS = ("size_squared", "size")
# Whose size errors are taken at.
WEIGHTS = ("model", "measured")
# A share of the size from which on the scatter of shots is the beam's more than the screen's.
UNSTEADY = 0.1
# Scans that are looked at in one call at most, in powers of two (the last one fills them up), as
# far as rows times the longest of their arrays have room.
LANES, ROOM = 256, 1 << 20


def see(
    scan: QuadScan,
    line: Beamline,
    planes: tuple[str, ...] | None = None,
    method: str = METHODS[0],
    noise: Noise | None = None,
    weights: str = WEIGHTS[0],
) -> Seen:
    """Look at a scan through its line, and at what its sizes say of a beam.

    Parameters
    ----------
    scan, line, planes, method, noise, weights
        As for `beamfit.fit_emittance`.

    Returns
    -------
    Seen

    Raises
    ------
    InputError
        If the line lacks a magnet or screen of the scan, or a plane was not measured.
    """
    return with_posteriors(looked_through([unfitted(scan, line, planes, method, noise, weights)]))[
        0
    ]


def prepared(
    scan: QuadScan, line: Beamline | None, scenario: str = "known"
) -> tuple[QuadScan, Beamline]:
    """A scan of one beam with total energies, and its line.

    Raises
    ------
    InputError
        If it is of several slices, or its matrices are both given and unknown.
    """
    if len(scan.slices) > 1:
        found = f"a scan of {len(scan.slices)} slices of the beam"
        raise scan.unusable(found, "rows of one, as scan.of_slice(name) gives")
    line = rows_line(scan) if line is None else line
    _check_own(scan, line, scenario)
    return scan.of_particle(line.mass), line


def _check_own(scan: QuadScan, line: Beamline, scenario: str) -> None:
    """Refuse to have the matrices of rows both given and unknown, or given twice."""
    if scan.transfer is None:
        return
    if line.magnets or float(line.length) > 0.0:
        raise scan.unusable("rows with matrices of their own and a line", "one of the two")
    if scenario != "known":
        expected = "scenario known, or settings and a lattice"
        raise scan.unusable(f"scenario {scenario} for rows with matrices of their own", expected)


def unfitted(
    scan: QuadScan,
    line: Beamline,
    planes: tuple[str, ...] | None = None,
    method: str = METHODS[0],
    noise: Noise | None = None,
    weights: str = WEIGHTS[0],
) -> Seen:
    """The scan and its line as `see` takes them, checked, without the look and the posterior."""
    check_names(scan, *names_of(line))
    asked = planes or scan.planes
    for plane in asked:
        scan.rows(plane)  # says so if it was not measured
    scanned = scanned_line(scan, line)
    check_gradients(scan, scanned)
    rows = scan_rows(scan, scanned, method == METHODS[0])
    return Seen(scan, line, scanned, asked, method, weights, rows, noise or Noise(), None, {})


def looked_through(begun: Sequence[Seen]) -> list[Seen]:
    """Look at scans through their lines; those whose rows have one shape are one call."""
    found, alike = list(begun), {}
    for i, seen in enumerate(begun):
        leaves, kind = jax.tree.flatten(seen.rows)
        alike.setdefault((kind, *map(np.shape, leaves)), []).append((i, leaves))
    for (kind, *shapes), members in alike.items():
        room = max(ROOM // max(map(np.prod, shapes)) ** 2, 1)
        lanes = min(int(room), LANES, 1 << (len(members) - 1).bit_length())
        for start in range(0, len(members), lanes):
            own = members[start : start + lanes]
            columns = zip(
                *(leaves for _, leaves in own + own[-1:] * (lanes - len(own))), strict=True
            )
            looks = jax.tree.map(np.asarray, _looks([np.stack(c) for c in columns], kind))
            for lane, (i, _) in enumerate(own):
                look = jax.tree.map(lambda a, lane=lane: a[lane], looks)
                found[i] = begun[i]._replace(look=look)
    return found


@partial(jax.jit, static_argnums=1, compiler_options=SELDOM)
def _looks(columns: list, kind: Any) -> Any:
    return jax.vmap(lambda leaves: look_through(jax.tree.unflatten(kind, leaves)))(columns)


def with_posteriors(begun: Sequence[Seen]) -> list[Seen]:
    """The same scans with the posterior of every plane; all with one noise and one method."""
    if not begun:
        return []
    own = [{plane: plane_sizes(seen, plane) for plane in seen.planes} for seen in begun]
    sizes = [each for planes in own for each, _ in planes.values()]
    found = iter(compare(sizes, begun[0].noise, begun[0].method, begun[0].weights))
    every = []
    for seen, planes in zip(begun, own, strict=True):
        works = {
            plane: _work(seen, plane, each, next(found), shots)
            for plane, (each, shots) in planes.items()
        }
        every.append(seen._replace(works=works))
    return every


def plane_sizes(seen: Seen, plane: str) -> tuple[PlaneSizes, ShotMeans | None]:
    """The sizes of a plane with their errors, and what its shots say."""
    scan, at, i = seen.scan, seen.measured(plane), "xy".index(plane)
    r11, r12, known = (part[i, at] for part in seen.look[:3])
    size, error, shots = scan.size[plane][at], scan.error.get(plane), None
    if plane in scan.shot_size and (shots := means_of(scan.shot_size[plane][at], seen.noise)):
        size, error = shots.size, shots.error
    elif error is not None:
        error = error[at]
        freedom = np.zeros(1) if scan.shots is None else np.asarray(scan.shots, float)[at] - 1.0
        if freedom.sum() > 0:
            square = error**2 * (freedom + 1.0) * freedom
            error = np.sqrt(evened(square, freedom, size) / (freedom + 1.0))
    counted = scan.shots is not None and bool((np.asarray(scan.shots) > 1).any())
    of_shots = shots is not None or (error is not None and counted)
    screens = {seen.rows.places[j] for j in seen.rows.which[at]}
    moved = any(np.ptp(v[at]) > 0 for v in scan.settings.values()) or len(screens) < 3
    return PlaneSizes(r11, r12, known, size, error, of_shots, moved), shots


def _work(
    seen: Seen, plane: str, sizes: PlaneSizes, post: PlanePosterior, shots: ShotMeans | None
) -> Work:
    scan, at, follows = seen.scan, seen.measured(plane), seen.weights == WEIGHTS[0]
    points = Points(
        settings={name: v[at] for name, v in scan.settings.items()},
        units={name: SETTING_UNITS[scan.units[name]] for name in scan.settings},
        screen=tuple(seen.rows.places[j] for j in seen.rows.which[at]),
        size=sizes.size,
        error=post.error,
        weighed=post.model if follows else sizes.size,
        relative=post.relative if follows else 0.0,
        model=post.model,
        pull=np.zeros(len(at)),
        outlier_probability=post.bad,
        r11=sizes.r11,
        r12=sizes.r12,
        known=sizes.known,
    )
    points = points._replace(pull=pulls(points, seen.rows.squared))
    return Work(sizes, post, points, _shot_words(points, shots))


def pulls(p: Points, squared: bool) -> np.ndarray:
    """Residual of the quantity that was fitted, over its error."""
    if squared:
        return (p.size**2 - p.model**2) / (2.0 * p.weighed * p.error)
    return (p.size - p.model) / p.error


def _shot_words(p: Points, shots: ShotMeans | None) -> str:
    """Count and name the shots that surely show no beam."""
    if shots is None:
        return ""
    lost = np.argwhere(np.nan_to_num(shots.bad) > 0.99)
    unsteady = ""
    if shots.scatter > UNSTEADY:
        unsteady = (
            f"Shots of one setting scatter by {100 * shots.scatter:.2g} %: the beam changes from "
            "shot to shot, and this is that of the mean sizes."
        )
    if not len(lost):
        return unsteady
    count = int((~np.isnan(shots.bad)).sum())
    places = [f"shot {j + 1} at {p.where(i)}" for i, j in lost[:MOST_NAMED]]
    places += [f"{len(lost) - MOST_NAMED} more"] * (len(lost) > MOST_NAMED)
    are = "are" if len(lost) > 1 else "is"
    said = f"{len(lost)} of {count} shots {are} left out, no beam there: {'; '.join(places)}."
    return f"{said} {unsteady}".strip()


# Nothing but the beam is unknown; as a problem for those who want more than the posterior.
SCENARIO = Scenario("known", lambda seen, _told: beam_problem(seen), closed=True)
