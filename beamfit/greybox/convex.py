"""Proof that a problem is convex, so that a local optimum is the global one.

The rules of disciplined convex programming are applied to each operation of the compiled cost and
constraints (M. Grant, S. Boyd & Y. Ye, in Global Optimization, L. Liberti & N. Maculan eds.,
Springer 2006, 155). A quadratic cost is also convex if its constant Hessian has no negative
eigenvalue.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from beamfit.greybox import problem
from beamfit.greybox.problem import Problem

# Operations that only move elements, with the index of the first operand that holds positions; 0 if
# there is none.
MOVING = dict.fromkeys(
    """broadcast_in_dim concatenate expand_dims pad reshape rev slice split squeeze stack tile
    transpose unstack""".split(),  # noqa: SIM905
    0,
) | {"dynamic_slice": 1, "gather": 1, "dynamic_update_slice": 2}
# Linear operations on elements.
LINEAR = {"reduce_sum", "cumsum", "convert_element_type", "copy", "add", "add_any",
        "reduce_precision"}  # fmt: skip
# Operations that are linear if the operand of this index (positions or choices) is constant.
LINEAR_IF_CONSTANT = {"select_n": 0, "scatter": 1, "scatter-add": 1}
# Convex functions that never fall, and concave ones: they keep convex, or concave, arguments so.
RISING_CONVEX, RISING_CONCAVE = {"exp", "exp2", "expm1"}, {"log", "log1p", "sqrt"}
# Largest number of operations of a loop of known length that is followed step by step.
MAX_UNROLLED = 5_000
# Negative eigenvalues of a Hessian below this share of the largest are rounding.
EIGENVALUE_ROUNDING = 1e-12


class _Unknown(Exception):
    """Raised if no rule covers an operation."""


class Curvature(NamedTuple):
    """Curvature and polynomial degree of all elements of an array as functions of the free numbers.

    `sign` is 0 if they are affine, 1 if convex, -1 if concave, None if not known. `degree` is
    infinite if they are not polynomials.
    """

    sign: int | None
    degree: float


def convex(p: Problem) -> bool:
    """True if the problem is proved convex: a convex cost within a convex set."""
    try:
        cost = _curvature_of(p, problem.cost)
        limits = _curvature_of(p, problem.constraints) if p.constraints else Curvature(0, 0.0)
    except _Unknown:
        return False
    if not (cost.sign in (0, 1) or (cost.degree <= 2 and _is_positive(p))):
        return False
    # A convex function may be limited from above, a concave one from below.
    ends = {1: p.constraint_lower, -1: p.constraint_upper}
    straight = limits.sign == 0 or limits.degree <= 1
    return straight or (limits.sign in ends and not np.isfinite(ends[limits.sign]).any())


def _is_positive(p: Problem) -> bool:
    """True if the Hessian of a quadratic cost has no negative eigenvalue."""
    h = np.asarray(p.compiled(_hessian)(p.start))
    if not np.all(np.isfinite(h)):
        return False
    values = np.linalg.eigvalsh(h)
    return bool(values[0] >= -EIGENVALUE_ROUNDING * len(h) * max(values[-1], 0.0))


def _hessian(core, theta):
    return jax.hessian(problem.cost, 1)(core, theta)


def _curvature_of(p: Problem, function) -> Curvature:
    """Find the curvature of a compiled function of (core, theta) in theta."""
    program = function.trace(p.core, jnp.asarray(p.start)).jaxpr
    arguments = [*jax.tree.leaves(p.core), Curvature(0, 1.0)]
    (found,) = _propagate(program.jaxpr, program.consts, arguments)
    return found if isinstance(found, Curvature) else Curvature(0, 0.0)


def _propagate(program: Jaxpr, constants, arguments: list[Any]) -> list[Any]:
    """Propagate the curvatures of some arguments through a program; the others are arrays."""
    values: dict[Any, Any] = dict(zip(program.constvars, constants, strict=True))
    values |= dict(zip(program.invars, arguments, strict=True))

    def value(atom):
        return atom.val if isinstance(atom, Literal) else values[atom]

    for step in program.eqns:
        operands = [value(atom) for atom in step.invars]
        values |= dict(zip(step.outvars, _results(step, operands), strict=True))
    return [value(atom) for atom in program.outvars]


def _results(step, operands: list[Any]) -> list[Any]:
    """Find the results of one operation, arrays or curvatures."""
    name = step.primitive.name
    if not any(isinstance(v, Curvature) for v in operands):
        found = step.primitive.bind(*operands, **step.params)
        return list(found) if step.primitive.multiple_results else [found]
    called = (step.params.get(key) for key in ("jaxpr", "call_jaxpr", "fun_jaxpr"))
    inner = next((c for c in called if isinstance(c, ClosedJaxpr)), None)
    if inner is not None and name not in ("scan", "while", "cond"):
        return _propagate(inner.jaxpr, inner.consts, operands)
    if name == "scan" and step.params["length"] * len(inner.jaxpr.eqns) <= MAX_UNROLLED:
        return _unroll(step, inner, operands)
    found = _apply_rule(step, operands)
    if found.sign is None and not np.isfinite(found.degree):
        raise _Unknown
    return [found] * len(step.outvars)


def _unroll(step, inner: ClosedJaxpr, operands: list[Any]) -> list[Any]:
    """Propagate curvatures through a loop of known length, step by step.

    Arrays with one value for each step have one axis more outside the loop than within.
    """

    def same(outer, own) -> list[bool]:
        return [a.aval.shape == b.aval.shape for a, b in zip(outer, own, strict=True)]

    kept = sum(same(step.outvars, inner.jaxpr.outvars))
    fixed = sum(same(step.invars, inner.jaxpr.invars)) - kept
    constants, carry, each = operands[:fixed], operands[fixed:][:kept], operands[fixed + kept :]
    times = range(step.params["length"])[:: -1 if step.params["reverse"] else 1]
    found: dict[int, list[Any]] = {}
    for t in times:
        now = [v if isinstance(v, Curvature) else v[t] for v in each]
        ends = _propagate(inner.jaxpr, inner.consts, [*constants, *carry, *now])
        carry, found[t] = ends[:kept], ends[kept:]
    rows = [found[t] for t in range(len(times))]
    return [*carry, *map(_combine, zip(*rows, strict=True))]


def _combine(parts: tuple[Any, ...]) -> Any:
    """Combine the results of the steps of a loop."""
    numbers = [v for v in parts if isinstance(v, Curvature)]
    return _add(numbers) if numbers else np.stack(parts)


def _add(numbers: list[Curvature]) -> Curvature:
    return Curvature(_common_sign([v.sign for v in numbers]), max(v.degree for v in numbers))


def _apply_rule(step, operands: list[Any]) -> Curvature:
    """Find the curvature of an operation's result from those of its operands."""
    name = step.primitive.name
    numbers = [v for v in operands if isinstance(v, Curvature)]
    first, degree = numbers[0], max(v.degree for v in numbers)
    if name in LINEAR or _only_moved(name, operands):
        return _add(numbers)
    if name == "neg":
        return Curvature(_multiply_signs(first.sign, -1), degree)
    if name == "sub":
        signed = zip(operands, (1, -1), strict=True)
        signs = [_multiply_signs(v.sign, way) for v, way in signed if isinstance(v, Curvature)]
        return Curvature(_common_sign(signs), degree)
    if name in ("mul", "dot_general") or (name == "div" and not isinstance(operands[1], Curvature)):
        return _multiply(step, operands, numbers)
    if name in ("square", "integer_pow"):
        return _power(first, step.params.get("y", 2))
    return Curvature(_compose(name, numbers), np.inf)


