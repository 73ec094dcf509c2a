"""The emittance fit: from a scan and a line to a result with errors and a verdict."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

from beamfit.answer import Table, answer, determined, json_of, labelled, quantity_frame
from beamfit.emittance.answer import beam_answers
from beamfit.emittance.assumptions import Anchor, Assumptions
from beamfit.emittance.comparison import BEAM
from beamfit.emittance.model import line_with
from beamfit.emittance.predicted import Prediction, correlations_of, predicted_sizes
from beamfit.emittance.results import Parameter, PlaneFit, parameter_table, result_rows
from beamfit.emittance.scan import QuadScan
from beamfit.emittance.statement import (
    METHODS,
    WEIGHTS,
    PreparedScan,
    Scenario,
    assemble,
    prepare,
    scenario_of,
    single_beam,
    with_elements,
    with_posteriors,
)
from beamfit.emittance.transport import emittance_warnings, prior_warnings, unit_warnings
from beamfit.emittance.verdict import SURE
from beamfit.errors import InputError, expect
from beamfit.greybox.problem import Problem
from beamfit.noise.model import ROBUST, Noise
from beamfit.optics.beamline import Beamline
from beamfit.quantity import Quantity

if TYPE_CHECKING:
    from pandas import DataFrame

    from beamfit.greybox.fit import Fit
    from beamfit.noise.learn import Sample
    from beamfit.sampling.posterior import Correlations, Posterior
    from beamfit.sampling.priors import Distribution


def fit_emittance(
    scan: QuadScan,
    line: Beamline | None = None,
    *,
    planes: tuple[str, ...] | None = None,
    method: str = "size_squared",
    robust: bool = False,
    noise: Noise | None = None,
    weights: str = "model",
    scenario: str = "known",
    priors: Mapping[str, tuple[float, float]] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    gains: Mapping[str, tuple[float, float]] | None = None,
    anchor: Anchor | None = None,
    hysteresis: bool = False,
    hidden: int = 5,
    starts: int = 20,
    seed: int = 0,
) -> EmittanceFit:
    """Fit the beam matrix at the start of a line to a scan, with errors and a verdict.

    Parameters
    ----------
    scan : QuadScan
        The measured sizes.
    line : Beamline, optional
        The line from the place of the beam matrix to the screens. Rows with matrices of their own
        need none; the beam matrix is then where these matrices begin.
    planes : tuple of str, optional
        ("x",), ("y",) or both; all planes of the scan if None.
    method : {"size_squared", "size"}
        The residual: the report's ``error_linear`` or ``error_nonlinear``.
    robust : bool
        Expect one bad reading in ten; the prior is 3 % otherwise.
    noise : Noise, optional
        Priors of the noise of sizes; `beamfit.Noise()` if None.
    weights : {"model", "measured"}
        Size at which the errors of size² are taken. The model's is free of noise. The measured
        one, used by older programs, makes the emittance too small by 3 to 7 times the square of
        the relative size error.
    scenario : {"known", "transport-network", "calibration", "focusing-network"}
        Unknowns besides the beam: none; R11 and R12; slope and offset of the scanned magnets'
        calibration; k1 as a function of the current. All planes are then fitted together. See
        docs/scenarios.md for the limits of each.
    priors, bounds : mapping of str to (float, float), optional
        Calibration parameter, such as "Q2.slope", to mean and standard deviation, or to lower and
        upper bound ("calibration"). In any scenario also priors on screen, beam and line, which
        become part of the error: "size_scale", "resolution", "wire" (m), "energy", "dispersion"
        (m), "dispersion_slope", "NAME.gradient", "NAME.length" (m); see docs/systematics.md.
        Bounds of a "transport-network" are the box of the beam ("x.sigma11", SI) and that of the
        network's inputs ("Q2"), in which the signs or limits of its gains hold.
    gains : mapping of str to (float, float), optional
        Limits of gains instead of their signs, such as {"dA_x/dQ2": (-inf, -0.0083)}, for the
        report's own network without scales ("transport-network").
    anchor : Anchor, optional
        Tie of a network to first principles.
    hysteresis : bool
        Fit two branches of k1, for rising and falling currents ("focusing-network").
    hidden, starts, seed : int
        Hidden nodes of a network, starts of its training, seed of their random numbers.

    Returns
    -------
    EmittanceFit
        Values, errors, statuses and sentences.

    Raises
    ------
    InputError
        If the line lacks a magnet or screen of the scan, or an option is unknown.

    Notes
    -----
    One beam matrix at the start is common to all rows. If their energies differ it is that at the
    mean energy, and scales with 1/βγ: the normalised emittance is common. Values are those of the
    best fit; errors are half of the central 68 % of the posterior, averaged over the noise; see
    docs/emittance.md and docs/verdict.md.

    Examples
    --------
    >>> import numpy as np
    >>> from beamfit.optics.beam import BeamMatrix
    >>> from beamfit.optics.elements import Drift, Quadrupole, Screen
    >>> line = Beamline((Quadrupole("Q", 0.1), Drift("D", 2.0), Screen("S")), energy=135.0)
    >>> k1 = np.linspace(-2.0, 12.0, 8)
    >>> sizes = [float(BeamMatrix.from_twiss(2e-9, 5.0, 0.0).transport(
    ...     line.matrix({"Q": k}).x).l11) for k in k1]
    >>> scan = QuadScan({"Q": k1}, {"Q": "k1"}, {"x": sizes}, {"x": 0.02 * np.array(sizes)})
    >>> fit = fit_emittance(scan, line)
    >>> fit.x.status.value, f"{fit.x.emittance.value * 1e9:.4f} nm"
    ('converged', '2.0000 nm')
    """
    expect(scan, QuadScan, "beamfit.read_quad_scan(path)")
    if line is not None:
        expect(line, Beamline, "beamfit.load_lattice(path)")
    if noise is not None:
        expect(noise, Noise, "beamfit.Noise(bad=0.1)")
    for name, value, choices in (("method", method, METHODS), ("weights", weights, WEIGHTS)):
        if value not in choices:
            raise InputError(f"{name} '{value}'", " or ".join(choices))
    network_options = (gains or {}, anchor or Anchor(), hysteresis)
    assumptions = Assumptions(priors or {}, bounds or {}, *network_options, hidden, starts, seed)
    assumptions.check_scenario(scenario)
    noise = replace(noise or Noise(), bad=ROBUST) if robust else noise
    scan, line = single_beam(scan, line, scenario)
    statement = scenario_of(scenario)
    if assumptions.systematics:
        from beamfit.emittance.systematics import with_systematics

        statement = with_systematics(statement)
    prepared = prepare(scan, line, planes, method, noise, weights)
    if statement.closed:
        return EmittanceFit(beam_answers(prepared), scan, line, statement, assumptions, prepared)

    from beamfit.emittance.scenario_fit import iterated_fit, scenario_answers  # loads the solvers

    fit, prepared = iterated_fit(prepared, statement, assumptions)
    parameters = tuple(statement.parameters(prepared, assumptions, fit))
    found = line_with(fit.model, prepared.scanned)
    unanswered = EmittanceFit(
        (), scan, found, statement, assumptions, prepared, parameters, (), fit
    )
    answers = scenario_answers(unanswered)
    identified = all(p.identifiability.determined for p in answers)
    open_directions = statement.null_directions(prepared, parameters, identified)
    return replace(unanswered, planes=answers, null_directions=open_directions)


@answer
@dataclass(frozen=True, eq=False)
class EmittanceFit:
    """A fitted scan: one `PlaneFit` per plane, with the scan and its line; printed as a table.

    Attributes
    ----------
    planes : tuple of PlaneFit
        One per plane.
    scan : QuadScan
        The scan.
    line : Beamline
        The line; in a scenario with the fitted calibration or network of k1.
    statement : Scenario
        Free parameters besides the beam.
    told : Assumptions
        Assumptions besides the data.
    seen : PreparedScan
        The scan through the line as given.
    parameters : tuple of Parameter
        Fitted parameters besides the beam.
    null_directions : tuple of str
        Changes of the parameters that do not change the sizes.
    solved : Fit or None
        The grey-box fit; None for a linear fit in closed form.

    Examples
    --------
    >>> from beamfit.optics.beamline import Beamline
    >>> from beamfit.optics.elements import Drift, Quadrupole, Screen
    >>> line = Beamline((Quadrupole("Q", 0.1), Drift("D", 2.0), Screen("S")), 135.0)
    >>> sizes = [3.4e-4, 1.9e-4, 0.9e-4, 1.9e-4, 3.4e-4]
    >>> scan = QuadScan({"Q": [-1.0, 1.5, 4.0, 6.5, 9.0]}, {"Q": "k1"}, {"x": sizes})
    >>> fit = fit_emittance(scan, line)
    >>> [p.plane for p in fit.planes], fit.x.dof
    (['x'], 2)
    """

    planes: tuple[PlaneFit, ...]
    scan: QuadScan
    line: Beamline
    statement: Scenario
    told: Assumptions
    seen: PreparedScan
    parameters: tuple[Parameter, ...] = ()
    null_directions: tuple[str, ...] = ()
    solved: Fit | None = None

    @property
    def headline(self) -> str:
        """The scan, the line, and the answer of each plane, in one line."""
        found = "; ".join(p.headline for p in self.planes)
        return f"{self.scan.name} on {self.line.name}: {found}"

    @property
    def message(self) -> str:
        """Sentences on each plane, one line per plane."""
        return "\n".join(f"{p.plane}: {p.message}" for p in self.planes)

    @property
    def scenario(self) -> str:
        """The name of the scenario."""
        return self.statement.name

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on changes to the numbers of the file, and on unusual numbers."""
        measured = self.seen.weights == "measured"
        weight_note = (
            "Errors of size squared are taken at the measured sizes, on request.",
        ) * measured
        warnings = (
            *unit_warnings(self.scan, self.seen.scanned),
            *prior_warnings(self.told.priors, self.seen.scanned),
            *emittance_warnings(self.planes),
        )
        return (*self.scan.notes, *warnings, *weight_note)

    @property
    def anchor(self) -> str:
        """The tie of a network to first principles, in words."""
        return self.told.anchor.words

    @cached_property
    def fit(self) -> Fit:
        """Grey-box fit; for a fit in closed form it is solved on first use."""
        from beamfit.greybox.solve import solve

        return solve(self.problem) if self.solved is None else self.solved

    @cached_property
    def problem(self) -> Problem:
        """Grey-box problem of all planes together, as fitted or starting from the given line.

        Parameters of the beam are ``beam.x.l11``, ``beam.x.l21``, ``beam.x.l22``: the Cholesky
        factor of σ in units of 1e-4 (m, rad); those of a calibration are ``magnets.Q2.slope`` and
        so on.
        """
        if self.solved is None:
            return self.statement.state(self.seen, self.told)
        return self.solved.problem

    def __getitem__(self, plane: str) -> PlaneFit:
        found = {p.plane: p for p in self.planes}
        if plane not in found:
            raise self.scan.unusable(f"no fit of plane '{plane}'", " or ".join(found))
        return found[plane]

    def __iter__(self) -> Iterator[str]:
        return (p.plane for p in self.planes)

    @property
    def x(self) -> PlaneFit:
        """The fit of the x plane."""
        return self["x"]

    @property
    def y(self) -> PlaneFit:
        """The fit of the y plane."""
        return self["y"]

    def sample(
        self,
        planes: tuple[str, ...] | None = None,
        *,
        priors: Mapping[str, Distribution] | None = None,
        **options: Any,
    ) -> Posterior:
        """Draw σ of the planes from the posterior of the fit.

        Parameters
        ----------
        planes : tuple of str, optional
            Planes to sample; all that were fitted if None.
        priors
            As `beamfit.emittance.posterior.beam_target`, on ``x.sigma11`` and so
            on; in a scenario also on the further names of its ``problem``.
        **options
            ``seed, target_ess, budget, walkers, store, provenance, progress`` of
            `beamfit.sampling.ensemble.draw`.

        Returns
        -------
        Posterior
            Samples of ``x.sigma11`` and so on, and of the other fitted parameters;
            ``x.emittance``, ``x.normalized_emittance``, ``x.beta``, ``x.alpha``, ``x.mismatch`` are
            derived.

        Raises
        ------
        InputError
            As `beam_target` and `draw`.
        """
        from beamfit.emittance.posterior import beam_target
        from beamfit.sampling.ensemble import draw

        return draw(beam_target(self, planes, priors), **options)

    def predict(
        self, settings: Mapping[str, Any], plane: str | None = None, *, screen: str | None = None
    ) -> Prediction:
        """Predict the sizes of the fitted beam at other settings, with their errors.

        Parameters
        ----------
        settings : mapping of str to float or array
            Magnet to settings, shape (n,) or one number for all, in the unit of the scan's column
            (the lattice's for a magnet that was not scanned). Others keep the lattice's setting.
        plane : str, optional
            "x" or "y"; the first that was fitted if None.
        screen : str, optional
            Screen of the sizes; the scan's last screen if None.

        Returns
        -------
        Prediction
            ``size`` and ``error`` in m, shape (n,), at the mean energy of the scan.

        Raises
        ------
        InputError
            If a magnet or screen is not in the line, or the fit knows the transport only at the
            measured rows.

        Examples
        --------
        >>> from beamfit.optics.elements import Drift, Quadrupole, Screen
        >>> line = Beamline((Quadrupole("Q", 0.1), Drift("D", 2.0), Screen("S")), 135.0)
        >>> sizes = [3.4e-4, 1.9e-4, 0.9e-4, 1.9e-4, 3.4e-4]
        >>> scan = QuadScan({"Q": [-1.0, 1.5, 4.0, 6.5, 9.0]}, {"Q": "k1"}, {"x": sizes})
        >>> fit_emittance(scan, line).predict({"Q": [0.0, 2.0]}).size.round(5).tolist()
        [0.00028, 0.00016]
        """
        return predicted_sizes(self, settings, plane or self.planes[0].plane, screen)

    def correlations(self, plane: str | None = None) -> Correlations:
        """Correlation coefficients of one plane's σ11, σ12, σ22, emittance, β and α.

        Parameters
        ----------
        plane : str, optional
            "x" or "y"; the first that was fitted if None.

        Returns
        -------
        Correlations
            ``names`` and ``values``, shape (6, 6); NaN where the data do not determine the beam.
        """
        return correlations_of(self[plane or self.planes[0].plane])

    def to_frame(self) -> DataFrame:
        """Give a pandas data frame of all numbers, one row for each plane and quantity.

        Columns are value, error, error_raw, low_95, high_95 (NaN where there is none) and unit.

        Raises
        ------
        InputError
            If pandas is not installed.
        """
        rows = {(p.plane, n): q for p in self.planes for n, q in p.quantities.items()}
        return quantity_frame(rows, ("plane", "quantity"))

    def to_json(self) -> list[dict[str, Any]]:
        """Give the ``results`` list of the JSON contract."""
        line = {"name": self.line.name, "sha256": self.seen.line.digest}
        common = {"slice": self.scan.slices[0]} if self.scan.slices else {}
        common |= {"line": line} | ({"notes": list(self.notes)} if self.notes else {})
        energy = Quantity(self.seen.energy, None, "MeV").to_json()
        entries = [p.to_json() | {"energy": energy} | common for p in self.planes]
        scenario_parts = {
            "scenario": self.scenario,
            "anchor": self.anchor,
            "parameters": json_of(self.parameters),
            "null_directions": list(self.null_directions),
        }
        return entries if self.statement.closed else [entry | scenario_parts for entry in entries]

    def tables(self) -> tuple[Table, ...]:
        """Tables of all quantities, the other fitted parameters, and the open directions."""
        names = [p.plane for p in self.planes]
        found = [labelled("", names, determined(result_rows(self.planes)))]
        if self.parameters:
            tie = f", anchor: {self.anchor}" * self.statement.network
            found.append(parameter_table(self.parameters, f"Scenario {self.scenario}{tie}."))
        if self.null_directions:
            rows = [[f"{words}."] for words in self.null_directions]
            found.append(Table("Not determined by the data", [], rows))
        return tuple(found)


