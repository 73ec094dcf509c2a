"""Make the pictures of the site: what a command's page shows, and the figures of results.

`python docs/pictures.py [NAME …]` writes docs/_static/NAME.png; `make docs` calls it. Pages are
looked at in Chromium, and stay as they are where there is none.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import planning_pictures
import report_pictures
from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parents[1]
PLACE = ROOT / "docs/_static"
OTR2 = ("measurements/lcls_otr2.csv", "--lattice", "lattices/lcls_otr2.toml")
VALVE = ("measurements/valve_level_simulated.csv", "--map", "network")

# Command of each page whose first screen is shown; {} is a folder of the moment.
PAGES = {
    "page_emittance": ("emittance", *OTR2),
    "page_slices": ("emittance", "measurements/gtf_slices_simulated.csv",
                    "--lattice", "lattices/gtf.toml"),
    "page_half": ("emittance", "{}/half.csv", "--lattice", "beamfit/example/lattice.toml",
                  "--plane", "x"),
    "page_posterior": ("emittance", *OTR2, "--sample"),
    "page_study": ("lifetime", "measurements/spear3_shift_simulated.csv",
                   "--ring", "lattices/spear3_2003.toml", "--study"),
    "page_lifetime": ("lifetime", "measurements/aps_1999_decay.csv"),
    "page_identify": ("identify", *VALVE),
    "page_control": ("control", *VALVE, "--set", "level=12", "--set", "level=15@30",
                     "--limit", "level=:16", "--disturb", "level=-1.5@60"),
    "page_solve": ("solve", "formulations/appendix_a.bf",
                   "--data", "d=formulations/fitdata_simulated.csv", "--start", "20"),
    "page_batch": ("batch", "{}/scans", "--kind", "emittance",
                   "--lattice", "lattices/lcls_otr2.toml", "--out", "{}/year.csv"),
}  # fmt: skip


def scan() -> Figure:
    """The scan of LCLS, vertical plane."""
    import beamfit.figures

    return beamfit.figures.scan(_otr2(), "y")


def phase_space() -> Figure:
    """The phase ellipses of the same beam."""
    import beamfit.figures

    return beamfit.figures.phase_space(_otr2())


def lifetime() -> Figure:
    """The momentary lifetime of a real decay."""
    import beamfit
    import beamfit.figures

    record = beamfit.read_decay_record(ROOT / "measurements/aps_1999_decay.csv")
    return beamfit.figures.lifetime(beamfit.fit_decay(record))


def mechanisms() -> Figure:
    """Computed losses of simulated decays by mechanism, and what was measured."""
    import beamfit
    from beamfit.lifetime.study import Machine, study_record
    from beamfit.report.document import Picture, figure_of
    from beamfit.report.lifetime import draw_budget

    ring = ROOT / "lattices/spear3_2003.toml"
    machine = Machine(beamfit.read_ring(ring), beamfit.read_operation(ring))
    record = beamfit.read_decay_record(ROOT / "measurements/spear3_shift_simulated.csv")
    decays = study_record(record, machine).decays
    return figure_of(Picture("", 4.0, lambda figure: draw_budget(figure, decays[:6]), record.name))


def more_settings() -> Figure:
    """The 95 % interval of the emittance of the example's scan by the number of its settings."""
    import beamfit

    line = beamfit.load_lattice(ROOT / "beamfit/example/lattice.toml")
    whole = beamfit.read_quad_scan(ROOT / "beamfit/example/scan.csv")
    figure = Figure(figsize=(6.4, 3.2), layout="constrained")
    axes = figure.subplots()
    for count in range(4, len(whole) + 1):
        p = beamfit.fit_emittance(_first(whole, count), line).x
        q = p.normalized_emittance
        if q.interval_95 is not None:
            colour = "#b5421f" if q.error is None else "#1f5fa8"
            low, high = (1e6 * end for end in q.interval_95)
            axes.plot([count, count], [low, high], color=colour, lw=4, solid_capstyle="butt")
    axes.plot([], [], color="#b5421f", lw=4, label="not determined")
    axes.plot([], [], color="#1f5fa8", lw=4, label="converged")
    axes.axhline(1.0, color="0.4", lw=1, ls="--", label="truth of the simulation")
    axes.set(xlabel="settings measured, from -5 A up", yscale="log")
    axes.set_yticks([0.1, 1.0, 10.0], ["0.1", "1", "10"])
    axes.set_ylabel("normalised emittance in x,\n95 % interval, µm")
    axes.legend(frameon=False)
    return figure


