"""Errors of screen, beam and line as parameters with priors, in any scenario.

What the budget lists one by one (sensitivity.py) is here free, within what is known of it: the
error of the emittance then holds statistics and systematics, and says which of them it is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from beamfit.emittance.assumptions import Assumptions
from beamfit.emittance.model import spoken
from beamfit.emittance.results import Parameter
from beamfit.emittance.statement import PreparedScan, Scenario
from beamfit.errors import InputError, nearest
from beamfit.greybox.fit import Fit
from beamfit.greybox.problem import Free, Prior, Problem
from beamfit.optics.elements import Drift, Quadrupole, ThinLens

# Free numbers end so many standard deviations of their prior away.
REACH = 6.0
# Units of the numbers that are one for all elements, and what they are where nobody says.
UNITS = {
    "size_scale": ("1", 1.0),
    "resolution": ("m", None),
    "wire": ("m", None),
    "energy": ("1", 1.0),
    "dispersion": ("m", 0.0),
    "dispersion_slope": ("1", 0.0),
}
# How far the mean of a relative prior may be from what line and scan say.
NEAR = (0.8, 1.25)
POSITIVE = ("size_scale", "resolution", "wire", "energy")


class Term(NamedTuple):
    """A number with a prior: as users call it, where it stands, mean, deviation, bounds, unit."""

    name: str
    path: str
    mean: float
    sd: float
    lower: float
    upper: float
    unit: str


def with_systematics(scenario: Scenario, told: Assumptions) -> Scenario:
    """Free the numbers of screen, beam and line that have priors, besides a scenario's own.

    Parameters
    ----------
    scenario : Scenario
        Any.
    told : Assumptions
        With priors on ``size_scale``, ``resolution`` and ``wire`` (the rms of a round wire is a
        quarter of its diameter), ``energy``, ``dispersion`` and ``dispersion_slope`` of the
        incoming beam, ``NAME.gradient`` of magnets and ``NAME.length`` of drifts.

    Returns
    -------
    Scenario
        The same one if there are none.
    """
    if not told.systematics:
        return scenario

    def state(seen: PreparedScan, told: Assumptions) -> Problem:
        terms = _terms(seen, told)
        magnets = [t.name.rpartition(".")[0] for t in terms if "." in t.name]
        seen = seen.keeping(magnets, any_energy="energy" in told.systematics)
        problem = scenario.state(seen, told)
        return replace(
            problem,
            model=problem.model | {"systematics": _numbers(terms)},
            free=[*problem.free, *(Free(t.path, t.lower, t.upper) for t in terms)],
            priors=[*problem.priors, *(Prior(t.path, t.mean, t.sd) for t in terms)],
        )

    def parameters(seen: PreparedScan, told: Assumptions, fit: Fit) -> Iterator[Parameter]:
        yield from scenario.parameters(seen, told, fit)
        for term in _terms(seen, told):
            prior = term.mean, term.sd
            yield Parameter.of(term.name, fit[term.path], term.unit, prior)

    return replace(scenario, state=state, parameters=parameters, closed=False)


def _numbers(terms: list[Term]) -> dict[str, Any]:
    """The part of a model that has them, at their means."""
    model: dict[str, Any] = {}
    for term in terms:
        *path, last = term.path.split(".")[1:]
        part = model.setdefault(path[0], {}) if path else model
        part[last] = term.mean
    return model


def _terms(seen: PreparedScan, told: Assumptions) -> list[Term]:
    """The numbers of a scan and its line that priors were given for."""
    return [_term(seen, name, *prior) for name, prior in told.systematics.items()]


def _term(seen: PreparedScan, name: str, mean: float | None, sd: float) -> Term:
    element, _, what = name.rpartition(".")
    if element:
        own, unit = _of_element(seen, element, what)
        path, positive = f"systematics.{what}.{element}", what == "length"
    else:
        (unit, own), path, positive = UNITS[name], f"systematics.{name}", name in POSITIVE
        if name == "resolution":
            own = float(np.sqrt(np.mean(np.square(seen.rows.resolution))))
        if name == "wire" and mean is None:
            raise InputError("a wire without its diameter", "wire=DIAMETER+-SD, in metres")
        if name.startswith("dispersion") and not np.any(seen.rows.spread):
            expected = "energy_spread in the lattice or the scan"
            raise InputError(f"a prior on {name} without a momentum spread", expected)
    mean = own if mean is None else mean
    if name == "energy" and not NEAR[0] <= mean <= NEAR[1]:
        # 135+-1 is an energy in MeV, where a share of the line's is meant.
        mean, sd = mean / seen.energy, sd / seen.energy
    if unit == "1" and own == 1.0 and not NEAR[0] <= mean <= NEAR[1]:
        expected = f"{name}=1+-0.02: relative to what line and scan say, within 20 %"
        raise InputError(f"a prior {name} = {mean:.4g} ± {sd:.3g}", expected)
    low = mean - REACH * sd
    return Term(name, path, mean, sd, max(low, 0.0) if positive else low, mean + REACH * sd, unit)


def _of_element(seen: PreparedScan, name: str, what: str) -> tuple[float, str]:
    kinds = {"gradient": (Quadrupole, ThinLens), "length": (Drift,)}[what]
    known = [e.name for e in seen.scanned.elements if isinstance(e, kinds)]
    if name not in known:
        raise InputError(f"a prior on {name}.{what}", f"{nearest(name, known)}, with .{what}")
    return (1.0, "1") if what == "gradient" else (float(seen.scanned[name].length), "m")


def effect_words(fit: Fit, told: Assumptions, emittance: float, slope: np.ndarray) -> str:
    """Take the error of an emittance apart, and name its largest part.

    Parameters
    ----------
    fit : Fit
        Of a problem from `with_systematics`.
    told : Assumptions
        With the priors.
    emittance, slope : float and ndarray
        The emittance and its derivatives by the free numbers.

    Returns
    -------
    str
        Empty where no such number is free.

    Notes
    -----
    With the covariance C of all free numbers a number s moves the emittance by cov(ε, s)/sd(s);
    what is left with all s known is the Schur complement C_εε - C_εs C_ss⁻¹ C_sε.
    """
    places = {
        spoken(name): i for i, name in enumerate(fit.problem.names) if spoken(name) in told.priors
    }
    if not told.systematics or not emittance > 0:
        return ""
    covariance, at = fit.covariance, list(places.values())
    variance, across = float(slope @ covariance @ slope), covariance[at] @ slope
    own = covariance[np.ix_(at, at)]
    sd = np.sqrt(np.maximum(np.diag(own), 1e-300))
    rest = max(variance - float(across @ np.linalg.pinv(own, hermitian=True) @ across), 0.0)
    most, name = max(zip((np.abs(across) / sd).tolist(), places, strict=True))
    parts = math.sqrt(max(variance, 0.0)), math.sqrt(rest), most
    total, statistical, most = (100 * part / emittance for part in parts)
    return (
        f" Of its error of {total:.2g} % statistics makes {statistical:.2g} %; the largest "
        f"systematic is {name} with {most:.2g} %."
    )
