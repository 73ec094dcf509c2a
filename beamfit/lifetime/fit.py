"""Fit of a decay record: I0, a, b and lifetimes, and what the record does not determine."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from beamfit.answer import Table, answer, cell, json_of, labelled, plain_name, quantity_frame
from beamfit.errors import InputError, expect
from beamfit.lifetime.alternatives import Change, ConstantA, LifetimeLaw, Outgassing, SuddenLoss
from beamfit.lifetime.answer import finding_of, finding_of_cycles
from beamfit.lifetime.cycles import (
    MIN_CYCLE_READINGS,
    MIN_CYCLES,
    clean_cycles,
    collect_cycles,
    usual_cycle,
)
from beamfit.lifetime.decay_law import current
from beamfit.lifetime.evidence import BELIEVED, UNITS, Evidence, RatePart, Separability
from beamfit.lifetime.expansion import Expansion, Pieces, fit_law
from beamfit.lifetime.free_law import FreeLaw, Law
from beamfit.lifetime.readings import rounding_of, with_common_errors, with_rounding
from beamfit.lifetime.record import DecayRecord, Monitor
from beamfit.quantity import Quantity, Status

if TYPE_CHECKING:
    from pandas import DataFrame

    from beamfit.sampling.posterior import Posterior
    from beamfit.sampling.priors import Distribution

# Smallest number of readings in a fit: three parameters, and two degrees of freedom for the noise.
MIN_FITTED_READINGS = 5


def bare(value: float | None, unit: str) -> dict[str, Any]:
    """Write a number without an error as JSON."""
    return {"value": value, "error": None, "unit": unit}


def headline_of(fit: Any) -> str:
    """Record, status and lifetime of a decay or a table of lifetimes in a line."""
    return f"{fit.record} {cell(fit.status)}: mean lifetime {fit.lifetime_mean}"


def loss_json(fit: Any) -> dict[str, Any]:
    """Write the fields that fits of a decay and of a table of lifetimes share as JSON."""
    first, last = ("record", "status", "message"), ("chi2", "dof", "noise_inferred")
    last = (*last, "identifiability", "constant_a")
    found = {name: getattr(fit, name) for name in (*first, *fit.quantities, *last)}
    further = {"mean_current": bare(fit.mean_current, "mA"), "lifetime_by_current": fit.lifetimes}
    return json_of(found | further)


@answer
@dataclass(frozen=True, eq=False)
class DecayFit:
    """The result of `fit_decay`.

    Parameters
    ----------
    record : str
        Name of the record.
    status : Status
        `converged`; `poor_fit` if chi² is improbable (below 1e-3) or the record refutes constant a
        and b; `infeasible` if a or b is negative by more than its error allows; `unidentified` if a
        and b, or the lifetime itself, are not determined; `not_finite` if the search failed.
    message : str
        One or two sentences with the cause and the remedy.
    i0, a, b : Quantity
        Current at the first reading, mA, and the coefficients of dI/dt = -a I² - b I.
    lifetime_start, lifetime_end, lifetime_mean : Quantity
        Lifetime 1/(a I + b) at the first and last reading and at the mean current, h.
    mean_current : float
        Mean current of the record, mA.
    chi2 : float
        Weighted sum of squares. Without errors in the record the noise is inferred from the
        residuals, and chi2 equals dof.
    dof : int
        Readings less parameters.
    rms_residual : float
        Root mean square of the residuals, mA.
    noise_inferred : bool
        True if the record has no errors.
    residuals : array, shape (n,)
        Model minus reading, mA.
    identifiability : Separability
        Separability of a and b.
    readings : DecayRecord
        The fitted readings.
    constant_a : ConstantA or None
        Test of a constant a; None where nothing decays.
    correlation_time : float or None
        Correlation time of the errors, s; None where they are independent.
    inflation : float
        Factor by which the memory of the noise enlarges the error of the loss rate, determined or
        not.
    lifetimes : LifetimeLaw or None
        Lifetime by current, where a constant a is refuted.
    alternative : Change, Outgassing, SuddenLoss or None
        A change of the loss rate, a gas loss that relaxes, or current lost at once, where that
        explains a refuted law; also as `change`, `outgassing` or `loss`.
    shaped : bool
        True if the dependence of a on the current was given.
    first : array of int, optional
        Index of the first reading of each cycle, in a fit to many cycles.
    exact : mapping of str to Quantity
        The same quantities if a and b are constant.
    free_law : FreeLaw or None
        Posterior of the exponent of a and the drift of b, which the errors contain; None where the
        law is given.
    course : tuple of RatePart
        Lifetimes by part of the record, for many cycles with different loss rates.

    Examples
    --------
    >>> hours = np.linspace(0.0, 36000.0, 40)
    >>> fit = fit_decay(DecayRecord(hours, 100.0 / (1.0 + 100.0 * 1e-7 * hours)))
    >>> isinstance(fit, DecayFit), f"{fit.a.value:.2e}"
    (True, '1.00e-07')
    """

    record: str
    status: Status
    message: str
    i0: Quantity
    a: Quantity
    b: Quantity
    lifetime_start: Quantity
    lifetime_end: Quantity
    lifetime_mean: Quantity
    mean_current: float
    chi2: float
    dof: int
    rms_residual: float
    noise_inferred: bool
    residuals: np.ndarray
    identifiability: Separability
    readings: DecayRecord
    constant_a: ConstantA | None = None
    correlation_time: float | None = None
    inflation: float = 1.0
    lifetimes: LifetimeLaw | None = None
    alternative: Change | Outgassing | SuddenLoss | None = None
    shaped: bool = False
    first: np.ndarray | None = None
    exact: Mapping[str, Quantity] = field(default_factory=dict)
    free_law: FreeLaw | None = None
    course: tuple[RatePart, ...] = ()

    def sample(
        self, *, priors: Mapping[str, Distribution] | None = None, **options: Any
    ) -> Posterior:
        """Draw from the posterior that the fit quotes: that of the free law or of the constant one.

        Parameters
        ----------
        priors : mapping of str to distribution, optional
            On ``i0``, ``a``, ``b``, ``exponent`` or ``drift``: `Normal`, `LogNormal`, `Uniform`,
            `HalfNormal` of `beamfit.sampling.priors`, or a frozen one of scipy.stats.
        **options
            ``seed, target_ess, store, provenance`` of `beamfit.lifetime.posterior.sample_decay`.

        Returns
        -------
        Posterior
            It contains the lifetimes, too.

        Raises
        ------
        InputError
            As `beamfit.lifetime.posterior.sample_decay`, and for many cycles.

        Examples
        --------
        >>> t = np.linspace(0, 8 * 3600, 100)
        >>> noise = 1e-2 * np.random.default_rng(1).normal(size=t.size)
        >>> fit = fit_decay(DecayRecord(t, 100.0 / (1.0 + 100.0 * 1e-7 * t) + noise))
        >>> posterior = fit.sample(seed=1)
        >>> posterior.status.value, bool(posterior.values("b").min() >= 0)
        ('converged', True)
        """
        from beamfit.lifetime.posterior import sample_decay

        if self.first is not None:
            expected = "one decay; the errors of cycles fitted together are those of the fit"
            raise InputError("samples of many cycles", expected, path=self.record)
        return sample_decay(self, priors, **options)

    def _alternative(self, kind: type) -> Any:
        return self.alternative if isinstance(self.alternative, kind) else None

    @property
    def change(self) -> Change | None:
        """Change of the loss rate that explains a refuted law."""
        return self._alternative(Change)

    @property
    def outgassing(self) -> Outgassing | None:
        """Gas loss that relaxes and explains a refuted law."""
        return self._alternative(Outgassing)

    @property
    def loss(self) -> SuddenLoss | None:
        """Current lost at once that explains a refuted law, too small to be seen in single
        readings.
        """
        return self._alternative(SuddenLoss)

    def if_constant(self, name: str) -> Quantity:
        """Return a quantity of the law with constant a and b."""
        return self.exact.get(name, getattr(self, name))

    def curve(self, time: np.ndarray) -> np.ndarray:
        """Current by the quoted law, mA, at times since the first reading, s."""
        if self.free_law is not None and self.free_law.is_preferred:
            return self.free_law.curve(time)
        numbers = (self.if_constant(name).value for name in ("i0", "a", "b"))
        return np.asarray(current(time, *numbers))

    @property
    def expansion(self) -> Expansion:
        """Expansion of the law with constant a and b, about this fit of a single decay."""
        numbers = (self.if_constant(name).value for name in ("i0", "a", "b"))
        return Expansion.at(self.readings, *numbers)

    def with_power(self, power: float) -> Expansion:
        """Fit the law with a power of the current in a to the readings of this single decay."""
        expansion = self.expansion
        if not power:
            return expansion
        return fit_law(expansion.pieces, start=[*expansion.numbers[:2], power])

    @property
    def quantities(self) -> dict[str, Quantity]:
        """Quoted quantities, by name."""
        return {name: getattr(self, name) for name in UNITS}

    @property
    def headline(self) -> str:
        """The answer in a line."""
        return headline_of(self)

    @property
    def noise(self) -> float:
        """Standard deviation of a reading, from the residuals, mA."""
        return self.rms_residual * math.sqrt(self.residuals.size / self.dof)

    def tables(self) -> tuple[Table, ...]:
        """Build the tables that show the fit."""
        rows = [(plain_name(name), [value]) for name, value in self.quantities.items()]
        rows.append(("chi2/dof", [f"{self.chi2:.4g}/{self.dof}"]))
        rows.append(("rms residual", [f"{self.rms_residual:.3g} mA"]))
        return (labelled(f"{self.record}: {cell(self.status)}", [], rows),)

    def __str__(self) -> str:
        rows = [f"{self.record}: {self.status}. {self.message}"]
        rows += [f"  {name:15s} {value}" for name, value in self.quantities.items()]
        noise = f"residual {self.rms_residual:.3g} mA rms"
        return "\n".join([*rows, f"  chi²/dof {self.chi2:.4g}/{self.dof}, {noise}"])

    def to_frame(self) -> DataFrame:
        """Give a pandas data frame of all numbers, one row a quantity.

        Columns are value, error, error_raw, low_95, high_95 (NaN where there is none) and unit.

        Raises
        ------
        InputError
            If pandas is not installed.
        """
        rows = {(self.record, name): value for name, value in self.quantities.items()}
        return quantity_frame(rows, ("record", "quantity"))

    def to_json(self) -> dict[str, Any]:
        """Return the result as one JSON object, as `beamfit lifetime --json` prints it."""
        found = loss_json(self) | {
            "rms_residual": bare(self.rms_residual, "mA"),
            "correlation_time": bare(self.correlation_time, "s"),
            "change": self.change,
        }
        if self.free_law is not None:
            found |= {"if_a_and_b_are_constant": dict(self.exact), "free_law": self.free_law}
        found |= {} if self.outgassing is None else {"outgassing": self.outgassing}
        if self.first is not None:
            found |= {"cycles": self.first.size, "course": [part.to_json() for part in self.course]}
        return json_of(found)


def fit_decay(
    record: DecayRecord,
    shape: Callable[[Any], Any] | None = None,
    monitor: Monitor | None = None,
    law: Law | str = Law.free,
) -> DecayFit:
    """Fit the decay law to one decay.

    Parameters
    ----------
    record : DecayRecord
        One decay, without refills or steps: cut others with `split_record` first.
    shape : callable, optional
        Dependence of a on the current in mA, up to a factor, if it is not constant; for example
        `beamfit.lifetime.mechanisms.touschek_shape(ring, operation)`. The rate equation is then
        integrated, and `a` is the value at the mean current.
    monitor : Monitor, optional
        Stability of the current monitor, in place of that of the record; the errors contain it.
    law : {"free", "constant"}
        With "free", a may depend on the current by a power and b may drift in the record, with the
        priors of `beamfit.lifetime.free_law`; the errors contain both. With "constant", or with a
        `shape`, the law is given.

    Returns
    -------
    DecayFit
        Values, errors, and a verdict. A record from which nothing can be learned is a result with
        the status `unidentified`, not an error.

    Raises
    ------
    InputError
        If the record has fewer than five readings, or rises.

    Notes
    -----
    Least squares with report equation 44, or with equation 42 if `shape` is given. With constant a
    and b errors are those of the linearised problem, else those of the posterior of
    `beamfit.lifetime.free_law.free_law`.

    Examples
    --------
    >>> import numpy as np
    >>> from beamfit.lifetime.decay_law import current
    >>> t = np.linspace(0, 8 * 3600, 1000)
    >>> noise = 1e-3 * np.random.default_rng(1).normal(size=t.size)
    >>> record = DecayRecord(t, np.array(current(t, 500.0, 2e-8, 1e-6)) + noise)
    >>> fit = fit_decay(record, law="constant")
    >>> print(fit.status, fit.lifetime_mean)
    converged 28.704763 ± 0.000026 h
    """
    expect(record, DecayRecord, "beamfit.read_decay_record(path)")
    record = record if monitor is None else replace(record, monitor=monitor)
    if len(record) < MIN_FITTED_READINGS:
        expected = f"{MIN_FITTED_READINGS} or more for a decay"
        raise InputError(f"{len(record)} readings", expected, path=record.name)
    if np.ptp(record.current) == 0:
        return _constant(record, f"All {len(record)} readings are {record.current[0]:.6g} mA")
    expansion = fit_law(Pieces.of(record), shape=shape)
    residuals = expansion.current_residuals
    prepared = with_rounding(with_common_errors(record, residuals), residuals)
    expansion = expansion if prepared is record else fit_law(Pieces.of(prepared), shape=shape)
    evidence = Evidence(expansion, Law(law), shape is not None, prepared)
    rate, error = evidence.normal_equivalent("rate_mean")
    if rate < -BELIEVED * error:
        first, last = record.current[0], record.current[-1]
        expected = "a decay; cut out refills with split_record"
        found = f"a current that rises, {first:.6g} to {last:.6g} mA"
        raise InputError(found, expected, path=record.name, column="current")
    finding = finding_of(evidence)
    return DecayFit(
        record=record.name,
        status=finding.status,
        message=finding.message,
        **evidence.fit_fields(expansion.converged),
        mean_current=record.mean_current,
        rms_residual=evidence.rms,
        readings=prepared,
    )


def fit_decays(records: Sequence[DecayRecord], law: Law | str = Law.free) -> tuple[DecayFit, ...]:
    """Fit many decays, each by itself.

    Parameters
    ----------
    records : sequence of DecayRecord
        As for `fit_decay`.
    law : {"free", "constant"}
        As for `fit_decay`.

    Returns
    -------
    tuple of DecayFit
        In the order of the records.

    Raises
    ------
    InputError
        As for `fit_decay`.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.linspace(0, 36000, 50)
    >>> records = [DecayRecord(t, i0 / (1 + i0 * 1e-8 * t)) for i0 in (100.0, 200.0)]
    >>> [f"{fit.a.value:.3e}" for fit in fit_decays(records)]
    ['1.000e-08', '1.000e-08']
    """
    return tuple(fit_decay(record, law=law) for record in records)


def _constant(record: DecayRecord, found: str) -> DecayFit:
    """Build the result for equal readings, which show neither decay nor noise."""
    level = record.mean_current
    unknown = {name: Quantity(math.nan, None, unit) for name, unit in UNITS.items()}
    if level:
        remedy = "record longer, or read the monitor with more digits."
        message = f"{found}, so neither decay nor noise is seen: {remedy}"
    else:
        message = f"{found}: no beam is stored, or this is not the column of the current."
    return DecayFit(
        record=record.name,
        status=Status.unidentified,
        message=message,
        **unknown | {"i0": Quantity(level, None, "mA")},
        mean_current=level,
        chi2=0.0,
        dof=len(record) - 1,
        rms_residual=0.0,
        noise_inferred=record.error is None,
        residuals=np.zeros(len(record)),
        identifiability=Separability(False, None, None, None, None, 1.0),
        readings=record,
    )


def fit_cycles(
    cycles: Sequence[DecayRecord],
    name: str = "cycles",
    law: Law | str = Law.free,
    *,
    found: bool = True,
) -> DecayFit:
    """Fit one a and one b to many cycles, such as top-up, each with a starting current of its own.

    Parameters
    ----------
    cycles : sequence of DecayRecord
        Three or more, of three readings or more, in order of time, as from `split_record`. Their
        `start`, if all have it, gives the time between them.
    name : str, optional
        Name of the result.
    law : {"free", "constant"}
        With "free", a may be proportional to a power of the current; errors of a and b contain
        that.
    found : bool, optional
        True if the cycles were found in the readings. There is no lifetime then if the noise may
        have hidden refills, or they may come faster than the readings. False if the times of the
        refills are known.

    Returns
    -------
    DecayFit
        Result for all cycles. `lifetime_start` and `lifetime_end` are at the highest and the lowest
        current, `i0` is the mean of the starting currents, without an error, and `lifetimes` has
        the lifetime by current if the currents differ enough. If a and b are not separable the
        lifetime at the mean current is the answer.

    Raises
    ------
    InputError
        If there are fewer than three cycles, one has fewer than three readings, or they are not in
        order of time.

    Notes
    -----
    Least squares. The starting currents are eliminated, so that time and memory grow only with the
    number of readings. Correlated noise continues from cycle to cycle, 1/f noise is that within
    each (`beamfit.noise.correlated`).

    Outlying readings, cycles and heads of cycles are left out and counted. If the loss rate differs
    between cycles the answer is that of the mean rate, and `course` has the lifetimes of parts
    (`beamfit.lifetime.cycles`).

    Examples
    --------
    >>> t = np.arange(0.0, 180.0, 10.0)
    >>> noise = 1e-3 * np.random.default_rng(1).normal(size=(50, 18))
    >>> cycles = [DecayRecord(t, 500 * np.exp(-t / 36000) + row) for row in noise]
    >>> print(fit_cycles(cycles).lifetime_mean)
    10.00002 ± 0.00049 h
    """
    if len(cycles) < MIN_CYCLES:
        raise InputError(f"{len(cycles)} cycles", f"{MIN_CYCLES} or more", path=name)
    for cycle in cycles:
        if len(cycle) < MIN_CYCLE_READINGS:
            found, expected = f"{len(cycle)} readings", f"{MIN_CYCLE_READINGS} or more in a cycle"
            raise InputError(found, expected, path=cycle.name)
    return fit_pieces(cycles, name, Law(law), found=found)


def fit_pieces(
    cycles: Sequence[DecayRecord], name: str, law: Law = Law.constant, *, found: bool = False
) -> DecayFit:
    """Fit cycles as `fit_cycles`, also only two of them, such as before and after a refill or a
    gap.
    """
    collected = collect_cycles(cycles)
    if np.any(np.diff(collected.time) <= 0):
        raise InputError("a cycle before the end of the one before", "an order in time", path=name)
    if not any(np.ptp(cycle.current) for cycle in cycles):
        sentence = f"The readings of each of {len(cycles)} cycles are equal"
        fit = _constant(_readings(collected, name, None), sentence)
        return replace(fit, first=collected.first)
    expansion, left_out = clean_cycles(collected)
    digit, span = cycles[0].resolution, float(np.median([cycle.span for cycle in cycles]))
    rounding = rounding_of(digit, expansion.current_residuals, span, collected.monitor)
    if collected.error is None and rounding is not None:
        rounding_error, monitor = rounding
        error = np.full(collected.time.size, rounding_error)
        expansion, left_out = clean_cycles(replace(collected, error=error, monitor=monitor))
    cycle = usual_cycle(cycles) if found else None
    evidence, pieces = Evidence(expansion, law, usual_cycle=cycle), expansion.pieces
    finding = finding_of_cycles(evidence, pieces.monitor, left_out)
    return DecayFit(
        record=name,
        status=finding.status,
        message=finding.message,
        **evidence.fit_fields(evidence.determines_lifetime),
        mean_current=pieces.units[1],
        rms_residual=evidence.rms,
        readings=_readings(pieces, name, digit),
        first=pieces.first,
    )


def _readings(pieces: Pieces, name: str, digit: float | None) -> DecayRecord:
    """Join the readings of many pieces to one record."""
    start = float(pieces.time[0])
    return DecayRecord(pieces.time, pieces.current, pieces.error, name, start, digit=digit)
