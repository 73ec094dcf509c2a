"""A sampled posterior: draws, intervals, correlations, bands, and the verdict."""

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
from beamfit.sampling.priors import describe_prior
from beamfit.sampling.target import SamplingTarget

if TYPE_CHECKING:
    from arviz import InferenceData
    from pandas import DataFrame

# Probability within one standard deviation of a normal distribution.
ONE_SIGMA = math.erf(math.sqrt(0.5))
# Default number of draws for which a user's function is computed: the ends of 68 % intervals then
# scatter by a few hundredths of an error.
ENOUGH_DRAWS = 4000
# R-hat above which walkers are in separate peaks, and intervals have no meaning.
SEPARATED_RHAT = 1.2
# Default quantiles: median, central 68 % and 95 %.
QUANTILES = (0.025, 0.16, 0.5, 0.84, 0.975)


HEADER = ("", "median", "68 % interval", "95 % interval")


class Interval(NamedTuple):
    """Median and central credible interval of a number.

    Attributes
    ----------
    name : str
        Name of the number.
    median, lower, upper : float
        Median and ends of the interval, in `unit`.
    unit : str
        Unit.
    separable : bool
        True if the data determine it. Otherwise the interval comes from the prior or the bounds
        and must not be quoted.
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
    """A number with its quantiles: ends of the 95 and 68 % intervals and median, in order.

    `doubt` is the reason for which no interval may be quoted; empty if there is none.
    """

    name: str
    quantity: Quantity
    quantiles: np.ndarray
    doubt: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return an entry of ``quantities`` of the JSON contract; doubtful intervals are null."""
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
        """Return label, median and intervals, with the digits that their width determines."""
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
    """Make a table with median and intervals of each number."""
    cells = [row.row() for row in rows[:MAX_ROWS_SHOWN]]
    left = len(rows) - MAX_ROWS_SHOWN
    return Table(title, HEADER, [*cells, *([[f"and {left} more"]] if left > 0 else [])], note)


@shown
class Correlations(NamedTuple):
    """Matrix of correlation coefficients of some numbers."""

    names: tuple[str, ...]
    values: np.ndarray

    @property
    def headline(self) -> str:
        """Names of the quantities on one line."""
        return f"of {', '.join(self.names)}"

    def tables(self) -> tuple[Table, ...]:
        """Make the table of the coefficients."""
        rows = [
            [plain_name(name), *(f"{value:.3f}" for value in row)]
            for name, row in zip(self.names, self.values, strict=True)
        ]
        header = ["", *map(plain_name, self.names)]
        return (Table("Correlation coefficients", header, rows, numeric=True),)


class Band(NamedTuple):
    """Median and credible interval of a curve, point by point."""

    lower: np.ndarray
    median: np.ndarray
    upper: np.ndarray


class Expected(NamedTuple):
    """Posterior prediction of measurements; arrays of shape (n,) or (2, n).

    Attributes
    ----------
    median : array, shape (n,)
        Median of the model.
    model : array, shape (2, n)
        Ends of the 68 % interval of the model.
    reading : array, shape (2, n)
        Ends of the 95 % interval of a further reading, with its noise.
    """

    median: np.ndarray
    model: np.ndarray
    reading: np.ndarray


