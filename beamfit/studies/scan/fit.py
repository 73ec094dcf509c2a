"""A fitted scan: its planes, and the scan and line they came from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from beamfit.quantity import Quantity
from beamfit.studies.scan.results import Parameter, PlaneFit
from beamfit.studies.scan.scans import QuadScan
from beamfit.studies.scan.tables import as_html, as_text, parameter_rows

if TYPE_CHECKING:
    from beamfit.greybox.fit import Fit
    from beamfit.greybox.problem import Problem
    from beamfit.optics.beamline import Beamline
    from beamfit.sampling.posterior import Posterior
    from beamfit.sampling.priors import Distribution

__all__ = ["EmittanceFit"]


@dataclass(frozen=True, eq=False)
class EmittanceFit:
    """A fitted scan: one `PlaneFit` a plane, with the scan and the line it came from.

    Prints as a table; in a notebook it shows as one.

    Attributes
    ----------
    planes : tuple of PlaneFit
        One a plane.
    scan : QuadScan
        The scan.
    line : Beamline
        The line; in a scenario with the calibration or the network of k1 as fitted.
    scenario : str
        "known", "transport-network", "calibration" or "focusing-network".
    anchor : str
        What ties a network to first principles, in words.
    parameters : tuple of Parameter
        Numbers fitted besides the beam.
    null_directions : tuple of str
        Changes of the unknowns that leave the sizes as they are.
    fit : Fit or None
        The grey-box fit of a scenario; None where transport is known and the fit is linear.
    stated : Problem or None
        A scenario's problem as it was stated, starting from first principles.

    Examples
    --------
    >>> from beamfit.optics.beamline import Beamline
    >>> from beamfit.optics.elements import Drift, Quadrupole, Screen
    >>> from beamfit.studies.scan.emittance import fit_emittance
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
    scenario: str = "known"
    anchor: str = "none"
    parameters: tuple[Parameter, ...] = ()
    null_directions: tuple[str, ...] = ()
    fit: Fit | None = None
    stated: Problem | None = None

    @property
    def problem(self) -> Problem:
        """The grey-box problem of all planes together, as it was fitted or could be.

        Numbers of the beam are ``beam.x.l11``, ``beam.x.l21``, ``beam.x.l22``: the Cholesky factor
        of σ in units of 1e-4 (m, rad).
        """
        if self.fit is not None:
            return self.fit.problem
        from beamfit.studies.scan.known_problem import known_problem

        return known_problem(self)

    def __getitem__(self, plane: str) -> PlaneFit:
        return {p.plane: p for p in self.planes}[plane]

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
        noise: str | None = None,
        outliers: bool | None = None,
        priors: Mapping[str, Distribution] | None = None,
        **options: Any,
    ) -> Posterior:
        """Draw σ of the planes from its posterior, flat over positive definite matrices.

        Parameters
        ----------
        planes : tuple of str, optional
            Which; all that were fitted if None.
        noise, outliers, priors
            As `beam_posterior.beam_target`, with priors on ``x.sigma11`` and so on; in a scenario
            also on the further names of its ``problem``.
        **options
            ``seed, target_ess, budget, walkers, store, provenance, progress`` of
            `beamfit.sampling.ensemble.draw`.

        Returns
        -------
        Posterior
            Of ``x.sigma11`` ... and what else a scenario fitted; ``x.emittance``,
            ``x.normalized_emittance``, ``x.beta``, ``x.alpha``, ``x.mismatch`` are derived.

        Raises
        ------
        InputError
            As `beam_target` and `draw`.
        """
        from beamfit.sampling.ensemble import draw
        from beamfit.studies.scan.beam_posterior import beam_target

        return draw(beam_target(self, planes, noise, outliers, priors), **options)

    def to_json(self) -> list[dict[str, Any]]:
        """Give the ``results`` list of the JSON contract."""
        entries = [p.to_json() | {"energy": self._energy(p.plane).to_json()} for p in self.planes]
        if self.scenario == "known":
            return entries
        own = {
            "scenario": self.scenario,
            "anchor": self.anchor,
            "parameters": [p.to_json() for p in self.parameters],
            "null_directions": list(self.null_directions),
        }
        return [entry | own for entry in entries]

    def _energy(self, plane: str) -> Quantity:
        """Mean total energy of the rows in which a plane was measured, MeV."""
        if self.scan.energy is None:
            return Quantity(float(self.line.energy), None, "MeV")
        measured = np.isfinite(self.scan.size[plane])
        return Quantity(float(self.scan.energy[measured].mean()), None, "MeV")

    def __str__(self) -> str:
        heading = f"{self.scan.name} on {self.line.name}, fit of {self.planes[0].method}"
        text = as_text(heading.replace("_", " "), self.planes)
        if self.scenario == "known":
            return text
        rows = parameter_rows(self.parameters)
        width = max((len(row[0]) for row in rows), default=0)
        lines = [f"scenario {self.scenario}, anchor: {self.anchor}"]
        lines += [f"{name.ljust(width)}  {'  '.join(cells)}".rstrip() for name, cells in rows]
        lines += [f"Left open: {words}." for words in self.null_directions]
        return "\n".join([text, "", *lines])

    def _repr_html_(self) -> str:
        return as_html(self.planes)
