"""Every tool on every family: how often it answers, holds the truth and is wrong."""

from __future__ import annotations

import importlib
import math
import time
import zlib
from typing import Any

import numpy as np

from . import decay_tools, decays, scan_tools, scans
from .answers import Answer, ask, score

FIELDS = {"scans": (scans, scan_tools), "decays": (decays, decay_tools)}
KINDS = {"good": "GOOD", "traps": "TRAPS", "hidden": "HIDDEN"}
ASKED = {"scans": ("emittance",), "decays": ("a", "loss")}
PEERS = ("pyemittance", "lmfit", "emcee")


def refuse_if_missing() -> None:
    """Stop where a peer is not installed: a league without it would be another."""
    for name in PEERS:
        try:
            importlib.import_module(name)
        except ImportError as error:
            raise SystemExit(
                f"league: {name} is not installed ({error}); make .venv/league"
            ) from None


def cases(field: str, kind: str) -> dict[str, Any]:
    """Name to what draws a case."""
    found = getattr(FIELDS[field][0], KINDS[kind])
    return {name: make[0] if kind == "hidden" else make for name, make in found.items()}


def drawn(field: str, kind: str, name: str, seed: int, number: int) -> Any:
    """Draw `number` of a family: the same for every tool."""
    random = np.random.default_rng([seed, zlib.crc32(name.encode()), number])
    return cases(field, kind)[name](random)


def answers(field: str, label: str, given: list) -> list[dict[str, Answer]]:
    """What a tool stands for, of each case."""
    tool = FIELDS[field][1].TOOLS[label][0]
    return tool(given) if label == "beamfit" else [ask(tool, case) for case in given]


def judged(what: str, case: Any, said: dict[str, Answer]) -> tuple[float, Answer | None]:
    """The truth of a quantity and the answer; of a loss rate, at the current of the answer."""
    name = next((name for name in said if name.split()[0] == what), None)
    answer = said.get(name)
    if what == "emittance":
        return case.truth, answer
    current = float(name.split()[1]) if name and what == "loss" else None
    a, lifetime = case.truth(current)
    return a if what == "a" else 1 / lifetime, answer


def measured(field: str, label: str, given: list) -> dict[str, Any]:
    """Scores of a tool on draws of a family, by quantity."""
    begin = time.process_time()
    said = answers(field, label, given)
    spent = (time.process_time() - begin) / len(given)
    scores: dict[str, Any] = {"ms": 1e3 * spent}
    for what in ASKED[field]:
        pairs = [judged(what, *both) for both in zip(given, said, strict=True)]
        known = [(truth, answer) for truth, answer in pairs if not math.isnan(truth)]
        if known and (label != "line through log I" or what == "loss"):
            scores[what] = score(*map(list, zip(*known, strict=True)))
    return scores


def family(field: str, kind: str, name: str, seed: int, draws: int) -> dict[str, Any]:
    """Scores of every tool on one family."""
    module, tools = FIELDS[field]
    given = [drawn(field, kind, name, seed, k) for k in range(draws)]
    found: dict[str, Any] = {"tools": {}}
    for label, (_, part) in tools.TOOLS.items():
        found["tools"][label] = measured(field, label, given[: max(draws // part, 3)])
    if kind == "hidden":
        found["says"] = tools.says(given[0], module.HIDDEN[name][1])
    return found