OWN = (scan, phase_space, lifetime, mechanisms, more_settings)
FIGURES: dict[str, Callable[[], Figure]] = {
    each.__name__: each for each in (*OWN, *planning_pictures.FIGURES, *report_pictures.FIGURES)
}


def _otr2():
    import beamfit

    line = beamfit.load_lattice(ROOT / OTR2[2])
    return beamfit.fit_emittance(beamfit.read_quad_scan(ROOT / OTR2[0]), line)


def _first(scan, count: int):
    import beamfit

    size = {plane: v[:count] for plane, v in scan.size.items()}
    error = {plane: v[:count] for plane, v in scan.error.items()}
    settings = {name: v[:count] for name, v in scan.settings.items()}
    return beamfit.QuadScan(settings, scan.units, size, error)


def many_scans(folder: Path) -> None:
    """Write 40 scans a day apart, simulated from the real one: sizes 10 % larger from the 31st."""
    from datetime import date, timedelta

    head, *rows = [line for line in (ROOT / OTR2[0]).read_text().splitlines() if line[0] != "#"]
    noise = np.random.default_rng(1)
    folder.mkdir()
    for k in range(40):
        lines = ["# SIMULATED from measurements/lcls_otr2.csv", head]
        for row in rows:
            q, x, ex, y, ey, shots = map(float, row.split(","))
            x, y = (v * (1.1 if k >= 30 else 1.0) * (1 + 0.02 * noise.normal()) for v in (x, y))
            lines.append(f"{q},{x:.4f},{ex},{y:.4f},{ey},{shots:.0f}")
        day = date(2026, 1, 5) + timedelta(days=k)
        (folder / f"otr2-{day}.csv").write_text("\n".join(lines) + "\n")


def shown(pages: dict[str, tuple[str, ...]], folder: Path) -> None:
    """Write the first screen, 1280 by 800, of the page of each command."""
    sys.path.insert(0, str(ROOT))
    from tests.report import browser

    if browser.NAME is None:
        print("no Chromium here: the pictures of pages stay as they are")
        return
    chromium = browser.Chromium(folder / "profile")
    for name, command in pages.items():
        page = folder / f"{name}.html"
        words = [word.format(folder) for word in command]
        call = [sys.executable, "-m", "beamfit", *words, "--report", page]
        subprocess.run(call, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        (PLACE / f"{name}.png").write_bytes(chromium.screen(page))
    chromium.close()


def main(names: list[str]) -> None:
    """Make the pictures of these names, or all."""
    from matplotlib import rc_context

    from beamfit.report.document import STYLE

    for name, draw in FIGURES.items():
        if name in (names or FIGURES):
            with rc_context(STYLE):
                draw().savefig(PLACE / f"{name}.png", dpi=110)
    wanted = {name: command for name, command in PAGES.items() if name in (names or PAGES)}
    if wanted:
        with tempfile.TemporaryDirectory() as place:
            many_scans(Path(place) / "scans")
            head = (ROOT / "beamfit/example/scan.csv").read_text().splitlines()[:8]
            (Path(place) / "half.csv").write_text("\n".join(head) + "\n")
            shown(wanted, Path(place))


if __name__ == "__main__":
    main(sys.argv[1:])
