"""Write docs/gtf_reproduction.html: Table 2, figures 19 to 25 of the report, a SIMULATED scan.

Run from the top of the repository: python docs/gtf_reproduction.py [FILE.html]
"""

import sys
from pathlib import Path

import beamfit
from beamfit.io.files import digest
from beamfit.report.reproduction import write_reproduction
from beamfit.studies.scan.reproduction import reproduce

ROOT = Path(__file__).resolve().parents[1]
INPUTS = ("measurements/gtf_simulated.csv", "lattices/gtf.toml")


def main(path: str | None = None) -> None:
    """Compute and write the page."""
    scan = beamfit.read_quad_scan(ROOT / INPUTS[0])
    line = beamfit.load_lattice(ROOT / INPUTS[1])
    write_reproduction(
        path or ROOT / "docs" / "gtf_reproduction.html",
        reproduce(scan, line),
        command="python docs/gtf_reproduction.py",
        inputs={name: digest(ROOT / name) for name in INPUTS},
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
