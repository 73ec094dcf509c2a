"""Prediction of a batch under another feed profile, and the best one within limits (fig 36)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from beamfit.answer import Table, answer
from beamfit.dynamics.balances import STATES, TITRE, Batches, batches_of
from beamfit.dynamics.fedbatch import FedBatchFit, forecast, predict_batch
from beamfit.errors import InputError, Status
from beamfit.greybox.fit import Fit
from beamfit.greybox.problem import Constraint, Free, Objective, Problem
from beamfit.greybox.solve import solve
from beamfit.quantity import Quantity

OUTPUTS = (*STATES, TITRE)
# Approximate number of rows of a plan, and rounds in which its safety margins follow its errors.
ROWS = 31
MARGIN_ROUNDS = 3


class FeedCourse(NamedTuple):
    """Predicted course of a batch under a feed profile.

    Attributes
    ----------
    time : array, shape (n,)
        Times, h.
    feed : array, shape (n,)
        Feed, L/h, each until the next time.
    value, error : dict of str to array
        Biomass, substrate, volume and titre; errors are those of the model and of the spread
        between batches, without the noise of readings.
    """

    time: np.ndarray
    feed: np.ndarray
    value: dict[str, np.ndarray]
    error: dict[str, np.ndarray]

    def length(self, titre: float) -> Quantity:
        """Time until a titre is reached, h, with its error; undetermined if it never is."""
        y = self.value[TITRE]
        above = np.flatnonzero(y >= titre)
        if not above.size or above[0] == 0:
            return Quantity(float("nan") if not above.size else float(self.time[0]), None, "h")
        crossing = slice(above[0] - 1, above[0] + 1)
        (slope,) = np.diff(y[crossing]) / np.diff(self.time[crossing])
        at, error = (
            np.interp(titre, y[crossing], values[crossing])
            for values in (self.time, self.error[TITRE])
        )
        return Quantity(float(at), float(error / slope), "h")


def _start_numbers(start: Any) -> dict[str, Any]:
    """Start numbers of one batch, as the model has them."""
    return {"start": jnp.log(start[None, :3]), "begin": start[3:], "own": jnp.zeros((1, 3))}


def predict(
    fit: FedBatchFit, time: np.ndarray, inputs: Mapping[str, Any], start: tuple[float, ...]
) -> FeedCourse:
    """Predict a batch.

    Parameters
    ----------
    fit : FedBatchFit
        A fit with a titre.
    time : array, shape (n,)
        Times, h, increasing.
    inputs : mapping of str to array or float
        Inputs of the rates and of the titre, and the flows.
    start : (float, float, float, float)
        Biomass, substrate (g/L), volume (L) and titre at the first time.

    Returns
    -------
    FeedCourse

    Raises
    ------
    InputError
        If the fit has no titre, an input is missing, or the start is not positive.
    """
    time = np.asarray(time, float)
    b = _batch(fit, time, inputs, start)
    found = forecast(fit.fit, b, _start_numbers(jnp.asarray(start, float)), [*fit.spread.values()])
    n = len(time)
    value, error = (dict(zip(OUTPUTS, part[0, :n].T, strict=True)) for part in found)
    return FeedCourse(time, np.asarray(b.flow.feed)[0, :n], value, error)


def _batch(
    fit: FedBatchFit, time: np.ndarray, inputs: Mapping[str, Any], start: tuple[float, ...]
) -> Batches:
    like, model = fit.seen.batches, fit.fit.model
    if "product" not in model:
        raise InputError("a fit without titre", "batches with y_titre")
    needed = {"feed", "feed_substrate", *model["rates"].inputs, *model["product"].inputs}
    needed = [name for name in like.inputs if name in needed]
    missing = [name for name in needed if name not in inputs]
    if missing:
        raise InputError(f"no input {missing[0]}", f"all of {', '.join(needed)}")
    if len(start) != len(OUTPUTS) or not min(start[0], start[2]) > 0 or min(start) < 0:
        raise InputError(f"a start of {start}", f"{', '.join(OUTPUTS)}, biomass and volume above 0")
    held = {n: np.broadcast_to(np.asarray(v, float), time.shape) for n, v in inputs.items()}
    return batches_of([time], [held], like)


@answer
@dataclass(frozen=True, eq=False)
class FeedPlan:
    """The best feed profile found.

    Attributes
    ----------
    status : Status
        Status of the search; ``message`` says what limits the plan.
    course : FeedCourse
        Predicted course.
    hours : Quantity
        Length of the batch, with its error from that of the titre.
    product : Quantity
        Product at the end, g.
    fit : Fit
        The optimum, with the multipliers of its limits.
    """

    status: Status
    message: str
    course: FeedCourse
    hours: Quantity
    product: Quantity
    fit: Fit

    @property
    def headline(self) -> str:
        """The answer in one line."""
        return f"feed {self.status}: {self.hours} for {self.product.value:.4g} g of product"

    def tables(self) -> tuple[Table, ...]:
        """The feed of each piece, product and length."""
        feed = np.asarray(self.fit.model["feed"])
        ends = np.linspace(0.0, self.course.time[-1], len(feed) + 1)
        rows = [[f"{ends[k]:.4g} to {ends[k + 1]:.4g} h", f"{f:.4g} L/h"]
                for k, f in enumerate(feed)]  # fmt: skip
        rows += [["product", str(self.product)], ["length", str(self.hours)]]
        return (Table("feed", [], rows, f"held by {', '.join(self.fit.active) or 'nothing'}"),)


def best_feed(
    fit: FedBatchFit,
    start: tuple[float, ...],
    inputs: Mapping[str, float],
    *,
    product: float,
    feed: tuple[float, float],
    volume: float,
    substrate: float,
    hours: tuple[float, float] = (5.0, 60.0),
    pieces: int = 8,
    margin: float = 2.0,
) -> FeedPlan:
    """Find the feed profile that makes a wanted mass of product soonest, within limits.

    Parameters
    ----------
    fit : FedBatchFit
        A fit with a titre.
    start : (float, float, float, float)
        Biomass, substrate (g/L), volume (L) and titre at the start.
    inputs : mapping of str to float
        All other inputs, held constant.
    product : float
        Product wanted at the end, g.
    feed : (float, float)
        Lowest and highest feed, L/h.
    volume, substrate : float
        Highest volume at the end, L, and highest substrate from the first feed on, g/L.
    hours : (float, float)
        Shortest and longest batch.
    pieces : int
        Number of pieces of equal length, each with a constant feed.
    margin : float
        Distance of product and substrate from their limits, in standard errors of the model.

    Returns
    -------
    FeedPlan

    Raises
    ------
    InputError
        If a range is empty, or the start is above the limit of the substrate.
    """
    if not (0 <= feed[0] < feed[1] and 0 < hours[0] < hours[1] and pieces > 0):
        found = f"feed {feed[0]:g} to {feed[1]:g}, hours {hours[0]:g} to {hours[1]:g}"
        raise InputError(found, "the lower end first")
    if start[1] > substrate:
        raise InputError(f"a start at {start[1]:g} g/L", f"at most {substrate:g}, the cap")
    rows = pieces * max(ROWS // pieces, 1)
    b = _batch(fit, np.linspace(0.0, hours[1], rows + 1), dict(inputs) | {"feed": 0.0}, start)
    data = b, jnp.asarray(np.maximum(start, 1e-9), float), jnp.arange(1, rows + 1)
    free = [Free("feed", *feed), Free("hours", *hours)]
    middle = {"feed": np.full(pieces, 0.5 * sum(feed)), "hours": 0.5 * sum(hours)}
    model, margins = dict(fit.fit.model) | middle, (0.0, np.zeros(rows))
    labels = ("product", "volume", *(f"substrate[{k}]" for k in range(1, rows + 1)))
    for _ in range(MARGIN_ROUNDS):
        low = np.append([product + margins[0], -np.inf], np.full(rows, -np.inf))
        high = np.append([np.inf, volume], substrate - margins[1])
        limits = [Constraint("batch", _limited_values, data, low, high, labels)]
        optimum = solve(Problem(model, free, (), (), limits, [Objective("hours", _hours)]))
        model = dict(optimum.model)
        found = fit.fit.derive(_plan_outputs_of, (model["feed"], model["hours"], data))
        mass = found.error[-1, 3] * found.value[-1, 2]
        margins = margin * mass, margin * found.error[:, 1]
    time = np.linspace(0.0, float(model["hours"]), rows + 1)
    profile = np.append(np.repeat(np.asarray(model["feed"]), rows // pieces), 0.0)
    course = predict(fit, time, dict(inputs) | {"feed": profile}, start)
    titre = float(course.value[TITRE][-1])
    made = Quantity(float(titre * course.value["volume"][-1]), float(mass), "g")
    return FeedPlan(optimum.status, optimum.message, course, course.length(titre), made, optimum)


def _hours(model: Any, data: Any) -> Any:
    return model["hours"]


def _plan_outputs(model: Any, data: Any) -> Any:
    """Outputs after each row of a plan, shape (rows, 4)."""
    b, start, rows = data
    piece = jnp.minimum(jnp.arange(b.dt.shape[1]) * len(model["feed"]) // len(rows),
                        len(model["feed"]) - 1)  # fmt: skip
    feed = model["feed"][piece][None]
    dt = jnp.where(b.dt > 0, model["hours"] / len(rows), 0.0)
    u = b.u.at[..., b.inputs.index("feed")].set(feed)
    b = replace(b, u=u, flow=b.flow._replace(feed=feed), dt=dt)
    return predict_batch(model, (b, _start_numbers(start)))[0, rows]


def _plan_outputs_of(model: Any, data: Any) -> Any:
    feed, hours, plan = data
    return _plan_outputs(model | {"feed": feed, "hours": hours}, plan)


def _limited_values(model: Any, data: Any) -> Any:
    """Product and volume at the end, then the substrate after each row."""
    found = _plan_outputs(model, data)
    return jnp.concatenate([jnp.stack([found[-1, 2] * found[-1, 3], found[-1, 2]]), found[:, 1]])
