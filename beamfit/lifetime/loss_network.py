"""a and b by a network that obeys physics everywhere: alone, or as a correction (report 3.4.2).

The network's outputs are logarithms, so a and b are positive. Signs of its weights make both fall
with bunches and scraper opening and rise with pressure, at every point and not only at data.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.linalg import block_diag, cho_solve, cholesky, solve_triangular
from scipy.optimize import nnls

from beamfit.answer import Row, json_of, shown
from beamfit.errors import InputError
from beamfit.greybox.bounds import over_cells
from beamfit.greybox.fit import Fit
from beamfit.greybox.mlp import MLP, Layer, Port
from beamfit.greybox.problem import Prior, Problem, Record
from beamfit.greybox.signed_network import signed_weights
from beamfit.greybox.solve import solve
from beamfit.lifetime.ring import Operation
from beamfit.lifetime.scales import (
    PRESSURE_ERROR,
    ScaleFit,
    Summaries,
    by_losses,
    loss_parts,
    summarise,
    widened,
)
from beamfit.lifetime.study import Decay, Machine, settings_of
from beamfit.quantity import HOUR, Quantity, percent

INPUTS = ("rf_voltage", "scraper_y", "pressure", "bunches")
# How the loss moves with each input; nothing is known of the sign for the RF voltage.
SIGNS = {"scraper_y": -1, "pressure": 1, "bunches": -1}
ROUNDING = 1e-9


def scaled(rf_voltage: float, scraper_y: float, pressure: float, bunches: float) -> np.ndarray:
    """Inputs of a network from V, m, Pa, number: MV, logarithms of mm, nPa and number."""
    values = np.array([1e3 * scraper_y, 1e9 * pressure, bunches], float)
    return np.array([1e-6 * float(rf_voltage), *np.log(values)])


class Box(NamedTuple):
    """A range of operation, the ends in SI: what a network is asked to hold over.

    Parameters
    ----------
    rf_voltage, scraper_y, pressure, bunches : (float, float)
        V, m, Pa at the mean current, and number.

    Raises
    ------
    InputError
        From `corners`, if a range is empty or not positive and finite.

    Examples
    --------
    >>> box = Box((1.6e6, 3.2e6), (3e-3, 6e-3), (1e-8, 1e-7), (100, 300))
    >>> box.corners()[0].round(2).tolist()
    [1.6, 1.1, 2.3, 4.61]
    """

    rf_voltage: tuple[float, float]
    scraper_y: tuple[float, float]
    pressure: tuple[float, float]
    bunches: tuple[float, float]

    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Both corners in the network's inputs."""
        for name, (low, high) in zip(self._fields, self, strict=True):
            if not 0 < low <= high < np.inf:
                expected = "0 < lower <= upper, finite"
                raise InputError(f"range {low:g} to {high:g}", expected, column=name)
        low, high = np.array(self, float).T
        return scaled(*low), scaled(*high)


class Certificate(NamedTuple):
    """Bounds that hold for all inputs in the operating box.

    Attributes
    ----------
    lower, upper : array, shape (4,)
        Corners of the box: RF voltage MV, logarithms of scraper mm, pressure nPa, bunches.
    gains : array, shape (2, 4, 2)
        Enclosures of the slopes of the network's ln a and ln b by the four inputs over the box,
        rounded outward; of a correction, those of its factor.
    single_maximum : str
        Whether the lifetime has a single maximum in the RF voltage: "certified" by convex nodes of
        a network alone; of a correction "seen" or "broken" at points of the box, since first
        principles have no enclosure; "not asked".
    """

    lower: np.ndarray
    upper: np.ndarray
    gains: np.ndarray
    single_maximum: str

    @property
    def holds(self) -> bool:
        """True if every slope of known sign has it, within rounding."""
        known = [INPUTS.index(name) for name in SIGNS]
        sign = np.array(list(SIGNS.values()))
        worst = np.where(sign > 0, -self.gains[:, known, 0], self.gains[:, known, 1])
        return bool(np.all(worst <= ROUNDING))

    def holds_at(self, inputs: np.ndarray) -> bool:
        """Test if a point is in the box, within rounding."""
        inside = (inputs >= self.lower - ROUNDING) & (inputs <= self.upper + ROUNDING)
        return bool(np.all(inside))

    def to_json(self) -> dict[str, Any]:
        """Return the range and the slopes as JSON's types."""
        return json_of({"holds": self.holds, **self._asdict()})


