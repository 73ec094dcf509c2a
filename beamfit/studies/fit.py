"""A fitted scan: its planes, and the scan and line they came from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from beamfit.studies.results import PlaneFit
from beamfit.studies.scans import QuadScan
from beamfit.studies.tables import as_html, as_text

if TYPE_CHECKING:
    from beamfit.optics.beamline import Beamline
    from beamfit.sampling.posterior import Posterior
    from beamfit.sampling.priors import Distribution

__all__ = ["EmittanceFit"]


@dataclass(frozen=True, eq=False)
class EmittanceFit:
    """A fitted scan: one `PlaneFit` a plane, with the scan and the line it came from.

    Prints as a table; in a notebook it shows as one.

    Examples
    --------
    >>> from beamfit.optics.beamline import Beamline
    >>> from beamfit.optics.elements import Drift, Quadrupole, Screen
    >>> from beamfit.studies.emittance import fit_emittance
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
            As `beamfit.studies.beam_posterior.beam_target`, with priors on ``x.sigma11`` and so on.
        **options
            ``seed, target_ess, budget, walkers, store, provenance, progress`` of
            `beamfit.sampling.ensemble.draw`.

        Returns
        -------
        Posterior
            Of ``x.sigma11`` ...; ``x.emittance``, ``x.normalized_emittance``, ``x.beta``,
            ``x.alpha``, ``x.mismatch`` are derived.

        Raises
        ------
        InputError
            As `beam_target` and `draw`.
        """
        from beamfit.sampling.ensemble import draw
        from beamfit.studies.beam_posterior import beam_target

        return draw(beam_target(self, planes, noise, outliers, priors), **options)

    def to_json(self) -> list[dict[str, Any]]:
        """Give the ``results`` list of the JSON contract."""
        return [p.to_json() for p in self.planes]

    def __str__(self) -> str:
        heading = f"{self.scan.name} on {self.line.name}, fit of {self.planes[0].method}"
        return as_text(heading.replace("_", " "), self.planes)

    def _repr_html_(self) -> str:
        return as_html(self.planes)
