"""docs/league*.md from results.json: the pages are written, never edited."""

from __future__ import annotations

import math
from pathlib import Path

from .answers import DEFINITION
from .honesty import KINDS, cases

PLACE = Path(__file__).resolve().parents[2] / "docs"
MOST_WRONG, MOST_REFUSED = 1.0, 2.0  # percent
HEAD = """\
# The league

beamfit and what else can be had, on the same SIMULATED data in the same run; `make league` measures
it again and writes this page. Cases and their noise are in `benchmarks/league/scans.py` and
`decays.py`, made without the tools.

Of the peers pyemittance analyses scans; cheetah has the
optics, and scipy, lmfit and emcee the fits that one then writes oneself, as here (emcee: 32 chains,
300 steps, no look at whether they have settled). lcls-tools and elegant's sddsemitproc are not on
PyPI: what is run is their method, written from its description. pyAT, MAD-X, xfields, CasADi,
jax-sysid and do-mpc analyse no such measurement: they are asked for speed alone.

Draws are in the
heads of tables, least and most: 1000 where time allowed; one wrong answer of 60 is 1.7 %. What is
not in a table was not reached. In bold is what exceeds 1 % of wrong or 2 % of refused.

## Honesty

"""
TITLES = {"scans": "Emittance from a quadrupole scan", "decays": "a, b and lifetime from a decay"}
PAGES = {"scans": "league_scans", "decays": "league_decays"}


def percent(count: int, draws: int) -> str:
    share = 100 * count / draws
    return f"{share:.0f}" if share > 10 else f"{share:.2g}"


def table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def share_of(cases: dict, what: str, emphasised: float) -> str:
    """One row a case, one column a tool; beyond the limit in bold."""
    tools = list(next(iter(cases.values()))["tools"])
    rows = []
    for name, case in cases.items():
        cells = []
        for tool in tools:
            found = case["tools"][tool]
            said = percent(found[what], found["draws"])
            cells.append(f"**{said}**" if float(said) > emphasised else said)
        rows.append([name, *cells])
    return table(["", *(f"{tool} ({draws_of(cases, tool)})" for tool in tools)], rows)


def draws_of(cases: dict, tool: str) -> str:
    """How many draws, least and most where cases differ."""
    counts = sorted({case["tools"][tool]["draws"] for case in cases.values()})
    return str(counts[0]) if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"


def shares(cases: dict, tool: str, what: str) -> dict[str, float]:
    """Percent of the draws, by case."""
    found = {name: case["tools"][tool] for name, case in cases.items()}
    return {name: 100 * f[what] / f["draws"] for name, f in found.items()}


def summary(field: dict) -> str:
    """Per tool: how many traps it falls into, the worst, and how many good cases it refuses."""
    traps, good = field["traps"], field["good"]
    rows = []
    for tool in next(iter(traps.values()))["tools"]:
        wrong = {
            n: 100 * c["tools"][tool]["wrong"] / c["tools"][tool]["draws"] for n, c in traps.items()
        }
        refused = [
            100 * c["tools"][tool]["refused"] / c["tools"][tool]["draws"] for c in good.values()
        ]
        off = shares(good, tool, "wrong").values()
        worst = max(wrong, key=wrong.get)
        rows.append([
            tool, f"{sum(w > MOST_WRONG for w in wrong.values())} of {len(wrong)}",
            f"{sum(wrong.values()) / len(wrong):.2g} %", f"{wrong[worst]:.3g} % ({worst})",
            f"{sum(r > MOST_REFUSED for r in refused)} of {len(refused)}", f"{max(refused):.2g} %",
            f"{max(off):.3g} %",
        ])  # fmt: skip
    head = ["", "traps with more than 1 % wrong", "wrong on average", "worst trap"]
    head += ["good cases with more than 2 % refused", "most refused", "most wrong of good cases"]
    return table(head, rows)


def ordered(found: dict, names: dict) -> dict:
    """As the cases stand in their module."""
    return {name: found[name] for name in names if name in found}


