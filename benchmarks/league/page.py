"""docs/league*.md from the scores: the pages are written, never edited."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from scipy.stats import beta

from .answers import DEFINITION
from .honesty import ASKED

PLACE = Path(__file__).resolve().parents[2] / "docs"
HEAD = f"""\
# The league

The league compares beamfit with other programs on the same SIMULATED data: [quadrupole
scans](league_scans.md) and [decays and top-up](league_decays.md). `make league` simulates, measures
and writes these pages; [speed](speed.md) is a separate page.

Every row is a family: line, beam, law, number of readings, noise and the size of the defect are
drawn at random for each record in each run, within the ranges of `benchmarks/league/scans.py` and
`decays.py`; the page gives the seed. All tools get the same records, in the form that their users
give; emcee, which is slow, gets the first tenth.

pyemittance analyses scans; curve_fit, lmfit and emcee stand for scripts that users write (emcee: 32
walkers, 300 steps, no convergence test). lcls-tools and elegant's sddsemitproc are not on PyPI;
their methods were reimplemented from the descriptions. In top-up the scripts get the refills:
they fit the longest piece, straight lines every piece. A program that is not installed stops the
run.

## What is counted

{DEFINITION}
"""
TITLES = {"scans": "Emittance from a quadrupole scan", "decays": "Decays and top-up"}
QUANTITIES = {"emittance": "emittance", "a": "a", "loss": "loss rate (1/lifetime)"}
SECTIONS = {
    "good": "Good records",
    "traps": "Traps that the data can reveal",
    "hidden": "What the data cannot show",
}


def limits(hits: int, count: int) -> str:
    """Percent with its central 95 % (Clopper-Pearson), in one word."""
    if not count:
        return "–"
    low = beta.ppf(0.025, hits, count - hits + 1) if hits else 0.0
    high = beta.ppf(0.975, hits + 1, count - hits) if hits < count else 1.0
    return f"{100 * hits / count:.0f}({100 * low:.0f}–{100 * high:.0f})"


def percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.2g}"


def table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("|" + "|".join(line) + "|" for line in lines) + "\n"


def own(families: dict[str, Any], what: str) -> str:
    """All scores of beamfit."""
    head = ["", "answered", "in 68 %", "in 95 %", "wrong", "bias, %", "error, %"]
    rows = []
    for name, found in families.items():
        if (s := found["tools"]["beamfit"].get(what)) is None:
            continue
        counts = [limits(s[k], s["sure"]) for k in ("in_68", "in_95")]
        ends = [limits(s["wrong"], s["draws"]), percent(s["bias"]), percent(s["error"])]
        rows.append([name, limits(s["answered"], s["draws"]), *counts, *ends])
    return table(head, rows)


def beside(families: dict[str, Any], what: str, key: str, of: str) -> str:
    """One score of every tool."""
    first = next(iter(families.values()))["tools"]
    tools = [t for t in first if any(what in f["tools"][t] for f in families.values())]
    rows = []
    for name, found in families.items():
        if what in found["tools"]["beamfit"]:
            scores = [found["tools"][tool][what] for tool in tools]
            rows.append([name, *(limits(s[key], s[of]) for s in scores)])
    return table(["", *tools], rows)


def summed(found: dict[str, dict], what: str) -> str:
    """Of each tool, the good records and the traps taken together."""
    rows = []
    for tool in next(iter(found["good"].values()))["tools"]:
        cells = [tool]
        for kind in ("good", "traps"):
            scores = [f["tools"][tool].get(what) for f in found[kind].values()]
            s = {k: sum(one[k] for one in scores if one) for k in ("draws", "answered", "sure",
                 "in_68", "in_95", "wrong")}  # fmt: skip
            if not s["draws"]:
                break
            cells.append(limits(s["answered"], s["draws"]))
            if kind == "good":
                cells += [limits(s[k], s["sure"]) for k in ("in_68", "in_95")]
            cells.append(limits(s["wrong"], s["draws"]))
        else:
            rows.append(cells)
    head = ["", "good: answered", "in 68 %", "in 95 %", "wrong", "traps: answered", "wrong"]
    return table(head, rows)


def parts(field: str, found: dict[str, dict], seed: int, draws: int) -> Iterator[str]:
    """A page: all together, beamfit's scores, and the tools side by side."""
    yield f"# The league: {TITLES[field]}\n"
    yield (
        f"Made by `python -m benchmarks.league --field {field} --draws {draws} --seed {seed}`: "
        f"{draws} draws a family, a tenth of them for emcee. All numbers are %; words and tools "
        "are those of [the league](league.md). All data are SIMULATED.\n"
    )
    for what in ASKED[field]:
        yield f"## All together: {QUANTITIES[what]}\n"
        yield summed(found, what)
    for kind, families in found.items():
        yield f"## {SECTIONS[kind]}\n"
        for what in ASKED[field]:
            yield f"beamfit, {QUANTITIES[what]}:\n"
            yield own(families, what)
            if kind == "good":
                yield f"Truth in the 95 % interval, {QUANTITIES[what]}:\n"
                yield beside(families, what, "in_95", "sure")
            else:
                yield f"Wrong, {QUANTITIES[what]}:\n"
                yield beside(families, what, "wrong", "draws")
    yield "What beamfit says of the first draw of each:\n"
    yield "\n".join(f"- {name}: {f['says']}" for name, f in found["hidden"].items()) + "\n"


def write(field: str, found: dict[str, dict], seed: int, draws: int) -> None:
    """Write the page of a field, and the one that stands above both."""
    (PLACE / "league.md").write_text(HEAD)
    (PLACE / f"league_{field}.md").write_text("\n".join(parts(field, found, seed, draws)))
