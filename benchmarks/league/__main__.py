"""Measure into results.json, and write docs/league.md from it."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

RESULTS = Path(__file__).with_name("results.json")


def read() -> dict:
    return json.loads(RESULTS.read_text()) if RESULTS.exists() else {}


def keep(results: dict) -> None:
    """Written whole beside the old one, then renamed."""
    partial = RESULTS.with_suffix(".partial")
    partial.write_text(json.dumps(results, indent=1, ensure_ascii=False) + "\n")
    os.replace(partial, RESULTS)


def honesty(draws: int, only: str, case: str, show: bool) -> None:
    from .honesty import FIELDS, KINDS, cases, measured

    for field in FIELDS:
        for kind in KINDS:
            for name in cases(field, kind):
                if case not in name:
                    continue
                found = measured(field, kind, name, draws, only)
                for tool, f in found.items():
                    said = f"wrong {f['wrong']} {f['such_as']}, refused {f['refused']}"
                    said += f" {f['refused_such_as']} of {f['draws']}, {f['ms']:.1f} ms"
                    print(f"{field} {kind:6s} {name:45s} {tool:22s} {said}", flush=True)
                if not show:
                    results = read()
                    part = results.setdefault("honesty", {}).setdefault(field, {})
                    part.setdefault(kind, {}).setdefault(name, {}).update(found)
                    keep(results)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.league", description=__doc__)
    parser.add_argument("what", choices=("honesty", "speed", "page"))
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--tool", default="", help="this one alone")
    parser.add_argument("--case", default="", help="cases whose name holds this")
    parser.add_argument("--show", action="store_true", help="print, keep nothing")
    asked = parser.parse_args()
    if asked.what == "honesty":
        honesty(asked.draws, asked.tool, asked.case, asked.show)


if __name__ == "__main__":
    main()