# Sizes that are weighed, as relative errors of a and of b.
SIZES = tuple(0.005 * 2 ** (k / 2) for k in range(13))


class Discrepancy(NamedTuple):
    """Smooth errors of a model of decays.

    Attributes
    ----------
    size : (float, float)
        Standard deviation of ln a and of ln b about the network.
    inputs : array, shape (n, k)
        Of the decays.
    length : array, shape (k,)
        Correlation lengths.
    rows : array, shape (2n, 2n)
        Slopes of what the decays say, in their errors, by ln a and ln b of each decay.
    """

    size: tuple[float, float]
    inputs: np.ndarray
    length: np.ndarray
    rows: np.ndarray

    def kernel(self, at: np.ndarray) -> np.ndarray:
        """Covariance of (ln a, ln b) at inputs (m, k) with those at the decays, (2m, 2n)."""
        off = (at[:, None] - self.inputs) / self.length
        return np.kron(np.exp(-0.5 * np.sum(off**2, -1)), np.diag(np.square(self.size)))

    @property
    def root(self) -> np.ndarray:
        """Lower triangle of the covariance of the decays, in their own errors, (2n, 2n)."""
        covariance = self.rows @ self.kernel(self.inputs) @ self.rows.T
        return cholesky(np.eye(len(covariance)) + covariance, lower=True)

    def spread(
        self, at: np.ndarray, slopes: np.ndarray, left: np.ndarray, fit: Fit
    ) -> tuple[np.ndarray, np.ndarray]:
        """Model error of the network at inputs (m, k): mean (2m,), covariance (2m, 2m).

        `slopes` of ln a and ln b by the network's free numbers, (2m, p); `left` of the decays'
        residuals, in their errors, (2n,). Weights and errors of the model are not told apart.
        """
        root = self.root
        reach = cho_solve((root, True), self.rows @ self.kernel(at).T)
        jacobian = root @ fit.dense_jacobian[: left.size]
        total = slopes - reach.T @ jacobian
        own = self._replace(inputs=at).kernel(at)
        rest = own - reach.T @ self.rows @ self.kernel(at).T
        return reach.T @ left, rest + total @ fit.covariance_raw @ total.T


def sized(trial: Discrepancy, fit: Fit, left: np.ndarray) -> Discrepancy:
    """The size by restricted likelihood: weights integrated out about a fit made with a trial size.

    `left` are the decays' residuals, in their errors.
    """
    free = [k for k, variable in enumerate(fit.variables) if variable.state == "free"]
    jacobian = fit.dense_jacobian[:, free]
    seen, known = trial.root @ jacobian[: left.size], jacobian[left.size :]
    start = fit.theta[free]

    def likelihood(size: tuple[float, float]) -> float:
        root = trial._replace(size=size).root
        rows = solve_triangular(root, seen, lower=True)
        off = solve_triangular(root, left, lower=True)
        # Priors are normal about zero: their residuals are their rows times the weights.
        information = rows.T @ rows + known.T @ known
        pull = rows.T @ off - known.T @ (known @ start)
        rest = off @ off - pull @ np.linalg.solve(information, pull)
        return -np.log(np.diag(root)).sum() - 0.5 * (np.linalg.slogdet(information)[1] + rest)

    return trial._replace(size=max(itertools.product(SIZES, SIZES), key=likelihood))


