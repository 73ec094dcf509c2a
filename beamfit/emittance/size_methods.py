"""Emittances of one scan for several methods of taking sizes from profiles."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from beamfit.answer import Table, cell
from beamfit.emittance.fit import fit_emittance
from beamfit.emittance.model import emittance_parts
from beamfit.emittance.scan import QuadScan
from beamfit.emittance.sigma import fit_sizes
from beamfit.errors import Status
from beamfit.optics.beamline import Beamline
from beamfit.particles import ELECTRON_MASS, beta_gamma
from beamfit.quantity import Quantity
from beamfit.statistics import reach_of


class MethodRow(NamedTuple):
    """Normalised emittance of one plane, for one method of taking the sizes.

    Attributes
    ----------
    method : str
        Method by which the sizes were taken from the profiles.
    stored : Quantity or None
        Value in the file.
    measured_weights : Quantity or None
        The same, recomputed by the file's own method from its mean sizes; see `measured_weights`.
        None if the file has none.
    emittance : Quantity
        Value from `beamfit.fit_emittance`; without an error if the sizes do not determine it.
    status : Status
        Status of that fit.
    """

    method: str
    stored: Quantity | None
    measured_weights: Quantity | None
    emittance: Quantity
    status: Status


@dataclass(frozen=True)
class SizeMethods:
    """Emittances of a plane for all methods of taking the sizes, and one that covers them.

    Attributes
    ----------
    plane : str
        "x" or "y".
    rows : tuple of MethodRow
        One per method.
    covering : Quantity
        Mean of the methods' normalised emittances. Its error is that of the fits and, as a
        systematic, the spread of the methods, added in quadrature.
    """

    plane: str
    rows: tuple[MethodRow, ...]
    covering: Quantity

    def to_json(self) -> dict[str, Any]:
        """Rows and covering emittance for the JSON output."""
        return {
            "methods": [row._asdict() for row in self.rows],
            "normalized_emittance": self.covering,
        }

    def table(self) -> Table:
        """Table of the methods."""
        header = ["size method", "in the file", "measured weights", "beamfit", "status"]
        rows = [
            [r.method, _um(r.stored), _um(r.measured_weights), _um(r.emittance), cell(r.status)]
            for r in self.rows
        ]
        rows.append(["over all methods", "", "", _um(self.covering), ""])
        return Table(f"Normalised emittance in {self.plane}, µm, by size method", header, rows)


def _um(q: Quantity | None) -> str:
    """A length in µm without its unit."""
    if q is None:
        return "-"
    error = None if q.error is None else 1e6 * q.error
    return str(Quantity(1e6 * q.value, error, "1")).replace("(not determined)", "(open)")


def compare_size_methods(
    scans: Mapping[str, QuadScan],
    line: Beamline,
    stored: Mapping[str, Mapping[str, Quantity]] | None = None,
    means: Mapping[str, QuadScan] | None = None,
) -> tuple[SizeMethods, ...]:
    """Fit a scan for each method of taking its sizes.

    Parameters
    ----------
    scans : mapping of str to QuadScan
        Method to scan.
    line : Beamline
        The line.
    stored : mapping of str to mapping of str to Quantity, optional
        Method and plane to the normalised emittance stored in a file.
    means : mapping of str to QuadScan, optional
        Method to the mean sizes and errors from which the file computed it, with the rows' own
        matrices.

    Returns
    -------
    tuple of SizeMethods
        One per plane.

    Examples
    --------
    >>> from beamfit.optics.elements import Drift, Quadrupole, Screen
    >>> line = Beamline((Quadrupole("Q", 0.1), Drift("D", 2.0), Screen("S")), 135.0)
    >>> sizes = np.array([3.4e-4, 1.9e-4, 0.9e-4, 1.9e-4, 3.4e-4])
    >>> k1 = [-1.0, 1.5, 4.0, 6.5, 9.0]
    >>> scans = {n: QuadScan({"Q": k1}, {"Q": "k1"}, {"x": f * sizes}, {"x": 0.02 * f * sizes})
    ...          for n, f in (("rms", 1.0), ("cut", 0.9))}
    >>> [found] = compare_size_methods(scans, line)
    >>> rms, cut = (row.emittance.value for row in found.rows)
    >>> round(cut / rms, 2), round(2 * found.covering.value / (rms + cut), 6)
    (0.81, 1.0)
    """
    fits = {method: fit_emittance(scan, line) for method, scan in scans.items()}
    planes = dict.fromkeys(p.plane for fit in fits.values() for p in fit.planes)
    found = []
    for plane in planes:
        rows = []
        for method, fit in fits.items():
            if plane not in fit.scan.planes:
                continue
            p, mean = fit[plane], (means or {}).get(method)
            stored_value = (stored or {}).get(method, {}).get(plane)
            recomputed = measured_weights(mean, plane) if mean and plane in mean.planes else None
            rows.append(
                MethodRow(method, stored_value, recomputed, p.normalized_emittance, p.status)
            )
        found.append(SizeMethods(plane, tuple(rows), _covering_answer(rows)))
    return tuple(found)


def measured_weights(scan: QuadScan, plane: str) -> Quantity:
    """Compute the normalised emittance with weights of the measured sizes, as emittance_gui does.

    Parameters
    ----------
    scan : QuadScan
        Mean sizes of electrons, with errors, total energies and matrices of the rows.
    plane : str
        "x" or "y".

    Returns
    -------
    Quantity
        In m; without an error if there is no residual, NaN if no beam is found.

    Notes
    -----
    Linear least squares of size² with weights 1/(2 size error) of the measured sizes. The error is
    linear propagation times sqrt(χ²/dof), also if that is below 1. These are the stored numbers of
    ../shared/data/lcls_otr2/test_scan2.mat and of the files in ../shared/data/lcls_gui, with
    βγ = E/mc².

    Examples
    --------
    >>> drift = [[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]]  # from a waist of 0.1 mm and 0.1 mrad
    >>> sizes = {"x": 1e-4 * np.sqrt([1.0, 2.0, 5.0])}
    >>> scan = QuadScan({}, {}, sizes, energy=[135.0] * 3, transfer={"x": drift})
    >>> print(measured_weights(scan, "x"))
    2.64 µm (not determined)
    """
    measured = ~np.isnan(scan.size[plane])
    size = scan.size[plane][measured]
    error = scan.error[plane][measured] if plane in scan.error else size
    r11, r12 = scan.transfer[plane][measured, :2].T
    found, dof = fit_sizes(r11, r12, size, error, weights="measured"), len(size) - 3
    if not (bool(found.positive) and bool(found.full_rank)):
        return Quantity(math.nan, None, "m")
    factor = beta_gamma(float(scan.energy.mean()), ELECTRON_MASS)
    value = factor * float(emittance_parts(found.sigma)[0])
    if dof < 1:
        return Quantity(value, None, "m")
    relative = 0.5 * float(found.determinant_error / found.determinant)
    return Quantity(value, value * relative * math.sqrt(float(found.chi2) / dof), "m")


def _covering_answer(rows: list[MethodRow]) -> Quantity:
    """Mean over the methods that find a beam, with their spread as a part of its error.

    The standard deviation of the methods is not divided by the square root of their number: they
    are not repetitions of one measurement.
    """
    found = [r.emittance for r in rows if r.emittance.value > 0.0]
    values = np.array([q.value for q in found])
    if len(values) < 2:
        return Quantity(float(values.mean()) if len(values) else math.nan, None, "m")
    spread = float(values.std(ddof=1))
    errors = [q.error for q in found if q.error is not None]
    statistical = math.sqrt(float(np.mean(np.square(errors)))) if errors else 0.0
    error, middle = math.hypot(spread, statistical), float(values.mean())
    reach = reach_of(len(values) - 1) * error
    return Quantity.reaching(middle, error, "m", statistical, reach)
