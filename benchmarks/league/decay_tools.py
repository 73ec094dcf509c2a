"""a and the loss rate at the mean current from a record, by beamfit and by what others offer.

A loss rate, 1/h, stands for the lifetime: it is zero where nothing decays.
"""

from __future__ import annotations

import emcee
import numpy as np
from scipy.optimize import curve_fit

from beamfit.lifetime.fit import DecayFit
from beamfit.lifetime.record import DecayRecord
from beamfit.lifetime.study import study_record
from beamfit.lifetime.systematics import systematics
from beamfit.quantity import HOUR

from ..decay_families import Case
from .answers import Answer, ask, of_draws, of_quantity, of_sigma

# Readings of a piece between refills, for scripts; and a rise of so many scatters is a refill.
FEWEST, RISE = 5, 6.0


def beamfit_fit(case: Case) -> DecayFit:
    """The first answer of the command line: cut into decays, each with its verdict."""
    return study_record(case.record).answers[0].fit


def stands_for(case: Case) -> dict[str, Answer]:
    """`unidentified` speaks against a, not against the lifetime."""
    fit = beamfit_fit(case)
    found, life = {}, fit.lifetime_mean
    if fit.status == "converged" and fit.a.error is not None:
        found["a"] = of_quantity(fit.a)
    if fit.status in ("converged", "unidentified") and life.error is not None:
        low, high = life.interval_95
        rate = 1 / life.value
        found[f"loss {fit.mean_current}"] = Answer(rate, life.error * rate**2, (1 / high, 1 / low))
    return found


def by_beamfit(cases: list[Case]) -> list[dict[str, Answer]]:
    return [ask(stands_for, case) for case in cases]


def says(case: Case, cause: str) -> str:
    """What beamfit says where the data show nothing: its budget's row, else its message."""
    fit = beamfit_fit(case)
    rows = [row for row in systematics(fit) if cause in row.cause]
    if not rows or not fit.a.error:
        return f"status `{fit.status}`: {fit.message.split('. ')[0].rstrip('.')}"
    a, life = fit.a, fit.lifetime_mean
    moved = f"a {100 * rows[0].a / a.value:+.1f} %"
    moved += f", lifetime {100 * rows[0].lifetime_mean / life.value:+.2g} %"
    said = f"a ±{100 * a.error / a.value:.2g} %, lifetime ±{100 * life.error / life.value:.1g} %"
    return f"{said}; budget: *{rows[0].cause}*, {moved}"


def pieces(case: Case) -> list[DecayRecord]:
    """The record between its refills, as a script cuts it whose writer knows that there are any."""
    record = case.record
    if not case.refilled:
        return [record]
    steps = np.diff(record.current)
    scatter = 1.4826 * np.median(np.abs(steps - np.median(steps)))
    cuts = np.flatnonzero(steps > RISE * scatter) + 1
    rows = np.split(np.arange(record.time.size), cuts)
    return [DecayRecord(record.time[r], record.current[r]) for r in rows if r.size >= FEWEST]


def longest(case: Case) -> DecayRecord:
    return max(pieces(case), key=lambda piece: piece.time.size)


def rates(record: DecayRecord, value: np.ndarray, covariance: np.ndarray) -> dict[str, Answer]:
    """Answers from a and b (the last two numbers) and their covariance."""
    mean, freedom = float(record.current.mean()), record.time.size - 3
    freedom = np.inf if record.error is not None else freedom
    a, slope = value[-2], np.array([mean, 1.0])
    spread = float(np.sqrt(slope @ covariance[-2:, -2:] @ slope))
    rate = float(slope @ value[-2:])
    return {
        "a": of_sigma(a, np.sqrt(covariance[-2, -2]), freedom),
        f"loss {mean}": of_sigma(HOUR * rate, HOUR * spread, freedom),
    }


