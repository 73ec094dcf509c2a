"""Measure into results.json, and write docs/league.md from it."""

from __future__ import annotations

import argparse
import json
import os
import re
from pathlib import Path

RESULTS = Path(__file__).with_name("results.json")


def read() -> dict:
    return json.loads(RESULTS.read_text()) if RESULTS.exists() else {}


def merged(old: dict, new: dict) -> dict:
    """`new` laid over `old`, level by level."""
    both = {k: merged(old[k], v) if isinstance(v, dict) and k in old else v for k, v in new.items()}
    return old | both


def keep(found: dict) -> None:
    """Add to the results, one line a tool; written whole beside the old ones, then renamed."""
    partial = RESULTS.with_suffix(f".{os.getpid()}")
    text = json.dumps(merged(read(), found), indent=1, ensure_ascii=False)
    partial.write_text(re.sub(r"\{[^{}]*\}", lambda m: " ".join(m[0].split()), text) + "\n")
    os.replace(partial, RESULTS)


def honesty(asked: argparse.Namespace) -> None:
    """Every case by every tool, kept one by one: nothing kept of so many draws is done again."""
    from .honesty import FIELDS, KINDS, cases, count, measured, says

    for field in asked.field.split(","):
        for kind, name in [(k, name) for k in KINDS for name in cases(field, k)]:
            if asked.case not in name:
                continue
            known = {} if asked.show or asked.again else read()
            for key in ("honesty", field, kind, name, "tools"):
                known = known.get(key, {})
            for tool in FIELDS[field][1].TOOLS:
                done = known.get(tool, {}).get("draws", 0) >= count(field, tool, asked.draws)
                if done or asked.tool not in ("", tool):
                    continue
                f = measured(field, kind, name, asked.draws, tool)
                said = f"wrong {f['wrong']} {f['such_as']}, refused {f['refused']}"
                said += f" {f['refused_such_as']} of {f['draws']}, {f['ms']:.1f} ms"
                print(f"{field} {kind:6s} {name:45s} {tool:22s} {said}", flush=True)
                case = {"tools": {tool: f}}
                if kind == "hidden" and tool == "beamfit":
                    case["says"] = says(field, name)
                    print(case["says"])
                if not asked.show:
                    keep({"honesty": {field: {kind: {name: case}}}})


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.league", description=__doc__)
    parser.add_argument("what", choices=("honesty", "speed", "page"), nargs="*")
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--field", default="scans,decays")
    parser.add_argument("--tool", default="", help="this one alone")
    parser.add_argument("--case", default="", help="cases whose name holds this")
    parser.add_argument("--again", action="store_true", help="also what is kept already")
    parser.add_argument("--show", action="store_true", help="print, keep nothing")
    asked = parser.parse_args()
    what = asked.what or ["honesty", "speed", "page"]
    if "honesty" in what:
        honesty(asked)
    if "speed" in what:
        from .speed import measured

        for work in measured(asked.case):
            keep({"speed": work})
    if "page" in what:
        from .page import write

        write(read())


if __name__ == "__main__":
    main()
