"""A sampled posterior: draws, what they say, and how far to believe them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from beamfit.errors import InputError, nearest
from beamfit.quantity import Quantity, finite
from beamfit.sampling.convergence import Diagnostics
from beamfit.sampling.priors import in_words
from beamfit.sampling.target import Target
from beamfit.sampling.text import as_html, as_text
from beamfit.status import Status

if TYPE_CHECKING:
    from arviz import InferenceData

__all__ = ["Band", "Correlations", "Interval", "Posterior"]

# One standard deviation of a normal distribution to each side.
ONE_SIGMA = 0.6826894921370859
# Draws from which functions of the user's are computed, unless all are asked for.
ENOUGH_DRAWS = 4000
# Beyond this R-hat walkers sit in places of their own.
APART = 1.2


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
        said = f"{self.name}: {self.median:.4g} ({self.lower:.4g} to {self.upper:.4g}) {self.unit}"
        return said if self.separable else f"{said}, not separable"


class Correlations(NamedTuple):
    """Correlation coefficients of numbers, one row and column a name."""

    names: tuple[str, ...]
    values: np.ndarray


class Band(NamedTuple):
    """Median and ends of a credible interval, point by point."""

    lower: np.ndarray
    median: np.ndarray
    upper: np.ndarray


@dataclass(frozen=True, eq=False)
class Posterior:
    """Draws from a posterior, with a verdict on them. Prints as a table.

    Parameters
    ----------
    target : Target
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

    target: Target
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
        hidden = [name for name in self.names if name.endswith("log_noise")]
        return tuple(name for name in every if name not in (*hidden, *self.target.hidden))

    @property
    def draws(self) -> np.ndarray:
        """All draws of the sampled numbers, shape (steps x walkers, n)."""
        return self.chain.reshape(-1, len(self.names))

    @cached_property
    def _derived(self) -> np.ndarray:
        return self.target.derive(self.draws)

    def unit(self, name: str) -> str:
        """Unit of a number."""
        self._check(name)
        if name in self.names:
            return self.target.units[self.names.index(name)]
        return self.target.derived_units[self.target.derived_names.index(name)]

    def values(self, name: str) -> np.ndarray:
        """All draws of one number, sampled or derived, shape (steps x walkers,)."""
        self._check(name)
        if name in self.names:
            return self.draws[:, self.names.index(name)]
        return self._derived[:, self.target.derived_names.index(name)]

    def _check(self, name: str) -> None:
        known = [*self.target.derived_names, *self.names]
        if name not in known:
            raise InputError(f"no sampled number '{name}'", nearest(name, known))

    def __getitem__(self, name: str) -> Quantity:
        """Mean and standard deviation of a number; no error where the data do not decide it."""
        values = self.values(name)
        if not values.size:
            return Quantity(float("nan"), None, self.unit(name))
        error = None if name in self.held or self.apart else float(np.std(values))
        return Quantity(float(np.mean(values)), error, self.unit(name))

    def quantiles(
        self, name: str, probabilities: Sequence[float] = (0.025, 0.16, 0.5, 0.84, 0.975)
    ) -> np.ndarray:
        """Quantiles of a number; NaN where nothing was sampled."""
        values = self.values(name)
        if not values.size:
            return np.full(len(probabilities), np.nan)
        return np.quantile(values, probabilities)

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
        """So many draws, evenly spaced along the chain, or all if there are fewer."""
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

    @property
    def priors(self) -> Mapping[str, str]:
        """The priors, the problem's own and those given to `sample`, in words."""
        given = {name: in_words(prior) for name, prior in self.target.priors.items()}
        return {**self.target.stated, **given}

    def to_json(self) -> dict[str, Any]:
        """Give the ``posterior`` object of the JSON contract; intervals are null where held."""
        d, shown = self.diagnostics, self.shown
        found = self.correlations(shown)
        document = {
            "status": self.status.value,
            "message": self.message,
            "likelihood": [group._asdict() for group in self.target.likelihood.groups],
            "priors": dict(self.priors),
            "quantities": [self._json_of(name) for name in shown],
            "correlations": {"names": list(shown), "values": found.values.tolist()},
            "diagnostics": {
                "names": list(self.names),
                "autocorrelation": d.autocorrelation.tolist(),
                "effective_samples": d.effective.tolist(),
                "rhat": d.rhat.tolist(),
                "steps": d.steps,
                "walkers": d.walkers,
                "warmup": self.warmup,
                "acceptance": self.acceptance,
                "seed": self.seed,
            },
        }
        return finite(document)

    @property
    def apart(self) -> bool:
        """Whether the walkers lie so far apart that no interval of theirs means anything."""
        rhat = self.diagnostics.rhat
        return bool(rhat.size and np.max(rhat) > APART)

    def _json_of(self, name: str) -> dict[str, Any]:
        quantity = self[name].to_json()
        low, one, middle, other, high = (float(v) for v in self.quantiles(name))
        known = name not in self.held and not self.apart
        return {
            "name": name,
            "value": quantity["value"],
            "error": quantity["error"],
            "median": middle,
            "interval_68": [one, other] if known else None,
            "interval_95": [low, high] if known else None,
            "unit": quantity["unit"],
        }

    def to_arviz(self) -> InferenceData:
        """Convert to ArviZ, for its plots and diagnostics.

        Raises
        ------
        InputError
            If arviz is not installed.
        """
        from beamfit.sampling.exchange import arviz_of

        return arviz_of(self)

    def __str__(self) -> str:
        return as_text(self)

    def _repr_html_(self) -> str:
        return as_html(self)