def in_unit(values: np.ndarray, unit: str) -> tuple[np.ndarray, str]:
    """Convert values to a unit in which they are easily read; return them and the unit.

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
    """Draws from a posterior, with the verdict. Prints as a table.

    Parameters
    ----------
    target : SamplingTarget
        The posterior that was sampled.
    chain : array, shape (steps, walkers, n)
        The draws, without the warm-up.
    log_prob : array, shape (steps, walkers)
        Log of their posterior density, up to a constant.
    status : Status
        ``converged``; ``not_converged`` if the budget was spent first; ``unidentified`` if a number
        is determined by nothing, or only by the prior; ``poor_fit`` from the fit; ``infeasible`` if
        no point meets the constraints.
    message : str
        Cause and remedy.
    diagnostics : Diagnostics
        Autocorrelation, effective sample size and R-hat of each number in `names`.
    acceptance : float
        Share of accepted proposals.
    warmup : int
        Number of warm-up steps, which are left out.
    seed : int
        Seed of the random numbers.
    held : tuple of str
        Numbers, derived ones included, that the prior or the bounds determine, not the data.

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
        """Names of the sampled numbers, parameters of the noise last."""
        return self.target.names

    @property
    def shown(self) -> tuple[str, ...]:
        """Names of the results: derived numbers, then sampled ones without nuisance numbers."""
        every = (*self.target.derived_names, *self.names)
        # The factor on the errors is a derived number; its logarithm is hidden.
        hidden = [name for name in self.names if name.endswith(LOG_NOISE)]
        return tuple(name for name in every if name not in (*hidden, *self.target.hidden))

    @property
    def draws(self) -> np.ndarray:
        """All draws of the sampled numbers, shape (steps x walkers, n)."""
        return self.chain.reshape(-1, len(self.names))

    @cached_property
    def _numbers(self) -> dict[str, tuple[str, np.ndarray]]:
        """Unit and draws of all numbers, derived ones first."""
        t = self.target
        columns = np.concatenate([t.derive(self.draws), self.draws], axis=1).T
        units = zip((*t.derived_units, *t.units), columns, strict=True)
        return dict(zip((*t.derived_names, *t.names), units, strict=True))

    def _number(self, name: str) -> tuple[str, np.ndarray]:
        if name not in self._numbers:
            raise InputError(f"no sampled number '{name}'", nearest(name, list(self._numbers)))
        return self._numbers[name]

    def unit(self, name: str) -> str:
        """Return the unit of a number."""
        return self._number(name)[0]

    def values(self, name: str) -> np.ndarray:
        """Return all draws of a sampled or derived number, shape (steps x walkers,)."""
        return self._number(name)[1]

    def __getitem__(self, name: str) -> Quantity:
        """Return the median and half the 68 % interval; no error if data do not determine it."""
        low, one, middle, other, high = map(float, self.quantiles(name))
        unit = self.unit(name)
        if not self.values(name).size or name in self.held or self.apart:
            return Quantity(middle, None, unit)
        return Quantity(middle, 0.5 * (other - one), unit, interval_95=(low, high))

    def quantiles(self, name: str, probabilities: Sequence[float] | None = None) -> np.ndarray:
        """Compute quantiles of a number; NaN if nothing was sampled.

        By default the median and the ends of the 68 and 95 % intervals; the latter extends to a
        bound that is not excluded.
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
        """Return the median and central credible interval of a number."""
        ends = (0.5, 0.5 - 0.5 * probability, 0.5 + 0.5 * probability)
        found = (float(v) for v in self.quantiles(name, ends))
        return Interval(name, *found, self.unit(name), name not in self.held)

    def correlations(self, names: Sequence[str] | None = None) -> Correlations:
        """Compute the correlation coefficients of numbers, by default of all results."""
        names = tuple(names or self.shown)
        columns = np.array([self.values(name) for name in names])
        if not columns.size:
            return Correlations(names, np.full((len(names),) * 2, np.nan))
        with np.errstate(invalid="ignore", divide="ignore"):
            return Correlations(names, np.corrcoef(columns).reshape((len(names),) * 2))

    def thinned(self, number: int = ENOUGH_DRAWS) -> np.ndarray:
        """Return `number` draws evenly spaced along the chain, or all if there are fewer."""
        draws = self.draws
        if len(draws) <= number:
            return draws
        return draws[np.linspace(0, len(draws) - 1, number).astype(int)]

    def derive(
        self, function: Callable[[Any], Any], number: int = ENOUGH_DRAWS
    ) -> np.ndarray | Any:
        """Compute draws of any quantity.

        Parameters
        ----------
        function : callable
            A function, in JAX, of the study's object: the model of a `Problem`, a dictionary of
            plane to `BeamMatrix` for an emittance, `DecayNumbers` for a decay.
        number : int, optional
            Largest number of draws.

        Returns
        -------
        array, shape (draws, ...)
            One row for each draw.
        """
        build = self.target.law.build
        return self.target.each(
            lambda data, theta: function(build(data, theta)), self.thinned(number)
        )

    def band(self, function: Callable[[Any], Any], probability: float = ONE_SIGMA) -> Band:
        """Compute the credible interval of a curve; `function` as for `derive`."""
        ends = (0.5 - 0.5 * probability, 0.5, 0.5 + 0.5 * probability)
        return Band(*np.quantile(self.derive(function), ends, axis=0))

    def expected(self, draws: np.ndarray, error: np.ndarray, label: str = "") -> Expected:
        """Predict the model and further readings at measured points.

        Parameters
        ----------
        draws : array, shape (m, n)
            Predictions at each point of the draws of `thinned`.
        error : array, shape (n,)
            Given errors.
        label : str
            Label of the group of points, for its noise.

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
        """Descriptions of the priors: the problem's, and those given to `sample`."""
        given = {name: describe_prior(prior) for name, prior in self.target.priors.items()}
        return {**self.target.stated, **given}

    @property
    def apart(self) -> bool:
        """True if the walkers disagree so much that intervals have no meaning."""
        rhat = self.diagnostics.rhat
        return bool(rhat.size and np.max(rhat) > SEPARATED_RHAT)

    @property
    def headline(self) -> str:
        """Status, numbers and draws on one line."""
        draws = self.chain.shape[0] * self.chain.shape[1]
        return f"{self.status}: {draws} draws of {brief(self.names)}"

    def summary(self, name: str) -> Summary:
        """Return a number with its quantiles, and the doubt about quoting them."""
        doubt = "walkers disagree" if self.apart else ""
        doubt = "the prior's" if name in self.held else doubt
        return Summary(name, self[name], self.quantiles(name), doubt)

    def table(self, title: str = "", note: str = "") -> Table:
        """Make the table of medians and intervals of the results."""
        return interval_table([self.summary(name) for name in self.shown], title, note)

    def to_json(self) -> dict[str, Any]:
        """Return the ``posterior`` object of the JSON contract; doubtful intervals are null."""
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
        """Return a pandas data frame of all draws, with a column for each number.

        Raises
        ------
        InputError
            If pandas is not installed.
        """
        return frame_of({name: values for name, (_, values) in self._numbers.items()})

    def to_arviz(self) -> InferenceData:
        """Convert to ArviZ, for its plots and diagnostics; walkers become chains.

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
