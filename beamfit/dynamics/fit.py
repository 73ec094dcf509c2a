"""Identification of a response: start, delay, free-running fit, correlated noise, verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtri

from beamfit.answer import Table, answer, json_of
from beamfit.dynamics.alternatives import (
    FURTHER,
    GROWTH,
    HIGHER,
    Alternatives,
    alternatives_of,
)
from beamfit.dynamics.answer import (
    Curve,
    ResponseEvidence,
    add_remarks,
    curves_of,
    judge_outputs,
    limit_words,
    open_undetermined,
    remove_errors_if_wrong,
    response_quantities,
)
from beamfit.dynamics.bad_readings import BadReadings, answer_without_bad_readings
from beamfit.dynamics.checks import (
    Checks,
    HeldOutRun,
    checks_of,
    digit_covariance,
    fuller_model_slopes,
    predict_runs,
)
from beamfit.dynamics.limits import LAG_RANGE, lag_posterior
from beamfit.dynamics.model import PreparedOutput, network_of, predict_readings
from beamfit.dynamics.paths import Paths, max_delay, usable_rows
from beamfit.dynamics.record import MIN_READINGS, Run, check_inputs, check_runs, gain_error_share
from beamfit.dynamics.response import PHYSICS, mean_step
from beamfit.dynamics.search import (
    ResponseSearch,
    RunsFit,
    effective_parameters,
    fit_case,
    response_case,
)
from beamfit.errors import InputError, Status, nearest
from beamfit.greybox.fit import Fit
from beamfit.noise.memory import CorrelatedNoise
from beamfit.quantity import Quantity
from beamfit.statistics import POOR_FIT

MAPS = ("constant", "network")
# Largest number of searches, each for a path that is more probable than the one before.
MAX_PATH_SEARCHES = 3


@answer
@dataclass(frozen=True, eq=False)
class ResponseFit:
    """An identified response of one output.

    Attributes
    ----------
    output : str
        Name of the output.
    status : Status
        How far to believe it; ``message`` says why and what to do.
    model, map : str
        The physics, and what gives its parameters.
    delay : float
        Samples by which the output follows the inputs.
    runs : tuple of Run
        Runs that it was identified from.
    seen : PreparedOutput
        The runs as the model sees them.
    fit : Fit
        The grey-box fit.
    quantities : dict of str to Quantity
        Constant parameters and the offset, with errors.
    curves : tuple of Curve
        Parameters of a network against the operating point.
    noise : tuple of float
        Rms residual of each run.
    memory : CorrelatedNoise or None
        Correlation of the noise; None for white noise.
    checks : Checks
        Tests of the residuals.
    held : tuple of HeldOutRun
        Predictions of held-out runs.
    left_out : tuple of BadReadings
        Readings that do not show the output; they are missing from ``runs`` and ``seen``.
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
        """The outputs that pictures are drawn of: this one."""
        return (self,)

    @property
    def headline(self) -> str:
        """The answer in one line."""
        quantities = [f"{name} = {q}" for name, q in list(self.quantities.items())[:3]]
        found = ", ".join(quantities) or f"{len(self.curves)} parameter curves"
        return f"{self.output} {self.status}: {self.model}, {found}"

    @cached_property
    def fitted(self) -> tuple[np.ndarray, ...]:
        """Free-running output at the readings of each run."""
        return tuple(predict_readings(self.fit.model, run) for run in self.seen.runs)

    def tables(self) -> tuple[Table, ...]:
        """Tables of all numbers."""
        rows = [[name, f"{q} {limit_words(q)}".rstrip()] for name, q in self.quantities.items()]
        if "delay" not in self.quantities:
            rows.append(["delay", f"{self.delay:.4g} samples"])
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
        Parameters are constants, or a network of the inputs at each moment.
    output : str, optional
        Name of the output, if the runs have several.
    delay : float, optional
        Samples by which the output follows the inputs; searched for if None. A delay that is not a
        whole number is fitted, with an error. It is negative where the clocks of input and output
        differ.
    offset : bool
        True if the output at rest is a free number; else it is 0.
    hidden, starts, seed : int
        Hidden nodes of the network, starts of its training, seed of their weights.
    held : sequence of Run
        Held-out runs, which are only predicted.

    Returns
    -------
    ResponseFit

    Raises
    ------
    InputError
        If runs do not fit together, an option is unknown, an input never changes, or samples for
        ``"arx"`` are not equally spaced.

    Notes
    -----
    The output runs free from the start of each run (output error): predictions from measured
    outputs are useless under noise. The first states are estimated. The noise is estimated from the
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
    runs, held = check_runs(runs, held, PHYSICS[model].even)
    check_inputs(runs)
    output = _choose_output(runs[0], output)
    shortest = min(len(run) for run in runs)
    if (
        delay is not None
        and min(usable_rows(run, output, delay).size for run in runs) < MIN_READINGS
    ):
        expected = f"less than the {shortest} rows of a run by {MIN_READINGS} readings"
        raise InputError(f"a delay of {delay:g} samples", expected)
    paths = Paths.of(runs, delay, PHYSICS[model].even)
    search = ResponseSearch(output, PHYSICS[model], paths, offset)
    identification = _Identification(search, map, hidden, range(seed, seed + starts), held)
    return answer_without_bad_readings(
        runs, [identification.search_runs], lambda trial: trial.fit, identification.answer
    )


