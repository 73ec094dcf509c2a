"""Transfer matrices of many settings of a line at once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from beamfit.optics.beamline import Beamline
from beamfit.optics.calibration import IntegratedStrength
from beamfit.optics.elements import TransferMatrix
from beamfit.optics.sections import ElementSeries

# Most matrices in memory, elements times rows, if each row has its own energy.
MOST_AT_ONCE = 100_000
# Most numbers of a calibration by which the line is differentiated directly; a network has more.
MOST_DIRECT = 3


def transfer_rows(
    line: Beamline, settings: Mapping[str, Array], energy: Array, places: tuple[str, ...]
) -> TransferMatrix:
    """Transfer matrices from the start to several places, for many settings.

    Parameters
    ----------
    line : Beamline
        The line, with the calibrations of the scan's columns. What no setting moves is
        multiplied out first; a line that is traced is taken as it is (see `seen_line`).
    settings : mapping of str to Array
        Magnet name to settings, shape (n,).
    energy : Array
        MeV, shape (n,), or one number.
    places : tuple of str
        Element names.

    Returns
    -------
    TransferMatrix
        ``planes`` of shape (n, 2, places, 3, 3).
    """
    if not any(isinstance(v, jax.core.Tracer) for v in jax.tree.leaves(line)):
        line = seen_line(line, settings, energy, places)
    return _rows(line, dict(settings), energy, places)


def seen_line(
    line: Beamline, settings: Iterable[str], energy: ArrayLike, places: Iterable[str]
) -> Beamline:
    """A line as rows of these settings and energies see it: all else multiplied out."""
    own = () if isinstance(energy, jax.core.Tracer) else np.unique(energy)
    keep = frozenset((*settings, *places))
    # Kept beyond a trace that this may be called in: what is known is computed, never traced.
    with jax.ensure_compile_time_eval():
        return _condensed(Same(line), keep, float(own[0]) if len(own) == 1 else None)


class Same(NamedTuple):
    """A line that is itself and no other: scan after scan of it shares what it is made into."""

    line: Beamline

    def __hash__(self) -> int:
        return id(self.line)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and self.line is other.line


@lru_cache(maxsize=64)
def _condensed(same: Same, keep: frozenset[str], energy: float | None) -> Beamline:
    return same.line.condensed(keep, energy)


def _from_strengths(
    places: tuple[str, ...], strengths: dict[str, Array], line: Beamline, energy: Array
) -> Array:
    found = line.matrices(places, strengths, energy)
    return jnp.stack([jnp.asarray(found[p].planes) for p in places], axis=-3)


# A row has few strengths, the weights of a network are many: so the line is differentiated by
# strengths alone, and what those hang on is carried through one small product.
_by_strengths = jax.custom_jvp(_from_strengths, nondiff_argnums=(0,))


@partial(_by_strengths.defjvp, symbolic_zeros=True)
def _through_strengths(places, given, changes):
    strengths, *others = given
    found = _from_strengths(places, *given)
    slopes = jax.jacfwd(partial(_from_strengths, places))(*given)
    moved = [slopes[name] * d for name, d in changes[0].items() if not _still(d)]
    leaves, kind = jax.tree.flatten(others)
    rest = jax.tree.leaves(changes[1:], is_leaf=_still)
    moving = [i for i, d in enumerate(rest) if not _still(d)]

    def by_rest(values):
        every = dict(enumerate(leaves)) | dict(zip(moving, values, strict=True))
        return _from_strengths(places, strengths, *jax.tree.unflatten(kind, every.values()))

    if moving:
        at, along = ([part[i] for i in moving] for part in (leaves, rest))
        moved.append(jax.jvp(by_rest, (at,), (along,))[1])
    return found, sum(moved, jnp.zeros_like(found))


def _still(change: Any) -> bool:
    return isinstance(change, jax.custom_derivatives.SymbolicZero)


@partial(jax.jit, static_argnames="places")
def _rows(
    line: Beamline, settings: dict[str, Array], energy: Array, places: tuple[str, ...]
) -> TransferMatrix:
    bare, members = line, [(m, name) for name in settings for m in line.members(name)]
    weights = [np.size(v) for m, _ in members for v in jax.tree.leaves(line[m].calibration)]
    through = _by_strengths if sum(weights) > MOST_DIRECT * len(members) else _from_strengths
    for m, _ in members:
        bare = bare.with_element(replace(line[m], calibration=IntegratedStrength(), setting=0.0))

    def one(row: tuple[dict[str, Array], Array]) -> Array:
        setting, at = row
        at = energy if at is None else at
        strengths = {
            m: jnp.asarray(line[m].calibration.k1l(setting[name], line[m].length, at), float)
            for m, name in members
        }
        return through(places, strengths, bare, at)

    rows = (settings, None if jnp.ndim(energy) == 0 else energy)
    long = max((e.order.size for e in line.elements if isinstance(e, ElementSeries)), default=0)
    if jnp.size(energy) * long <= MOST_AT_ONCE:
        return TransferMatrix(jax.vmap(one)(rows))
    by_turns = jax.lax.map(jax.checkpoint(one), rows, batch_size=max(1, MOST_AT_ONCE // long))
    return TransferMatrix(by_turns)
