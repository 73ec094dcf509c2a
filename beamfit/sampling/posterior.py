"""A sampled posterior: draws, their intervals, correlations and bands, and a verdict on them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from beamfit.answer import (
    MAX_ROWS_SHOWN,
    Table,
    answer,
    brief,
    frame_of,
    html_of,
    json_of,
    plain_name,
    shown,
    text_of,
)
from beamfit.errors import InputError, Status, nearest
from beamfit.quantity import Quantity, display_unit
from beamfit.sampling.convergence import Diagnostics
from beamfit.sampling.likelihood import LOG_NOISE
from beamfit.sampling.priors import in_words
from beamfit.sampling.target import SamplingTarget

if TYPE_CHECKING:
    from arviz import InferenceData
    from pandas import DataFrame

# One standard deviation of a normal distribution to each side.
ONE_SIGMA = math.erf(math.sqrt(0.5))
# Default number of draws at which a user's function is computed.
ENOUGH_DRAWS = 4000
# R-hat above which walkers are separated and intervals mean nothing.
APART = 1.2
# Default quantiles: median, central 68 % and 95 %.
QUANTILES = (0.025, 0.16, 0.5, 0.84, 0.975)


HEADER = ("", "median", "68 % interval", "95 % interval")


class Interval(NamedTuple):
    """A number's median and central credible interval.

    Attributes
    ----------
    name : str
        What it is.
    median, lower, upper : float
        In `unit`.
    unit : str
        Unit.
    separable : bool
        Whether the data decide it; if not, the interval is the prior's or the bounds' and is not
        to be quoted.
    """

    name: str
    median: float
    lower: float
    upper: float
    unit: str
    separable: bool = True

    def __str__(self) -> str:
        if not math.isfinite(self.median):
            return f"{self.name}: not determined"
        said = f"{self.name}: {self.median:.4g} ({self.lower:.4g} to {self.upper:.4g}) {self.unit}"
        return said if self.separable else f"{said}, not separable"


class Summary(NamedTuple):
    """A number with the ends of its 95 and 68 % and its median, in order.

    `doubt` says in a word or two why no interval may be quoted; empty where one may.
    """

    name: str
    quantity: Quantity
    quantiles: np.ndarray
    doubt: str = ""

    def to_json(self) -> dict[str, Any]:
        """Give one of ``quantities`` of the JSON contract; intervals are null where in doubt."""
        low, one, middle, other, high = map(float, self.quantiles)
        return {
            "name": self.name,
            "value": self.quantity.value,
            "error": self.quantity.error,
            "median": middle,
            "interval_68": None if self.doubt else [one, other],
            "interval_95": None if self.doubt else [low, high],
            "unit": self.quantity.unit,
        }

    def row(self) -> list[str]:
        """Label, median and intervals, with the digits that their width allows."""
        label = plain_name(self.name)
        if not np.isfinite(self.quantiles).all():
            return [label, "not determined", "-", "-"]
        (low, one, middle, other, high), unit = in_unit(self.quantiles, self.quantity.unit)
        label = f"{label}, {unit}" if unit else label
        if self.doubt:
            return [label, "not determined", self.doubt, self.doubt]
        width = 0.5 * (other - one)
        places = 4 if width <= 0 else min(max(1 - math.floor(math.log10(width)), 0), 12)
        one, other, low, high = (f"{v:.{places}f}" for v in (one, other, low, high))
        return [label, f"{middle:.{places}f}", f"{one} to {other}", f"{low} to {high}"]


def interval_table(rows: Sequence[Summary], title: str = "", note: str = "") -> Table:
    """Table with a row for each number: median and intervals."""
    cells = [row.row() for row in rows[:MAX_ROWS_SHOWN]]
    left = len(rows) - MAX_ROWS_SHOWN
    return Table(title, HEADER, [*cells, *([[f"and {left} more"]] if left > 0 else [])], note)


@shown
class Correlations(NamedTuple):
    """Correlation coefficients of numbers, one row and column a name."""

    names: tuple[str, ...]
    values: np.ndarray

    @property
    def headline(self) -> str:
        """Names of the quantities, in a line."""
        return f"of {', '.join(self.names)}"

    def tables(self) -> tuple[Table, ...]:
        """The coefficients, to be shown."""
        rows = [
            [plain_name(name), *(f"{value:.3f}" for value in row)]
            for name, row in zip(self.names, self.values, strict=True)
        ]
        header = ["", *map(plain_name, self.names)]
        return (Table("Correlation coefficients", header, rows, numeric=True),)


class Band(NamedTuple):
    """Median and ends of a credible interval, point by point."""

    lower: np.ndarray
    median: np.ndarray
    upper: np.ndarray


class Expected(NamedTuple):
    """Posterior prediction of measurements; arrays of shape (n,) or (2, n).

    Attributes
    ----------
    median : array, shape (n,)
        Of the model.
    model : array, shape (2, n)
        Ends of the 68 % interval of the model: how well the curve is known.
    reading : array, shape (2, n)
        Ends of the 95 % interval of a further reading, its noise included: where points should lie.
    """

    median: np.ndarray
    model: np.ndarray
    reading: np.ndarray


def in_unit(values: np.ndarray, unit: str) -> tuple[np.ndarray, str]:
    """Values in a unit in which they are easily read, and that unit.

    Examples
    --------
    >>> in_unit(np.array([7e-7]), "m")[1], in_unit(np.array([7e-8]), "1/s")[1]
    ('µm', '1e-8 1/s')
    """
    size = float(np.quantile(np.abs(values), 0.98))
    factor, readable = display_unit(size, unit)
    if unit != "m" and size > 0 and not 1e-3 <= size < 1e5:
        power = math.floor(math.log10(size))
        factor, readable = 10.0**power, f"1e{power} {readable}".strip()
    return values / factor, readable.replace("^2", "²")


@answer
@dataclass(frozen=True, eq=False)
class Posterior:
    """Draws from a posterior, with a verdict on them. Prints as a table.

    Parameters
    ----------
    target : SamplingTarget
        What was sampled.
    chain : array, shape (steps, walkers, n)
        The draws, without the warm-up.
    log_prob : array, shape (steps, walkers)
        Log of their posterior density, up to a constant.
    status : Status
        ``converged``; ``not_converged`` if the budget ended first; ``unidentified`` if a number is
        held by nothing, or by the prior alone; ``poor_fit`` as the fit's; ``infeasible`` if no
        point is allowed.
    message : str
        Cause and remedy.
    diagnostics : Diagnostics
        Autocorrelation, effective sample size and R-hat of each number in `names`.
    acceptance : float
        Share of proposals that were taken.
    warmup : int
        Steps left out.
    seed : int
        Of the random numbers.
    held : tuple of str
        Numbers, derived ones too, that are the prior's or the bounds', not the data's.

    Examples
    --------
    >>> from beamfit.greybox.problem import Free, Problem, Record
    >>> from beamfit.greybox.solve import solve
    >>> def line(model, x):
    ...     return model["slope"] * x
    >>> data = Record("scan", line, np.arange(4.0), [0.0, 2.1, 3.9, 6.0], error=0.1)
    >>> posterior = solve(Problem({"slope": 1.0}, [Free("slope")], [data])).sample(seed=1)
    >>> posterior.status.value, str(posterior["slope"])  # the fit: 1.993 ± 0.027
    ('converged', '1.993 ± 0.027')
    """

    target: SamplingTarget
    chain: np.ndarray
    log_prob: np.ndarray
    status: Status
    message: str
    diagnostics: Diagnostics
    acceptance: float
    warmup: int
    seed: int
    held: tuple[str, ...]

    def __post_init__(self) -> None:
        for values in (self.chain, self.log_prob):
            values.flags.writeable = False

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sampled numbers, those of the likelihood last."""
        return self.target.names

    @property
    def shown(self) -> tuple[str, ...]:
        """Names of what is asked for: derived numbers, then sampled ones but for hidden ones."""
        every = (*self.target.derived_names, *self.names)
        # The factor on the errors is shown, not its logarithm.
        hidden = [name for name in self.names if name.endswith(LOG_NOISE)]
        return tuple(name for name in every if name not in (*hidden, *self.target.hidden))

    @property
    def draws(self) -> np.ndarray:
        """All draws of the sampled numbers, shape (steps x walkers, n)."""
        return self.chain.reshape(-1, len(self.names))

    @cached_property
    def _numbers(self) -> dict[str, tuple[str, np.ndarray]]:
        """Unit and draws of every number, the derived ones first."""
        t = self.target
        columns = np.concatenate([t.derive(self.draws), self.draws], axis=1).T
        units = zip((*t.derived_units, *t.units), columns, strict=True)
        return dict(zip((*t.derived_names, *t.names), units, strict=True))

    def _number(self, name: str) -> tuple[str, np.ndarray]:
        if name not in self._numbers:
            raise InputError(f"no sampled number '{name}'", nearest(name, list(self._numbers)))
        return self._numbers[name]

    def unit(self, name: str) -> str:
        """Unit of a number."""
        return self._number(name)[0]

    def values(self, name: str) -> np.ndarray:
        """All draws of one number, sampled or derived, shape (steps x walkers,)."""
        return self._number(name)[1]

    def __getitem__(self, name: str) -> Quantity:
        """Median of a number and half of its central 68 %; no error if the data do not decide."""
        low, one, middle, other, high = map(float, self.quantiles(name))
        unit = self.unit(name)
        if not self.values(name).size or name in self.held or self.apart:
            return Quantity(middle, None, unit)
        return Quantity(middle, 0.5 * (other - one), unit, interval_95=(low, high))

    def quantiles(self, name: str, probabilities: Sequence[float] | None = None) -> np.ndarray:
        """Quantiles of a number; NaN where nothing was sampled. By default the median and the ends
        of 68 and 95 %, which reach to a bound that is not excluded.
        """
        values, ends = self.values(name), (QUANTILES[0], QUANTILES[-1])
        if probabilities is None:
            ends = self.target.reaching.get(name, ends)
            probabilities = (ends[0], *QUANTILES[1:-1], ends[1])
        if not values.size:
            return np.full(len(probabilities), np.nan)
        found = np.quantile(values, probabilities)
        if name in self.target.reaching and not ends[0]:
            found[0] = self.target.lower[self.names.index(name)]
        return found

    def interval(self, name: str, probability: float = ONE_SIGMA) -> Interval:
        """Median and central credible interval of a number."""
        ends = (0.5, 0.5 - 0.5 * probability, 0.5 + 0.5 * probability)
        found = (float(v) for v in self.quantiles(name, ends))
        return Interval(name, *found, self.unit(name), name not in self.held)

    def correlations(self, names: Sequence[str] | None = None) -> Correlations:
        """Correlation coefficients of numbers, of all that are shown by default."""
        names = tuple(names or self.shown)
        columns = np.array([self.values(name) for name in names])
        if not columns.size:
            return Correlations(names, np.full((len(names),) * 2, np.nan))
        with np.errstate(invalid="ignore", divide="ignore"):
            return Correlations(names, np.corrcoef(columns).reshape((len(names),) * 2))

    def thinned(self, number: int = ENOUGH_DRAWS) -> np.ndarray:
        """`count` draws, evenly spaced along the chain, or all if there are fewer."""
        draws = self.draws
        if len(draws) <= number:
            return draws
        return draws[np.linspace(0, len(draws) - 1, number).astype(int)]

    def derive(
        self, function: Callable[[Any], Any], number: int = ENOUGH_DRAWS
    ) -> np.ndarray | Any:
        """Draws of any quantity.

        Parameters
        ----------
        function : callable
            Of the study's own object, in JAX: the model of a `Problem`, a dictionary from plane to
            `BeamMatrix` for an emittance, `DecayNumbers` for a decay.
        number : int, optional
            How many draws at most.

        Returns
        -------
        array, shape (draws, ...)
            One row a draw.
        """
        build = self.target.law.build
        return self.target.each(
            lambda data, theta: function(build(data, theta)), self.thinned(number)
        )

    def band(self, function: Callable[[Any], Any], probability: float = ONE_SIGMA) -> Band:
        """Median and credible interval of a curve, point by point; `function` as for `derive`."""
        ends = (0.5 - 0.5 * probability, 0.5, 0.5 + 0.5 * probability)
        return Band(*np.quantile(self.derive(function), ends, axis=0))

    def expected(self, draws: np.ndarray, error: np.ndarray, label: str = "") -> Expected:
        """Expect readings such as were measured, and further ones like them.

        Parameters
        ----------
        draws : array, shape (m, n)
            What `thinned` draws predict at each point.
        error : array, shape (n,)
            Stated errors.
        label : str
            Of the group of points, whose noise goes with them.

        Returns
        -------
        Expected
        """
        name, noise = f"{label}.{LOG_NOISE}".lstrip("."), np.ones(len(draws))
        if name in self.names:
            noise = np.exp(self.thinned()[:, self.names.index(name)])
        normal = np.random.default_rng(self.seed).standard_normal(draws.shape)
        readings = draws + noise[:, None] * error * normal
        low, median, high = np.quantile(draws, (0.16, 0.5, 0.84), axis=0)
        ends = np.quantile(readings, (QUANTILES[0], QUANTILES[-1]), axis=0)
        return Expected(median, np.stack([low, high]), ends)

    @property
    def priors(self) -> Mapping[str, str]:
        """The priors, the problem's own and those given to `sample`, in words."""
        given = {name: in_words(prior) for name, prior in self.target.priors.items()}
        return {**self.target.stated, **given}

    @property
    def apart(self) -> bool:
        """True if the walkers disagree so much that their intervals mean nothing."""
        rhat = self.diagnostics.rhat
        return bool(rhat.size and np.max(rhat) > APART)

    @property
    def headline(self) -> str:
        """Status, numbers and draws in a line."""
        draws = self.chain.shape[0] * self.chain.shape[1]
        return f"{self.status}: {draws} draws of {brief(self.names)}"

    def summary(self, name: str) -> Summary:
        """A number's median and quantiles, and whether they may be quoted."""
        doubt = "walkers disagree" if self.apart else ""
        doubt = "the prior's" if name in self.held else doubt
        return Summary(name, self[name], self.quantiles(name), doubt)

    def table(self, title: str = "", note: str = "") -> Table:
        """Medians and intervals of all numbers that are asked for."""
        return interval_table([self.summary(name) for name in self.shown], title, note)

    def to_json(self) -> dict[str, Any]:
        """Give the ``posterior`` object of the JSON contract; intervals are null where held."""
        d = self.diagnostics
        document = {
            "status": self.status,
            "message": self.message,
            "likelihood": self.target.groups,
            "priors": self.priors,
            "quantities": [self.summary(name) for name in self.shown],
            "correlations": self.correlations(),
            "diagnostics": {
                "names": self.names,
                "autocorrelation": d.autocorrelation,
                "effective_samples": d.effective,
                "rhat": d.rhat,
                "steps": d.steps,
                "walkers": d.walkers,
                "warmup": self.warmup,
                "acceptance": self.acceptance,
                "seed": self.seed,
            },
        }
        return json_of(document)

    def to_frame(self) -> DataFrame:
        """Give a pandas data frame of all draws, one column a number, sampled or derived.

        Raises
        ------
        InputError
            If pandas is not installed.
        """
        return frame_of({name: values for name, (_, values) in self._numbers.items()})

    def to_arviz(self) -> InferenceData:
        """Convert to ArviZ, for its plots and diagnostics: walkers as chains.

        Returns
        -------
        arviz.InferenceData
            Groups posterior (sampled and derived numbers), sample_stats and observed_data (an
            xarray.DataTree from ArviZ 1.0 on).

        Raises
        ------
        InputError
            If arviz is not installed.
        """
        try:
            import arviz
        except ImportError:
            expected = "the package arviz; install it with: pip install arviz"
            raise InputError("no ArviZ", expected) from None
        shape, observed = self.chain.shape[:2], self.target.observed.items()
        groups = {
            "posterior": {n: v.reshape(shape).T for n, (_, v) in self._numbers.items()},
            "sample_stats": {"lp": self.log_prob.T},
            "observed_data": {n: v for n, v in observed if np.asarray(v).dtype.kind == "f"},
        }
        as_one = int(arviz.__version__.split(".")[0]) >= 1
        return arviz.from_dict(groups) if as_one else arviz.from_dict(**groups)

    def __str__(self) -> str:
        return f"{self.status}: {self.message}\n{text_of(self.table())}"

    def _repr_html_(self) -> str:
        return html_of(self.table(f"{self.status}: {self.message}"))
