"""Order of a linear state space: fits of rising order and their information criterion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from beamfit.dynamics.case import Case, Settled, information, used_by
from beamfit.dynamics.model import CLOSE
from beamfit.dynamics.noise import noise_of
from beamfit.dynamics.realise import LINEAR, normal_form, padded, realisations
from beamfit.dynamics.shooting import LONGEST, trained
from beamfit.greybox.problem import Free
from beamfit.noise.correlated import Noise, remembers

# State counts of the compiled searches (unused states are held at 0), and number of orders without
# improvement that ends the search.
SIZES, BEYOND = (4, 10), 2
# Starts searched for each order, the best predictors; readings needed for each free number.
BEGINS, EACH = 2, 3
# Pole, and weight in the output, of a state that is added to an order.
NEW, FAINT = 0.6, 1e-3


class Tried(NamedTuple):
    """A fit of an order, with a direct path from inputs to outputs or without."""

    order: int
    direct: bool
    case: Case
    found: Settled


def count_of(case: Case) -> int:
    """Number of readings."""
    return sum(len(m) for s in case.seen for m in s.measured)


def largest_order(case: Case) -> int:
    """The largest order that leaves a few readings to each free number."""
    k, m = len(case.seen), len(case.seen[0].inputs)
    return int((count_of(case) / EACH - k * (m + 1)) / (m + k + len(case.courses)))


def orders(case: Case, order: int | None, offset: bool) -> tuple[Tried, list[dict[str, Any]]]:
    """Fit 1, 2, … states, or as many as asked for; give the best, and what was tried."""
    tried: list[Tried] = []
    for n in [order] if order else range(1, min(SIZES[-1], largest_order(case)) + 1):
        tried.append(_tried(case, n, offset, tried[-1] if tried else None))
        told = criterion(case, [t.found for t in tried])
        if n - tried[int(np.argmin(told))].order >= BEYOND:
            break
    full = tried[int(np.argmin(told))]
    model = full.found.fit.model
    p = model["p"] | {"d": model["p"]["d"].at[:, : len(case.seen[0].inputs)].set(0.0)}
    bounded = case._replace(free=free_of(case, full.order, len(p["z"]), offset, False))
    plain = Tried(full.order, False, bounded, trained(bounded, [model | {"p": p}]))
    tried.append(plain)
    told = criterion(case, [t.found for t in tried], tried[-2].found)
    best = plain if told[-1] <= min(told[:-1]) else full
    return best, [{"order": t.order, "direct": t.direct, "bic": v}
                  for t, v in zip(tried, told, strict=True)]  # fmt: skip


def criterion(case: Case, found: Sequence[Settled], last: Settled | None = None) -> list[float]:
    """The Bayesian information criterion of fits under the noise, with its memory, of the last."""
    noise = _noise_of(case, last or found[-1])
    return [information(case, each, noise) for each in found]


def _noise_of(case: Case, found: Settled) -> Noise | None:
    """The noise with a memory of residuals that have one; slopes are left out for speed."""
    rows = case.rows(found.rest)
    if not any(remembers(rest, used_by(found.fit)) for rest, _, _ in rows):
        return None
    scaled = [rest[:LONGEST, None] / max(float(rest.std()), CLOSE * s.size_y)
              for rest, _, s in rows]  # fmt: skip
    return noise_of(scaled, [time[:LONGEST] for _, time, _ in rows], np.zeros((0, 1)))[1]


def free_of(case: Case, order: int, size: int, offset: bool, direct: bool) -> tuple[Free, ...]:
    """Free numbers of a model of `size` states; those beyond the order are held at 0."""
    k, m, runs = len(case.seen), len(case.seen[0].inputs), len(case.courses)
    used, straight = np.arange(size) < order, np.full((k, m + offset), direct)
    straight[:, m:] = True
    start = np.tile(used, (runs, 1))
    start[0] &= not offset  # where the first run begins, the offsets of a linear system say
    parts = {"p.z": np.tile(used[:, None], (1, m + offset)), "p.c": np.tile(used, (k, 1))}
    parts |= {"p.d": straight, "start": start}
    return tuple(Free(name, np.where(on, -np.inf, 0.0), np.where(on, np.inf, 0.0), nuisance=True)
                 for name, on in parts.items())  # fmt: skip


def _tried(case: Case, n: int, offset: bool, before: Tried | None) -> Tried:
    """The fit of an order from its best realisations, and from the order before and one more."""
    size = next((s for s in SIZES if s >= n), n)
    bounded = case._replace(free=free_of(case, n, size, offset, True))
    units, k = _units(case, offset), len(case.seen)
    u, y = _scaled(case, units, offset)
    m, rest = u[0].shape[1], np.zeros((len(y), n))

    def model(a, b, c, d, start=rest):
        around, c, to = normal_form(a, b, c)
        p = {"z": np.zeros((n, m)), "around": around, "c": c, "d": d, "units": units}
        return padded({"p": p, "start": start @ to.T}, size)

    models = [model(*found) for found in realisations(u, y, n)]
    missed = [case.squares(case.rest(each)) for each in models]
    best = [i for i in np.argsort(missed, kind="stable") if np.isfinite(missed[i])]
    models = [models[i] for i in best[:BEGINS]]
    if before is not None:
        old, last = before.order, before.found.fit.model
        a, b, c, d, _ = map(np.asarray, LINEAR.matrices(last["p"]))
        a = np.diag([*np.zeros(old), NEW]) + np.pad(a[:old, :old], ((0, 1), (0, 1)))
        b, c = np.vstack([b[:old], np.ones(m)]), np.hstack([c[:, :old], np.full((k, 1), FAINT)])
        start = np.pad(np.asarray(last["start"])[:, :old], ((0, 0), (0, 1)))
        models.append(model(a, b, c, d, start))
    if not models:  # runs too short for a regression
        a = np.diag(NEW ** np.arange(1.0, n + 1))
        models = [model(a, np.ones((n, m)), np.full((k, n), FAINT), np.zeros((k, m)))]
    return Tried(n, True, bounded, trained(bounded, models))


def _units(case: Case, offset: bool) -> dict[str, np.ndarray]:
    """Mean and size of inputs and outputs; without an offset all is about 0."""
    seen = case.seen[0]
    y = np.array([np.mean(np.concatenate(s.measured)) for s in case.seen])
    return {
        "u": np.stack([offset * seen.mean_u, seen.wide]),
        "y": np.stack([offset * y, [s.size_y for s in case.seen]]),
    }


def _scaled(
    case: Case, units: dict[str, np.ndarray], offset: bool
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Inputs (with a 1) and outputs of the runs in units, unpadded; missing readings bridged."""
    u, y = [], []
    for i, run in enumerate(case.seen[0].runs):
        count = int(np.count_nonzero(np.asarray(run.dt))) + 1
        each = (np.asarray(run.u)[:count] - units["u"][0]) / units["u"][1]
        u.append(np.pad(each, ((0, 0), (0, int(offset))), constant_values=1.0))
        read = [np.interp(np.arange(count), np.asarray(s.runs[i].index), s.measured[i])
                for s in case.seen]  # fmt: skip
        y.append((np.stack(read, axis=1) - units["y"][0]) / units["y"][1])
    return u, y
