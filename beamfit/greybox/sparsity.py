"""Pattern of a Jacobian: which outputs depend on which numbers, and in how few sweeps it is had.

Properties of values, here sets of numbers, are handed through the program of a JAX function,
operation by operation: those that compute element by element unite sets, those that only move
elements are run on the elements' places instead, sums and products of matrices unite rows. An
operation that is not known is taken to mix all that it is given, so that no dependence is missed.
Columns that share no row are computed in one sweep (A. R. Curtis, M. J. D. Powell & J. K. Reid,
J. Inst. Math. Appl. 13 (1974) 117).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal
from scipy import sparse

# Operations that move elements, with the first operand that says where to, 0 if none does.
MOVES = dict.fromkeys(
    """broadcast_in_dim concatenate expand_dims pad reshape rev slice split squeeze stack tile
    transpose unstack""".split(),  # noqa: SIM905
    0,
) | {"dynamic_slice": 1, "gather": 1, "dynamic_update_slice": 2}
# Operations up to which a loop of known length is unrolled.
UNROLLED = 5_000

Rule = Callable[[Any, list[Any]], list[Any]]


def followed(program: ClosedJaxpr, arguments: Sequence[Any], rule: Rule, kind: type) -> list[Any]:
    """Follow properties of some arguments of a program to its results.

    Parameters
    ----------
    program : ClosedJaxpr
        From `jax.make_jaxpr`.
    arguments : sequence
        One for each of its inputs: an array, or a property where it is not fixed.
    rule : callable
        ``rule(step, operands)``: the properties of the results of one operation. Operands that do
        not depend on what is not fixed are arrays.
    kind : type
        The class of the properties.

    Returns
    -------
    list
        A property or an array for each result.
    """
    return _walk(program.jaxpr, program.consts, list(arguments), rule, kind)


def moves(step, operands: list[Any], kind: type) -> bool:
    """True if an operation only moves elements, to known positions."""
    first = MOVES.get(step.primitive.name)
    return first is not None and not (first and any(isinstance(v, kind) for v in operands[first:]))


def _walk(program: Jaxpr, constants, arguments: list, rule: Rule, kind: type) -> list[Any]:
    known: dict[Any, Any] = dict(zip(program.constvars, constants, strict=True))
    known |= dict(zip(program.invars, arguments, strict=True))

    def value(atom):
        return atom.val if isinstance(atom, Literal) else known[atom]

    for step in program.eqns:
        operands = [value(atom) for atom in step.invars]
        known |= dict(zip(step.outvars, _results(step, operands, rule, kind), strict=True))
    return [value(atom) for atom in program.outvars]


def _results(step, operands: list[Any], rule: Rule, kind: type) -> list[Any]:
    name, inner = step.primitive.name, _inner(step.params)
    if not any(isinstance(v, kind) for v in operands):
        found = step.primitive.bind(*operands, **step.params)
        return list(found) if step.primitive.multiple_results else [found]
    if inner is not None and name not in ("scan", "while", "cond"):
        return _walk(inner.jaxpr, inner.consts, operands, rule, kind)
    if name == "scan" and step.params["length"] * len(inner.jaxpr.eqns) <= UNROLLED:
        return _unrolled(step, inner, operands, rule, kind)
    return rule(step, operands)


def _inner(params: dict[str, Any]) -> ClosedJaxpr | None:
    """The program that an operation calls with its operands."""
    for name in ("jaxpr", "call_jaxpr", "fun_jaxpr"):
        if isinstance(found := params.get(name), ClosedJaxpr):
            return found
    return None


def _unrolled(step, inner: ClosedJaxpr, operands: list, rule: Rule, kind: type) -> list[Any]:
    """A loop over a known length, its elements taken and put together by their own operations."""
    fixed, kept = step.params["num_consts"], step.params["num_carry"]
    constants, carry, each = operands[:fixed], operands[fixed:][:kept], operands[fixed + kept :]
    takes = [_take(v.aval) for v in step.invars[fixed + kept :]]
    found: list[list[Any]] = []
    times = range(step.params["length"])
    for t in reversed(times) if step.params["reverse"] else times:
        at = jnp.asarray(t)
        now = [_walk(take.jaxpr, take.consts, [v, at], rule, kind)[0]
               for take, v in zip(takes, each, strict=True)]  # fmt: skip
        ends = _walk(inner.jaxpr, inner.consts, [*constants, *carry, *now], rule, kind)
        carry = ends[:kept]
        found.append(ends[kept:])
    if step.params["reverse"]:
        found.reverse()
    parts = zip(zip(*found, strict=True), step.outvars[kept:], strict=True)
    return [*carry, *(_put(list(part), out.aval, rule, kind) for part, out in parts)]


def _take(like) -> ClosedJaxpr:
    """The program of one element of an array at a place."""
    whole = jax.ShapeDtypeStruct(like.shape, like.dtype)
    return jax.make_jaxpr(jax.lax.dynamic_index_in_dim, static_argnums=(2, 3))(whole, 0, 0, False)


def _put(parts: list[Any], like, rule: Rule, kind: type) -> Any:
    """Elements as one array."""
    shape = jax.ShapeDtypeStruct(like.shape[1:], like.dtype)
    program = jax.make_jaxpr(lambda *v: jnp.concatenate([jnp.expand_dims(p, 0) for p in v]))
    program = program(*[shape] * len(parts))
    return _walk(program.jaxpr, program.consts, parts, rule, kind)[0]


# Operations whose elements each depend on the elements at the same place.
ELEMENTWISE = frozenset(
    """abs acos acosh add add_any asin asinh atan atan2 atanh cbrt convert_element_type copy copy_p
    cos cosh digamma div erf erf_inv erfc exp exp2 expm1 integer_pow lgamma log log1p logistic max
    min mul neg optimization_barrier pow reduce_precision rem rsqrt select_n sin sinh sqrt square
    stop_gradient sub tan tanh xlog1py xlogy""".split()  # noqa: SIM905
)
REDUCTIONS = {"reduce_sum", "reduce_max", "reduce_min", "reduce_prod"}
# Relative difference between probe and matrix up to which the pattern is complete.
PROBE = 1e-9
# Share of nonzero entries above which dense matrices are faster.
FULL = 0.25


class _Dense(Exception):
    """The pattern has too many places to be of use."""


class Sets(NamedTuple):
    """Numbers on which each element of an array depends: a Boolean matrix (elements, numbers)."""

    shape: tuple[int, ...]
    rows: sparse.csr_array


@dataclass(frozen=True, eq=False)
class Pattern:
    """Places of a Jacobian that may differ from zero, by rows, and sweeps that give them.

    `indptr` and `columns` are those of a CSR matrix of `shape`, `colours` (n,) the sweep of each
    column.
    """

    shape: tuple[int, int]
    indptr: np.ndarray
    columns: np.ndarray
    colours: np.ndarray

    @cached_property
    def seeds(self) -> np.ndarray:
        """A direction for each sweep, and one of all numbers that tells a wrong pattern."""
        sweeps = np.zeros((int(self.colours.max(initial=-1)) + 2, self.shape[1]))
        sweeps[self.colours, np.arange(self.shape[1])] = 1.0
        sweeps[-1] = np.random.default_rng(0).uniform(0.5, 1.0, self.shape[1])
        return sweeps

    def holds(self, found: sparse.csr_array, swept: np.ndarray) -> bool:
        """True if a sweep along all numbers agrees with the matrix: the pattern is complete."""
        size = abs(found) @ self.seeds[-1]
        wrong = np.abs(found @ self.seeds[-1] - swept[-1])
        return not np.any(wrong > PROBE * (size + np.max(size, initial=0.0)))

    def matrix(self, swept: np.ndarray) -> sparse.csr_array:
        """The Jacobian from its products with the seeds, shape (sweeps, m)."""
        rows = np.repeat(np.arange(self.shape[0]), np.diff(self.indptr))
        values = swept[self.colours[self.columns], rows]
        return sparse.csr_array((values, self.columns, self.indptr), shape=self.shape)


def pattern_of(program: ClosedJaxpr, given: Sequence[Any], n: int) -> Pattern | None:
    """Find the pattern of a function's Jacobian; None where it is of no use.

    Parameters
    ----------
    program : ClosedJaxpr
        The function, whose last argument is an array of shape (n,), and its result (m,).
    given : sequence of array
        Its other arguments.
    n : int
        How many numbers there are.

    Returns
    -------
    Pattern or None

    Examples
    --------
    >>> import beamfit.greybox
    >>> found = pattern_of(jax.make_jaxpr(lambda x: x[1:] * x[:-1])(np.zeros(9)), [], 9)
    >>> found.columns.tolist()[:6], found.colours.tolist()[:4]
    ([0, 1, 1, 2, 2, 3], [0, 1, 0, 1])
    """
    each = Sets((n,), sparse.eye_array(n, dtype=bool, format="csr"))
    try:
        (found,) = followed(program, [*given, each], _capped_sets, Sets)
    except _Dense:
        return None
    if not isinstance(found, Sets):
        return None
    rows = found.rows
    rows.sum_duplicates()
    if rows.nnz > FULL * rows.shape[0] * rows.shape[1]:
        return None
    colours = _colours(rows)
    if colours.max(initial=0) >= FULL * n:
        return None
    return Pattern(rows.shape, rows.indptr, rows.indices, colours)


def _colours(rows: sparse.csr_array) -> np.ndarray:
    """The first sweep for each column in which no other has one of its rows."""
    columns = rows.tocsc()
    used, found = [0] * rows.shape[0], []
    places, ends = columns.indices.tolist(), columns.indptr.tolist()
    for first, last in pairwise(ends):
        own, taken = places[first:last], 0
        for row in own:
            taken |= used[row]
        free = ~taken & (taken + 1)  # the lowest bit that is not set
        for row in own:
            used[row] |= free
        found.append(free.bit_length() - 1)
    return np.array(found, int)


def _capped_sets(step, operands: list) -> list[Sets]:
    return [_capped(s) for s in _sets(step, operands)]


def _capped(s: Sets) -> Sets:
    if s.rows.nnz > max(FULL * s.rows.shape[0] * s.rows.shape[1], 100 * s.rows.shape[1]):
        raise _Dense
    return s


def _sets(step, operands: list) -> list[Sets]:
    name, numbers = step.primitive.name, next(v for v in operands if isinstance(v, Sets))
    shapes, n = [v.aval.shape for v in step.outvars], numbers.rows.shape[1]
    # Integers and truth values have no derivatives.
    if all(not jnp.issubdtype(v.aval.dtype, jnp.inexact) for v in step.outvars):
        return [Sets(shape, _none(shape, n)) for shape in shapes]
    depends = [v for v in operands if isinstance(v, Sets)]
    if name in ELEMENTWISE and all(v.shape == shapes[0] for v in depends):
        return [Sets(shapes[0], sum((v.rows for v in depends[1:]), depends[0].rows))]
    if moves(step, operands, Sets):
        return _moved(step, operands, shapes, n)
    if name in REDUCTIONS:
        kept = [1 if i in step.params["axes"] else k for i, k in enumerate(numbers.shape)]
        target = np.arange(int(np.prod(shapes[0]))).reshape(kept)
        return [_united(numbers, np.broadcast_to(target, numbers.shape).ravel(), shapes[0])]
    if name in ("scatter", "scatter-add") and not isinstance(operands[1], Sets):
        return [_scattered(step, operands, n)]
    if name == "dot_general":
        return [_product(operands, step.params["dimension_numbers"][0:2], shapes[0], n)]
    every = sparse.csr_array(sum(v.rows.sum(axis=0) for v in depends) > 0).reshape(1, n)
    if any(np.prod(shape) * every.nnz > FULL * n * max(np.prod(shape), n) for shape in shapes):
        raise _Dense
    return [Sets(s, sparse.csr_array(sparse.vstack([every] * int(np.prod(s))))) for s in shapes]


def _none(shape: tuple[int, ...], n: int) -> sparse.csr_array:
    return sparse.csr_array((int(np.prod(shape)), n), dtype=bool)


def _moved(step, operands: list, shapes: list, n: int) -> list[Sets]:
    """Run an operation on the places of elements, -1 for what depends on nothing."""
    told, places, stacked, first = MOVES[step.primitive.name], [], [], 0
    for i, v in enumerate(operands):
        if told and i >= told:
            places.append(v)
        elif isinstance(v, Sets):
            count = v.rows.shape[0]
            places.append(jnp.arange(first, first + count).reshape(v.shape))
            stacked.append(v.rows)
            first += count
        else:
            places.append(jnp.full(np.shape(v), -1))
    params = dict(step.params)
    if params.get("fill_value", 0) is None:
        params["fill_value"] = -1
    found = step.primitive.bind(*places, **params)
    found = found if step.primitive.multiple_results else [found]
    rows = sparse.csr_array(sparse.vstack([*stacked, _none((1,), n)]))  # of -1: the last
    return [Sets(s, rows[np.ravel(at)]) for s, at in zip(shapes, found, strict=True)]


def _scattered(step, operands: list, n: int) -> Sets:
    """Unite what is there with what is written or added to it."""
    there, indices, written = operands
    shape = there.shape if isinstance(there, Sets) else np.shape(there)
    rows = there.rows if isinstance(there, Sets) else _none(shape, n)
    if not isinstance(written, Sets):
        return Sets(shape, rows)
    # The transpose reads, for each element written, the place it was written to.
    back = jax.linear_transpose(
        lambda t: step.primitive.bind(jnp.zeros(shape), indices, t, **step.params),
        jax.ShapeDtypeStruct(written.shape, float),
    )
    places = jnp.arange(1.0, rows.shape[0] + 1).reshape(shape)
    target = np.ravel(back(places)[0]).astype(int) - 1
    inside = np.flatnonzero(target >= 0)
    entries = (np.ones(len(inside), bool), (target[inside], inside))
    size = (rows.shape[0], written.rows.shape[0])
    added = sparse.csr_array(entries, shape=size) @ written.rows
    return Sets(shape, sparse.csr_array(rows + added))


def _united(s: Sets, target: np.ndarray, shape: tuple[int, ...]) -> Sets:
    """Unite the sets of elements that go to one place each."""
    size = int(np.prod(shape))
    places = (np.ones(len(target), bool), (target, np.arange(len(target))))
    return Sets(shape, sparse.csr_array(places, shape=(size, len(target))) @ s.rows)


def _product(operands: list, dimensions, shape: tuple[int, ...], n: int) -> Sets:
    """Unite what a product of matrices sums, without what a known factor makes zero."""
    # Axes of both factors: batch, own, summed; the product has batch, left's own, right's own.
    parts = []
    for v, summed, batch in zip(operands, *dimensions, strict=True):
        size = v.shape if isinstance(v, Sets) else np.shape(v)
        own = [i for i in range(len(size)) if i not in (*summed, *batch)]
        order = (*batch, *own, *summed)
        sizes = [int(np.prod([size[i] for i in part])) for part in (batch, own, summed)]
        places = np.arange(int(np.prod(size))).reshape(size).transpose(order).reshape(sizes)
        full = np.ones(sizes, bool)
        if not isinstance(v, Sets):
            full = np.asarray(v).transpose(order).reshape(sizes) != 0
        parts.append((v, places, full))
    rows = _none(shape, n)
    target = np.arange(int(np.prod(shape)))
    target = target.reshape(parts[0][1].shape[0], parts[0][1].shape[1], parts[1][1].shape[1])
    for (v, places, _), (_, _, other), side in ((parts[0], parts[1], 1), (parts[1], parts[0], 2)):
        if not isinstance(v, Sets):
            continue
        b, far, k = np.nonzero(other)
        links = len(b) * places.shape[1]
        if links > max(FULL * rows.shape[0] * v.rows.shape[0], 100 * n):
            raise _Dense
        source = places[b, :, k]
        to = target[b, :, far] if side == 1 else target[b, far, :]
        entries = (np.ones(source.size, bool), (to.ravel(), source.ravel()))
        size = (rows.shape[0], v.rows.shape[0])
        rows = rows + sparse.csr_array(entries, shape=size) @ v.rows
    return Sets(shape, sparse.csr_array(rows))
