"""Columns and rows of the table of answers.

A number has its name in JSON with the unit at the end. Further columns have its error, its error
before scaling, and the ends of its 95 % interval. An empty cell is null.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from beamfit.emittance.model import QUANTITIES
from beamfit.lifetime.evidence import UNITS
from beamfit.quantity import Quantity

if TYPE_CHECKING:
    from beamfit.emittance.fit import EmittanceFit
    from beamfit.lifetime.study import RecordStudy

UNUSABLE = "unusable"
# Units at the end of a column name.
UNIT_ENDINGS = {"1": "", "m^2": "_m2", "m rad": "_m_rad", "rad^2": "_rad2", "1/s": "_per_s"}
UNIT_ENDINGS |= {"1/(mA s)": "_per_mA_s"}
ENDINGS = ("", "_error", "_error_raw", "_low_95", "_high_95")
# Columns that identify an answer: the file, and everything else that determines the answer.
KEY_COLUMNS = ("file", "sha256", "lattice_sha256", "options", "beamfit")


@lru_cache(maxsize=256)
def quantity_columns(name: str, unit: str, ends: tuple[str, ...] = ENDINGS) -> tuple[str, ...]:
    """Columns of a quantity.

    Examples
    --------
    >>> quantity_columns("beta", "m", ("", "_error"))
    ('beta_m', 'beta_error_m')
    """
    return tuple(f"{name}{end}{UNIT_ENDINGS.get(unit, f'_{unit}')}" for end in ends)


def _all_columns(quantities: Mapping[str, str]) -> list[str]:
    """Columns of all quantities."""
    return [column for item in quantities.items() for column in quantity_columns(*item)]


NUMBERS = {
    "emittance": (
        *_all_columns(QUANTITIES),
        *("rms_residual_m", "chi2", "dof", "error_scale", "determined", "waist_bracketed"),
        *("beam_probability", "phase_coverage_deg", "condition"),
        *(f"singular_value_{i}" for i in (1, 2, 3)),
    ),
    "lifetime": (
        *_all_columns(UNITS),
        *("mean_current_mA", "rms_residual_mA", "chi2", "dof", "noise_inferred", "start_s"),
        *("separable", "share", "share_error", "correlation", "residual_correlation"),
        *("error_inflation", "cycles"),
    ),
}
COLUMNS = {
    "emittance": (
        *(*KEY_COLUMNS, "slice", "plane", "status", "message", *NUMBERS["emittance"]),
        *("noise", "method", "weights", "undetermined", "next_measurement", "notes"),
    ),
    "lifetime": (*KEY_COLUMNS, "record", "status", "message", *NUMBERS["lifetime"], "notes"),
}


def emittance_rows(fit: EmittanceFit) -> Iterator[dict[str, Any]]:
    """Make a row for each plane."""
    notes = " ".join(fit.notes)
    for p in fit.planes:
        ident = p.identifiability
        quantities = p.quantities | ({} if p.mismatch is None else {"mismatch": p.mismatch})
        row = _quantity_cells(quantities) | vars(ident)
        row |= {name: getattr(p, name) for name in ("plane", "status", "message", "chi2", "dof")}
        row |= {name: getattr(p, name) for name in ("error_scale", "noise", "method", "weights")}
        row |= {f"singular_value_{i}": v for i, v in enumerate(ident.singular_values, start=1)}
        row["beam_probability"] = ident.probability["beam"]
        row["phase_coverage_deg"] = ident.phase_coverage
        yield row | {"undetermined": "; ".join(ident.undetermined), "notes": notes}


def lifetime_rows(study: RecordStudy) -> Iterator[dict[str, Any]]:
    """Make a row for each decay, and one for cycles fitted together."""
    notes = " ".join(study.record.notes)
    for decay in study.answers:
        yield decay_row(decay.fit.to_json()) | {"start_s": decay.offset, "notes": notes}


def decay_row(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Make the row of an entry of ``results`` of `beamfit lifetime --json`."""
    quantities = {k: v for k, v in entry.items() if isinstance(v, Mapping) and "unit" in v}
    scalars = {k: v for k, v in entry.items() if not isinstance(v, Mapping)}
    return _quantity_cells(quantities) | scalars | entry["identifiability"]


def _quantity_cells(quantities: Mapping[str, Quantity | Mapping[str, Any]]) -> dict[str, Any]:
    """Cells of quantities: value, error, raw error and ends of the 95 % interval."""
    row = {}
    for name, q in quantities.items():
        entry = q.to_json() if isinstance(q, Quantity) else q
        low, high = entry.get("interval_95") or (None, None)
        values = (entry["value"], entry["error"], entry.get("error_raw"), low, high)
        row |= zip(quantity_columns(name, entry["unit"]), values, strict=True)
    return row


def csv_text(rows: Iterable[Mapping[str, Any]], columns: Iterable[str]) -> str:
    """Write rows as CSV; numbers have all digits.

    Examples
    --------
    >>> csv_text([{"a": 0.1, "b": "x,\\ny", "c": math.nan, "d": True}], "abcde")
    '0.1,"x, y",,1,\\n'
    """
    text = io.StringIO()
    wanted = tuple(columns)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([_cell(row.get(name)) for name in wanted] for row in rows)
    return text.getvalue()


def _cell(value: Any) -> Any:
    """Text or number of a cell: NaN and infinities are empty, a flag is 0 or 1."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, str):
        return value if value.isprintable() else " ".join(value.split())
    return int(value) if isinstance(value, bool) else value
