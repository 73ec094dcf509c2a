"""a, b and the lifetime at the mean current from a record, by beamfit and by what others offer."""

from __future__ import annotations

import emcee
import numpy as np
from scipy.optimize import curve_fit

from beamfit.lifetime.record import DecayRecord
from beamfit.lifetime.study import study_record
from beamfit.lifetime.systematics import systematics

from .answers import Answer, ask, of_quantity
from .decays import HOUR, Decay, closed

__all__ = ["systematics"]


def beamfit_fits(case: Decay) -> list:
    """What the command line does: cut into decays, each with its verdict."""
    study = study_record(DecayRecord(case.time, case.current, case.error))
    return [*(pooled.fit for pooled in study.pooled), *(one.fit for one in study.decays)]


def told(case: Decay) -> dict[str, Answer]:
    """Every decay's answers; lifetimes stand beside `unidentified` (a and b), nothing else does."""
    found = {}
    for k, fit in enumerate(beamfit_fits(case)):
        if fit.status not in ("converged", "unidentified"):
            continue
        for name in ("a", "b"):
            quantity = getattr(fit, name)
            if fit.status == "converged" and quantity.error is not None:
                found[f"{name} {k}"] = of_quantity(quantity)
        life = fit.lifetime_mean
        if life.error is not None:
            found[f"lifetime {k} {fit.mean_current}"] = of_quantity(life, HOUR)
    return found


def by_beamfit(cases: list[Decay]) -> list[dict[str, Answer]]:
    return [ask(told, case) for case in cases]


def rates(case: Decay, value: np.ndarray, covariance: np.ndarray) -> dict[str, Answer]:
    """Answers from a and b (the last two numbers) and their covariance."""
    mean = float(case.current.mean())
    (a, b), error = value[-2:], np.sqrt(np.diag(covariance)[-2:])
    slope = np.array([mean, 1.0])
    rate, spread = a * mean + b, float(np.sqrt(slope @ covariance[-2:, -2:] @ slope))
    return {"a": Answer(a, error[0]), "b": Answer(b, error[1])} | lifetime(mean, rate, spread)


def lifetime(mean: float, rate: float, error: float) -> dict[str, Answer]:
    return {f"lifetime 0 {mean}": Answer(1 / rate, error / rate**2)}


def start(case: Decay) -> tuple[float, float, float]:
    """The current at first, and half of the mean loss rate to each of a and b."""
    good = case.current > 0
    rate = max(-np.polyfit(case.time[good], np.log(case.current[good]), 1)[0], 1e-9)
    return float(case.current[0]), rate / 2 / case.current.mean(), rate / 2


def by_scipy(case: Decay) -> dict[str, Answer]:
    """curve_fit of report equation 44."""

    def law(t, i0, a, b):
        with np.errstate(all="ignore"):
            return i0 * np.exp(-b * t) / (1 + i0 * a * -np.expm1(-b * t) / b)

    known = case.error is not None
    return rates(case, *curve_fit(law, case.time, case.current, start(case), case.error, known))


def by_lmfit(case: Decay) -> dict[str, Answer]:
    """The same with a and b bounded at zero."""
    import lmfit

    first = start(case)
    model = lmfit.Model(closed, independent_vars=["time"])
    parameters = model.make_params(i0=first[0])
    parameters.add("a", first[1], min=0)
    parameters.add("b", first[2], min=0)
    weights = None if case.error is None else 1 / case.error
    found = model.fit(case.current, parameters, time=case.time, weights=weights)
    if not (found.success and found.errorbars):
        return {}
    return rates(case, np.array([found.params[n].value for n in ("i0", "a", "b")]), found.covar)


def by_logarithm(case: Decay) -> dict[str, Answer]:
    """The control room's: a straight line through log I; the lifetime alone."""
    slope, covariance = np.polyfit(case.time, np.log(case.current), 1, cov=True)
    return lifetime(float(case.current.mean()), -float(slope[0]), float(covariance[0, 0] ** 0.5))


def by_emcee(case: Decay, walkers: int = 32, steps: int = 300) -> dict[str, Answer]:
    """A posterior by hand: white noise (of the file, else one more number), a and b from zero."""
    first = np.array(start(case))
    spread = case.error if case.error is not None else np.std(np.diff(case.current)) / 2**0.5

    def log_probability(p):
        with np.errstate(all="ignore"):
            scaled = first * np.exp(np.clip(p[:, :3], -50, 20))
            i0, a, b = scaled.T[:, :, None]
            model = i0 * np.exp(-b * case.time) / (1 + i0 * a * -np.expm1(-b * case.time) / b)
            noise = spread * np.exp(p[:, 3:] if case.error is None else 0.0)
            value = -np.sum(0.5 * ((model - case.current) / noise) ** 2 + np.log(noise), 1)
        # flat in a and b, not in their logarithms
        return np.where(np.isfinite(value), value + p[:, 1] + p[:, 2], -np.inf)

    sizes = np.array([1e-4, 0.1, 0.1] + [0.1] * (case.error is None))
    begin = sizes * np.random.default_rng(1).normal(size=(walkers, len(sizes)))
    sampler = emcee.EnsembleSampler(walkers, len(sizes), log_probability, vectorize=True)
    sampler._random.seed(1)
    sampler.run_mcmc(begin, steps)
    chain = first * np.exp(sampler.get_chain(discard=steps // 2, flat=True)[:, :3])
    return rates(case, np.median(chain, 0), np.cov(chain.T))


# Name: (tool, one of how many draws it is given); beamfit is given a list of them.
TOOLS = {
    "beamfit": (by_beamfit, 1),
    "scipy curve_fit": (by_scipy, 1),
    "lmfit": (by_lmfit, 2),
    "emcee by hand": (by_emcee, 10),
    "line through log I": (by_logarithm, 1),
}
