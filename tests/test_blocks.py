"""Code blocks of the documentation: commands are what the program takes, Python runs as it stands.

Blocks with a test beside their subject are run there: tutorial, extending, control, fedbatch,
live_adapters, the language's own examples.
"""

import re
import shlex
from pathlib import Path

import click
import pytest

from beamfit.cli import cli

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
# An indented or fenced line that begins with the program's name, and the lines it goes on in.
COMMAND = re.compile(r"^(?:    |\$ )\$? ?(beamfit (?:.*\\\n)*.*)$", re.MULTILINE)


def commands():
    """Page and words of each command; what stands behind # is a remark."""
    for page in PAGES:
        for found in COMMAND.findall(page.read_text()):
            words = shlex.split(found.replace("\\\n", " "), comments=True)
            if len(words) > 1 and words[1] in cli.commands:
                yield pytest.param(words[1:], id=f"{page.stem}: {' '.join(words)[:60]}")


@pytest.mark.parametrize("words", list(commands()))
def test_every_command_of_every_page_has_the_options_that_it_names(words):
    parsed(words)


def parsed(words):
    """The words of a command by option, none of them looked up."""
    name, *arguments = [word for word in words if word not in ("…", "...")]
    context = click.Context(cli.commands[name], info_name=name)
    return cli.commands[name].make_parser(context).parse_args(arguments)[0]


def test_an_option_that_is_none_is_found():
    assert parsed(["emittance", "scan.csv", "--json"])["as_json"]
    with pytest.raises(click.NoSuchOption):
        parsed(["emittance", "scan.csv", "--jsn"])


@pytest.mark.parametrize("words", list(commands()))
def test_every_file_of_measurements_that_a_command_names_is_there(words):
    named = [w for w in words if re.match(r"(measurements|lattices|formulations|benchmarks)/", w)]
    named += [
        w.partition("=")[2] for w in words if re.match(r"\w+=(measurements|formulations)/", w)
    ]
    assert [name for name in named if not list(ROOT.glob(name))] == []


@pytest.mark.parametrize("name", ["uncertainty", "greybox", "language"])
def test_python_runs_as_it_stands(name, monkeypatch, tmp_path, capsys):
    for folder in ("measurements", "lattices", "formulations"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / f"docs/{name}.md").read_text(), re.DOTALL)
    names = {}
    for block in blocks:
        exec(block, names)
    assert blocks
