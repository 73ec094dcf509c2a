"""Pictures of a design and of a live scan, both SIMULATED."""

from __future__ import annotations

import re
from contextlib import chdir, redirect_stdout
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parents[1]
BLUE, RED, GREY = "#1f5fa8", "#b5421f", "0.75"


def design() -> Figure:
    """Expected errors after the further measurements that `beamfit design` names."""
    import beamfit

    scan = beamfit.read_quad_scan(ROOT / "beamfit/example/scan.csv")
    kept = slice(0, 8)
    part = beamfit.QuadScan(
        {name: v[kept] for name, v in scan.settings.items()},
        scan.units,
        {plane: v[kept] for plane, v in scan.size.items()},
        {plane: v[kept] for plane, v in scan.error.items()},
    )
    line = beamfit.load_lattice(ROOT / "beamfit/example/lattice.toml")
    advice = beamfit.design(beamfit.fit_emittance(part, line))
    rows = [("what is measured", advice.now, advice.determined)]
    rows += [(f"then {s.candidate.words}", s.relative_error, s.determined) for s in advice.steps]
    rows += [(f"or {o.words}", o.relative_error, o.determined) for o in advice.options]
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axes = figure.subplots()
    for shift, plane, colour in ((-0.2, "x", BLUE), (0.2, "y", RED)):
        error = [100 * found[plane] for _, found, _ in rows]
        known = [colour if sure[plane] else GREY for *_, sure in rows]
        axes.barh(np.arange(len(rows)) + shift, error, height=0.38, color=known)
        axes.bar([0], [0], color=colour, label=plane)
    axes.bar([0], [0], color=GREY, label="not determined")
    axes.set_yticks(range(len(rows)), [words for words, *_ in rows], fontsize=8)
    axes.invert_yaxis()
    axes.set_xlabel("expected error of the emittance, %")
    figure.legend(frameon=False, ncols=3, loc="outside upper right")
    return figure


def live_scan() -> Figure:
    """Settings that a scan of the simulation of docs/live_adapters.md chose, and its answers."""
    import beamfit
    from beamfit.live.points import scan_of

    machine, line, found = _simulated()
    figure = Figure(figsize=(6.4, 5.2), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=[1.2, 1])
    left, right = above.subplots(1, 2)
    setting = [point.settings["Q1"] for point in found.points]
    for axes, plane, colour in ((left, "x", BLUE), (right, "y", RED)):
        size = [1e6 * np.mean(point.shots[plane]) for point in found.points]
        axes.plot(setting, size, "o", ms=4, color=colour)
        for at in dict.fromkeys(setting):
            numbers = [k for k, other in enumerate(setting) if other == at]
            words = ", ".join(str(k + 1) for k in numbers)
            axes.annotate(words, (at, size[numbers[0]]), (4, 5), textcoords="offset points")
        axes.margins(0.12, 0.15)
        axes.set(xlabel="Q1, T/m", ylabel=f"size {plane}, µm", ylim=(0, None))
    axes = below.subplots()
    for shift, plane, colour in ((-0.08, "x", BLUE), (0.08, "y", RED)):
        for count in range(4, len(found.points) + 1):
            fit = beamfit.fit_emittance(scan_of(found.points[:count], machine), line)
            q = fit[plane].normalized_emittance
            if q.interval_95 is not None:
                low, high = (1e6 * end for end in q.interval_95)
                axes.plot([count + shift] * 2, [low, high], color=colour, lw=4)
        axes.plot([], [], color=colour, lw=4, label=plane)
    axes.set(xlabel="points measured", ylabel="normalised emittance,\n95 % interval, µm")
    axes.set_xticks(range(4, len(found.points) + 1))
    axes.legend(frameon=False)
    return figure


def _simulated():
    """Machine, line and outcome of the simulation of docs/live_adapters.md."""
    from beamfit.io.line import build_line
    from beamfit.io.machine import read_scan_machine

    page = (ROOT / "docs/live_adapters.md").read_text()
    files = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)[:2]
    code = next(b for b in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "Injector" in b)
    with TemporaryDirectory() as folder, chdir(folder), redirect_stdout(StringIO()):
        for name, text in zip(("line.toml", "machine.toml"), files, strict=True):
            Path(name).write_text(text)
        machine = read_scan_machine("machine.toml")
        names = {"machine": machine, "line": build_line(machine.lattice)}
        exec(code, names)
    return machine, names["line"], names["found"]


FIGURES = (design, live_scan)
