"""Numbers that move together without a change of any prediction: symmetries of a model."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np

from beamfit.greybox.assess import LOOKS, NEAR
from beamfit.greybox.problem import Problem, compiled_at, sloped

# A row is constant along a direction if it changes by less than this share of its terms.
STILL = 1e-7
# Numbers are tied if their part of the open directions exceeds this share of the largest.
TIED = 1e-3


class Gauge(NamedTuple):
    """Names of numbers that move together, and relative changes along one direction they may take.

    `free` tells in how many directions: as many of them must be fixed.
    """

    names: tuple[str, ...]
    changes: tuple[float, ...]
    free: int


def gauges(p: Problem, theta: np.ndarray, unseen: np.ndarray) -> tuple[Gauge, ...]:
    """Find symmetries among directions that the data do not see.

    A direction that residuals do not see at other settings either, made up at random, is none that
    further data could tell: it belongs to the model.

    Parameters
    ----------
    p : Problem
        The problem.
    theta : array, shape (n,)
        The point.
    unseen : array, shape (n, k)
        Directions that its residuals do not see there.

    Returns
    -------
    tuple of Gauge
        One for each set of at least two numbers that are tied.

    Examples
    --------
    >>> from beamfit.greybox.problem import Free, Record
    >>> def series(model, x):
    ...     return model["first"] * model["second"] * x
    >>> record = Record("r", series, np.arange(3.0), [0.0, 6.0, 12.0], 0.1)
    >>> p = Problem({"first": 2.0, "second": 3.0}, [Free("first"), Free("second")], [record])
    >>> at = np.array([2.0, 3.0])
    >>> gauges(p, at, np.array([[2.0], [-3.0]]))[0].names
    ('first', 'second')
    """
    open_ones = _still(p, theta, unseen)
    if not open_ones.shape[1]:
        return ()
    basis = np.linalg.qr(open_ones)[0]
    size = np.where(theta != 0, np.abs(theta), 1.0)
    together = np.abs(basis @ basis.T)
    part = np.sqrt(np.diag(together))
    tied = together > TIED * np.outer(part, part) + 1e-12
    found, left = [], set(np.flatnonzero(part > TIED**2).tolist())
    while left:
        group = _reached(tied, min(left))
        left -= group
        at = sorted(group)
        _, sizes, turned = np.linalg.svd(basis[at].T)
        free = int(np.sum(sizes > TIED * sizes[0]))
        change = turned[0] / size[at]
        names = tuple(p.names[i] for i in at)
        if len(at) > 1 and free < len(at):
            shares = change / np.max(np.abs(change)) * np.sign(change[0])
            found.append(Gauge(names, tuple(shares.tolist()), free))
    return tuple(found)


def _reached(tied: np.ndarray, first: int) -> set[int]:
    """Numbers connected to one number, directly or through others."""
    group, fresh = {first}, {first}
    while fresh:
        fresh = {j for i in fresh for j in np.flatnonzero(tied[i]).tolist()} - group
        group |= fresh
    return group


def _still(p: Problem, theta: np.ndarray, unseen: np.ndarray) -> np.ndarray:
    """Combinations of directions along which rows change at no made-up settings."""
    random, size = np.random.default_rng(0), np.where(theta != 0, np.abs(theta), 1.0)
    rows = []
    for _ in range(LOOKS if unseen.shape[1] else 0):
        records = tuple(
            dataclasses.replace(r, data=jax.tree.map(lambda v: _moved(v, random), r.data))
            for r in p.core.records
        )
        core = dataclasses.replace(p.core, records=records)
        jacobian = np.asarray(compiled_at(sloped, core)(theta)[1])
        usable = np.all(np.isfinite(jacobian), axis=1)
        terms = np.linalg.norm(jacobian[usable] * size, axis=1, keepdims=True)
        rows.append(jacobian[usable] / np.where(terms > 0, terms, 1.0))
    if not rows:
        return unseen[:, :0]
    along = unseen / np.linalg.norm(unseen / size[:, None], axis=0)
    _, sizes, turned = np.linalg.svd(np.vstack(rows) @ along, full_matrices=True)
    return along @ turned[int(np.sum(sizes > STILL)) :].T


def _moved(value: Any, random: np.random.Generator) -> Any:
    """Settings that are other ones, whole numbers apart."""
    value = np.asarray(value)
    if not np.issubdtype(value.dtype, np.floating) or not value.size:
        return value
    spread = float(np.std(value)) or float(np.max(np.abs(value))) or 1.0
    factor, shift = (NEAR * random.normal(size=value.shape) for _ in range(2))
    return value * (1 + factor) + spread * shift
