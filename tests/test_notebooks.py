"""The notebooks run, and say what their text says."""

import os
import warnings

import pytest


@pytest.fixture
def executed(root):
    """Execute a notebook in a kernel of its own; its text output, cell by cell."""

    def run(name):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the notebook machinery, not of beamfit
            import nbformat
            from nbclient import NotebookClient

            notebook = nbformat.read(root / "docs/notebooks" / name, as_version=4)
            os.environ["PYTHONPATH"] = os.pathsep.join(
                [str(root), *filter(None, [os.environ.get("PYTHONPATH")])]
            )
            os.environ.setdefault("MPLBACKEND", "module://matplotlib_inline.backend_inline")
            place = {"metadata": {"path": str(root / "docs/notebooks")}}
            NotebookClient(notebook, timeout=300, resources=place).execute()
        outputs = [o for cell in notebook.cells for o in cell.get("outputs", ())]
        pictures = sum("image/png" in o.get("data", {}) for o in outputs)
        return "".join(o.get("text", "") for o in outputs), pictures

    return run


def test_one_runs_as_a_notebook(executed):
    text, pictures = executed("emittance_lcls.ipynb")
    assert pictures == 2
    assert "x converged 0.702 ± 0.025 µm" in text
    assert "0.786 µm (+2.0 errors)" in text


# Words of each. Those that take 10 s and more are executed by `make docs` and `make calibrate`;
# the same fits of the same files are run by commands and examples of functions.
SAID = {
    "lifetime_study": [
        "If a and b are constant, a is (7.01 ± 0.11)e-08",
        "bremsstrahlung and elastic",
        "not separable by",
        "30 decays: converged",
        "b moved since later fill 5",
        "Alarm: b moved by +5",
    ],
    # Which of its equally good optima a free network ends at hangs on rounding: it falls somewhere.
    "greybox_from_scratch": ["1/m, least step -", "rising: rms off by 0.0"],
    "lifetime_aps": ["converged 39.149 ± 0.037 h", "a (7.0 ± 1.2)e-08"],
    "when_data_do_not_tell": [" 8 settings: unidentified", " 9 settings: converged"],
    "calibration": ["converged 0.679 ± 0.015 µm", "Q2.slope 167.2 ± 3.3"],
    "slices": ["3          converged 0.4954 ± 0.0058 µm"],
    "loss_mechanisms": ["longest: 18.4 h at 3.2 MV"],
    "density": ["x by sizes 0.900 ± 0.041 µm by the density 1.0"],
    "tuning": ["converged: normalised emittance 0.755 ± 0.022 µm at SOL = 198.2 A"],
    "posterior": ["converged", "fit:     0.702 ± 0.025 µm"],
    "identification": ["poor_fit The output has a tau that changes", "converged The free run"],
}
SLOW = {"lifetime_study", "identification", "density", "tuning"}


def cells_of(root, name):
    """Code cells of a notebook that was executed from top to bottom."""
    import nbformat

    notebook = nbformat.read(root / f"docs/notebooks/{name}.ipynb", as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(cell.execution_count == number for number, cell in enumerate(code, 1))
    return code


@pytest.mark.parametrize("name", SAID)
def test_they_are_shipped_as_executed(root, name):
    shipped = "".join(o.get("text", "") for c in cells_of(root, name) for o in c.outputs)
    for word in SAID[name]:
        assert word in shipped


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.calibrate] * (n in SLOW)) for n in SAID]
)
def test_the_others_run_here(root, monkeypatch, capsys, name):
    code = cells_of(root, name)
    monkeypatch.chdir(root / "docs/notebooks")
    exec("\n".join(cell.source for cell in code).replace("%matplotlib inline", ""), {})
    said = capsys.readouterr().out
    for word in SAID[name]:
        assert word in said


def test_it_is_shipped_as_it_runs_and_imports_the_package_alone(root):
    code = cells_of(root, "lifetime_study")
    lines = [line.strip() for cell in code for line in cell.source.splitlines()]
    imports = [line for line in lines if line.startswith(("import ", "from "))]
    assert imports
    assert all(line.split()[1].split(".")[0] == "beamfit" for line in imports)