OUTPUTS = ("log_a", "log_b")
# Units of a, b and the lifetime.
LOSSES = ("1/(mA s)", "1/s", "h")
# Weights with a sign: from the inputs that the loss rises or falls with, and, as sums of rising
# and of convex nodes are such, to the outputs; the last makes the lifetime have one maximum.
RISING, POSITIVE = "rest->rising", ("rising->out", "convex->out")
DIRECTION = np.array([SIGNS[name] for name in INPUTS[1:]])[:, None]
# Widths of the priors on weights: alone the network covers decades, a correction is near zero.
ALONE, CORRECTION = 3.0, 0.3
# Widths of the prior that no weight exceeds.
MOST = 10.0
# Correlation length of the model's error: of half the range of each input, or of that where less
# was seen. Chosen on simulated shifts.
LENGTH, SHORTEST = 0.8, 0.1
# Below this share of the loss b is compatible with zero.
SMALLEST = 1e-3
# Voltages that are looked at, of a correction or for the longest lifetime.
VOLTAGES = 65


class Network(StrEnum):
    """Kinds of loss network: all of a and b, or a factor on first principles."""

    alone = "alone"
    correction = "correction"


@shown
@dataclass(frozen=True, eq=False)
class NetworkFit:
    """A fitted network of losses.

    Parameters
    ----------
    fit : Fit
        Of the grey-box core, with its status, message and covariance.
    certificate : Certificate
        Signs that hold everywhere in the box.
    machine : Machine
        The ring and its usual operation.
    corrected : ScaleFit or None
        The first principles that the network corrects; None if it stands alone.
    discrepancy : Discrepancy
        What it may be wrong by.
    vacuum : array, shape (2,)
        Pressure of the decays, Pa, without beam and for each mA of it, by a straight line.
    left : array, shape (2n,)
        What it leaves of the decays, in their errors.
    """

    fit: Fit
    certificate: Certificate
    machine: Machine
    corrected: ScaleFit | None
    discrepancy: Discrepancy
    vacuum: np.ndarray
    left: np.ndarray

    @property
    def usual(self) -> Operation:
        """The machine's usual settings, of a network alone in the vacuum of the decays."""
        if self.corrected is not None:
            return self.machine.operation
        base, slope = self.vacuum
        return self.machine.operation._replace(pressure_base=base, pressure_slope=slope)

    def losses(self, operation: Operation, current: float) -> tuple[Quantity, Quantity]:
        """Predict a and b at a setting.

        Parameters
        ----------
        operation : Operation
            Settings and vacuum.
        current : float
            Mean current, mA.

        Returns
        -------
        tuple of Quantity
            a, 1/(mA s), and b, 1/s. Outside the operating box the network is not to be believed,
            and the errors are None.
        """
        return self.predict(operation, current)[:2]

    def predict(self, operation: Operation, current: float) -> tuple[Quantity, ...]:
        """a, 1/(mA s), b, 1/s, and the lifetime, h, as `losses`."""
        at, base = _inputs(operation, current)[None], _base(self.corrected, operation, current)
        logs = self.fit.derive(_logs, (at, base[None]))
        mean, covariance = self.discrepancy.spread(at, logs.slope[0], self.left, self.fit)
        a, b = np.exp(logs.value[0])
        rate = a * current + b
        # By ln a and ln b: of themselves, and of the logarithm of the lifetime.
        rows = np.array([[1, 0], [0, 1], [-a * current / rate, -b / rate]])
        spread = np.sum(rows @ covariance * rows, axis=1) + (rows @ mean) ** 2
        if self.corrected is None:
            spread = spread + self._pressed(at[0], current)
        inside = self.certificate.holds_at(at[0])
        named = zip((a, b, 1 / rate / HOUR), np.sqrt(spread), LOSSES, strict=True)
        return tuple(Quantity(float(v), float(e * v) if inside else None, u) for v, e, u in named)

    def _pressed(self, at: np.ndarray, current: float) -> float:
        """Variance of ln a and ln b at another pressure than the decays had at that current.

        The pressure went with the current, so that what is of one and what of the other is not
        told: losses go with a power of the pressure of which only 0 to 1 is known (gas part).
        """
        base, slope = self.vacuum
        off = at[INPUTS.index("pressure")] - np.log(1e9 * (base + slope * current))
        return off**2 / 3

    def rows(self, current: float) -> list[Row]:
        """Label and value of what it says at a current, and of what it obeys."""
        held, wrong = self.certificate, self.discrepancy.size
        at = f"at the usual settings, {current:.4g} mA"
        names = (f"a {at}", f"b {at}", f"lifetime {at}")
        numbers = zip(names, self.predict(self.usual, current), strict=True)
        rows = [
            ("status", self.fit.status),
            ("chi2/dof", f"{self.fit.chi2:.4g}/{self.fit.dof}"),
            ("what it may be wrong by, a and b", " and ".join(map(percent, wrong))),
            *numbers,
            ("falls with scraper and bunches, rises with pressure", held.holds),
            ("single maximum of the lifetime in the RF voltage", held.single_maximum),
        ]
        return [Row(label, [value], quoted=True) for label, value in rows]

    def to_json(self, current: float) -> dict[str, Any]:
        """Return the verdict, and a, b and lifetime at the usual settings, as JSON's types."""
        found = {name: getattr(self.fit, name) for name in ("status", "message", "chi2", "dof")}
        a, b, lifetime = self.predict(self.usual, current)
        told = {"a": a, "b": b, "lifetime": lifetime, "certificate": self.certificate}
        told["model_error"] = dict(zip("ab", self.discrepancy.size, strict=True))
        return json_of(found | told)


