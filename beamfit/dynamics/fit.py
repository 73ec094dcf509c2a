"""Fit of a response to runs: start, delay, free-running fit, noise with a memory, verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtri

from beamfit.answer import Table, answer, json_of
from beamfit.dynamics.alternatives import FURTHER, GROWTH, Alternatives, alternatives_of
from beamfit.dynamics.answer import (
    Curve,
    ResponseEvidence,
    curves_of,
    judged,
    limit_words,
    quantities_of,
    quoted,
    remarked,
    told,
)
from beamfit.dynamics.bad_readings import BadReadings, judged_without
from beamfit.dynamics.checks import Checks, HeldOutRun, changing_of, checks_of, digits_of, held_out
from beamfit.dynamics.limits import RANGE, lag_posterior
from beamfit.dynamics.model import PreparedOutput, network_of, output_of
from beamfit.dynamics.paths import Paths, heard, latest
from beamfit.dynamics.record import LEAST, Run, check_inputs, checked, unsure_gain
from beamfit.dynamics.response import PHYSICS, mean_step
from beamfit.dynamics.search import Begun, ResponseSearch, Settled, case_of, fitted, used_by
from beamfit.errors import InputError, Status, nearest
from beamfit.greybox.fit import Fit
from beamfit.noise.memory import CorrelatedNoise
from beamfit.quantity import Quantity
from beamfit.statistics import POOR_FIT

MAPS = ("constant", "network")
# Most searches by a path that was likelier than that of the search before.
AGAIN = 3


@answer
@dataclass(frozen=True, eq=False)
class ResponseFit:
    """An identified response of one output.

    Attributes
    ----------
    output : str
        Which.
    status : Status
        How far to believe it; ``message`` says why and what to do.
    model, map : str
        The physics, and what gives its parameters.
    delay : float
        Samples by which the output follows the inputs late.
    runs : tuple of Run
        What it was identified from.
    seen : PreparedOutput
        The same as the model sees it.
    fit : Fit
        The grey-box fit.
    quantities : dict of str to Quantity
        Constant parameters, and the offset, with errors.
    curves : tuple of Curve
        Parameters against the operating point, of a network.
    noise : tuple of float
        Rms residual of each run.
    memory : CorrelatedNoise or None
        How the noise wanders; None where it does not.
    checks : Checks
        What the residuals say.
    held : tuple of HeldOutRun
        How runs are predicted that were not used.
    left_out : tuple of BadReadings
        Readings that show no output; they are missing from ``runs`` and ``seen``.
    """

    output: str
    status: Status
    message: str
    model: str
    map: str
    delay: float
    runs: tuple[Run, ...]
    seen: PreparedOutput
    fit: Fit
    quantities: dict[str, Quantity]
    curves: tuple[Curve, ...]
    noise: tuple[float, ...]
    memory: CorrelatedNoise | None
    checks: Checks
    held: tuple[HeldOutRun, ...] = ()
    left_out: tuple[BadReadings, ...] = ()

    @property
    def parts(self) -> tuple[ResponseFit]:
        """Itself: the outputs it has pictures of."""
        return (self,)

    @property
    def headline(self) -> str:
        """The answer in a line."""
        said = [f"{name} = {q}" for name, q in list(self.quantities.items())[:3]]
        found = ", ".join(said) or f"{len(self.curves)} parameter curves"
        return f"{self.output} {self.status}: {self.model}, {found}"

    @cached_property
    def fitted(self) -> tuple[np.ndarray, ...]:
        """The free-running output at the readings of each run."""
        return tuple(output_of(self.fit.model, run) for run in self.seen.runs)

    def tables(self) -> tuple[Table, ...]:
        """All numbers, to be shown."""
        rows = [[name, f"{q} {limit_words(q)}".rstrip()] for name, q in self.quantities.items()]
        rows += [["delay", f"{self.delay:.4g} samples"]]
        rows += self.checks.rows() + [each.row() for each in self.held]
        found = [Table(f"{self.output} ({self.model}, {self.map} parameters)", [], rows)]
        return (*found, *(curve.table() for curve in self.curves))

    def to_json(self) -> dict[str, Any]:
        """Give one entry of ``results`` in the JSON contract."""
        names = ("output", "status", "message", "model", "map")
        return json_of({
            **{name: getattr(self, name) for name in names},
            "records": [run.path or run.name for run in self.runs],
            "delay_samples": self.delay, "parameters": self.quantities, "curves": self.curves,
            "noise_rms": self.noise, "noise_memory": self.memory,
            "checks": self.checks, "held_back": self.held, "left_out": self.left_out,
        })  # fmt: skip


def identify(
    runs: Run | Sequence[Run],
    model: str = "first-order",
    map: str = "constant",
    *,
    output: str | None = None,
    delay: float | None = None,
    offset: bool = True,
    hidden: int = 5,
    starts: int = 3,
    seed: int = 0,
    held: Sequence[Run] = (),
) -> ResponseFit:
    """Identify the response of an output to the inputs of some runs.

    Parameters
    ----------
    runs : Run or sequence of Run
        Records with the same inputs and outputs.
    model : {"first-order", "second-order", "arx"}
        tau y' + y = K u (report eq 5); T² y'' + 2 zeta T y' + y = K u, which is eq 8 with
        T² = tau1 tau2 and 2 zeta T = tau1 + tau2; or the difference equation (eq 12), stable by
        construction.
    map : {"constant", "network"}
        Whether parameters are numbers, or a network of the inputs at each moment.
    output : str, optional
        Which output, if the runs have several.
    delay : float, optional
        Samples by which the output follows late; found among candidates if None. What is no whole
        number is estimated besides, with an error. Below zero where the clocks of input and output
        differ.
    offset : bool
        Whether the output at rest is a free number; else it is 0.
    hidden, starts, seed : int
        Hidden nodes of the network, starts of its training, seed of their weights.
    held : sequence of Run
        Runs that are only predicted.

    Returns
    -------
    ResponseFit

    Raises
    ------
    InputError
        If runs do not fit together, an option is unknown, no input ever changes, or samples of
        ``"arx"`` are not at equal distances.

    Notes
    -----
    The output runs free from the start of each run (output error): predictions from measured
    outputs are useless under noise. The first states are estimated. Noise is inferred from the
    residuals, with a correlation time where neighbours are correlated. Sources: report 3.2;
    L. Ljung, System Identification (1999), chapters 7 and 16.

    Examples
    --------
    >>> t = np.arange(60.0)
    >>> u = (t // 15) % 2
    >>> y = [0.0]
    >>> for value in u[:-1]:
    ...     y.append(2.0 * value + (y[-1] - 2.0 * value) * np.exp(-1 / 5.0))
    >>> noise = 0.01 * np.random.default_rng(0).normal(size=60)
    >>> fit = identify(Run(t, {"valve": u}, {"level": y + noise}))
    >>> fit.status.value, fit.delay, abs(fit.quantities["tau"].value - 5.0) < 0.1
    ('converged', 0, True)
    """
    if model not in PHYSICS:
        raise InputError(f"model '{model}'", nearest(model, list(PHYSICS)))
    if map not in MAPS:
        raise InputError(f"map '{map}'", nearest(map, list(MAPS)))
    runs, held = checked(runs, held, PHYSICS[model].even)
    check_inputs(runs)
    output = _output(runs[0], output)
    shortest = min(len(run) for run in runs)
    if delay is not None and min(heard(run, output, delay).size for run in runs) < LEAST:
        expected = f"less than the {shortest} rows of a run by {LEAST} readings"
        raise InputError(f"a delay of {delay:g} samples", expected)
    paths = Paths.of(runs, delay, PHYSICS[model].even)
    search = ResponseSearch(output, PHYSICS[model], paths, offset)
    asked = _Identification(search, map, hidden, range(seed, seed + starts), held)
    return judged_without(runs, [asked.begun], lambda trial: trial.fit, asked.answer)


class _Trial(NamedTuple):
    """A fit with constant parameters; where a network was asked for by the likeliest path, with
    what was compared with it, and with a network.
    """

    constant: Begun
    others: Alternatives | None = None
    network: Begun | None = None

    @property
    def fit(self) -> Begun:
        """The fit that was asked for."""
        return self.network or self.constant


class _Identification(NamedTuple):
    """Settings of an identification."""

    search: ResponseSearch
    map: str
    hidden: int
    seeds: range
    held: tuple[Run, ...]

    def begun(self, runs: tuple[Run, ...]) -> _Trial:
        """The fit that readings are judged by: constants miss good ones where parameters change."""
        found = self.search.begun(runs)
        if self.map == "constant":
            return _Trial(found)
        found, others = self.likeliest(runs, found)
        return _Trial(found, others, self.with_network(found))

    def answer(
        self, runs: tuple[Run, ...], trial: _Trial, left_out: tuple[BadReadings, ...]
    ) -> ResponseFit:
        """Judge a fit of runs."""
        output, physics, paths, _ = self.search
        found, others, network = trial
        if network is None:
            found, others = self.likeliest(runs, found)
        whole = network or found
        answer, exact = whole.settled, whole.exact
        checks, quantities, curves = self.known(runs, found, answer, others)
        ahead = held_out(whole, self.held)[output]
        rms = float(np.sqrt(np.mean(answer.rms**2)))
        status, message = judged({output: ResponseEvidence(
            answer.fit, answer.rests, checks, quantities, curves, ahead, self.map, rms,
            0.0 if paths.given else _early(whole, others, quantities),
        )})  # fmt: skip
        quantities, curves = quoted(status, quantities, curves)
        message = remarked(message, not paths.given and exact == latest(runs) > 0, left_out)
        return ResponseFit(
            output, status, message, physics.name, self.map,
            int(exact) if exact == int(exact) else exact, runs, found.seen, answer.fit, quantities,
            curves, tuple(answer.rms[:, 0].tolist()), answer.memory, checks, ahead, left_out,
        )  # fmt: skip

    def likeliest(self, runs: tuple[Run, ...], found: Begun) -> tuple[Begun, Alternatives | None]:
        """The fit by the likeliest path without a law, and the alternatives to it."""
        for left in reversed(range(AGAIN)):
            if found.settled.exact(found.case):
                return found, None
            slopes = changing_of(found.seen, found.settled.fit)
            lawful = self.map == "constant"
            others = alternatives_of(runs, found, self.search.paths, slopes, lawful)
            if others.path == found.path or not left:
                break
            found = self.search.along(runs, others.path, found.settled.fit.model)
        return found, others

    def with_network(self, found: Begun) -> Begun:
        """The best fit with a network of parameters, from the constant ones."""
        seen, first = found.seen, found.settled.fit.model
        nets = (network_of(seen, self.search.physics, np.asarray(first["map"]), self.hidden, seed)
                for seed in self.seeds)  # fmt: skip
        case = case_of(seen, self.search.offset, True)
        models = [first | {"map": net} for net in nets]
        return found._replace(case=case, settled=fitted(case, models))

    def known(
        self,
        runs: tuple[Run, ...],
        found: Begun,
        answer: Settled,
        others: Alternatives | None,
    ) -> tuple[Checks, dict[str, Quantity], tuple[Curve, ...]]:
        """Tests of the residuals, and what the runs determine of constants or curves."""
        seen, constant = found.seen, self.map == "constant"
        _, _, paths, offset = self.search
        used = used_by(answer.fit) + (not paths.given and not seen.ends)  # a delay found counts
        gain = None if constant else found.settled.likelihood - answer.likelihood
        whole = found._replace(settled=answer)
        checks = checks_of(whole, 0, changing_of(seen, answer.fit), used, gain)._replace(
            first_order=constant and self.search.is_first_order(runs, found),
            band_limited=() if found.path.way.moving else paths.most.smooth,
        )
        if not constant:
            curves = curves_of(answer.fit, answer.errors, seen)
            return checks, *told({}, curves, seen, checks)
        if others is not None and others.departure.probability > 0.5:
            words, kind, chance = others.departure
            if checks.input_share or kind not in (FURTHER, GROWTH):  # more than digits do
                checks = checks._replace(law=words, law_probability=chance, law_kind=kind)
        unsure = [unsure_gain(runs, found.path.way, name) for name in seen.inputs]
        lags = lag_posterior(found, offset)
        row = float(mean_step(seen.runs[0].dt))
        late = others.late * seen.parts * row if others is not None else 0.0
        quantities = quantities_of(found, others, late, lags, digits_of(found), unsure)
        return checks, *told(quantities, (), seen, checks, lags.limits(late))


def _early(found: Begun, others: Alternatives | None, quantities: Mapping[str, Quantity]) -> float:
    """Samples by which the output moves before its inputs; 0 unless that is likely, or of an exact
    output clear of the error of the delay and of the shortest lag, which is never quite 0.
    """
    delay = quantities.get("delay")
    if others is not None:
        likely = others.ahead >= 0.5
    elif delay is None or delay.error is None:
        likely = True
    else:
        row = float(mean_step(found.seen.runs[0].dt))
        likely = delay.value + RANGE[0] * row < ndtri(POOR_FIT) * delay.error
    return max(-found.exact, 0.0) if likely else 0.0


def _output(run: Run, output: str | None) -> str:
    names = list(run.outputs)
    if output is not None and output not in names:
        raise InputError(f"no output '{output}'", nearest(output, names))
    if output is None and len(names) > 1:
        raise InputError(f"{len(names)} outputs", f"one of {', '.join(names)}")
    return output or names[0]
