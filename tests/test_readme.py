"""Python of the README and of docs/python.md runs as it stands, and their commands are known."""

import re

import pytest

import beamfit
from beamfit.cli import cli


@pytest.mark.parametrize("page", ["README.md", "docs/python.md"])
def test_python_runs_as_it_stands(root, monkeypatch, tmp_path, page):
    for folder in ("measurements", "lattices", "formulations"):
        (tmp_path / folder).symlink_to(root / folder)
    monkeypatch.chdir(tmp_path)
    names = {}
    for block in re.findall(r"```python\n(.*?)```", (root / page).read_text(), re.DOTALL):
        exec(block, names)
    assert names["fit"].x.status.value == "converged"
    assert (tmp_path / "otr2.html").is_file()


def test_the_table_has_every_command_with_a_public_function(root):
    rows = re.findall(r"^\| `beamfit (\w+)` \| (.*?) \|", (root / "README.md").read_text(), re.M)
    assert {command for command, _ in rows} == cli.commands.keys() - {"example"}
    for _, functions in rows:
        for name in re.findall(r"`(\w+)", functions):
            assert name in beamfit.__all__