# The network's inputs, what it is added to, mean currents, weights of the two loss rates.
Data = tuple[Array, Array, Array, Array]


def _inputs(operation: Operation, current: float) -> np.ndarray:
    """Inputs in units near one; logarithms where the losses go as powers."""
    pressure = operation.pressure_base + operation.pressure_slope * current
    return scaled(operation.rf_voltage, operation.scraper_y, pressure, operation.bunches)


def _logs(model: Mapping[str, MLP], data: tuple[Array, Array]) -> Array:
    """ln a and ln b at settings and what is added to, shape (n, 2)."""
    inputs, base = data
    return base + jax.vmap(model["map"].values)(inputs)


def _predict(model: Mapping[str, MLP], data: Data) -> Array:
    *at, current, weight = data
    a, b = jnp.exp(_logs(model, at)).T
    return weight @ loss_parts(a, b, current).ravel()


def _base(corrected: ScaleFit | None, operation: Operation, current: float) -> Array:
    """ln a and ln b of first principles, which the network corrects; zero if it stands alone."""
    if corrected is None:
        return jnp.zeros(2)
    return jnp.log(jnp.stack(corrected.losses_at(operation, current)))


def _network(inputs: np.ndarray, means: np.ndarray, hidden: int, seed: int) -> MLP:
    """Additive in the voltage and the rest: convex nodes for one, rising ones for the other.

    ln a = convex(V) + monotonic(Y, P, M). The rate a I + b is then log-convex in V, as a sum of
    log-convex functions, so the lifetime has a single maximum.
    """
    middle, half = inputs.mean(0), np.maximum(np.ptp(inputs, axis=0) / 2, 1e-3)
    ports = [
        Port(name, "voltage" if k == 0 else "rest", max(k - 1, 0), half[k], middle[k])
        for k, name in enumerate(INPUTS)
    ]
    layers = [
        Layer("voltage", "identity", 1),
        Layer("rest", "identity", 3),
        Layer("convex", "logcosh", 2, bias=True),
        Layer("rising", "tanh", hidden, bias=True),
        Layer("out", "linear", 2, bias=True),
    ]
    random = np.random.default_rng(seed)
    weights = {
        "voltage->convex": random.normal(0, 1, (1, 2)),
        "voltage->out": random.normal(0, 0.1, (1, 2)),
        "convex->out": np.abs(random.normal(0, 0.3, (2, 2))),
        RISING: DIRECTION * np.abs(random.normal(0, 0.5, (3, hidden))),
        "rising->out": np.abs(random.normal(0, 0.3, (hidden, 2))),
    }
    biases = {"out": np.zeros(2), "rising": random.normal(0, 0.5, hidden)}
    outputs = [Port(name, "out", k, 1.0, means[k]) for k, name in enumerate(OUTPUTS)]
    pairs = [tuple(name.split("->")) for name in weights]
    return MLP(layers, pairs, ports, outputs, weights, biases)


