"""Every example of docs/language.md runs, and the command prints what stands behind it.

`python -m tests.language.test_reference` writes the answers into the page.
"""

import contextlib
import io
import os
import re
import sys
import tempfile
from pathlib import Path

import pytest

from beamfit.cli import main

PAGE = Path(__file__).resolve().parents[2] / "docs" / "language.md"
EXAMPLE = re.compile(
    r"```bf\n(.*?)```\n\n(?:    beamfit solve (.*?)\n\n)?```text\n(.*?)```", re.DOTALL
)
# What is left of zero after rounding differs from machine to machine.
RESIDUAL = re.compile(r"KKT\s+residual\s+[\d.e+-]+")


def answer(text, arguments):
    """What `beamfit solve example.bf` prints."""
    out, before, given = io.StringIO(), Path.cwd(), (sys.argv, os.environ.get("COLUMNS"))
    words = arguments.split() if arguments else ["example.bf"]
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(out):
        (Path(folder) / "example.bf").write_text(text)
        os.chdir(folder)
        os.environ["COLUMNS"] = "100"
        sys.argv = ["beamfit", "solve", *words]
        try:
            with contextlib.redirect_stderr(out), pytest.raises(SystemExit):
                main()
        finally:
            os.chdir(before)
            sys.argv = given[0]
            os.environ.pop("COLUMNS") if given[1] is None else os.environ.update(COLUMNS=given[1])
    return "\n".join(line.rstrip() for line in out.getvalue().strip().splitlines()) + "\n"


def examples():
    return EXAMPLE.findall(PAGE.read_text())


def test_there_are_many_and_every_block_of_the_language_is_one():
    assert len(examples()) >= 18
    assert PAGE.read_text().count("```bf\n") == len(examples())


@pytest.mark.parametrize("number", range(len(examples())))
def test_the_command_prints_what_the_page_says(number):
    text, arguments, said = examples()[number]
    found = answer(text, arguments)
    assert RESIDUAL.sub("KKT residual", found) == RESIDUAL.sub("KKT residual", said)


def _written(match):
    return match[0].removesuffix(f"{match[3]}```") + answer(match[1], match[2]) + "```"


if __name__ == "__main__":
    PAGE.write_text(EXAMPLE.sub(_written, PAGE.read_text()))