def fit_many(
    scans: Iterable[tuple[QuadScan, Beamline]],
    weights: str = WEIGHTS[0],
    noise: Noise | None = None,
) -> list[EmittanceFit | InputError]:
    """Fit the emittance to each of many scans, as `fit_emittance` does.

    Parameters
    ----------
    scans : iterable of (QuadScan, Beamline)
        The scans with their lines; hundreds at a time.
    weights, noise
        As for `beamfit.fit_emittance`.

    Returns
    -------
    list of EmittanceFit or InputError
        One per scan, in their order: its fit, or the reason why it cannot be fitted.

    Examples
    --------
    >>> import numpy as np
    >>> from beamfit.optics.elements import Drift, Quadrupole, Screen
    >>> line = Beamline((Quadrupole("Q", 0.1), Drift("D", 2.0), Screen("S")), 135.0)
    >>> k1, sizes = [-1.0, 1.5, 4.0, 6.5, 9.0], np.array([3.4e-4, 1.9e-4, 0.9e-4, 1.9e-4, 3.4e-4])
    >>> scans = [QuadScan({"Q": k1}, {"Q": "k1"}, {"x": f * sizes}) for f in (1.0, 2.0)]
    >>> one, other = fit_many((scan, line) for scan in scans)
    >>> round(other.x.emittance.value / one.x.emittance.value, 9)
    4.0
    """
    closed_form, assumptions = scenario_of("known"), Assumptions()
    return [
        one if isinstance(one, InputError)
        else EmittanceFit(beam_answers(one), one.scan, one.line, closed_form, assumptions, one)
        for one in _prepare_many(scans, weights, noise)
    ]  # fmt: skip


