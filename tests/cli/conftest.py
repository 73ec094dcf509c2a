"""The command in this process."""

import sys

import pytest

from beamfit.cli import main


@pytest.fixture
def run(monkeypatch, capsys, root):
    """Run `beamfit ...` in this process from the top of the checkout; status, out, err."""
    monkeypatch.chdir(root)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["beamfit", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            main()
        captured = capsys.readouterr()
        return stop.value.code, captured.out, captured.err

    return call
