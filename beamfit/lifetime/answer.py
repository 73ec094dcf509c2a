"""Verdict on a decay: rules in order of gravity, then remarks.

A rule takes the evidence of a fit and returns a `Finding`, or None where it does not apply. The
first finding is the verdict.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from beamfit.errors import Finding, Status, judge
from beamfit.lifetime.alternatives import ConstantA, LifetimeLaw, Outgassing
from beamfit.lifetime.cycles import HIDDEN_REFILLS_PRIOR, is_sawtooth, lives_longer
from beamfit.lifetime.evidence import (
    BELIEVED,
    MAX_RELATIVE_ERROR,
    OUTSIDE,
    SEPARABLE,
    UNITS,
    Evidence,
)
from beamfit.lifetime.free_law import FreeLaw, Law
from beamfit.lifetime.pieces import split_record
from beamfit.lifetime.readings import noise_of
from beamfit.lifetime.record import Monitor
from beamfit.noise.memory import remembers
from beamfit.quantity import HOUR, Quantity, percent
from beamfit.statistics import FEW_DOF, POOR_FIT, chi2_probability, few_dof_words, of_use

# Range of plausible lifetimes, s: outside it the unit of the time is probably wrong.
MIN_LIFETIME, MAX_LIFETIME = 20.0, 3000 * HOUR
# One-sided 95 % limit of a normal distribution, in standard errors.
LIMIT_95 = float(ndtri(0.95))
# A change between neighbouring residuals of this many times their usual change is a step: normal
# noise never reaches it.
STEP_RATIO = 12.0
# A step is a single outlying reading if a neighbouring change takes back at least this share of it.
RETURN_SHARE = 0.5
# Below this chi²/dof a remark says that the stated errors are too large: by a factor of 2.
MIN_REDUCED_CHI2 = 0.25
# Residuals this many times the scatter of neighbouring readings are not noise of the monitor.
SLOW_RESIDUAL_RATIO = 10.0
# Label, factor to the displayed unit, and unit of the settings that a remark names if they drift
# within a decay, by more than SETTING_DRIFT of itself: the step at which a record is split.
SETTING_LABELS = {"rf_voltage": ("RF voltage", 1e-3, "kV"), "scraper_y": ("scraper", 1e3, "mm")}
SETTING_LABELS |= {"bunches": ("number of bunches", 1.0, "in all")}
SETTING_DRIFT = 0.01


class TableEvidence(NamedTuple):
    """Evidence of a table of lifetimes, for the same rules as a decay.

    Attributes
    ----------
    exact : mapping of str to Quantity
        Quantities of constant a and b, and `share`, the share of a in the loss at the mean current.
    chi2, dof : float, int
        Of the fit.
    constant_a : ConstantA
        Test of a constant a.
    lifetimes : LifetimeLaw or None
        Lifetime by current, the alternative where constant a and b are refuted.
    outliers : tuple of str
        Names of the points that were left out.
    noise : float or None
        Scatter of the points, h, if the table gives no errors.
    free : FreeLaw or None
        Posterior with an exponent of a and a change of b; None where the law is known.
    unphysical : bool
        True if a loss with a negative a or b is more probable than the free law.
    explained, addition, changed
        Alternatives in time, which a table does not have.
    """

    exact: Mapping[str, Quantity]
    chi2: float
    dof: int
    constant_a: ConstantA
    lifetimes: LifetimeLaw | None
    outliers: tuple[str, ...]
    noise: float | None
    free: FreeLaw | None
    unphysical: bool
    explained: None = None
    addition: None = None
    changed: bool = False

    @property
    def noise_inferred(self) -> bool:
        """True if the noise is estimated from the residuals."""
        return self.noise is not None

    def value_and_error(self, name: str) -> tuple[float, float]:
        """Value and error of a number."""
        return self.exact[name].value, self.exact[name].error

    normal_equivalent = value_and_error

    def quantity(self, name: str, known: bool) -> Quantity:
        """Quote a or b of the constant law; without an error where it is not determined."""
        return self.exact[name] if known else self.exact[name].open()


def _search_failed(e: Evidence) -> Finding | None:
    if e.expansion.converged:
        return None
    cause = "The search found no finite minimum: look at the record for steps."
    return Finding(Status.not_finite, cause)


def _is_level(e: Evidence) -> bool:
    """Return True if the loss rate is compatible with zero."""
    rate, error = e.normal_equivalent("rate_mean")
    return not e.separability.separable and error > MAX_RELATIVE_ERROR * abs(rate)


def _held_by_refills(e: Evidence) -> Finding | None:
    """Beam held by refills that the record does not resolve: currents spread evenly in a range."""
    digit = math.inf if e.record is None else e.record.resolution or 0.0
    if not _is_level(e) or digit >= np.std(e.residuals) or not is_sawtooth(e.residuals):
        return None
    return Finding(
        Status.unidentified,
        "The beam is held by refills that the record does not resolve: its readings lie evenly "
        "between two currents, and tell nothing of the lifetime. If it has several readings "
        "between refills, beamfit.study(record) fits the decays between them; else record more "
        "often",
    )


def _within_noise(e: Evidence) -> Finding | None:
    if not _is_level(e):
        return None
    rate, error = e.normal_equivalent("rate_mean")
    # A rate that is negative by chance does not lengthen the limit.
    limit = 1 / (max(rate, 0.0) + LIMIT_95 * error) / HOUR
    if lives_longer(limit * HOUR) < HIDDEN_REFILLS_PRIOR:
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


def _step_or_spike(e: Evidence) -> Finding | None:
    """Step or spike in the residuals, with or without stated errors."""
    record, change = e.record, np.diff(e.residuals)
    # With fewer residuals the median change is too small by chance in several % of records.
    if e.noise_inferred and e.dof < FEW_DOF:
        return None
    median_change = 1.4826 * float(np.median(np.abs(change)))
    floor = max(record.resolution or 0.0, 1e-12 * float(record.current.max()))
    largest = int(np.argmax(np.abs(change)))
    if abs(change[largest]) <= STEP_RATIO * max(median_change, floor):
        return None
    # Residuals are model minus reading, so a refill lowers them.
    size, time = f"{-change[largest]:+.4g} mA", f"{record.time[largest + 1]:.6g} s"
    if len(split_record(record).segments) > 1:
        remedy = "cut it with split_record and fit the pieces"
        return Finding(Status.poor_fit, f"The record has a step of {size} at {time}: {remedy}")
    neighbours = np.clip([largest - 1, largest + 1], 0, change.size - 1)
    if np.min(change[neighbours] / change[largest]) < -RETURN_SHARE:
        outlier = f"A reading near {time} lies {size.lstrip('+-')} off those beside it"
        remedy = "leave it out, or state errors that contain it"
        return Finding(Status.poor_fit, f"{outlier}: {remedy}")
    remedy = "too small there to cut at: fit the readings before and after it by themselves"
    return Finding(Status.poor_fit, f"The record has a step of {size} at {time}, {remedy}")


def _negative(name: str, cause: str, e: Evidence | TableEvidence) -> Finding | None:
    value, error = e.normal_equivalent(name)
    least = LIMIT_95 if e.unphysical else BELIEVED
    if not (value < -least * error and value < 0) or e.free is not None:
        return None
    cause, (_, error) = _explanation(e) or cause, e.value_and_error(name)
    return Finding(Status.infeasible, f"{name} is negative by {-value / error:.1f} errors; {cause}")


NOT_GAS = (
    "the loss rate falls faster than the current, as no gas and no bunch length does: look for a "
    "vacuum that changes, as after a fill"
)
RISING_RATE = "the loss rate rises as the current falls: look for a changing vacuum or setting"


def _explanation(e: Evidence | TableEvidence) -> str | None:
    """Alternative that explains a refuted law better than an exponent of a, and the remedy."""
    if e.explained is None:
        return None
    gas = isinstance(e.explained.explanation, Outgassing)
    remedy = ". Fit what comes later, or give the pressure in a column"
    return f"{e.explained}{remedy if gas else ': cut the record there'}"


def _refuted_law(e: Evidence | TableEvidence) -> Finding | None:
    """Constant a and b refuted: the quoted values are not those of this beam."""
    refuted = e.constant_a.status is Status.poor_fit or e.changed or e.explained is not None
    if not refuted or e.free is not None:
        return None
    alternative = "" if e.lifetimes is None else f". Use the lifetime by current: {e.lifetimes}"
    if (explained := _explanation(e)) is not None:
        return Finding(Status.poor_fit, explained[0].upper() + explained[1:])
    return Finding(Status.poor_fit, e.constant_a.message.rstrip(".") + alternative)


def _not_separable(e: Evidence) -> Finding | None:
    found = e.separability
    if found.separable:
        return None
    if found.share_error is None:
        cause = "a and b are not separable on this record: record longer"
        return Finding(Status.unidentified, cause)
    if (beyond := max(-found.share, found.share - 1.0) / found.share_error) > OUTSIDE:
        return _impossible_share(e, beyond)
    if e.free is not None and e.free.is_odd:
        return Finding(
            Status.unidentified,
            f"{_odd_exponent(e)}, as after a fill: give the pressure in a column",
        )
    cause = (
        f"a and b are not separable on this record (correlation {found.correlation:.6f}; share "
        f"of a in the loss {found.share:.2g} ± {found.share_error:.2g}), the lifetime at the mean "
        "current is determined. "
    )
    cause += f"{disturbance}. " if (disturbance := _disturbance(e)) else ""
    if e.is_separable:
        remedy = "An exponent of a and a drift of b leave them open: record farther, or give the "
        cause += f"{remedy}ring, the pressure, or --law constant. {_values_if_constant(e)}"
        return Finding(Status.unidentified, cause)
    # The bend of the decay grows with the square of the span.
    longer = max((found.share_error / SEPARABLE) ** 0.5, 1.1)
    constant = "" if e.law is Law.constant else " if they are constant"
    cause += f"A record {longer:.2g} times longer, or at several currents, would separate them"
    return Finding(Status.unidentified, cause + constant)


def _odd_exponent(e: Evidence | TableEvidence) -> str:
    """Sentence on an exponent that no bunch lengthening explains."""
    return (
        "a and b are open, the lifetime is determined: the loss goes with the current as no bunch "
        f"length makes it, a as I^({e.free.exponent}). A vacuum that changes does"
    )


def _impossible_share(e: Evidence, errors: float) -> Finding:
    """Share of a outside 0 to 1, which no loss has: loss rate or monitor change in time."""
    found = e.separability
    cause = (
        f"The share of a in the loss is {found.share:.2g} ± {found.share_error:.2g}, {errors:.1f} "
        "errors outside 0 to 1: a longer record does not help. "
    )
    if e.alternative is not None:
        return Finding(Status.unidentified, f"{cause}Likely {e.alternative}: cut the record there")
    drift = abs(min(-found.share, 1.0 - found.share, key=abs)) / found.share_error
    drift *= e.drift_of_one_error("share")
    return Finding(
        Status.unidentified,
        f"{cause}The loss rate changes in the record, or the monitor drifts: by {drift:.2g} mA "
        "over the record that would be all of it",
    )


def _improbable_chi2(e: Evidence | TableEvidence, remedy: str = "") -> Finding | None:
    if e.noise_inferred or chi2_probability(e.chi2, e.dof) >= POOR_FIT:
        return None
    # Correct errors may be correlated: then the evidence over all noise kinds decides.
    if isinstance(e, Evidence) and e.cycles == 1 and e.stated_odds > math.log(POOR_FIT):
        return None
    return Finding(
        Status.poor_fit,
        f"chi²/dof is {e.chi2 / e.dof:.3g}, improbable for this law and the stated errors, which "
        f"are enlarged to match{remedy}",
    )


def _determination(e: Evidence | TableEvidence) -> Finding:
    """Finding on a and on b: determined, or an upper limit where compatible with zero."""
    found = {name: e.normal_equivalent(name) for name in "ab"}
    near_zero = {
        n: (v, error) for n, (v, error) in found.items() if not error < MAX_RELATIVE_ERROR * v
    }
    if not near_zero:
        return Finding(Status.converged, "a and b are determined")
    limits = " and ".join(
        f"{name} is compatible with zero: it is below {max(v, 0) + LIMIT_95 * error:.2g} "
        f"{UNITS[name]} at 95 %"
        for name, (v, error) in near_zero.items()
    )
    determined = "".join(f"{name} is determined; " for name in found if name not in near_zero)
    return Finding(Status.converged, f"{determined}{limits}")


def _cycles_with_exponent(e: Evidence) -> Finding | None:
    """Cycles whose errors of a and b include a free exponent of a."""
    if e.exponent_shifts is None:
        return None
    constants = " and ".join(f"{name} is {e.quantity(name, True)}" for name in "ab")
    found = _determination(e)
    return found._replace(
        cause=f"{found.cause}, with an exponent of a left open. If a is constant, {constants}"
    )


def _free_law(e: Evidence) -> Finding | None:
    """a and b of the free law, whose errors include the exponent of a and the drift of b."""
    if e.free is None:
        return None
    words = "; ".join(
        filter(None, (_determined_names(e), *(_interval_words(e, name) for name in "ab")))
    )
    if e.addition == "pumped":
        likely = f"Gas that is pumped away after a fill is likely ({percent(e.free.pumped)})"
        gas = e.outgassing if e.has_slow_gas else None
        # An undetermined lifetime after outgassing, or a negative a or b, explains nothing.
        explains = gas and math.isfinite(gas.after.value) and min(gas.a.value, gas.b.value) > 0
        outgassing = f": {e.explained}" if explains else ""
        return Finding(Status.converged, f"{words}. {likely}, which the errors contain{outgassing}")
    if likely := _disturbance(e):
        return Finding(Status.converged, f"{words}. {likely}")
    if e.constant_a.status is Status.poor_fit:
        return Finding(Status.converged, f"{words}. {_departure(e)}, which the errors contain")
    gas = "" if e.free.drift is None else ", a drift of b and gas that is pumped away"
    open_ = f"with an exponent of a{gas} left open"
    return Finding(Status.converged, f"{words}, {open_}. {_values_if_constant(e)}")


DISTURBANCES = {
    "settles": "A monitor that settles after a fill is likely",
    "wanders": "The loss rate or the monitor wanders within the record",
}


def _disturbance(e: Evidence) -> str:
    """Sentence on a disturbance in addition to the law, if it is more probable than not."""
    if e.addition not in DISTURBANCES:
        return ""
    chance = percent(getattr(e.free, e.addition))
    return f"{DISTURBANCES[e.addition]} ({chance}), which the errors contain"


def _departure(e: Evidence) -> str:
    """Sentence on the departure, exponent or drift, by which constant a and b are rejected."""
    chance = f"(p = {max(e.constant_a.p_value, 1e-300):.2g})"
    drift, power = e.free.drift, f"a goes as I^({e.free.exponent})"
    drifts = f"b drifts by {drift} of itself"
    has_exponent, has_drift = (
        q is not None and not q.interval_95[0] < 0 < q.interval_95[1]
        for q in (e.free.exponent, drift)
    )
    if has_exponent or drift is None:
        found = power if drift is None else f"{power} and {drifts}"
        return f"A constant a is rejected {chance}: {found}"
    drift_and_power = f"{drifts}, with a as I^({e.free.exponent})"
    either = f"{power} or {drifts}, and the record does not tell which"
    return f"Constant a and b are rejected {chance}: {drift_and_power if has_drift else either}"


def _values_if_constant(e: Evidence | TableEvidence) -> str:
    a, b = (e.quantity(name, True) for name in "ab")
    return f"If a and b are constant, a is {a} and b is {b}"


def _determined_names(e: Evidence) -> str:
    names = [name for name in "ab" if _interval_words(e, name) is None]
    return f"{' and '.join(names)} {'are' if names[1:] else 'is'} determined" if names else ""


def _interval_words(e: Evidence, name: str) -> str | None:
    """Upper limit or interval of a or b; None if it is determined."""
    low, high = e.free.quantities[name].interval_95
    if low <= 0:
        return f"{name} is compatible with zero: it is below {high:.2g} {UNITS[name]} at 95 %"
    if of_use((low, high)):
        return None
    return f"{name} lies between {low:.2g} and {high:.2g} {UNITS[name]} at 95 %"


NEGATIVE = (partial(_negative, "b", NOT_GAS), partial(_negative, "a", RISING_RATE))
LOOK = ": look for steps with split_record, or test constant_a_test"
RULES = (
    _search_failed,
    _held_by_refills,
    _step_or_spike,
    *NEGATIVE,
    _within_noise,
    _refuted_law,
    _not_separable,
)
RULES += (partial(_improbable_chi2, remedy=LOOK), _free_law, _determination)


def _narrow_range(e: TableEvidence) -> Finding | None:
    """Lifetimes that do not separate a and b, by the constant law or by the free one."""
    share, error = e.value_and_error("share")
    if not error < SEPARABLE:
        if e.free is not None:  # the share that is quoted
            share, error = e.free.share.value, e.free.share.error
        measured = (
            f" (share of a in the loss {share:.2g} ± {error:.2g})" if math.isfinite(error) else ""
        )
        cause = f"a and b are not separable by these lifetimes{measured}: measure at a wider range"
        return Finding(Status.unidentified, f"{cause} of currents")
    if e.free is None or e.free.determines_share:
        return None
    if e.free.is_odd:
        cause = f"{_odd_exponent(e)} with the current: measure the pressure beside the lifetimes"
        return Finding(Status.unidentified, cause)
    cause = "An exponent of a and a change of b along the current leave a and b open: measure at a "
    cause += f"wider range of currents, or give --law constant. {_values_if_constant(e)}"
    return Finding(Status.unidentified, cause)


TABLE_RULES = (
    *NEGATIVE,
    _refuted_law,
    _narrow_range,
    _improbable_chi2,
    _free_law,
    _determination,
)


def finding_of_table(evidence: TableEvidence) -> Finding:
    """Status and sentences of a table of lifetimes."""
    scatter = f"The table gives no errors; {evidence.noise or 0.0:.3g} h rms is their scatter"
    left_out = f"Left out as outliers: {', '.join(evidence.outliers)}"
    remarks = [scatter] * evidence.noise_inferred + [left_out] * bool(evidence.outliers)
    return _with_remarks(judge(evidence, TABLE_RULES), remarks)


def _with_remarks(found: Finding, remarks: Iterable[str | None]) -> Finding:
    """Append sentences to a finding; None is skipped."""
    return Finding(found.status, ". ".join([found.cause.rstrip("."), *filter(None, remarks)]) + ".")


def _course(e: Evidence) -> str | None:
    """Remark on a loss rate that changes from cycle to cycle."""
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


def _bend_within_cycles(e: Evidence) -> Finding | None:
    """Curvature within cycles that no loss has: no lifetime is quoted."""
    if not e.bends_impossibly:
        return None
    share, error = e.value_and_error("share")
    return Finding(
        Status.unidentified,
        f"The current bends within the cycles as no loss does: the share of a in it would be "
        f"{share:.2g} ± {error:.2g}, {e.outside:.1f} errors outside 0 to 1. Refills that the noise "
        "hides, fresh beam or vacuum after a refill, or a slow monitor do that, and the lifetime "
        "may be far off then: no error is given. Look at the mean of all cycles for steps, and "
        "leave out what follows a refill",
    )


def _single_current(e: Evidence) -> Finding | None:
    share, error = e.value_and_error("share")
    if error < SEPARABLE:
        return None
    return Finding(
        Status.unidentified,
        "The lifetime at the mean current is the answer; a and b are not separable at these "
        f"currents (share of a in the loss {share:.2g} ± {error:.2g}): let the beam decay "
        "farther once, or measure at another current",
    )


def _rising_current(e: Evidence) -> Finding | None:
    rate, error = e.normal_equivalent("rate_mean")
    if rate > -BELIEVED * error:
        return None
    cause = "The current rises, by injection or a drift of the monitor: this is no decay"
    return Finding(Status.infeasible, cause)


def _missed_refills(e: Evidence) -> Finding | None:
    """Refills that may have been missed: the lifetime then seems longer than it is."""
    if e.may_be_aliased:
        typical, interval = e.usual_cycle
        return Finding(
            Status.unidentified,
            "The beam is held by refills that the record may not resolve: of those that were found "
            f"the next comes after {typical:.3g} readings, but faster ones look the same when read "
            f"every {interval:.3g} s. Record more readings from refill to refill",
        )
    if e.hidden_refill is None:
        return None
    lost, limit = e.hidden_refill
    return Finding(
        Status.unidentified,
        f"A cycle of the {e.cycles} that were found loses {lost:.2g} mA, and refills below "
        f"{limit:.2g} mA can be missed in this noise: the beam then seems to live longer than it "
        "does. Average readings, or give the times of the refills by cutting the record there",
    )


CYCLE_RULES = (
    _rising_current,
    _missed_refills,
    _bend_within_cycles,
    *NEGATIVE,
    _held_by_refills,
    _within_noise,
    _refuted_law,
)
CYCLE_RULES += (_single_current, _improbable_chi2, _cycles_with_exponent, _determination)


def finding_of_cycles(
    evidence: Evidence, monitor: Monitor | None, left_out: Sequence[str]
) -> Finding:
    """Status and sentences of cycles fitted together; `left_out` says what was not fitted."""
    found, current = judge(evidence, CYCLE_RULES), evidence.expansion.pieces.current
    between = f"between {current.min():.4g} and {current.max():.4g} mA"
    first = f"One answer from {evidence.cycles} cycles {between}"
    remarks = [remark(evidence) for remark in CYCLE_REMARKS]
    remarks += [] if monitor is None else [_stated_stability(monitor)]
    remarks += [text[0].upper() + text[1:] for text in left_out]
    return _with_remarks(found._replace(cause=f"{first}. {found.cause}"), remarks)


def _inferred_noise(e: Evidence) -> str | None:
    if not e.noise_inferred:
        return None
    noise = f"{e.noise:.3g} mA rms is inferred from the residuals"
    return f"The record gives no errors; {noise}"


def _few_residuals(e: Evidence) -> str | None:
    """Remark on errors that few degrees of freedom determine."""
    words = few_dof_words(e.dof) if e.noise_inferred and e.independent else ""
    return words.removeprefix("; ").capitalize() or None


def _correlation(e: Evidence) -> str | None:
    found, length = e.separability, e.correlation_time
    if length is None or (e.quotes_free_law and not remembers(e.residuals, e.time.size - e.dof)):
        return None
    times = found.error_inflation
    than = f": they are {times:.1f} times those of independent readings" if times else ""
    span = float(e.time[-1] - e.time[0])
    over = f"over {length:.3g} s" if length < span else "longer than the record"
    return (
        f"Neighbouring residuals are correlated ({found.residual_correlation:.2f}, {over}), which "
        f"the errors contain{than}"
    )


def _errors_too_large(e: Evidence) -> str | None:
    """Remark on stated errors far above the scatter: the quoted errors are then too large."""
    if e.noise_inferred or not e.independent:
        return None
    if e.chi2 > MIN_REDUCED_CHI2 * e.dof or chi2_probability(e.chi2, e.dof) < 1 - POOR_FIT:
        return None
    return (
        f"chi²/dof is {e.chi2 / e.dof:.2g}: the stated errors are {(e.dof / e.chi2) ** 0.5:.2g} "
        "times the scatter, and so are those of a and b"
    )


def _setting_drift(e: Evidence) -> str | None:
    """Remark on settings that drift within a decay, in steps too small to split it."""
    part, said = max(len(e.record) // 10, 1), []
    for name, (label, factor, unit) in SETTING_LABELS.items():
        values = getattr(e.record.conditions, name)
        if values is None:
            continue
        first, last = (factor * float(np.median(v)) for v in (values[:part], values[-part:]))
        if abs(last - first) > SETTING_DRIFT * max(first, last):
            said.append(f"The {label} went from {first:.4g} to {last:.4g} {unit} within the decay")
    return f"{', '.join(said)}: a and b are of no one setting" if said else None


def _slow_residuals(e: Evidence) -> str | None:
    """Remark on slow residuals far above the scatter of neighbouring readings."""
    length, record, rival = e.correlation_time, e.record, e.explained
    local = noise_of(record.time, record.current)
    rms = float(np.std(e.residuals)) if rival is None else rival.scatter
    short = length is not None and length < record.span / 3
    if not e.expansion.has_memory or short or rms < SLOW_RESIDUAL_RATIO * local:
        return None
    return (
        f"Neighbouring readings scatter by {local:.2g} mA alone: the loss rate or the monitor "
        "changed several times or slowly, so look at the residuals before recording longer"
    )


def _quantisation(e: Evidence) -> str | None:
    # Where the readings are edges between digits a note says so.
    step, noise = None if e.record.mean else e.record.resolution, e.noise
    if e.record.error is not None:
        noise *= float(np.min(e.record.error))
    if step is None or step <= 2 * noise:
        return None
    return f"The readings are quantised in steps of {step:.3g} mA"


def _stated_stability(monitor: Monitor) -> str:
    return f"The errors contain a monitor that {monitor} (one standard deviation)"


def _monitor_drift(e: Evidence) -> str | None:
    """Remark on a monitor drift over the record, which residuals do not show."""
    if e.record.monitor is not None:
        return _stated_stability(e.record.monitor)
    if e.record.error is not None:
        return None
    names = ("a", "b") if e.separability.separable else ("rate_mean",)
    drift, name = min((e.drift_of_one_error(name), name) for name in names)
    if not math.isfinite(drift):
        return None
    label = {"rate_mean": "the lifetime"}.get(name, name)
    return (
        "The monitor's stability is not stated; a drift of "
        f"{drift:.2g} mA over the record would shift {label} by 1 σ"
    )


def _odd_lifetime(e: Evidence) -> str | None:
    rate, error = e.value_and_error("rate_mean")
    if not error < MAX_RELATIVE_ERROR * rate or 1 / MAX_LIFETIME < rate < 1 / MIN_LIFETIME:
        return None
    wrong = "milliseconds" if rate < 1 / MAX_LIFETIME else "minutes or hours"
    return (
        f"A lifetime of {1 / rate / HOUR:.2g} h is what {wrong} taken for seconds make: check the "
        "unit of the time"
    )


CYCLE_REMARKS = (_course, _inferred_noise, _correlation, _odd_lifetime)
REMARKS = (_setting_drift, _inferred_noise, _few_residuals, _errors_too_large, _correlation)
REMARKS += (_slow_residuals, _quantisation, _monitor_drift, _odd_lifetime)


def finding_of(evidence: Evidence) -> Finding:
    """Status and sentences of a decay: the gravest finding, then remarks."""
    found = judge(evidence, RULES)
    if found.status is Status.not_finite:
        return found
    return _with_remarks(found, (remark(evidence) for remark in REMARKS))