def _prepare_many(
    scans: Iterable[tuple[QuadScan, Beamline]], weights: str, noise: Noise | None
) -> list[PreparedScan | InputError]:
    """Prepared scans in their order, or the errors of those that cannot be used."""
    found: list[PreparedScan | InputError] = []
    for pair in scans:
        try:
            found.append(assemble(*single_beam(*pair), noise=noise, weights=weights))
        except InputError as error:
            found.append(error)
    usable = [i for i, one in enumerate(found) if isinstance(one, PreparedScan)]
    prepared = with_posteriors(with_elements([found[i] for i in usable]))
    for i, one in zip(usable, prepared, strict=True):
        found[i] = one
    return found


def noise_samples(scans: Iterable[tuple[QuadScan, Beamline]], noise: Noise) -> Iterator[Sample]:
    """Evidence for the noise priors from planes of many scans that are surely a beam's.

    Parameters
    ----------
    scans : iterable of (QuadScan, Beamline)
        The scans; those that cannot be used are skipped.
    noise : Noise
        Priors of the fits.
    """
    from beamfit.noise.learn import Sample  # loads the minimiser

    prepared = _prepare_many(scans, WEIGHTS[0], noise)
    for one in (p for p in prepared if isinstance(p, PreparedScan)):
        for solution in one.solutions.values():
            post = solution.posterior
            if len(solution.sizes.size) > 3 and post.probability[BEAM] > SURE:
                error_kind = solution.sizes.comparison_key[1]
                error_kind = "stated" if error_kind == "share" else error_kind
                kinds_under = partial(solution.sizes.kinds_under, post.unit)
                yield Sample(
                    error_kind, kinds_under, post.kinds, post.scales, post.scale_log_evidence
                )
