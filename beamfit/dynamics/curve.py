"""What is quoted of an identified response: constants with errors, curves with bands."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.dynamics.checks import Checks
from beamfit.dynamics.model import PreparedOutput, curves
from beamfit.dynamics.response import ARX, FIRST_ORDER, SECOND_ORDER, Physics
from beamfit.greybox.fit import Derived, Fit
from beamfit.greybox.memory import Memory
from beamfit.quantity import Quantity
from beamfit.statistics import POOR_FIT
from beamfit.table import Table, cell, json_of

# Points of a curve; samples within a share of its range that make a point visited.
POINTS, VISITS, NEAR = 41, 5, 0.05
# Points of a curve in JSON and tables.
SHOWN = 9
# A time constant with a relative error above this is compatible with 0 and with infinity.
WIDE = 0.5
TIME, GAIN, PURE = "s", "output/input", "1"


class Curve(NamedTuple):
    """A parameter against one input, the others at their means.

    Attributes
    ----------
    parameter, input : str
        What, against what.
    unit : str
        Of the parameter.
    at, value, error : ndarray
        Shape (points,); errors are NaN where the data do not determine the value.
    visited : ndarray of bool
        Whether the runs were there.
    """

    parameter: str
    input: str
    unit: str
    at: np.ndarray
    value: np.ndarray
    error: np.ndarray
    visited: np.ndarray

    def quantity(self, i: int) -> Quantity:
        """The value at one point, without an error where the runs never were."""
        known = self.visited[i] and np.isfinite(self.error[i])
        return Quantity(float(self.value[i]), float(self.error[i]) if known else None, self.unit)

    def table(self) -> Table:
        """A few points, to be shown."""
        rows = [
            [f"{self.at[i]:.4g}", cell(self.quantity(i)), "" if self.visited[i] else "not visited"]
            for i in np.linspace(0, len(self.at) - 1, SHOWN).round().astype(int)
        ]
        return Table(f"{self.parameter} by {self.input}", [self.input, self.parameter, ""], rows)

    def to_json(self) -> dict[str, Any]:
        """Arrays with null where nothing is known."""
        known = np.where(self.visited, self.error, np.nan)
        fields = self._asdict() | {"error": known}
        return json_of({k: _nulls(v) if k in ("value", "error") else v for k, v in fields.items()})


def _nulls(values: np.ndarray) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]


def _units(physics: Physics, m: int) -> list[str]:
    return [TIME if time else GAIN if gain else PURE for time, gain in physics.units(m)]


def _constants(model: Any, seen: Any) -> jax.Array:
    p = curves(model, (seen, seen.u[:1]))[0]
    if seen.physics is ARX:  # settled, y = K u
        m = seen.u.shape[1]
        return jnp.concatenate([p, (p[2 : 2 + m] + p[2 + m :]) / (1.0 + p[0] + p[1])])
    if seen.physics is not SECOND_ORDER:
        return p
    # Both lags of eq 8 where there are two: T (zeta ± sqrt(zeta² - 1)).
    root = jnp.sqrt(jnp.maximum(p[1] ** 2 - 1.0, 1e-12))
    return jnp.concatenate([p, p[0] * (p[1] + jnp.stack([root, -root]))])


def _offset(model: Any, seen: Any) -> jax.Array:
    return model["offset"]


def _late(model: Any, of: tuple[Any, float]) -> jax.Array:
    apart = jnp.median(jnp.diff(of[0].time))
    return (of[1] + model["late"]) * apart


def quantities_of(
    fit: Fit, errors: Memory | None, seen: PreparedOutput, physics: Physics, delay: float
) -> dict[str, Quantity]:
    """Constant parameters with errors, and the offset if it is free."""
    m = len(seen.inputs)
    found = derived(fit, errors, _constants, seen.runs[0])
    names, units = list(physics.parameters(seen.inputs)), _units(physics, m)
    if physics is SECOND_ORDER and found.value[1] > 1.0:
        names, units = [*names, "tau1", "tau2"], [*units, TIME, TIME]
    if physics is ARX:
        names, units = [*names, *FIRST_ORDER.parameters(seen.inputs)[1:]], [*units, *[GAIN] * m]
    said = {
        name: quantity(found, i, unit)
        for i, (name, unit) in enumerate(zip(names, units, strict=True))
    }
    free = {v.name for v in fit.variables}
    if "offset" in free:
        said["offset"] = quantity(derived(fit, errors, _offset, seen.runs[0]), (), "output")
    if "late" in free:
        said["delay"] = quantity(derived(fit, errors, _late, (seen.runs[0], delay)), (), TIME)
    return said


def derived(fit: Fit, errors: Memory | None, function: Callable, data: Any) -> Derived:
    """Numbers of a fit, with errors averaged over what is open of a noise with a memory."""
    found = fit.derive(function, data)
    if errors is None:
        return found
    slopes = found.slope.reshape(-1, found.slope.shape[-1])
    known = errors.moments(slopes).error.reshape(found.value.shape)
    return found._replace(error=np.where(np.isfinite(found.error), known, np.nan))


def quantity(found: Derived, i: Any, unit: str) -> Quantity:
    """A quantity; it has no error where the data do not determine it."""
    error, raw = (float(e[i]) for e in (found.error, found.error_raw))
    known = np.isfinite(error)
    return Quantity(float(found.value[i]), error if known else None, unit, raw if known else None)


def told(
    quantities: Mapping[str, Quantity],
    curves: Sequence[Curve],
    seen: PreparedOutput,
    checks: Checks,
) -> tuple[dict[str, Quantity], tuple[Curve, ...]]:
    """Quantities and curves with errors only where the runs determine them.

    No errors: of anything where the inputs explain no more than chance, of the gains of inputs that
    move together, of time constants compatible with 0.
    """
    nothing = checks.nothing_probability >= POOR_FIT
    physics, inputs = seen.runs[0].physics, seen.inputs
    powers = zip(physics.parameters(inputs), physics.units(len(inputs)), strict=True)
    gains = [name for name, (_, gain) in powers if gain]
    joint = {n for k, n in enumerate(gains) if inputs[k % len(inputs)] in checks.together}

    def is_open(name: str, q: Quantity) -> bool:
        wide = q.unit == TIME and q.error is not None and q.error > WIDE * abs(q.value)
        # Of a higher order that is a first one: its gains and its longer lag are told.
        more = checks.first_order and not name.startswith(("K", "offset", "tau1", "delay"))
        return nothing or wide or more or name in joint

    known = {n: q.open() if is_open(n, q) else q for n, q in quantities.items()}
    blank = (nothing or c.parameter in joint for c in curves)
    return known, tuple(
        c._replace(error=np.full_like(c.error, np.nan)) if b else c
        for c, b in zip(curves, blank, strict=True)
    )


def curves_of(fit: Fit, errors: Memory | None, seen: PreparedOutput) -> tuple[Curve, ...]:
    """Every parameter against every input."""
    physics, m = seen.runs[0].physics, len(seen.inputs)
    points, made = seen.points, []
    for j, name in enumerate(seen.inputs):
        low, high = points[:, j].min(), points[:, j].max()
        grid = np.tile(seen.mean_u, (POINTS, 1))
        grid[:, j] = at = np.linspace(low, high, POINTS)
        apart = np.abs(points[:, j][None, :] - at[:, None])
        visited = np.sum(apart <= NEAR * (high - low), axis=1) >= VISITS
        found = derived(fit, errors, curves, (seen.runs[0], jnp.asarray(grid)))
        names = physics.parameters(seen.inputs)
        made += [
            Curve(names[i], name, unit, at, found.value[:, i], found.error[:, i], visited)
            for i, unit in enumerate(_units(physics, m))
        ]
    return tuple(made)
