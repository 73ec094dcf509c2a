"""Many scans of known transport in one call: those whose rows have one shape are one vmap."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import jax
import numpy as np

from beamfit.emittance.assumptions import Assumptions
from beamfit.emittance.comparison import BEAM
from beamfit.emittance.fit import EmittanceFit
from beamfit.emittance.known import judged_beam, looked_through, prepared, unfitted
from beamfit.emittance.scan import QuadScan
from beamfit.emittance.statement import Seen, scenario_of
from beamfit.emittance.verdict import SURE
from beamfit.errors import InputError
from beamfit.noise.learn import Sample
from beamfit.noise.model import Noise
from beamfit.optics.beamline import Beamline

# How many a call is compiled for, and what bounds them: rows times the longest of their arrays.
FEW, LANES, ROOM = 16, 256, 1 << 20


def fit_many(
    scans: Iterable[tuple[QuadScan, Beamline]], weights: str = "model", noise: Noise | None = None
) -> list[EmittanceFit | InputError]:
    """Fit the emittance to each of many scans: what `fit_emittance` gives of each.

    Parameters
    ----------
    scans : iterable of (QuadScan, Beamline)
        The scans with their lines; hundreds at a time.
    weights, noise
        As for `beamfit.fit_emittance`.

    Returns
    -------
    list of EmittanceFit or InputError
        One a scan, in their order: its fit, or what is wrong with it.

    Examples
    --------
    >>> from beamfit.optics.elements import Drift, Quadrupole, Screen
    >>> line = Beamline((Quadrupole("Q", 0.1), Drift("D", 2.0), Screen("S")), 135.0)
    >>> k1, sizes = [-1.0, 1.5, 4.0, 6.5, 9.0], np.array([3.4e-4, 1.9e-4, 0.9e-4, 1.9e-4, 3.4e-4])
    >>> scans = [QuadScan({"Q": k1}, {"Q": "k1"}, {"x": f * sizes}) for f in (1.0, 2.0)]
    >>> one, other = fit_many((scan, line) for scan in scans)
    >>> round(other.x.emittance.value / one.x.emittance.value, 9)
    4.0
    """
    found: list[EmittanceFit | InputError | None] = []
    begun: dict[int, Seen] = {}
    for i, given in enumerate(scans):
        try:
            own, through = prepared(*given)
            begun[i] = unfitted(own, through, noise=noise, weights=weights)
            found.append(None)
        except InputError as error:
            found.append(error)
    for i, seen in zip(begun, looked_through(list(begun.values()), _together), strict=True):
        own = (seen.scan, seen.line, scenario_of("known"), Assumptions())
        found[i] = EmittanceFit(judged_beam(seen), *own, seen)
    return found


def noise_samples(scans: Iterable[tuple[QuadScan, Beamline]], noise: Noise) -> Iterator[Sample]:
    """Scales of the noise by the planes of many scans that are surely a beam's.

    Parameters
    ----------
    scans : iterable of (QuadScan, Beamline)
        Scans that cannot be used are passed over.
    noise : Noise
        The priors to look at them with.
    """
    begun = []
    for given in scans:
        with suppress(InputError):
            begun.append(unfitted(*prepared(*given), noise=noise))
    for seen in looked_through(begun, _together):
        for work in seen.works.values():
            post = work.posterior
            if len(work.sizes.size) > 3 and post.probability[BEAM] > SURE:
                word = work.sizes.likeness[1]
                word = "stated" if word == "share" else word
                yield Sample(word, post.kinds, post.scales, post.by_scale)


def _together(function: Callable[..., Any], given: Sequence[tuple], *static: str) -> list[Any]:
    """Results of a function for each, as NumPy arrays; those of one shape are one call."""
    found: list[Any] = [None] * len(given)
    alike: dict[Any, list[tuple[int, list[Any]]]] = {}
    for i, each in enumerate(given):
        leaves, kind = jax.tree.flatten(each)
        alike.setdefault((kind, *map(np.shape, leaves)), []).append((i, leaves))
    for (kind, *shapes), members in alike.items():
        largest = max(map(np.prod, shapes))
        most = int(np.clip(ROOM // max(largest**2, 1), 1, LANES))
        lanes = min(most, FEW if len(members) <= FEW else LANES)
        for start in range(0, len(members), lanes):
            own = members[start : start + lanes]
            several = _called(function, kind, [leaves for _, leaves in own], lanes, static)
            for lane, (i, _) in enumerate(own):
                found[i] = jax.tree.map(lambda a, lane=lane: a[lane], several)
    return found


def _called(function: Callable[..., Any], kind: Any, rows: list, lanes: int, static: tuple) -> Any:
    """One call; lanes to spare repeat the last."""
    rows = [*rows, *rows[-1:] * (lanes - len(rows))]
    columns = [np.stack(column) for column in zip(*rows, strict=True)]
    return jax.tree.map(np.asarray, _mapped(columns, function, kind, static))


@partial(jax.jit, static_argnums=(1, 2, 3))
def _mapped(columns: list, function: Callable, kind: Any, static: tuple) -> Any:
    def one(leaves: list) -> Any:
        return function(*jax.tree.unflatten(kind, leaves), *static)

    return jax.vmap(one)(columns)
