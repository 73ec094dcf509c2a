"""A problem: a model, its free numbers, measured data, priors and constraints.

A problem is made of functions of ``(model, data)``, where the model is any JAX tree whose numbers
are addressed by path. It offers residuals, cost, constraints and log-probability as pure JAX
functions of one flat vector ``theta`` of the free numbers. Fits, samplers and studies use these.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.errors import InputError
from beamfit.greybox import tree

# Default tolerance on limits and on the conditions of an optimum, in scales of the problem.
TOLERANCE = 1e-6


class Free(NamedTuple):
    """Free numbers of the model.

    Parameters
    ----------
    path : str
        Path of a leaf, or of a part of the model; all its leaves are then free.
    lower, upper : float or array
        Bounds; equal bounds hold a number fixed. Arrays have the shape of the leaf.
    start : (float, float), optional
        Range of random starts. By default the bounds if both are finite, else a normal distribution
        about the model's value with a standard deviation of its magnitude, at least 1.
    nuisance : bool
        True for numbers that are not results, such as weights: they may stay undetermined or end at
        a bound without effect on the verdict.
    labels : tuple of str, optional
        Names of the numbers of a leaf in C order, instead of ``path[i]``.
    """

    path: str
    lower: Any = -np.inf
    upper: Any = np.inf
    start: tuple[float, float] | None = None
    nuisance: bool = False
    labels: tuple[str, ...] | None = None


@tree.node("name", "predict", "worth")
class Record:
    """Measured data and the function that predicts them.

    Parameters
    ----------
    name : str
        Name of the record.
    predict : callable
        ``predict(model, data)``, of the shape of `measured`, in JAX. A function defined at the top
        of a module is compiled once for all records of one shape.
    data : pytree
        Settings, times and whatever else the prediction needs besides the model.
    measured : array
        Measured values.
    error : float or array, optional
        Standard deviation of each value. Without it, the noise is inferred from the residuals,
        which then cannot test the model. A problem may have records of both kinds.
    weight : float or array
        Weight of the record's chi-square among several objectives, or of each value. Values of
        weight 0 are padding and have no effect: records of similar lengths are padded to one length
        (`beamfit.arrays.padded_length`) so that they share compiled code.
    worth : float
        Degrees of freedom of `error`: infinite if it is known, a few if it is a guess that the
        residuals correct.

    Raises
    ------
    InputError
        If a measured value is not finite, an error not positive, or a weight negative.
    """

    name: str
    predict: Callable[[Any, Any], jax.Array]
    data: Any
    measured: Any
    error: Any = None
    weight: Any = 1.0
    worth: float = np.inf

    def __post_init__(self):
        measured = np.array(self.measured, float)
        error = None if self.error is None else np.array(self.error, float)
        bad = np.flatnonzero(~np.isfinite(measured))
        if bad.size:
            raise InputError(
                f"{bad.size} values of '{self.name}' that are not finite (the first at {bad[0]})",
                "finite measured values; leave the others out",
            )
        if error is not None and not (np.all(error > 0) and np.all(np.isfinite(error))):
            raise InputError(
                f"an error of '{self.name}' that is not positive and finite",
                "one standard deviation of each value",
            )
        weight = np.array(self.weight, float)
        if not (np.all(np.isfinite(weight)) and np.all(weight >= 0) and np.any(weight > 0)):
            raise InputError(f"weight {weight} of '{self.name}'", "positive weights, 0 for padding")
        object.__setattr__(self, "weight", weight)
        object.__setattr__(self, "measured", measured)
        object.__setattr__(self, "error", error)

    def residual(self, model: Any) -> jax.Array:
        """Compute the weighted residuals (predicted - measured)/error as a flat vector."""
        scale = 1.0 if self.error is None else self.error
        difference = (self.predict(model, self.data) - self.measured) / scale
        return jnp.ravel(jnp.where(self.weight > 0, jnp.sqrt(self.weight) * difference, 0.0))

    @property
    def errors_given(self) -> bool:
        """True if the errors are known, so that the residuals can refute the model."""
        return self.error is not None and np.isinf(self.worth)

    @property
    def prior_freedom(self) -> float:
        """Degrees of freedom of guessed errors; 0 if the errors are known or not given."""
        return 0.0 if self.error is None or self.errors_given else self.worth

    @property
    def used(self) -> np.ndarray:
        """True for each value with a weight above zero, shape (values,)."""
        return np.broadcast_to(np.asarray(self.weight) > 0, self.measured.shape).ravel()


@tree.node("name", "function")
class Prior:
    """A normal prior on numbers of the model, or on any function of it; also a regularisation.

    Parameters
    ----------
    name : str
        Path of the numbers, or the name of the function's value.
    mean, sd : float or array
        Mean and standard deviation.
    function : callable, optional
        ``function(model)``; without it the prior is on the numbers at the path `name`.

    Raises
    ------
    InputError
        If a standard deviation is not positive.
    """

    name: str
    mean: Any
    sd: Any
    function: Callable[[Any], jax.Array] | None = None

    def __post_init__(self):
        if not np.all(np.asarray(self.sd) > 0):
            raise InputError(f"standard deviation {self.sd} of the prior '{self.name}'", "above 0")

    def residual(self, model: Any) -> jax.Array:
        """Compute (value - mean)/sd as a flat vector."""
        if self.function is None:
            value = tree.read(model, tree.find_leaves(model, self.name))
        else:
            value = self.function(model)
        return jnp.ravel((value - self.mean) / self.sd)


@tree.node("name", "function", "labels")
class Constraint:
    """lower <= function(model, data) <= upper, element by element; equal ends make an equation.

    Parameters
    ----------
    name : str
        Name of the constraint; elements of an array are called ``name[i]``.
    function : callable
        ``function(model, data)``, of any shape, in JAX.
    data : pytree
        Second argument of the function: measured data, points, cells of a box.
    lower, upper : float or array
        Limits.
    labels : tuple of str, optional
        Names of its elements in C order, instead of ``name[i]``.
    """

    name: str
    function: Callable[[Any, Any], jax.Array]
    data: Any = None
    lower: Any = -np.inf
    upper: Any = np.inf
    labels: tuple[str, ...] | None = None


@tree.node("name", "function")
class Objective:
    """A further term of the cost, weight * function(model, data), that is not a sum of squares."""

    name: str
    function: Callable[[Any, Any], jax.Array]
    data: Any = None
    weight: float = 1.0


@tree.node("chosen")
class Core:
    """The part of a problem that JAX compiles: arrays to trace and static structure."""

    chosen: tuple[tree.Leaf, ...]
    model: Any
    records: tuple[Record, ...]
    priors: tuple[Prior, ...]
    constraints: tuple[Constraint, ...]
    objectives: tuple[Objective, ...]


def flattened(core: Core) -> Callable[[Callable], Callable]:
    """Return a function that compiles f(core, theta, ...) to f(theta, ...) at this core.

    An array that occurs twice in the core is passed once, so that equal computations on it are
    merged by the compiler.
    """
    leaves, structure = jax.tree_util.tree_flatten(core)
    keys = [id(x) if np.ndim(x) else -i for i, x in enumerate(leaves)]
    once = dict(zip(keys, leaves, strict=True))
    order = {key: i for i, key in enumerate(once)}
    # Small arrays are passed as NumPy arrays: converting them to JAX's takes longer.
    arrays = [jnp.asarray(x) if np.size(x) > 1000 else np.asarray(x) for x in once.values()]
    places = tuple(order[key] for key in keys)
    return lambda function: partial(_compiled(function, places, structure), arrays)


@lru_cache(maxsize=256)
def _compiled(function: Callable, places: tuple[int, ...], structure) -> Callable:
    def at(arrays, *rest):
        return function(structure.unflatten([arrays[i] for i in places]), *rest)

    return jax.jit(at)


def _model_at(core: Core, theta: jax.Array) -> Any:
    return tree.replace(core.model, core.chosen, theta)


@jax.jit
def residual(core: Core, theta: jax.Array) -> jax.Array:
    """Compute the residuals of all records, then of all priors, as one vector."""
    model = _model_at(core, theta)
    parts = [part.residual(model) for part in (*core.records, *core.priors)]
    return jnp.concatenate(parts) if parts else jnp.zeros(0)


@jax.jit
def cost(core: Core, theta: jax.Array) -> jax.Array:
    """Compute half the sum of squared residuals plus the further objectives."""
    r = residual(core, theta)
    return 0.5 * r @ r + further(core, theta)


def further(core: Core, theta: jax.Array) -> jax.Array:
    """Compute the sum of the further objectives."""
    model = _model_at(core, theta)
    return sum((jnp.sum(o.weight * o.function(model, o.data)) for o in core.objectives), 0.0)


def with_slope(function: Callable[[jax.Array], jax.Array], theta: jax.Array):
    """Compute a function's value and derivatives in one evaluation: half the code to compile."""

    def twice(t):
        value = function(t)
        return value, value

    slope, value = jax.jacfwd(twice, has_aux=True)(theta)
    return value, slope


