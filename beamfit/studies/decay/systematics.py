"""What no residual shows: how far a, b and the lifetime are off for causes that nobody measured."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from beamfit.lifetime.decay import HOUR
from beamfit.quantity import Status
from beamfit.shown import shown
from beamfit.studies.decay.evidence import UNITS
from beamfit.studies.decay.expansion import (
    POWER,
    Expansion,
    Physical,
    Pieces,
    expanded,
    further_columns,
)
from beamfit.studies.decay.fit import DecayFit, bare
from beamfit.studies.decay.record import DecayRecord
from beamfit.table import json_of

# The size of each cause that the table assumes; those of the monitor in mA, and in proportion
# below so many: a monitor of small currents is as good as that.
PRESSURE, DRIFT, OFFSET, EXPONENT = 0.01, 0.01, 0.1, -0.1
# The part of the gas that the beam makes: in electron rings the pressure with beam is often twice
# that without (O. Gröbner, CERN 99-05, p. 127).
FOLLOWING = 0.5
SMALL = 10.0


@shown
class Systematic(NamedTuple):
    """A cause and by how much it moves what was fitted.

    Attributes
    ----------
    cause : str
        In words, with its size.
    a, b, lifetime_mean : float
        Fitted less true value, 1/(mA s), 1/s and h.
    """

    cause: str
    a: float
    b: float
    lifetime_mean: float

    def to_json(self) -> dict[str, Any]:
        """Return the cause and the shifts as JSON's types."""
        moved = {name: bare(getattr(self, name), UNITS[name]) for name in self._fields[1:]}
        return json_of({"cause": self.cause, **moved})


def systematics(fit: DecayFit) -> tuple[Systematic, ...]:
    """Table of systematic errors of a fitted decay, each cause by itself.

    Parameters
    ----------
    fit : DecayFit
        With its readings, of a constant a.

    Returns
    -------
    tuple of Systematic
        Empty where a and b are impossible or not determined, a was given a shape, or many cycles
        were fitted. To first order each shift is proportional to its cause. A pressure that rises
        in the record and a bunch that lengthens are left out where the errors contain them.

    Notes
    -----
    A change of the readings d moves the numbers by (JᵀWJ)⁻¹ JᵀW d. A pressure that rises by the
    share e over the record adds -b e (t/T - 1/2) I to dI/dt: a column of the law, as an exponent
    is. A pressure P0 + P1 I adds the part that follows the current to a exactly: no decay tells it
    from a.

    Examples
    --------
    >>> from beamfit.lifetime.decay import current
    >>> from beamfit.studies.decay.fit import fit_decay
    >>> from beamfit.studies.decay.record import DecayRecord
    >>> t = np.linspace(0, 8 * 3600, 500)
    >>> noise = 1e-3 * np.random.default_rng(1).normal(size=t.size)
    >>> fit = fit_decay(DecayRecord(t, np.array(current(t, 500.0, 2e-8, 1e-6)) + noise))
    >>> [f"{100 * row.a / fit.a.value:.2f} %" for row in systematics(fit)]
    ['0.03 %', '0.00 %', '11.52 %']
    """
    a, b = fit.if_constant("a").value, fit.if_constant("b").value
    record, another = fit.readings, fit.shaped or fit.first is not None
    if record is None or another or fit.status is Status.infeasible or fit.a.error is None:
        return ()
    about = about_fit(fit)
    over, share = about.pieces.over, record.time / record.span
    grown = further_columns(about, "drift", np.zeros(1))[:, 0] * over * record.span
    rises = f"pressure rises by {100 * PRESSURE:g} % over the record"
    bends = f"a goes as I^{EXPONENT:g}, as of a bunch that lengthens"
    causes = {rises: b * PRESSURE * grown, **_monitor(record, share)}
    causes |= {bends: EXPONENT * (about.rows[:, POWER] * over)}
    if fit.free_law is not None:
        contained = {bends} if fit.free_law.drift is None else {bends, rises}
        causes = {cause: change for cause, change in causes.items() if cause not in contained}
    rate, found = a * fit.mean_current + b, []
    for cause, change in causes.items():
        moved = about.moved(change / over)
        lifetime = -moved.rate_mean / rate**2 / HOUR
        found.append(Systematic(cause, moved.a, moved.b, lifetime))
    gas = max(b, 0.0) * FOLLOWING / (1 - FOLLOWING)
    said = f"{100 * FOLLOWING:g} % of the pressure follows the current"
    return (*found, Systematic(said, gas / fit.mean_current, -gas, 0.0))


def _monitor(record: DecayRecord, share: np.ndarray) -> dict[str, np.ndarray]:
    """What is stated of the monitor, or else assumed."""
    if record.monitor is None:
        size = min(float(record.current.max()) / SMALL, 1.0)
        return {
            f"monitor drifts by {1e3 * DRIFT * size:.2g} µA over the record": DRIFT * size * share,
            f"monitor reads {OFFSET * size:.2g} mA too much": np.full(len(record), OFFSET * size),
        }
    stated = record.monitor.changes(record.time)
    return {f"monitor {cause} (in the errors)": moved for cause, moved in stated.items()}


def about_fit(fit: DecayFit) -> Expansion:
    """The law about a fit of a constant a."""
    i0, a, b = (fit.if_constant(name).value for name in ("i0", "a", "b"))
    rate, unused = a * fit.mean_current + b, np.nan
    values = Physical(i0, a, b, unused, unused, rate, unused, unused)
    return expanded(Pieces.of(fit.readings), values)