def _signs(single_maximum: bool) -> dict[str, np.ndarray | int]:
    """Signs of weights that make the network obey."""
    return dict.fromkeys(POSITIVE if single_maximum else POSITIVE[:1], 1) | {RISING: DIRECTION}


def _statement(measured: Summaries, floor: float) -> tuple[np.ndarray, np.ndarray]:
    """Weights of what the decays say, and slopes of that by ln a and ln b, (2n, 2n) each.

    With independent relative errors of a, and of b, whose pressure is as good as its reading.
    """
    quadratic, rate = np.abs(np.asarray(measured.parts)).T
    linear = np.maximum(np.abs(rate - quadratic), SMALLEST * rate)
    by = by_losses(quadratic, linear)
    weight = np.asarray(widened(measured.root, by * np.array([floor, PRESSURE_ERROR])))
    return block_diag(*weight), block_diag(*(weight @ by))


def fit_loss_network(
    decays: Sequence[Decay],
    machine: Machine,
    corrected: ScaleFit | None = None,
    *,
    hidden: int = 4,
    floor: float = 0.01,
    box: Box | None = None,
    single_maximum: bool = True,
    starts: int = 3,
    seed: int = 0,
) -> NetworkFit:
    """Fit a network of a and b to decays at different settings.

    Parameters
    ----------
    decays : sequence of Decay
        Fitted decays whose records carry their settings.
    machine : Machine
        The ring, and what the records do not say.
    corrected : ScaleFit, optional
        First principles that the network multiplies: a = a_fp exp(network). Without it the
        network stands alone.
    hidden : int, optional
        Nodes for scraper, pressure and bunches together; two more serve the voltage.
    floor : float, optional
        Independent relative error of a in each decay, for what no input shows; b has that of a
        pressure reading, 5 %.
    box : Box, optional
        The operating box of the certificate, outside which nothing is predicted; what the decays
        span by default. Where it is wider than that, errors are those of an extrapolation.
    single_maximum : bool, optional
        Whether a network alone must give the lifetime a single maximum in the RF voltage.
    starts, seed : int, optional
        Of the search.

    Returns
    -------
    NetworkFit
        With a certificate of its signs over the box.

    Raises
    ------
    InputError
        If there are fewer than four decays, a scraper is infinitely far away, or the box is empty.

    Notes
    -----
    Weights are regularised by a normal prior of width 3 alone and 0.3 as a correction, so that a
    correction the data do not ask for stays zero. First principles themselves fall with bunches
    and scraper and rise with pressure, so the signs hold for the product. What the network cannot
    follow is a smooth random error in its likelihood, whose size the decays themselves tell
    (`discrepancy`); errors of predictions contain it, and grow away from the decays.
    """
    if len(decays) < 4:
        raise InputError(f"{len(decays)} decays", "4 or more at different settings")
    measured = summarise(decays)
    settings = settings_of(decays, machine)
    inputs = np.stack([_inputs(*setting) for setting in settings])
    if not np.isfinite(inputs).all():
        raise InputError("a setting that is not finite", "RF voltage, scraper, pressure, bunches")
    means = np.zeros(2) if corrected is not None else _typical(measured)
    net = _network(inputs, means, hidden, seed)
    signs = _signs(single_maximum or corrected is not None)
    width = ALONE if corrected is None else CORRECTION
    weight, rows = _statement(measured, floor)
    seen = weight @ np.asarray(measured.parts).ravel()
    base = jnp.stack([_base(corrected, *setting) for setting in settings])

    def fitted(wrong: Discrepancy) -> tuple[Fit, np.ndarray]:
        whiten = np.linalg.inv(wrong.root)
        data = (jnp.asarray(inputs), base, measured.current, jnp.asarray(whiten @ weight))
        problem = Problem(
            model={"map": net},
            free=signed_weights("map", net, signs, MOST * width, 1.0),
            records=[Record("decays", _predict, data, jnp.asarray(whiten @ seen), error=1.0)],
            priors=[Prior("map", 0.0, width)],
        )
        fit = solve(problem, starts=starts, seed=seed, iterations=300)
        return fit, seen - np.asarray(_predict(fit.model, (*data[:3], jnp.asarray(weight))))

    pressure = 1e-9 * np.exp(inputs[:, INPUTS.index("pressure")])
    vacuum = _line(np.asarray(measured.current), pressure)
    length = np.maximum(LENGTH * np.ptp(inputs, axis=0) / 2, SHORTEST)
    middle = SIZES[len(SIZES) // 2]
    trial = Discrepancy((middle, middle), inputs, length, rows)
    wrong = sized(trial, *fitted(trial))
    fit, left = fitted(wrong)
    low, high = (inputs.min(0), inputs.max(0)) if box is None else box.corners()
    enclosed = over_cells(fit.model["map"], low, high, 2)
    gains = np.stack([np.min(enclosed.lower, axis=0), np.max(enclosed.upper, axis=0)], axis=-1)
    if corrected is None:
        maximum = "certified" if single_maximum else "not asked"
    else:
        maximum = _maximum_seen(fit, corrected, low, high, float(measured.current.max()))
    certificate = Certificate(low, high, gains, maximum)
    return NetworkFit(fit, certificate, machine, corrected, wrong, vacuum, left)


def _maximum_seen(
    fit: Fit, corrected: ScaleFit, low: np.ndarray, high: np.ndarray, current: float
) -> str:
    """Look along the voltage at every corner of the other settings."""
    corners = itertools.product(*zip(low[1:], high[1:], strict=True))
    voltages = np.linspace(low[0], high[0], VOLTAGES)
    for scraper, pressure, bunches in corners:
        operation = corrected.machine.operation._replace(
            scraper_y=1e-3 * np.exp(scraper),
            pressure_base=1e-9 * np.exp(pressure),
            pressure_slope=0.0,
            bunches=np.exp(bunches),
        )
        base = jax.lax.map(
            lambda v, o=operation: _base(corrected, o._replace(rf_voltage=v), current),
            jnp.asarray(1e6 * voltages),
        )
        rest = np.tile([scraper, pressure, bunches], (VOLTAGES, 1))
        inputs = jnp.asarray(np.column_stack([voltages, rest]))
        a, b = np.exp(np.asarray(_logs(fit.model, (inputs, base)))).T
        turns = np.diff(np.sign(np.diff(a * current + b)))
        if np.count_nonzero(turns) > 1 or turns.min(initial=0) < 0:
            return "broken"
    return "seen"


def _line(current: np.ndarray, pressure: np.ndarray) -> np.ndarray:
    """P0 and P1 of P = P0 + P1 I, neither negative; relative errors are alike."""
    rows = np.stack([np.ones_like(current), current], axis=1) / pressure[:, None]
    size = np.linalg.norm(rows, axis=0)
    return nnls(rows / size, np.ones_like(current))[0] / size


def _typical(measured: Summaries) -> np.ndarray:
    """Means of ln a and ln b, from the decays where both are positive."""
    quadratic, rate = np.asarray(measured.parts).T
    good = (quadratic > 0) & (rate > quadratic)
    if not good.any():
        raise InputError("no decay with positive a and b", "one at least, for a start")
    a, b = quadratic[good] / np.asarray(measured.current)[good], (rate - quadratic)[good]
    return np.array([np.log(a).mean(), np.log(b).mean()])
