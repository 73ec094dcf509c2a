"""The problem of a fit and its study, as a sampler needs it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.verdict import Finding


class Optimum(NamedTuple):
    """An optimum and what the fit found there: the start of a sampler.

    Attributes
    ----------
    theta : array, shape (n,)
        The problem's free numbers.
    verdict : Finding
        On the fit.
    scales : sequence of float
        Factor on the errors of each record that its residuals show; NaN where they show nothing.
    given : sequence of bool
        Whether each record came with errors.
    undetermined : array, shape (n, k), optional
        Directions that neither records nor priors see.
    others : sequence of array
        Further optima of nearly the same cost.
    """

    theta: np.ndarray
    verdict: Finding
    scales: Sequence[float]
    given: Sequence[bool]
    undetermined: np.ndarray | None = None
    others: Sequence[np.ndarray] = ()


def unchanged(model: Any) -> Any:
    """The numbers of a problem as they are."""
    return model


def _no_volume(model: Any, data: Any) -> jax.Array:
    return jnp.zeros(())


def _model_itself(model: Any, data: Any) -> Any:
    return model


class Statement(NamedTuple):
    """A study's additions to its problem for the sampler; by default none.

    The functions stand at the top of modules, so that they are compiled once.

    Attributes
    ----------
    derived : mapping of str to str
        Names and units of the numbers that `derive` gives.
    derive : callable
        ``derive(model, data)``, shape (len(derived),).
    build : callable
        ``build(model, data)``: what a user's functions of a draw are given.
    data : pytree
        Of these functions.
    quoted, own : callable
        A change of variables to those in which the prior is flat and which are sampled:
        ``quoted(model)`` puts them in the place of the problem's own, ``own(model)`` is the inverse
        and NaN outside its domain.
    renamed : mapping of str to str
        How users call numbers of the problem.
    log_volume : callable
        ``log_volume(model, data)``, added to the log density: of a prior that is flat in something
        else than the sampled numbers.
    units : mapping of str to str
        Of sampled numbers.
    lower, width : mapping of str to float
        Lower bounds of sampled numbers instead of the problem's own, and how far from the optimum
        each may be at most where the data do not say.
    along : str
        A number with which the spread of others changes, as the correlation time of a noise.
    labels : mapping of str to str
        What stands for a record before the names of its noise; by default nothing if there is one
        record, else its name.
    averaged : sequence of str
        Records whose noise `log_volume` averages over, so that their residuals count only for the
        first shape of the proposals.
    trusted : sequence of str
        Records whose errors are right, whatever the residuals show: anchors of a model.
    noise_unit : str
        Of the errors of records that came without.
    priors_own, hidden : sequence of str
        Numbers that the prior decides, and those nobody asks for.
    remark : str
        A further sentence.
    nothing : str
        Why there is no posterior; empty where there is one.
    """

    derived: Mapping[str, str] = {}
    derive: Callable[[Any, Any], jax.Array] = _model_itself
    build: Callable[[Any, Any], Any] = _model_itself
    data: Any = None
    quoted: Callable[[Any], Any] = unchanged
    own: Callable[[Any], Any] = unchanged
    renamed: Mapping[str, str] = {}
    log_volume: Callable[[Any, Any], jax.Array] = _no_volume
    units: Mapping[str, str] = {}
    lower: Mapping[str, float] = {}
    width: Mapping[str, float] = {}
    along: str = ""
    labels: Mapping[str, str] = {}
    averaged: Sequence[str] = ()
    trusted: Sequence[str] = ()
    noise_unit: str = "1"
    priors_own: Sequence[str] = ()
    hidden: Sequence[str] = ()
    remark: str = ""
    nothing: str = ""
