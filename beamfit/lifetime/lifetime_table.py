"""A table of lifetimes against current: a, b and the same verdicts as of a decay."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.special import chdtrc, fdtrc

from beamfit.answer import Table, answer, json_of, labelled, plain_name
from beamfit.arrays import padded_length
from beamfit.errors import expect
from beamfit.greybox.fit import Derived, Fit
from beamfit.greybox.problem import Free, Problem, Record
from beamfit.greybox.solve import solve
from beamfit.lifetime.alternatives import CURRENTS, ConstantA, LifetimeLaw, constant_a
from beamfit.lifetime.answer import TableEvidence, finding_of_table
from beamfit.lifetime.evidence import EXACT, UNITS
from beamfit.lifetime.fit import bare, headline_of, loss_json
from beamfit.lifetime.record import FEWEST_LIFETIMES, LifetimeTable
from beamfit.quantity import HOUR, Quantity, Status
from beamfit.statistics import reach_of

# Points so many robust standard deviations off the law with a free exponent are outliers; no more
# than a fifth of them.
OUTLIER, MOST = 5.0, 0.2
# Prior probability that a point of a table is a bad one.
BAD = 0.03
RECORD = "lifetimes"


@answer
@dataclass(frozen=True, eq=False)
class LifetimeFit:
    """The result of `fit_lifetimes`.

    Parameters
    ----------
    record : str
        Name of the table.
    status, message
        As of `DecayFit`.
    a, b, lifetime_start, lifetime_mean, lifetime_end : Quantity
        As of `DecayFit`, the lifetimes at the highest, mean and lowest current.
    mean_current, chi2, dof
        As of `DecayFit`.
    constant_a, lifetimes
        As of `DecayFit`.
    share : Quantity
        Of a in the loss at the mean current.
    outliers : tuple of int
        Points that were left out, counted from 0.
    readings : LifetimeTable
        What was fitted.
    """

    record: str
    status: Status
    message: str
    a: Quantity
    b: Quantity
    lifetime_start: Quantity
    lifetime_mean: Quantity
    lifetime_end: Quantity
    mean_current: float
    chi2: float
    dof: int
    constant_a: ConstantA
    lifetimes: LifetimeLaw | None
    share: Quantity
    outliers: tuple[int, ...]
    readings: LifetimeTable

    @property
    def quantities(self) -> dict[str, Quantity]:
        """Quoted quantities, by name."""
        return {name: getattr(self, name) for name in UNITS if name != "i0"}

    @property
    def headline(self) -> str:
        """The answer in a line."""
        return headline_of(self)

    @property
    def noise_inferred(self) -> bool:
        """True if the table came without errors."""
        return self.readings.error is None

    @property
    def identifiability(self) -> dict[str, Any]:
        """Separability of a and b by the table, and the share of a in the loss."""
        share, error = self.share.value, self.share.error
        return {"separable": self.a.error is not None, "share": share, "share_error": error}

    def tables(self) -> tuple[Table, ...]:
        """Quoted quantities, to be shown."""
        rows = [(plain_name(name), [value]) for name, value in self.quantities.items()]
        rows.append(("share of a in the loss", [self.share]))
        tested = f"{self.chi2:.4g}/{self.dof}"
        chi2 = f"not testable ({self.dof} dof)" if self.noise_inferred else tested
        rows = [("status", [self.status]), *rows, ("chi2/dof", [chi2])]
        return (labelled("", [self.record], rows),)

    def to_json(self) -> dict[str, Any]:
        """Return the result as one JSON object, with what was left out."""
        more = {"i0": bare(None, "mA"), "outliers": self.outliers, "notes": self.readings.notes}
        return loss_json(self) | json_of(more)


def _rate(model: dict[str, Array], x: Array) -> Array:
    """Loss rate over that at the mean current, 1, from the share of a there and its exponent."""
    return model["rate"] * (1 + model["share"] * (x ** (1 + model["exponent"]) - 1))


def _lifetimes(model: dict[str, Array], x: Array) -> Array:
    return 1 / jnp.maximum(_rate(model, x), 1e-6)


def _quoted(model: dict[str, Array], ends: Array) -> Array:
    """a I, b, and the rates at the ends, in units of the usual rate; share and exponent."""
    quadratic = model["rate"] * model["share"]
    rest = jnp.stack([quadratic, model["rate"] - quadratic, model["share"], model["exponent"]])
    return jnp.concatenate([rest, _rate(model, ends)])


def _solved(table: LifetimeTable, rows: np.ndarray, exponent: bool) -> Fit:
    """Fit in units of the mean current and the median lifetime; rows of weight 0 are padding."""
    more, usual = (0, padded_length(len(table)) - len(table)), float(np.median(table.lifetime))
    columns = [table.current / table.current.mean(), table.lifetime / usual]
    columns += [] if table.error is None else [table.error / usual]
    x, lifetime, *error = (np.pad(column, more, mode="edge") for column in columns)
    free = [Free("rate", 1e-3, 1e3), Free("share")] + [Free("exponent", -3.0, 3.0)] * exponent
    weight = np.pad(rows.astype(float), more)
    record = Record(RECORD, _lifetimes, x, lifetime, *(error or [None]), weight)
    return solve(Problem({"rate": 1.0, "share": 0.5, "exponent": 0.0}, free, [record]))


def _outliers(table: LifetimeTable) -> np.ndarray:
    """Which points lie off every smooth law, the farthest first, one at a time."""
    kept = np.ones(len(table), bool)
    for _ in range(int(MOST * len(table))):
        bends = bool(kept.sum() > FEWEST_LIFETIMES)
        found = _solved(table, kept, exponent=bends)
        pulls = np.asarray(found.problem.residual(found.theta))[: len(table)]
        scatter = 1.4826 * np.median(np.abs(pulls[kept]))
        scatter = scatter if table.error is None else max(1.0, scatter)
        worst = int(np.argmax(np.abs(pulls)))
        if abs(pulls[worst]) <= OUTLIER * scatter:
            worst = _bends_alone(table, kept, pulls) if bends else None
        if worst is None:
            break
        kept[worst] = False
    return ~kept


class _Off(NamedTuple):
    """The point farthest off the constant law of the others, by so many errors squared, and the sum
    of squares without it.
    """

    point: int
    squared: float
    rest: float


def _farthest_off(table: LifetimeTable, kept: np.ndarray) -> _Off:
    """Point with the largest residual from the others (R. D. Cook and S. Weisberg, Residuals and
    influence in regression, 1982, eq. 2.2.8), in the loss rates, which are linear in the current.
    """
    rows = np.flatnonzero(kept)
    current, lifetime, given = table.current[rows], table.lifetime[rows], table.error is not None
    error = table.error[rows] if given else np.full(rows.size, np.median(lifetime))
    columns = np.column_stack([current / current.mean(), np.ones(rows.size)])
    basis = np.linalg.qr(columns * (lifetime**2 / error)[:, None])[0]
    rates = lifetime / error
    left, free = rates - basis @ (basis.T @ rates), 1 - np.sum(basis**2, axis=1)
    falls = left**2 / np.maximum(free, 1e-12)
    worst = int(np.argmax(falls))
    rest = max(float(left @ left - falls[worst]), 1e-300)
    unit = 1.0 if given else rest / max(rows.size - 3, 1)
    return _Off(int(rows[worst]), float(falls[worst]) / unit, rest)


def _bends_alone(table: LifetimeTable, kept: np.ndarray, power: np.ndarray) -> int | None:
    """The point that lies off the constant law of the others, if that law without it is likelier
    than an exponent with it (`power` has its residuals), as where it stands at an end.
    """
    off, count = _farthest_off(table, kept), int(kept.sum())
    squares = max(float(power[kept] @ power[kept]), 1e-300)
    given = table.error is not None
    better = squares - off.rest if given else (count - 3) * math.log(squares / off.rest)
    likelier = better > 2 * math.log(count / BAD)
    return off.point if off.squared > OUTLIER**2 and likelier else None


def _tested(table: LifetimeTable, plain: Fit, power: Fit) -> ConstantA:
    """Test a constant a by the fall of chi², which knows no curvature."""
    before, after = plain.group(RECORD), power.group(RECORD)
    found, dof = power["exponent"], max(after.dof, 1.0)
    fall = max(before.chi2 - after.chi2, 0.0)
    if table.error is None:
        chance = fdtrc(1.0, dof, fall * dof / max(after.chi2, len(table) * EXACT**2))
    else:
        chance = chdtrc(1, fall / max(1.0, after.chi2 / dof))
    return constant_a(found.value, found.error, found.error_raw, float(chance))


def fit_lifetimes(table: LifetimeTable) -> LifetimeFit:
    """Fit 1/tau = a I + b to lifetimes at several currents.

    Parameters
    ----------
    table : LifetimeTable
        Four points or more.

    Returns
    -------
    LifetimeFit
        With the verdicts of a decay. Where a constant a is refuted, the lifetimes are those of a
        law with a free exponent.

    Notes
    -----
    Least squares on the lifetimes themselves: their errors, and not those of 1/tau, are what is
    stated. Points five robust standard deviations off a law with a free exponent are left out and
    named.

    Examples
    --------
    >>> from beamfit.lifetime.record import LifetimeTable
    >>> current = np.linspace(100, 500, 9)
    >>> fit = fit_lifetimes(LifetimeTable(current, 1 / (1e-4 * current + 0.01), np.full(9, 0.1)))
    >>> fit.status.value, f"{fit.a.value * 3600:.4e}"
    ('converged', '1.0000e-04')
    """
    expect(table, LifetimeTable, "read_lifetimes(path)")
    left_out = _outliers(table)
    plain, power = (_solved(table, ~left_out, exponent) for exponent in (False, True))
    test, group = _tested(table, plain, power), plain.group(RECORD)
    given, refuted = table.error is not None, test.status is Status.poor_fit
    mean, usual = float(table.current.mean()), float(np.median(table.lifetime)) * HOUR
    ends = np.array([table.current.max(), mean, table.current.min()]) / mean
    law, quoted = (fit.derive(_quoted, ends) for fit in (plain, power if refuted else plain))
    scale = {"a": usual * mean, "b": usual, "share": 1.0}
    numbers = {
        name: (float(value) / unit, max(float(error), EXACT) / unit)
        for (name, unit), value, error in zip(scale.items(), law.value, law.error, strict=False)
    }
    evidence = TableEvidence(
        numbers, float(group.chi2), round(group.dof), test,
        _by_current(table, power) if refuted else None, _named(table, left_out),
        None if given else group.scale * usual / HOUR,
    )  # fmt: skip
    finding, far = finding_of_table(evidence), _reach(table, plain)
    off = _farthest_off(table, ~left_out)
    if off.squared > OUTLIER**2:
        [named] = _named(table, np.arange(len(table)) == off.point)
        more = f"{named[0].upper()}{named[1:]} lies {math.sqrt(off.squared):.2g} errors off the"
        more += " constant law of the others: measure it again"
        finding = finding._replace(cause=f"{finding.message} {more}.")

    def quantity(name: str, raw: float | None = None) -> Quantity:
        value, error = numbers[name]
        return Quantity.reaching(value, error, UNITS.get(name, "1"), raw, far * error)

    a, b = (quantity(n, float(law.error_raw[k]) / scale[n]) for k, n in enumerate("ab"))
    if finding.status is Status.unidentified:
        a, b = a.open(), b.open()
    return LifetimeFit(
        table.name, finding.status, finding.message, a, b, *_lifetimes_of(table, quoted, far),
        mean, evidence.chi2 if given else float(evidence.dof), evidence.dof, test,
        evidence.lifetimes, quantity("share"), tuple(map(int, np.flatnonzero(left_out))), table,
    )  # fmt: skip


def _reach(table: LifetimeTable, fit: Fit) -> float:
    """Half of the 95 % interval, in standard errors."""
    return reach_of(math.inf if table.error is not None else round(fit.group(RECORD).dof))


def _lifetimes_of(table: LifetimeTable, found: Derived, far: float) -> list[Quantity]:
    """Lifetimes of the rates that `_quoted` gives."""
    rate, error = found.value[4:], found.error[4:]
    lifetime = float(np.median(table.lifetime)) / rate
    pairs = zip(lifetime, lifetime * np.maximum(error / rate, EXACT), strict=True)
    return [Quantity.reaching(float(v), float(e), "h", None, far * float(e)) for v, e in pairs]


def _by_current(table: LifetimeTable, power: Fit) -> LifetimeLaw:
    current = np.geomspace(table.current.min(), table.current.max(), CURRENTS)
    found, far = power.derive(_quoted, current / table.current.mean()), _reach(table, power)
    value, error = float(found.value[3]), float(found.error[3])
    exponent = Quantity.reaching(value, error, "1", None, far * error)
    lifetimes = tuple(_lifetimes_of(table, found, far))
    return LifetimeLaw(tuple(map(float, current)), lifetimes, exponent)


def _named(table: LifetimeTable, which: np.ndarray) -> tuple[str, ...]:
    return tuple(
        f"point {k + 1} ({table.lifetime[k]:.4g} h at {table.current[k]:.4g} mA)"
        for k in np.flatnonzero(which)
    )