class _Trial(NamedTuple):
    """Fit with constants, and for a network the alternatives and the network's fit."""

    constant: RunsFit
    alternatives: Alternatives | None = None
    network: RunsFit | None = None

    @property
    def fit(self) -> RunsFit:
        """The fit of the map that was asked for."""
        return self.network or self.constant


class _Identification(NamedTuple):
    """Settings of an identification."""

    search: ResponseSearch
    map: str
    hidden: int
    seeds: range
    held: tuple[Run, ...]

    def search_runs(self, runs: tuple[Run, ...]) -> _Trial:
        """Fit for the judgement of readings; constants would miss good ones of a network."""
        found = self.search.identify(runs)
        if self.map == "constant":
            return _Trial(found)
        found, alternatives = self.most_probable(runs, found)
        return _Trial(found, alternatives, self.fit_network(found))

    def answer(
        self, runs: tuple[Run, ...], trial: _Trial, left_out: tuple[BadReadings, ...]
    ) -> ResponseFit:
        """Judge a fit of runs."""
        output, physics, paths, _ = self.search
        found, alternatives, network = trial
        if network is None:
            found, alternatives = self.most_probable(runs, found)
        best = network or found
        checks, quantities, curves = self.evaluate(runs, found, best, alternatives)
        predictions = predict_runs(best, self.held)[output]
        rms, delay = float(np.sqrt(np.mean(best.rms**2))), best.delay
        status, message = judge_outputs({output: ResponseEvidence(
            best.fit, best.converged, checks, quantities, curves, predictions, self.map, rms,
            0.0 if paths.given else _lead(best, alternatives, quantities),
        )})  # fmt: skip
        quantities, curves = remove_errors_if_wrong(status, quantities, curves)
        message = add_remarks(message, not paths.given and delay == max_delay(runs) > 0, left_out)
        delay = int(delay) if delay == int(delay) else delay
        return ResponseFit(
            output, status, message, physics.name, self.map, delay, runs, found.prepared, best.fit,
            quantities, curves, tuple(best.rms[:, 0].tolist()), best.memory, checks, predictions,
            left_out,
        )  # fmt: skip

    def most_probable(
        self, runs: tuple[Run, ...], found: RunsFit
    ) -> tuple[RunsFit, Alternatives | None]:
        """Fit the most probable path without a law; return the fit and its alternatives."""
        for remaining in reversed(range(MAX_PATH_SEARCHES)):
            if found.is_exact():
                return found, None
            slopes = fuller_model_slopes(found.prepared, found.fit)
            departures = self.map == "constant"
            alternatives = alternatives_of(runs, found, self.search, slopes, departures)
            if alternatives.path == found.path or not remaining:
                break
            found = self.search.identify_path(runs, alternatives.path, found.fit.model)
        return found, alternatives

    def fit_network(self, found: RunsFit) -> RunsFit:
        """Fit a network of parameters, starting from the constant ones."""
        prepared, first = found.prepared, found.fit.model
        physics, raw = self.search.physics, np.asarray(first["map"])
        nets = (network_of(prepared, physics, raw, self.hidden, seed) for seed in self.seeds)
        case = response_case(prepared, found.path, self.search.offset, True)
        return fit_case(case, [first | {"map": net} for net in nets])

    def evaluate(
        self,
        runs: tuple[Run, ...],
        found: RunsFit,
        best: RunsFit,
        alternatives: Alternatives | None,
    ) -> tuple[Checks, dict[str, Quantity], tuple[Curve, ...]]:
        """Test the residuals; give the constants or curves with errors where determined.

        `found` is the fit with constants, `best` that with the map that was asked for.
        """
        prepared, constant = found.prepared, self.map == "constant"
        _, _, paths, offset = self.search
        # A delay that was searched for counts as a number, as does a fitted fraction of one.
        used = effective_parameters(best.fit)
        used += not paths.given and not prepared.fraction_limits
        gain = None if constant else found.cost - best.cost
        slopes = fuller_model_slopes(prepared, best.fit)
        checks = checks_of(best, 0, slopes, used, gain)._replace(
            first_order=constant and self.search.is_first_order(runs, found),
            band_limited=() if found.path.way.moving else paths.movable.smooth,
        )
        if not constant:
            curves = curves_of(best.fit, best.errors, prepared)
            return checks, *open_undetermined({}, curves, prepared, checks)
        if alternatives is not None and alternatives.departure.without < 0.5:
            words, kind, without = alternatives.departure
            # A further part of the response explains more than digits.
            if checks.input_share or kind not in (FURTHER, GROWTH, HIGHER):
                checks = checks._replace(law=words, no_law_probability=without, law_kind=kind)
        input_errors = [gain_error_share(runs, found.path.way, name) for name in prepared.inputs]
        lags = lag_posterior(found, offset)
        step = float(mean_step(prepared.runs[0].dt))
        delay_error = 0.0 if alternatives is None else alternatives.delay_error
        delay_error *= prepared.rows_per_sample * step
        quantities = response_quantities(
            found, alternatives, delay_error, lags, digit_covariance(found), input_errors
        )
        return checks, *open_undetermined(
            quantities, (), prepared, checks, lags.limits(delay_error)
        )


def _lead(
    found: RunsFit, alternatives: Alternatives | None, quantities: Mapping[str, Quantity]
) -> float:
    """Samples by which the output moves before its inputs; 0 unless that is likely.

    For an exact output the lead must exceed the error of the delay and the shortest lag, which is
    never quite 0.
    """
    delay = quantities.get("delay")
    if alternatives is not None:
        leads = alternatives.early_probability >= 0.5
    elif delay is None or delay.error is None:
        leads = True
    else:
        step = float(mean_step(found.prepared.runs[0].dt))
        leads = delay.value + LAG_RANGE[0] * step < ndtri(POOR_FIT) * delay.error
    return max(-found.delay, 0.0) if leads else 0.0


def _choose_output(run: Run, output: str | None) -> str:
    names = list(run.outputs)
    if output is not None and output not in names:
        raise InputError(f"no output '{output}'", nearest(output, names))
    if output is None and len(names) > 1:
        raise InputError(f"{len(names)} outputs", f"one of {', '.join(names)}")
    return output or names[0]