def _only_moved(name: str, operands: list[Any]) -> bool:
    """True if an operation only moves or selects elements, with constant positions."""
    if name in LINEAR_IF_CONSTANT:
        return not isinstance(operands[LINEAR_IF_CONSTANT[name]], Curvature)
    first = MOVING.get(name, -1)
    places = operands[first:] if first > 0 else []
    return first >= 0 and not any(isinstance(v, Curvature) for v in places)


def _multiply(step, operands: list[Any], numbers: list[Curvature]) -> Curvature:
    if len(numbers) == 2:
        square = step.invars[0] is step.invars[1] and numbers[0].sign == 0
        return Curvature(1 if square else None, sum(v.degree for v in numbers))
    factor = np.asarray(next(v for v in operands if not isinstance(v, Curvature)))
    sign = 1 if np.all(factor >= 0) else -1 if np.all(factor <= 0) else None
    return Curvature(_multiply_signs(numbers[0].sign, sign), numbers[0].degree)


def _power(v: Curvature, power: int) -> Curvature:
    if power < 0:
        return Curvature(None, np.inf)
    return Curvature(1 if v.sign == 0 and power % 2 == 0 else None, v.degree * power)


def _compose(name: str, numbers: list[Curvature]) -> int | None:
    """Find the sign of the curvature of a function of convex or concave arguments, or None."""
    signs = {v.sign for v in numbers}
    if name in RISING_CONVEX | {"max", "reduce_max"} and signs <= {0, 1}:
        return 1
    if name in RISING_CONCAVE | {"min", "reduce_min"} and signs <= {0, -1}:
        return -1
    if name in ("abs", "cosh") and signs == {0}:
        return 1
    return None


def _common_sign(signs: list[int | None]) -> int | None:
    """Return the curvature of a sum: the common one of all terms that are not affine, else None."""
    bent = {sign for sign in signs if sign != 0}
    return 0 if not bent else bent.pop() if len(bent) == 1 else None


def _multiply_signs(sign: int | None, factor: int | None) -> int | None:
    return 0 if sign == 0 else None if sign is None or factor is None else sign * factor