def residual_and_jacobian(core: Core, theta: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Compute the residuals and their Jacobian."""
    return with_slope(partial(residual, core), theta)


@jax.jit
def constraints(core: Core, theta: jax.Array) -> jax.Array:
    """Compute the values of all constraints as one vector."""
    model = _model_at(core, theta)
    parts = [jnp.ravel(c.function(model, c.data)) for c in core.constraints]
    return jnp.concatenate(parts) if parts else jnp.zeros(0)


def values(core: Core, theta: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Compute cost and constraints."""
    return cost(core, theta), constraints(core, theta)


@dataclass(frozen=True, eq=False)
class Problem:
    """A fit or optimisation to be done.

    Parameters
    ----------
    model : pytree
        Holds every number, free or not; free numbers start from its values.
    free : sequence of Free
        Free numbers with their bounds, each at most once.
    records : sequence of Record
        Measured data, which may depend on the same numbers.
    priors : sequence of Prior
    constraints : sequence of Constraint
    objectives : sequence of Objective
    tolerance : float
        Tolerance within which a limit is reached and a point is an optimum, in the problem's
        scales.

    Raises
    ------
    InputError
        If a path is unknown, a number free twice, bounds do not fit a leaf's shape, a prediction
        does not fit its measured values, or nothing is free or asked.

    Examples
    --------
    >>> def line(model, x):
    ...     return model["slope"] * x + model["offset"]
    >>> x = np.array([0.0, 1.0, 2.0])
    >>> problem = Problem({"slope": 1.0, "offset": 0.0}, [Free("slope"), Free("offset", 0, 1)],
    ...                   [Record("scan", line, x, measured=2 * x, error=0.1)])
    >>> problem.names
    ('slope', 'offset')
    >>> [round(float(v), 3) for v in problem.residual(np.array([1.0, 0.0]))]
    [0.0, -10.0, -20.0]
    """

    model: Any
    free: Sequence[Free]
    records: Sequence[Record] = ()
    priors: Sequence[Prior] = ()
    constraints: Sequence[Constraint] = ()
    objectives: Sequence[Objective] = ()
    tolerance: float = TOLERANCE
    core: Core = field(init=False, repr=False)

    def __post_init__(self):
        # NumPy arrays: converting small arrays to JAX's takes longer than passing them.
        model = jax.tree.map(partial(np.array, dtype=float), self.model)
        free_leaves = [(leaf, f) for f in self.free for leaf in tree.find_leaves(model, f.path)]
        paths = [leaf.path for leaf, _ in free_leaves]
        twice = sorted({path for path in paths if paths.count(path) > 1})
        if twice:
            raise InputError(f"'{twice[0]}' free twice", "each number free at most once")
        if not paths:
            raise InputError("no free number", "at least one")
        if not (self.records or self.priors or self.objectives):
            raise InputError("nothing to fit", "a record, a prior or an objective")
        for name in ("free", "records", "priors", "constraints", "objectives"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        groups = self.records, self.priors, self.constraints, self.objectives
        object.__setattr__(
            self, "core", Core(tuple(leaf for leaf, _ in free_leaves), model, *groups)
        )
        object.__setattr__(self, "_free_leaves", tuple(free_leaves))
        _check_shapes(self)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Name of each free number."""
        named = (f.labels or tree.element_names(leaf) for leaf, f in self._free_leaves)
        return tuple(name for names in named for name in names)

    @cached_property
    def start(self) -> np.ndarray:
        """Values of the free numbers in the model."""
        values = jax.tree_util.tree_leaves(self.core.model)
        return np.concatenate([np.asarray(values[leaf.index]).ravel() for leaf in self.core.chosen])

    @cached_property
    def lower(self) -> np.ndarray:
        """Lower bound of each free number."""
        return _broadcast("lower", self._free_shapes)

    @cached_property
    def upper(self) -> np.ndarray:
        """Upper bound of each free number."""
        return _broadcast("upper", self._free_shapes)

    @cached_property
    def moving(self) -> np.ndarray:
        """True for each free number whose bounds differ."""
        return self.lower < self.upper

    @cached_property
    def equations(self) -> np.ndarray:
        """True for each constraint element that is an equation."""
        return self.constraint_lower == self.constraint_upper

    @cached_property
    def nuisance(self) -> np.ndarray:
        """True for each free number that is a nuisance number."""
        return _broadcast("nuisance", self._free_shapes).astype(bool)

    @cached_property
    def with_prior(self) -> np.ndarray:
        """True for each free number with a prior on itself."""
        own = [prior.name for prior in self.priors if prior.function is None]
        paths = {leaf.path for name in own for leaf in tree.find_leaves(self.core.model, name)}
        parts = [np.full(leaf.size, leaf.path in paths) for leaf in self.core.chosen]
        return np.concatenate(parts)

    @cached_property
    def start_range(self) -> np.ndarray:
        """Range of random starts, shape (2, free); NaN where none was given."""
        ends = [
            np.tile((np.nan, np.nan) if f.start is None else f.start, (leaf.size, 1))
            for leaf, f in self._free_leaves
        ]
        return np.concatenate(ends).T

    @cached_property
    def constraint_names(self) -> tuple[str, ...]:
        """Name of each constraint element."""
        return tuple(
            name
            for name, shape, c in self._constraint_shapes
            for name in c.labels or tree.element_names(tree.Leaf(0, name, shape))
        )

    @cached_property
    def constraint_lower(self) -> np.ndarray:
        """Lower limit of each constraint element."""
        return _broadcast("lower", self._constraint_shapes)

    @cached_property
    def constraint_upper(self) -> np.ndarray:
        """Upper limit of each constraint element."""
        return _broadcast("upper", self._constraint_shapes)

    def __getstate__(self) -> dict[str, Any]:
        """State to be pickled: the compiled programs stay in their process."""
        return {name: value for name, value in vars(self).items() if name != "compiled"}

    @property
    def has_data(self) -> bool:
        """True if there are records or priors: a fit, not only an optimisation."""
        return bool(self.records or self.priors)

    @property
    def errors_known(self) -> bool:
        """True if any record has measurement errors."""
        return any(record.errors_given for record in self.records)

    @cached_property
    def size(self) -> int:
        """Number of measured values, padding included."""
        return sum(record.measured.size for record in self.records)

    @cached_property
    def residual_count(self) -> int:
        """Number of residuals, those of priors included."""
        return self.size + sum(shape_of(Prior.residual, p, self.core.model)[0] for p in self.priors)

    @cached_property
    def least_residual(self) -> float:
        """Length of the residual vector that is not distinguished from zero: one standard error.

        If no record has errors, it is 1e-6 of the measured values.
        """
        if self.errors_known or not self.records:
            return 1.0
        squares = [np.sum(r.used * np.asarray(r.measured).ravel() ** 2) for r in self.records]
        return 1e-6 * float(np.sqrt(sum(squares))) or 1.0

    @cached_property
    def compiled(self) -> Callable[[Callable], Callable]:
        """Compiler of functions of (core, theta, ...) to functions of (theta, ...) at this core.

        They are compiled once for each structure of problem. The core is flattened only once: doing
        so in each of thousands of calls takes longer than evaluating a small network.
        """
        return flattened(self.core)

    def model_at(self, theta) -> Any:
        """Return the model with the free numbers set to theta, all leaves as JAX arrays."""
        return jax.tree.map(jnp.asarray, _model_at(self.core, np.asarray(theta, float)))

    def residual(self, theta) -> jax.Array:
        """Compute residuals in units of their errors, priors last, shape (values,)."""
        return residual(self.core, jnp.asarray(theta, float))

    def cost(self, theta) -> jax.Array:
        """Compute half of chi-square (priors included) plus the weighted objectives."""
        return cost(self.core, jnp.asarray(theta, float))

    def constraint_values(self, theta) -> jax.Array:
        """Compute the values of the constraint elements."""
        return constraints(self.core, jnp.asarray(theta, float))

    def log_probability(self, theta) -> jax.Array:
        """Compute the log of the posterior density up to a constant.

        It is -cost, and -inf outside bounds and limits. Records without errors count with errors of
        1; set their noise before sampling.
        """
        theta = jnp.asarray(theta, float)
        inside = jnp.all((theta >= self.lower) & (theta <= self.upper))
        if self.constraints:
            c = self.constraint_values(theta)
            inside &= jnp.all((c >= self.constraint_lower) & (c <= self.constraint_upper))
        value = -self.cost(theta)
        return jnp.where(inside & jnp.isfinite(value), value, -jnp.inf)

    @property
    def _free_shapes(self) -> list[tuple[str, tuple[int, ...], Free]]:
        """Path, shape and `Free` of each free leaf."""
        return [(leaf.path, leaf.shape, f) for leaf, f in self._free_leaves]

    @cached_property
    def _constraint_shapes(self) -> list[tuple[str, tuple[int, ...], Constraint]]:
        """Name, shape of the values and `Constraint` of each constraint."""
        model = self.core.model
        return [(c.name, shape_of(c.function, model, c.data), c) for c in self.constraints]


def _broadcast(attribute: str, parts: Sequence[tuple[str, tuple[int, ...], Any]]) -> np.ndarray:
    """Broadcast one attribute of free numbers or constraints to all their elements."""
    found = [np.zeros(0)]
    for name, shape, part in parts:
        value = np.asarray(getattr(part, attribute), float)
        try:
            found.append(np.broadcast_to(value, shape).ravel())
        except ValueError:
            wanted = f"a number or an array of shape {shape}"
            raise InputError(f"{attribute} of shape {value.shape} for '{name}'", wanted) from None
    return np.concatenate(found)


def shape_of(function: Callable, *arguments: Any) -> tuple[int, ...]:
    """Find the shape of a function's result, traced once for each structure of arguments."""
    leaves, structure = jax.tree_util.tree_flatten(arguments)
    kinds = tuple((np.shape(leaf), getattr(leaf, "dtype", np.dtype(float))) for leaf in leaves)
    return _traced_shape(function, structure, kinds)


@lru_cache(maxsize=1024)
def _traced_shape(function, structure, kinds) -> tuple[int, ...]:
    leaves = [jax.ShapeDtypeStruct(*kind) for kind in kinds]
    return jax.eval_shape(function, *structure.unflatten(leaves)).shape


def _check_shapes(problem: Problem) -> None:
    """Raise an error for predictions, priors and limits whose shapes do not fit."""
    for record in problem.records:
        found = shape_of(record.predict, problem.core.model, record.data)
        if found != record.measured.shape:
            raise InputError(
                f"a prediction of shape {found} for record '{record.name}'",
                f"the shape of its measured values, {record.measured.shape}",
            )
        for what, given in (("errors", record.error), ("weights", record.weight)):
            if given is not None and given.shape not in ((), record.measured.shape):
                raise InputError(
                    f"{what} of shape {given.shape} in record '{record.name}'",
                    f"a number or the shape of the measured values, {record.measured.shape}",
                )
    for prior in problem.priors:
        shape_of(Prior.residual, prior, problem.core.model)
    _ = (problem.lower, problem.upper, problem.constraint_lower, problem.constraint_upper)
