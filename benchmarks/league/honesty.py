"""Every tool on every case: how often it is confident and wrong, and how often it refuses."""

from __future__ import annotations

import time
import zlib
from typing import Any

import numpy as np

from . import decay_tools, decays, scan_tools, scans
from .answers import Answer, ask

FIELDS = {"scans": (scans, scan_tools), "decays": (decays, decay_tools)}
KINDS = {"good": "GOOD", "traps": "TRAPS", "hidden": "HIDDEN"}


def cases(field: str, kind: str) -> dict[str, Any]:
    """Name to what draws a case."""
    found = getattr(FIELDS[field][0], KINDS[kind])
    return {name: make[0] if kind == "hidden" else make for name, make in found.items()}


def is_wrong(case: Any, answers: dict[str, Answer]) -> bool:
    """Whether any answer is confident and wrong."""
    for name, answer in answers.items():
        if isinstance(case, scans.Scan):
            truth = case.truth
        else:
            words = name.split()
            truth = case.truth(words[0], float(words[-1]) if words[0] == "lifetime" else 0.0)
        if truth is not None and answer.wrong(truth):
            return True
    return False


def refuses(answers: dict[str, Answer]) -> bool:
    """No emittance, or no lifetime."""
    told = [a for name, a in answers.items() if name.startswith(("emittance", "lifetime"))]
    return not any(answer.useful for answer in told)


def drawn(field: str, kind: str, name: str, number: int) -> Any:
    """Draw `number` of a case: the same for every tool."""
    return cases(field, kind)[name](np.random.default_rng([zlib.crc32(name.encode()), number]))


def count(field: str, tool: str, draws: int) -> int:
    """How many draws a tool is given where the cheapest are given so many."""
    return max(draws // FIELDS[field][1].TOOLS[tool][1], 3)


def measured(field: str, kind: str, name: str, draws: int, label: str) -> dict[str, Any]:
    """Of a tool: draws, and of them those confident and wrong, and refused, by number."""
    tool = FIELDS[field][1].TOOLS[label][0]
    given = [drawn(field, kind, name, k) for k in range(count(field, label, draws))]
    begin = time.perf_counter()
    answers = tool(given) if label == "beamfit" else [ask(tool, case) for case in given]
    seconds = (time.perf_counter() - begin) / len(given)
    both = list(zip(given, answers, strict=True))
    wrong = [k for k, (case, said) in enumerate(both) if is_wrong(case, said)]
    refused = [k for k, (_, said) in enumerate(both) if refuses(said)]
    return {
        "draws": len(given), "wrong": len(wrong), "refused": len(refused),
        "such_as": wrong[:3], "refused_such_as": refused[:3], "ms": round(1e3 * seconds, 3),
    }  # fmt: skip


def says(field: str, name: str) -> str:
    """What beamfit says where the data show nothing: its budget's row, else its message."""
    case = drawn(field, "hidden", name, 0)
    _, cause, steps = FIELDS[field][0].HIDDEN[name]
    if field == "scans":
        fit = scan_tools.beamfit_fit(case)
        error = fit.x.normalized_emittance.relative if fit.x.emittance.error else float("nan")
        rows = [(c.cause, c.normalized_emittance) for c in scan_tools.systematics(fit, "x")]
        told, what, message = f"statistics ±{100 * error:.1f} %", "emittance", fit.x.message
    else:
        fit = decay_tools.beamfit_fits(case)[0]
        b = fit.b
        told = (
            f"b ±{100 * b.error / b.value:.1f} % by statistics" if b.error else "b not determined"
        )
        rows = [(c.cause, c.b / b.value) for c in decay_tools.systematics(fit)]
        what, message = "b", fit.message
    row = [(c, share) for c, share in rows if cause and cause in c]
    if not row:
        return f"it says: {message.split(': errors rest')[0][:300]}"
    moved = f"{what} {100 * row[0][1]:+.1f} %, here {steps:g} times that"
    words = f"; it says: {message.split('. ')[0].rstrip('.')}" if field == "decays" else ""
    return f"{told}; its budget has *{row[0][0]}*: {moved}{words}"
