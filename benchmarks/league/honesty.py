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


def measured(field: str, kind: str, name: str, draws: int, only: str = "") -> dict[str, dict]:
    """Per tool: draws, and of them those confident and wrong, and refused, by number."""
    found = {}
    for label, (tool, every) in FIELDS[field][1].TOOLS.items():
        if only and label != only:
            continue
        count, begin = max(draws // every, 3), time.perf_counter()
        wrong, refused = [], []
        for number in range(count):
            case = drawn(field, kind, name, number)
            answers = ask(tool, case)
            if is_wrong(case, answers):
                wrong.append(number)
            if refuses(answers):
                refused.append(number)
        seconds = (time.perf_counter() - begin) / count
        found[label] = {
            "draws": count, "wrong": len(wrong), "refused": len(refused),
            "such_as": wrong[:3], "refused_such_as": refused[:3], "ms": round(1e3 * seconds, 3),
        }  # fmt: skip
    return found
