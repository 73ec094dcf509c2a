"""Readings of many cycles, cleaned: what is left out of one law for all of them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from beamfit.studies.decay.expansion import LOSS, Expansion, Pieces, solved
from beamfit.studies.decay.record import DecayRecord

FEWEST_CYCLES, FEWEST_READINGS = 3, 3
# Readings beyond which neighbours are averaged, in blocks within a cycle.
MOST = 16384
# Robust standard deviations off which a reading or a cycle is left out; at most this share of them.
OUTLIER, SHARE = 7.0, 0.2
# Errors of the mean by which readings at the edges of cycles lie off the law where they are of an
# injection: what stays below moves the lifetime by no more than its error.
EDGE, WITHIN = 2.5, "they lie within injections"
# Readings from the edge inwards that tell whether the edge lies off.
NEXT = 9


def averaged(cycles: Sequence[DecayRecord]) -> Pieces:
    """All readings, in time; of very many the means of neighbours within a cycle."""
    total = sum(map(len, cycles))
    fewer = max(1.0, total / MOST)
    begin, place, parts = 0.0, 0, []
    known = all(cycle.start is not None for cycle in cycles)
    for cycle in cycles:
        begin = cycle.start if known else begin
        blocks = min(len(cycle), max(FEWEST_READINGS, round(len(cycle) / fewer)))
        time, current, error = cycle.blocks(blocks)
        parts.append((begin + time, time - time[0], current, error, place))
        place += blocks
        begin += 2 * cycle.span  # nobody said when: as if a cycle were missing in between
    time, since, current, errors, first = zip(*parts, strict=True)
    given = all(error is not None for error in errors)
    return Pieces(
        *map(np.concatenate, (time, since, current)),
        np.concatenate(errors) if given else None, np.array(first), None, cycles[0].monitor,
    )  # fmt: skip


def _per_cycle(about: Expansion) -> tuple[np.ndarray, np.ndarray]:
    """By how much the loss of each cycle departs, and its error for noise of size 1."""
    first, slope, residual = about.pieces.first, about.left[:, LOSS], about.left[:, -1]
    squares = np.add.reduceat(slope**2, first)
    return -np.add.reduceat(slope * residual, first) / squares, 1 / np.sqrt(squares)


def _far(values: np.ndarray) -> np.ndarray:
    """Which values lie off the others, unless these are too many to be outliers."""
    off = np.abs(values - np.median(values))
    spread = 1.4826 * np.median(off)
    far = off > OUTLIER * spread
    return far if spread > 0 and far.mean() <= SHARE else np.zeros(values.size, bool)


def _edges(about: Expansion) -> np.ndarray:
    """How far the first and the last readings of all cycles lie above the law, beside those next to
    them, in errors: fresh beam decays faster, and a reading within an injection lies below.
    """
    first, lengths = about.pieces.first, about.pieces.lengths
    long = lengths > NEXT
    ends = np.array([first[long], (first + lengths - 1)[long]])
    if ends.shape[1] < FEWEST_CYCLES:
        return np.zeros(2)
    off = -about.left[:, -1]
    scatter = max(1.4826 * float(np.median(np.abs(off))), 1e-300)
    inward = np.array([[1], [-1]])[..., None] * np.arange(1, NEXT)
    beside = off[ends] - off[ends[..., None] + inward].mean(axis=2)
    beside = np.clip(beside / scatter, -OUTLIER, OUTLIER)
    return beside.mean(axis=1) * math.sqrt(ends.shape[1] / (1 + 1 / (NEXT - 1)))


def _trimmed(about: Expansion) -> tuple[Expansion, list[str]]:
    """The fit without readings at the edges of cycles that are not of the decay."""
    cut, high = np.zeros(2, int), 0
    most = int(np.median(about.pieces.lengths)) // 3
    while cut.max() < most and np.any(far := np.abs(edges := _edges(about)) > EDGE):
        high += int(edges[0] > EDGE)
        keep = np.ones(about.pieces.time.size, bool)
        first, lengths = about.pieces.first, about.pieces.lengths
        long = lengths > NEXT
        for side, ends in enumerate((first, first + lengths - 1)):
            keep[ends[long]] &= not far[side]
        about, cut = solved(about.pieces.kept(keep, FEWEST_READINGS)), cut + far
    said = []
    for side, why in enumerate(
        ("fresh beam decays faster" if 2 * high >= cut[0] else WITHIN, WITHIN)
    ):
        if cut[side]:
            which = f"{('first', 'last')[side]} {cut[side]}"
            of_each = (
                "reading of each cycle was" if cut[side] == 1 else "readings of each cycle were"
            )
            said.append(f"the {which} {of_each} left out: {why}")
    return about, said


def cleaned(cycles: Pieces) -> tuple[Expansion, tuple[str, ...]]:
    """The fit without readings, edges of cycles and cycles that are not of the decay."""
    said, about = [], solved(cycles)
    departure, error = _per_cycle(about)
    cut = np.repeat(_far(departure / error), about.pieces.lengths)
    if cut.any():
        before = about.pieces.first.size
        about = solved(about.pieces.kept(~cut, FEWEST_READINGS))
        left = before - about.pieces.first.size
        were = "cycle was" if left == 1 else "cycles were"
        said.append(f"{left} {were} left out, whose loss rate lies far off the others'")
    about, edges = _trimmed(about)
    said = edges + said
    if (lone := _far(about.left[:, -1])).any():
        said.append(f"{int(lone.sum())} readings were left out as outliers")
        about = solved(about.pieces.kept(~lone, FEWEST_READINGS))
    return about, tuple(said)
