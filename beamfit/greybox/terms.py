"""The parts of a problem: what is free, what was measured, what is known beforehand."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.errors import InputError
from beamfit.greybox import tree
from beamfit.noise.correlated import log_volume, whitened


class Free(NamedTuple):
    """Numbers of the model that are free.

    Parameters
    ----------
    path : str
        A leaf, or a part of the model whose leaves are all meant.
    lower, upper : float or array
        Bounds; equal bounds hold a number fixed. Arrays have the shape of the leaf.
    start : (float, float), optional
        Range of random starts. Without it the bounds serve if both are finite, else a normal
        around the model's value, as wide as the value and at least 1.
    nuisance : bool
        True for numbers nobody asks for, such as weights: they may stay undetermined or end on a
        bound without that being the verdict on the fit.
    labels : tuple of str, optional
        Names of the numbers of a leaf in C order, in the place of ``path[i]``.
    """

    path: str
    lower: Any = -np.inf
    upper: Any = np.inf
    start: tuple[float, float] | None = None
    nuisance: bool = False
    labels: tuple[str, ...] | None = None


@tree.node("name", "predict", "worth", "apart")
class Record:
    """Measured data and the function that predicts them.

    Parameters
    ----------
    name : str
        Of the record.
    predict : callable
        ``predict(model, data)``, of the shape of `measured`, in JAX. A function defined at the top
        of a module is compiled once for all records of one shape.
    data : pytree
        What the prediction needs besides the model: settings, times.
    measured : array
        What was measured.
    error : float or array, optional
        One standard deviation of it. Without, the record's noise is inferred from its residuals,
        which then cannot speak against the model; records of both kinds may stand together.
    weight : float or array
        Weight of the record's chi-square among several objectives, or of each value. Values of
        weight 0 are padding and count nowhere, so that records of a few lengths
        (`beamfit.greybox.problem.padded_length`) share compiled code.
    worth : float
        Degrees of freedom that `error` is worth: infinite where it is known; a few where it rests
        on a guess, which the residuals correct.
    guess : float
        That guess in units of `error`.
    apart : callable, optional
        ``apart(model, data)``, shape (values - 1,), for errors with a memory: the time between
        neighbouring values over the correlation time of their errors. Residuals are then those of
        independent errors (`beamfit.noise.correlated.whitened`). A sampler may vary the
        correlation time; a search takes it as fixed. Such a record has no padding.

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
    guess: Any = 1.0
    apart: Callable[[Any, Any], jax.Array] | None = None

    def __post_init__(self):
        measured = np.asarray(self.measured, float)
        error = None if self.error is None else np.asarray(self.error, float)
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
        weight = np.asarray(self.weight, float)
        if not (np.all(np.isfinite(weight)) and np.all(weight >= 0) and np.any(weight > 0)):
            raise InputError(f"weight {weight} of '{self.name}'", "positive weights, 0 for padding")
        object.__setattr__(self, "weight", jnp.asarray(weight))
        object.__setattr__(self, "measured", jnp.asarray(measured))
        object.__setattr__(self, "error", None if error is None else jnp.asarray(error))

    def residual(self, model: Any) -> jax.Array:
        """Weighted residuals (predicted - measured)/error as a flat vector, whitened."""
        scale = 1.0 if self.error is None else self.error
        difference = (self.predict(model, self.data) - self.measured) / scale
        rows = jnp.ravel(jnp.where(self.weight > 0, jnp.sqrt(self.weight) * difference, 0.0))
        return rows if self.apart is None else whitened(rows, self.apart(model, self.data))

    def log_volume(self, model: Any) -> jax.Array:
        """Logarithm of the density's factor from whitening."""
        return jnp.zeros(()) if self.apart is None else log_volume(self.apart(model, self.data))

    @property
    def errors_given(self) -> bool:
        """True if its errors are known, so that residuals can refute the model."""
        return self.error is not None and np.isinf(self.worth)

    @property
    def prior_noise(self) -> tuple[float, float]:
        """The guess at errors that are not known: degrees of freedom and its sum of squares."""
        if self.error is None or self.errors_given:
            return 0.0, 0.0
        return self.worth, self.worth * float(self.guess) ** 2

    @property
    def used(self) -> np.ndarray:
        """True for each value that counts, shape (values,)."""
        return np.broadcast_to(np.asarray(self.weight) > 0, self.measured.shape).ravel()


@tree.node("name", "function")
class Prior:
    """A normal prior on numbers of the model, or on any function of it; also a regularisation.

    Parameters
    ----------
    name : str
        Path of the numbers, or a name for the function's value.
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
        """(value - mean)/sd as a flat vector."""
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
        Of the constraint; elements of an array are called ``name[i]``.
    function : callable
        ``function(model, data)``, of any shape, in JAX.
    data : pytree
        What it needs: any subset of the measured data, points, cells.
    lower, upper : float or array
        Limits.
    labels : tuple of str, optional
        Names of its elements in C order, in the place of ``name[i]``.
    """

    name: str
    function: Callable[[Any, Any], jax.Array]
    data: Any = None
    lower: Any = -np.inf
    upper: Any = np.inf
    labels: tuple[str, ...] | None = None


@tree.node("name", "function")
class Objective:
    """A further term of the cost, weight * function(model, data), that is no sum of squares."""

    name: str
    function: Callable[[Any, Any], jax.Array]
    data: Any = None
    weight: float = 1.0