def field_of(name: str, found: dict) -> dict:
    """Cases of a study by kind."""
    return {kind: ordered(found[kind], cases(name, kind)) for kind in KINDS if kind in found}


def honesty(results: dict) -> str:
    said = DEFINITION + "\n"
    for name, found in results.items():
        said += f"\n### {TITLES[name]}\n\n{summary(field_of(name, found))}"
        said += f"\nCase by case: [{TITLES[name]}]({PAGES[name]}.md).\n"
    return said


def every_case(name: str, found: dict) -> str:
    """Page of the cases of one study."""
    field = field_of(name, found)
    said = f"# The league: {TITLES[name][0].lower()}{TITLES[name][1:]}\n\n"
    said += "All data are SIMULATED; words and tools are those of [the league](league.md).\n"
    said += "\n## Traps that the data can reveal\n\nConfident and wrong, % (draws):\n\n"
    said += share_of(field["traps"], "wrong", MOST_WRONG)
    said += "\n## Good cases\n\nRefused, %:\n\n" + share_of(field["good"], "refused", MOST_REFUSED)
    said += "\nConfident and wrong, %:\n\n" + share_of(field["good"], "wrong", MOST_WRONG)
    if "hidden" in field:
        said += "\n## What the data cannot show\n\nConfident and wrong, %:\n\n"
        said += share_of(field["hidden"], "wrong", 100.0) + "\nWhat beamfit says:\n"
        said += "".join(f"\n- {n}: {c['says']}" for n, c in field["hidden"].items()) + "\n"
    return said


def speed(results: dict) -> str:
    """Milliseconds, and each peer's time over beamfit's with the spread of repeats."""
    said = (
        "\n## Speed\n\nMilliseconds of processor time of beamfit, and for each peer its time over "
        "beamfit's: median, and in\nbrackets the least and most that the repeats allow. Above 1 "
        "beamfit is faster. Warm: nothing compiles.\nGrowth is p of time ~ size^p between the last "
        "two sizes.\n"
    )
    for name, work in results.items():
        tools = list(next(iter(work["sizes"].values())))
        peers = [tool for tool in tools if tool != "beamfit"]
        rows = []
        for size, times in work["sizes"].items():
            ours = times["beamfit"]
            cells = [f"{1e3 * ours[1]:.3g}"]
            for peer in peers:
                t = times.get(peer)
                cells.append(
                    f"{t[1] / ours[1]:.2g} ({t[0] / ours[2]:.2g} to {t[2] / ours[0]:.2g})"
                    if t
                    else "–"
                )
            rows.append([size, *cells])
        rows.append(["growth", *(growth(work["sizes"], tool) for tool in ["beamfit", *peers])])
        said += f"\n**{name}**. {work['words']}\n\n" + table(
            [work["unit"], "beamfit, ms", *peers], rows
        )
    return said


def ratio(theirs: list[float], ours: list[float]) -> str:
    least, most = theirs[0] / ours[2], theirs[2] / ours[0]
    return f"{theirs[1] / ours[1]:.2g} ({least:.2g} to {most:.2g})"


def growth(sizes: dict, tool: str) -> str:
    """Exponent between the last two sizes that the tool was given."""
    given = [(float(size), times[tool][1]) for size, times in sizes.items() if times.get(tool)]
    if len(given) < 2:
        return "–"
    (small, short), (large, long) = given[-2:]
    return f"{math.log(long / short) / math.log(large / small):.2g}"


def write(results: dict) -> None:
    text = HEAD
    if "honesty" in results:
        text += honesty(results["honesty"])
        for name, found in results["honesty"].items():
            (PLACE / f"{PAGES[name]}.md").write_text(every_case(name, found))
    if "speed" in results:
        text += speed(results["speed"])
    if "machine" in results:
        text += f"\nMeasured with {results['machine']}.\n"
    (PLACE / "league.md").write_text(text)
