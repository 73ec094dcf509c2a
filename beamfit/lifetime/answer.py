"""The rules by which a decay is judged, in order of gravity, and what is remarked besides."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from beamfit.errors import Finding, Status, judge
from beamfit.lifetime.alternatives import ConstantA, LifetimeLaw, Outgassing
from beamfit.lifetime.cycles import HELD, is_sawtooth, lives_longer
from beamfit.lifetime.evidence import (
    BELIEVED,
    DETERMINED,
    OUTSIDE,
    SEPARABLE,
    UNITS,
    Evidence,
)
from beamfit.lifetime.free_law import Law
from beamfit.lifetime.pieces import split_record
from beamfit.lifetime.readings import noise_of
from beamfit.lifetime.record import Monitor
from beamfit.noise.memory import remembers
from beamfit.quantity import HOUR, percent
from beamfit.statistics import FEW_DOF, POOR_FIT, chi2_probability, few_dof_words, of_use

# Lifetimes, s, that stored beams seldom have, but times in a wrong unit often give.
SHORTEST, LONGEST = 20.0, 3000 * HOUR
# Errors above a value that are not exceeded with 95 %.
LIMIT = float(ndtri(0.95))
# A change between neighbouring residuals of so many times their usual one is a step, not noise.
STEP = 12.0
# A change of which the next takes back such a share is of one reading.
BACK = 0.5
# Below this chi²/dof stated errors are said to be too large.
CAUTIOUS = 0.25
# Residuals so many times the scatter of neighbouring readings are not the monitor's noise.
WANDERS = 10.0
# Settings that are said to have gone from one value to another, by more than this share.
MOVABLE = {"rf_voltage": ("RF voltage", 1e-3, "kV"), "scraper_y": ("scraper", 1e3, "mm")}
MOVABLE |= {"bunches": ("number of bunches", 1.0, "in all")}
SLOW = 0.01


class TableEvidence(NamedTuple):
    """A table of lifetimes as the rules see it.

    `numbers` has values and errors of a, b and the share of a in the loss at the mean current,
    `outliers` names the points that were left out, `noise` is what the points scatter by, h, where
    they have no errors.
    """

    numbers: Mapping[str, tuple[float, float]]
    chi2: float
    dof: int
    constant_a: ConstantA
    lifetimes: LifetimeLaw | None
    outliers: tuple[str, ...]
    noise: float | None
    explained: None = None
    changed: bool = False
    free: None = None

    @property
    def noise_inferred(self) -> bool:
        """True if the residuals of the points tell the noise."""
        return self.noise is not None

    def scaled(self, name: str) -> tuple[float, float]:
        """A value and its error."""
        return self.numbers[name]

    sure = scaled


def _lost(e: Evidence) -> Finding | None:
    if e.about.rested:
        return None
    cause = "The search found no finite minimum: look at the record for steps."
    return Finding(Status.not_finite, cause)


def _is_level(e: Evidence) -> bool:
    """True if the readings tell no loss, of either sign."""
    rate, error = e.sure("rate_mean")
    return not e.separability.separable and error > DETERMINED * abs(rate)


def _held(e: Evidence) -> Finding | None:
    """Refills that an archive is too slow to resolve: readings even between two currents."""
    digit = math.inf if e.record is None else e.record.resolution or 0.0
    if not _is_level(e) or digit >= np.std(e.residuals) or not is_sawtooth(e.residuals):
        return None
    return Finding(
        Status.unidentified,
        "The beam is held by refills that the record does not resolve: its readings lie evenly "
        "between two currents, and tell nothing of the lifetime; record several readings "
        "between refills",
    )


def _within_noise(e: Evidence) -> Finding | None:
    if not _is_level(e):
        return None
    rate, error = e.sure("rate_mean")
    # A rate below zero by chance is no reason for a longer lifetime than that of a rate of zero.
    limit = 1 / (max(rate, 0.0) + LIMIT * error) / HOUR
    if lives_longer(limit * HOUR) < HELD:
        return Finding(
            Status.unidentified,
            "The current does not fall: that refills hold the beam, which the noise hides, is "
            "likelier than so long a lifetime. No limit is given; record more readings "
            "from refill to refill, or with less noise",
        )
    return Finding(
        Status.unidentified,
        f"The decay is within its noise: the lifetime is above {limit:.3g} h at 95 %, unless "
        "refills held the beam; record longer or with less noise",
    )


def _stepped(e: Evidence) -> Finding | None:
    """A step or spike in the record, whether or not its errors are known."""
    record, change = e.record, np.diff(e.residuals)
    # Of fewer residuals the middle one is small by chance in several records of a hundred.
    if e.noise_inferred and e.dof < FEW_DOF:
        return None
    usual = 1.4826 * float(np.median(np.abs(change)))
    floor = max(record.resolution or 0.0, 1e-12 * float(record.current.max()))
    largest = int(np.argmax(np.abs(change)))
    if abs(change[largest]) <= STEP * max(usual, floor):
        return None
    # Residuals are model minus reading, so a refill lowers them.
    size, time = f"{-change[largest]:+.4g} mA", f"{record.time[largest + 1]:.6g} s"
    if len(split_record(record).segments) > 1:
        remedy = "cut it with split_record and fit the pieces"
        return Finding(Status.poor_fit, f"The record has a step of {size} at {time}: {remedy}")
    beside = np.clip([largest - 1, largest + 1], 0, change.size - 1)
    if np.min(change[beside] / change[largest]) < -BACK:
        far = f"A reading near {time} lies {size.lstrip('+-')} off those beside it"
        remedy = "leave it out, or state errors that contain it"
        return Finding(Status.poor_fit, f"{far}: {remedy}")
    remedy = "too small there to cut at: fit the readings before and after it by themselves"
    return Finding(Status.poor_fit, f"The record has a step of {size} at {time}, {remedy}")


def _negative(name: str, cause: str, e: Evidence | TableEvidence) -> Finding | None:
    value, error = e.sure(name)
    if not (value < -BELIEVED * error and value < 0) or e.free is not None:
        return None
    cause, (_, error) = _explained(e) or cause, e.scaled(name)
    return Finding(Status.infeasible, f"{name} is negative by {-value / error:.1f} errors; {cause}")


NOT_GAS = (
    "the loss rate falls faster than the current, as no gas and no bunch length does: look for a "
    "vacuum that changes, as after a fill"
)
RISING = "the loss rate rises as the current falls: look for a changing vacuum or setting"


def _explained(e: Evidence | TableEvidence) -> str | None:
    """Cause that explains a refuted law better than an exponent of the current, and the remedy."""
    if e.explained is None:
        return None
    gas = isinstance(e.explained.found, Outgassing)
    remedy = ". Fit what comes later, or give the pressure in a column"
    return f"{e.explained}{remedy if gas else ': cut the record there'}"


def _refuted(e: Evidence | TableEvidence) -> Finding | None:
    """Data that refute constant a and b: what is quoted of them is not of this beam."""
    shown = e.constant_a.status is Status.poor_fit or e.changed or e.explained is not None
    if not shown or e.free is not None:
        return None
    offered = "" if e.lifetimes is None else f". Use the lifetime by current: {e.lifetimes}"
    if (explained := _explained(e)) is not None:
        return Finding(Status.poor_fit, explained[0].upper() + explained[1:])
    return Finding(Status.poor_fit, e.constant_a.message.rstrip(".") + offered)


def _inseparable(e: Evidence) -> Finding | None:
    found = e.separability
    if found.separable:
        return None
    if found.share_error is None:
        cause = "a and b are not separable on this record: record longer"
        return Finding(Status.unidentified, cause)
    if (beyond := max(-found.share, found.share - 1.0) / found.share_error) > OUTSIDE:
        return _beyond(e, beyond)
    if e.free is not None and e.free.is_odd:
        return Finding(
            Status.unidentified,
            "a and b are open, the lifetime is determined: the loss goes with the current as no "
            f"bunch length makes it, a as I^({e.free.exponent}). A vacuum that changes does, as "
            "after a fill: give the pressure in a column",
        )
    told = (
        f"a and b are not separable on this record (correlation {found.correlation:.6f}; share "
        f"of a in the loss {found.share:.2g} ± {found.share_error:.2g}), the lifetime at the mean "
        "current is determined. "
    )
    told += f"{likely}. " if (likely := _disturbed(e)) else ""
    if e.apart:
        open_ = "An exponent of a and a drift of b leave them open: record farther, or give the "
        told += f"{open_}ring, the pressure, or --law constant. {_if_constant(e)}"
        return Finding(Status.unidentified, told)
    # The bend of the decay grows with the square of the span.
    longer = max((found.share_error / SEPARABLE) ** 0.5, 1.1)
    constant = "" if e.law is Law.constant else " if they are constant"
    told += f"A record {longer:.2g} times longer, or at several currents, would separate them"
    return Finding(Status.unidentified, told + constant)


def _beyond(e: Evidence, errors: float) -> Finding:
    """A share of a that no loss has: the record departs from the law in time."""
    found = e.separability
    cause = (
        f"The share of a in the loss is {found.share:.2g} ± {found.share_error:.2g}, {errors:.1f} "
        "errors outside 0 to 1: a longer record does not help. "
    )
    if e.rival is not None:
        return Finding(Status.unidentified, f"{cause}Likely {e.rival}: cut the record there")
    drift = abs(min(-found.share, 1.0 - found.share, key=abs)) / found.share_error
    drift *= e.drift_of_one_error("share")
    return Finding(
        Status.unidentified,
        f"{cause}The loss rate changes in the record, or the monitor drifts: by {drift:.2g} mA "
        "over the record that would be all of it",
    )


def _improbable(e: Evidence | TableEvidence, remedy: str = "") -> Finding | None:
    if e.noise_inferred or chi2_probability(e.chi2, e.dof) >= POOR_FIT:
        return None
    # Errors that are right may have a memory: by the evidence of all noises together.
    if isinstance(e, Evidence) and e.cycles == 1 and e.stated_odds > math.log(POOR_FIT):
        return None
    return Finding(
        Status.poor_fit,
        f"chi²/dof is {e.chi2 / e.dof:.3g}, improbable for this law and the stated errors, which "
        f"are enlarged to match{remedy}",
    )


def _determined(e: Evidence | TableEvidence) -> Finding:
    """Judge a and b each by itself; one that is compatible with zero has an upper limit."""
    found = {name: e.sure(name) for name in "ab"}
    small = {n: (v, error) for n, (v, error) in found.items() if not error < DETERMINED * v}
    if not small:
        return Finding(Status.converged, "a and b are determined")
    limits = " and ".join(
        f"{name} is compatible with zero: it is below {max(v, 0) + LIMIT * error:.2g} "
        f"{UNITS[name]} at 95 %"
        for name, (v, error) in small.items()
    )
    clear = "".join(f"{name} is determined; " for name in found if name not in small)
    return Finding(Status.converged, f"{clear}{limits}")


def _bending(e: Evidence) -> Finding | None:
    """Cycles whose a and b contain an exponent of a."""
    if e.bending is None:
        return None
    exact = " and ".join(f"{name} is {e.quantity(name, True)}" for name in "ab")
    found = _determined(e)
    return found._replace(
        cause=f"{found.cause}, with an exponent of a left open. If a is constant, {exact}"
    )


def _freely(e: Evidence) -> Finding | None:
    """Both with the exponent and the drift of b that the record leaves open."""
    if e.free is None:
        return None
    told = "; ".join(filter(None, (_clear(e), *(_extent(e, name) for name in "ab"))))
    if e.beside == "pumped":
        likely = f"Gas that is pumped away after a fill is likely ({percent(e.free.pumped)})"
        gas = e.outgassing if e.by_gas else None
        # A lifetime afterwards that is not determined, or a below zero, is no explanation.
        known = gas and math.isfinite(gas.after.value) and min(gas.a.value, gas.b.value) > 0
        said = f": {e.explained}" if known else ""
        return Finding(Status.converged, f"{told}. {likely}, which the errors contain{said}")
    if likely := _disturbed(e):
        return Finding(Status.converged, f"{told}. {likely}")
    if e.constant_a.status is Status.poor_fit:
        return Finding(Status.converged, f"{told}. {_departs(e)}, which the errors contain")
    gas = "" if e.free.drift is None else ", a drift of b and gas that is pumped away"
    open_ = f"with an exponent of a{gas} left open"
    return Finding(Status.converged, f"{told}, {open_}. {_if_constant(e)}")


DISTURBED = {
    "settles": "A monitor that settles after a fill is likely",
    "wanders": "The loss rate or the monitor wanders within the record",
}


def _disturbed(e: Evidence) -> str:
    """Name what goes by itself beside the law, if that is likelier than not."""
    if e.beside not in DISTURBED:
        return ""
    chance = percent(getattr(e.free, e.beside))
    return f"{DISTURBED[e.beside]} ({chance}), which the errors contain"


def _departs(e: Evidence) -> str:
    """Name what departs of a and b where constant ones are rejected."""
    chance = f"(p = {max(e.constant_a.p_value, 1e-300):.2g})"
    drift, power = e.free.drift, f"a goes as I^({e.free.exponent})"
    drifts = f"b drifts by {drift} of itself"
    bends, moves = (
        q is not None and not q.interval_95[0] < 0 < q.interval_95[1]
        for q in (e.free.exponent, drift)
    )
    if bends or drift is None:
        found = power if drift is None else f"{power} and {drifts}"
        return f"A constant a is rejected {chance}: {found}"
    beside = f"{drifts}, with a as I^({e.free.exponent})"
    open_ = f"{power} or {drifts}, and the record does not tell which"
    return f"Constant a and b are rejected {chance}: {beside if moves else open_}"


def _if_constant(e: Evidence) -> str:
    a, b = (e.quantity(name, True) for name in "ab")
    return f"If a and b are constant, a is {a} and b is {b}"


def _clear(e: Evidence) -> str:
    clear = [name for name in "ab" if _extent(e, name) is None]
    return f"{' and '.join(clear)} {'are' if clear[1:] else 'is'} determined" if clear else ""


def _extent(e: Evidence, name: str) -> str | None:
    """An interval too wide for a value, or a limit."""
    low, high = e.free.quantities[name].interval_95
    if low <= 0:
        return f"{name} is compatible with zero: it is below {high:.2g} {UNITS[name]} at 95 %"
    if of_use((low, high)):
        return None
    return f"{name} lies between {low:.2g} and {high:.2g} {UNITS[name]} at 95 %"


NEGATIVE = (partial(_negative, "b", NOT_GAS), partial(_negative, "a", RISING))
LOOK = ": look for steps with split_record, or test constant_a_test"
RULES = (_lost, _held, _stepped, *NEGATIVE, _within_noise, _refuted, _inseparable)
RULES += (partial(_improbable, remedy=LOOK), _freely, _determined)


def _narrow(e: TableEvidence) -> Finding | None:
    share, error = e.scaled("share")
    if error < SEPARABLE:
        return None
    known = f" (share of a in the loss {share:.2g} ± {error:.2g})" if math.isfinite(error) else ""
    cause = f"a and b are not separable by these lifetimes{known}: measure at a wider range of "
    return Finding(Status.unidentified, f"{cause}currents")


TABLE_RULES = (*NEGATIVE, _refuted, _narrow, _improbable, _determined)


def finding_of_table(evidence: TableEvidence) -> Finding:
    """Status and sentences on a table of lifetimes."""
    scatter = f"The table gives no errors; {evidence.noise or 0.0:.3g} h rms is their scatter"
    left_out = f"Left out as outliers: {', '.join(evidence.outliers)}"
    said = [scatter] * evidence.noise_inferred + [left_out] * bool(evidence.outliers)
    return _with_remarks(judge(evidence, TABLE_RULES), said)


def _with_remarks(found: Finding, said: Iterable[str | None]) -> Finding:
    """A finding with what is remarkable besides, in sentences."""
    return Finding(found.status, ". ".join([found.cause.rstrip("."), *filter(None, said)]) + ".")


def _course(e: Evidence) -> str | None:
    """Sentence on a loss rate that is not the same in all cycles."""
    if not e.course:
        return None
    low, high = (pick(e.course, key=lambda part: part.lifetime.value) for pick in (min, max))
    hours = [f"{part.start / HOUR:.3g} to {part.end / HOUR:.3g} h" for part in (low, high)]
    return (
        f"The loss rate is not the same in all cycles: of {len(e.course)} parts the lifetime at "
        f"the mean current is shortest, {low.lifetime}, from {hours[0]}, and longest, "
        f"{high.lifetime}, from {hours[1]}; the answer is their mean. Look for a vacuum or a "
        "setting that changes"
    )


def _bent(e: Evidence) -> Finding | None:
    """Cycles within which the current bends as no loss does: no lifetime is quoted."""
    if not e.bends:
        return None
    share, error = e.scaled("share")
    return Finding(
        Status.unidentified,
        f"The current bends within the cycles as no loss does: the share of a in it would be "
        f"{share:.2g} ± {error:.2g}, {e.outside:.1f} errors outside 0 to 1. Refills that the noise "
        "hides, fresh beam or vacuum after a refill, or a slow monitor do that, and the lifetime "
        "may be far off then: no error is given. Look at the mean of all cycles for steps, and "
        "leave out what follows a refill",
    )


def _one_current(e: Evidence) -> Finding | None:
    share, error = e.scaled("share")
    if error < SEPARABLE:
        return None
    return Finding(
        Status.unidentified,
        "The lifetime at the mean current is the answer; a and b are not separable at these "
        f"currents (share of a in the loss {share:.2g} ± {error:.2g}): let the beam decay "
        "farther once, or measure at another current",
    )


def _rises(e: Evidence) -> Finding | None:
    rate, error = e.sure("rate_mean")
    if rate > -BELIEVED * error:
        return None
    cause = "The current rises, by injection or a drift of the monitor: this is no decay"
    return Finding(Status.infeasible, cause)


def _missed(e: Evidence) -> Finding | None:
    """Refills that may have been missed: the beam then seems to live longer than it does."""
    if e.aliased:
        usual, interval = e.usual
        return Finding(
            Status.unidentified,
            "The beam is held by refills that the record may not resolve: of those that were found "
            f"the next comes after {usual:.3g} readings, but faster ones look the same when read "
            f"every {interval:.3g} s. Record more readings from refill to refill",
        )
    if e.hidden is None:
        return None
    lost, least = e.hidden
    return Finding(
        Status.unidentified,
        f"A cycle of the {e.cycles} that were found loses {lost:.2g} mA, and refills below "
        f"{least:.2g} mA can be missed in this noise: the beam then seems to live longer than it "
        "does. Average readings, or give the times of the refills by cutting the record there",
    )


CYCLE_RULES = (_rises, _missed, _bent, *NEGATIVE, _held, _within_noise, _refuted)
CYCLE_RULES += (_one_current, _improbable, _bending, _determined)


def finding_of_cycles(
    evidence: Evidence, monitor: Monitor | None, left_out: Sequence[str]
) -> Finding:
    """Status and sentences on many cycles fitted together; `left_out` is what was not fitted."""
    found, current = judge(evidence, CYCLE_RULES), evidence.about.pieces.current
    between = f"between {current.min():.4g} and {current.max():.4g} mA"
    first = f"One answer from {evidence.cycles} cycles {between}"
    remarks = [remark(evidence) for remark in (_course, _noise_inferred, _correlated, _odd_clock)]
    remarks += [] if monitor is None else [_stated(monitor)]
    remarks += [text[0].upper() + text[1:] for text in left_out]
    return _with_remarks(found._replace(cause=f"{first}. {found.cause}"), remarks)


def _noise_inferred(e: Evidence) -> str | None:
    if not e.noise_inferred:
        return None
    noise = f"{e.noise:.3g} mA rms is inferred from the residuals"
    return f"The record gives no errors; {noise}"


def _few(e: Evidence) -> str | None:
    """Sentence on the reach of errors that few residuals tell."""
    said = few_dof_words(e.dof) if e.noise_inferred and e.independent else ""
    return said.removeprefix("; ").capitalize() or None


def _correlated(e: Evidence) -> str | None:
    found, length = e.separability, e.correlation_time
    if length is None or (e.freed and not remembers(e.residuals, e.time.size - e.dof)):
        return None
    times = found.error_inflation
    than = f": they are {times:.1f} times those of independent readings" if times else ""
    span = float(e.time[-1] - e.time[0])
    over = f"over {length:.3g} s" if length < span else "longer than the record"
    return (
        f"Neighbouring residuals are correlated ({found.residual_correlation:.2f}, {over}), which "
        f"the errors contain{than}"
    )


def _cautious(e: Evidence) -> str | None:
    """Stated errors far above the scatter: what is quoted is then too large."""
    if e.noise_inferred or not e.independent:
        return None
    if e.chi2 > CAUTIOUS * e.dof or chi2_probability(e.chi2, e.dof) < 1 - POOR_FIT:
        return None
    return (
        f"chi²/dof is {e.chi2 / e.dof:.2g}: the stated errors are {(e.dof / e.chi2) ** 0.5:.2g} "
        "times the scatter, and so are those of a and b"
    )


def _moved(e: Evidence) -> str | None:
    """Settings that go slowly from one value to another, in steps too small to cut at."""
    part, said = max(len(e.record) // 10, 1), []
    for name, (called, factor, unit) in MOVABLE.items():
        values = getattr(e.record.conditions, name)
        if values is None:
            continue
        first, last = (factor * float(np.median(v)) for v in (values[:part], values[-part:]))
        if abs(last - first) > SLOW * max(first, last):
            said.append(f"The {called} went from {first:.4g} to {last:.4g} {unit} within the decay")
    return f"{', '.join(said)}: a and b are of no one setting" if said else None


def _wandering(e: Evidence) -> str | None:
    """Residuals as long as the record, of readings that by themselves are far better than that."""
    length, record, rival = e.correlation_time, e.record, e.explained
    local = noise_of(record.time, record.current)
    rms = float(np.std(e.residuals)) if rival is None else rival.scatter
    short = length is not None and length < record.span / 3
    if not e.about.wanders or short or rms < WANDERS * local:
        return None
    return (
        f"Neighbouring readings scatter by {local:.2g} mA alone: the loss rate or the monitor "
        "changed several times or slowly, so look at the residuals before recording longer"
    )


def _quantised(e: Evidence) -> str | None:
    # Of edges between digits a note says it.
    step, noise = None if e.record.mean else e.record.resolution, e.noise
    if e.record.error is not None:
        noise *= float(np.min(e.record.error))
    if step is None or step <= 2 * noise:
        return None
    return f"The readings are quantised in steps of {step:.3g} mA"


def _stated(monitor: Monitor) -> str:
    return f"The errors contain a monitor that {monitor} (one standard deviation)"


def _drifting(e: Evidence) -> str | None:
    """Sentence on a monitor drift that is slow against the record, which no residual shows."""
    if e.record.monitor is not None:
        return _stated(e.record.monitor)
    if e.record.error is not None:
        return None
    names = ("a", "b") if e.separability.separable else ("rate_mean",)
    drift, name = min((e.drift_of_one_error(name), name) for name in names)
    if not math.isfinite(drift):
        return None
    called = {"rate_mean": "the lifetime"}.get(name, name)
    return (
        "The monitor's stability is not stated; a drift of "
        f"{drift:.2g} mA over the record would shift {called} by 1 σ"
    )


def _odd_clock(e: Evidence) -> str | None:
    rate, error = e.scaled("rate_mean")
    if not error < DETERMINED * rate or 1 / LONGEST < rate < 1 / SHORTEST:
        return None
    wrong = "milliseconds" if rate < 1 / LONGEST else "minutes or hours"
    return (
        f"A lifetime of {1 / rate / HOUR:.2g} h is what {wrong} taken for seconds make: check the "
        "unit of the time"
    )


REMARKS = (_moved, _noise_inferred, _few, _cautious, _correlated)
REMARKS += (_wandering, _quantised, _drifting, _odd_clock)


def finding_of(evidence: Evidence) -> Finding:
    """Status and sentences: the gravest finding, then what is remarkable besides."""
    found = judge(evidence, RULES)
    if found.status is Status.not_finite:
        return found
    return _with_remarks(found, (remark(evidence) for remark in REMARKS))
