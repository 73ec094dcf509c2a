"""Draw every family, ask every tool, and write docs/league*.md."""

from __future__ import annotations

import argparse
import os
import secrets

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

from . import honesty, page


def line(field: str, name: str, tool: str, scores: dict) -> str:
    said = [
        f"{what} answered {s['answered']}/{s['draws']}, in 68 % {s['in_68']}, "
        f"in 95 % {s['in_95']}, wrong {s['wrong']}"
        for what in honesty.ASKED[field]
        if (s := scores.get(what))
    ]
    return f"{field} {name:40s} {tool:22s} {'; '.join(said)}; {scores['ms']:.0f} ms"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.league", description=__doc__)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--seed", type=int, help="of an earlier run; drawn anew if not given")
    parser.add_argument("--field", choices=honesty.FIELDS, action="append")
    parser.add_argument("--family", default="", help="families whose name holds this; no page")
    asked = parser.parse_args()
    honesty.refuse_if_missing()
    seed = secrets.randbelow(10**6) if asked.seed is None else asked.seed
    print(f"seed {seed}", flush=True)
    for field in asked.field or honesty.FIELDS:
        found: dict[str, dict] = {}
        for kind in honesty.KINDS:
            names = [n for n in honesty.cases(field, kind) if asked.family in n]
            found[kind] = {}
            for name in names:
                found[kind][name] = honesty.family(field, kind, name, seed, asked.draws)
                for tool, scores in found[kind][name]["tools"].items():
                    print(line(field, name, tool, scores), flush=True)
        if not asked.family:
            page.write(field, found, seed, asked.draws)


if __name__ == "__main__":
    main()
