"""Slices of a beam, each fitted from its own rows, together with the projected beam."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from beamfit.answer import Table, answer, cell
from beamfit.emittance.fit import EmittanceFit, fit_emittance
from beamfit.emittance.results import PlaneFit
from beamfit.emittance.scan import PROJECTED, QuadScan
from beamfit.errors import Status
from beamfit.optics.beamline import Beamline

HEADER = ("slice", "energy", "status", "normalised emittance", "beta at the start")
HEADER += ("alpha at the start", "chi2/dof")


@answer
@dataclass(frozen=True, eq=False)
class SliceFits:
    """Fits of the slices of a beam, in the order of the scan, the projected beam last.

    Attributes
    ----------
    scan : QuadScan
        All rows.
    fits : tuple of EmittanceFit
        One per slice.
    """

    scan: QuadScan
    fits: tuple[EmittanceFit, ...]

    def __iter__(self) -> Iterator[EmittanceFit]:
        return iter(self.fits)

    def __len__(self) -> int:
        return len(self.fits)

    def __getitem__(self, name: str) -> EmittanceFit:
        return dict(zip(self.slices, self.fits, strict=True))[name]

    @property
    def slices(self) -> tuple[str, ...]:
        """Names of the slices."""
        return tuple(fit.scan.slices[0] for fit in self.fits)

    @property
    def projected(self) -> EmittanceFit | None:
        """Fit of the whole beam, if it was measured."""
        return self[PROJECTED] if PROJECTED in self.slices else None

    @property
    def planes(self) -> tuple[str, ...]:
        """Planes in which some slice was fitted."""
        fitted = {p.plane for fit in self.fits for p in fit.planes}
        return tuple(p for p in self.scan.planes if p in fitted)

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on unusual numbers of any slice, without repetition."""
        return tuple(dict.fromkeys(note for fit in self.fits for note in fit.notes))

    def of_plane(self, plane: str) -> list[tuple[EmittanceFit, PlaneFit]]:
        """Slices fitted in a plane, each with its fit there."""
        return [(fit, p) for fit in self.fits for p in fit.planes if p.plane == plane]

    def alike(self) -> dict[tuple[str, Status, str], dict[str, PlaneFit]]:
        """Fits by slice, grouped by equal plane, status and message."""
        found: dict[tuple[str, Status, str], dict[str, PlaneFit]] = {}
        for plane in self.planes:
            for fit, p in self.of_plane(plane):
                found.setdefault((plane, p.status, p.message), {})[fit.scan.slices[0]] = p
        return found

    @property
    def headline(self) -> str:
        """The scan in one line."""
        return f"{self.scan.name}: {', '.join(self.slices)}, planes {', '.join(self.planes)}"

    @property
    def message(self) -> str:
        """Sentences on the slices without repetition, one line each."""
        groups = self.alike().items()
        return "\n".join(
            f"{', '.join(names)}, {plane}: {message}" for (plane, _, message), names in groups
        )

    def tables(self) -> tuple[Table, ...]:
        """One table per plane, one row per slice."""
        found = []
        for plane in self.planes:
            rows = [_row(fit, p) for fit, p in self.of_plane(plane)]
            found.append(Table(f"Slices of {self.scan.name}, {plane} plane", HEADER, rows))
        return tuple(found)

    def to_json(self) -> list[dict[str, Any]]:
        """Give the ``results`` list of the JSON contract, each entry with its ``slice``."""
        return [entry for fit in self.fits for entry in fit.to_json()]


def _row(fit: EmittanceFit, p: PlaneFit) -> list[str]:
    """Table row of a slice in one plane."""
    chi2 = "-" if p.chi2 is None else f"{p.chi2:.1f}/{p.dof}"
    quantities = (p.status, p.normalized_emittance, p.beta, p.alpha)
    return [fit.scan.slices[0], f"{fit.seen.energy:.6g} MeV", *map(cell, quantities), chi2]


def fit_slices(scan: QuadScan, line: Beamline | None = None, **options: Any) -> SliceFits:
    """Fit the beam matrix of each slice of a beam, and of the projected beam if measured.

    Parameters
    ----------
    scan : QuadScan
        With ``slice``, and ``energy`` if it differs between the slices.
    line : Beamline, optional
        As for `beamfit.fit_emittance`. Its magnets stay as they are for the line's energy.
    **options
        As for `beamfit.fit_emittance`; ``planes`` in which a slice was not measured are skipped.

    Returns
    -------
    SliceFits
        ``fits["3"].x.normalized_emittance``, for example.

    Raises
    ------
    InputError
        As `beamfit.fit_emittance`, or if the scan has no slices.

    Notes
    -----
    Each slice has a beam matrix of its own and is fitted from its own rows: slices share only the
    line. A slice of another energy has its own orbit through magnets that stay, and its matrix is
    about that orbit (report eqs 24-28, with the corrections of docs/emittance.md).

    Examples
    --------
    >>> from beamfit.optics.elements import Drift, Quadrupole, Screen
    >>> line = Beamline((Quadrupole("Q", 0.1), Drift("D", 2.0), Screen("S")), 135.0)
    >>> sizes = [3.4e-4, 1.9e-4, 0.9e-4, 1.9e-4, 3.4e-4] * 2
    >>> scan = QuadScan({"Q": [-1.0, 1.5, 4.0, 6.5, 9.0] * 2}, {"Q": "k1"}, {"x": sizes},
    ...                 energy=[134.0] * 5 + [136.0] * 5, slice=["head"] * 5 + ["tail"] * 5)
    >>> fits = fit_slices(scan, line)
    >>> fits.slices, fits["tail"].x.dof
    (('head', 'tail'), 2)
    """
    if scan.slice is None:
        raise scan.unusable("a scan without slices", "a column slice, or fit_emittance")
    chosen = options.pop("planes", None) or scan.planes
    for plane in chosen:
        scan.rows(plane)  # raises an error if the plane was not measured
    fits = []
    for name in scan.slices:
        part = scan.of_slice(name)
        if planes := tuple(p for p in chosen if p in part.planes):
            fits.append(fit_emittance(part, line, planes=planes, **options))
    return SliceFits(scan, tuple(fits))