def start(record: DecayRecord) -> tuple[float, float, float]:
    """The current at first, and half of the mean loss rate to each of a and b."""
    good = record.current > 0
    rate = max(-np.polyfit(record.time[good], np.log(record.current[good]), 1)[0], 1e-9)
    return float(record.current[0]), rate / 2 / record.current.mean(), rate / 2


def closed(time, i0, a, b):
    """Report equation 44."""
    return i0 * np.exp(-b * time) / (1 + i0 * a * -np.expm1(-b * time) / b)


def by_scipy(case: Case) -> dict[str, Answer]:
    """The script one writes: curve_fit of report equation 44."""

    def law(*given):
        with np.errstate(all="ignore"):
            return closed(*given)

    record = longest(case)
    known = record.error is not None
    return rates(
        record, *curve_fit(law, record.time, record.current, start(record), record.error, known)
    )


def by_lmfit(case: Case) -> dict[str, Answer]:
    """The same with a and b bounded at zero."""
    import lmfit

    record = longest(case)
    first = start(record)
    model = lmfit.Model(closed, independent_vars=["time"])
    parameters = model.make_params(i0=first[0])
    parameters.add("a", first[1], min=0)
    parameters.add("b", first[2], min=0)
    weights = None if record.error is None else 1 / record.error
    found = model.fit(record.current, parameters, time=record.time, weights=weights)
    if not (found.success and found.errorbars):
        return {}
    value = np.array([found.params[n].value for n in ("i0", "a", "b")])
    return rates(record, value, found.covar)


def by_logarithm(case: Case) -> dict[str, Answer]:
    """The control room's: straight lines through log I between refills; the lifetime alone."""
    found = []
    for piece in pieces(case):
        slope, covariance = np.polyfit(piece.time, np.log(piece.current), 1, cov=True)
        found.append((-HOUR * slope[0], HOUR * covariance[0, 0] ** 0.5, piece.time.size - 2))
    rate, error, freedom = np.array(found).T
    name = f"loss {case.record.current.mean()}"
    if len(found) == 1:
        return {name: of_sigma(rate[0], error[0], freedom[0])}
    weight = error**-2 / np.sum(error**-2)
    return {name: of_sigma(weight @ rate, np.sum(error**-2) ** -0.5, freedom.sum())}


def by_emcee(case: Case, walkers: int = 32, steps: int = 300) -> dict[str, Answer]:
    """A posterior by hand: white noise (of the file, else one more number), a and b from zero."""
    record = longest(case)
    time, current, error = record.time, record.current, record.error
    first = np.array(start(record))
    spread = error if error is not None else np.std(np.diff(current)) / 2**0.5

    def log_probability(p):
        with np.errstate(all="ignore"):
            scaled = first * np.exp(np.clip(p[:, :3], -50, 20))
            model = closed(time, *scaled.T[:, :, None])
            noise = spread * np.exp(p[:, 3:] if error is None else 0.0)
            value = -np.sum(0.5 * ((model - current) / noise) ** 2 + np.log(noise), 1)
        # flat in a and b, not in their logarithms
        return np.where(np.isfinite(value), value + p[:, 1] + p[:, 2], -np.inf)

    sizes = np.array([1e-4, 0.1, 0.1] + [0.1] * (error is None))
    begin = sizes * np.random.default_rng(1).normal(size=(walkers, len(sizes)))
    sampler = emcee.EnsembleSampler(walkers, len(sizes), log_probability, vectorize=True)
    sampler._random.seed(1)
    sampler.run_mcmc(begin, steps)
    a, b = (first[1:] * np.exp(sampler.get_chain(discard=steps // 2, flat=True)[:, 1:3])).T
    mean = float(current.mean())
    return {"a": of_draws(a), f"loss {mean}": of_draws(HOUR * (a * mean + b))}


# Name: (tool, one of how many draws it is given); beamfit is given a list of them.
TOOLS = {
    "beamfit": (by_beamfit, 1),
    "curve_fit": (by_scipy, 1),
    "lmfit": (by_lmfit, 1),
    "emcee": (by_emcee, 10),
    "line through log I": (by_logarithm, 1),
}
