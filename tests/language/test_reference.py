"""Every example of docs/language.md runs, and gives what stands behind it.

`python -m tests.language.test_reference` writes the answers into the page.
"""

import re
from pathlib import Path

import numpy as np

from beamfit.errors import InputError
from beamfit.language.compiled import compile_mapping
from beamfit.language.parse import parse_document
from beamfit.language.solution import solve_document

PAGE = Path(__file__).resolve().parents[2] / "docs" / "language.md"
EXAMPLE = re.compile(r"```bf\n(.*?)```\n\n```text\n(.*?)```", re.DOTALL)


def answer(text):
    """What a document gives: a mistake, a solution, or its outputs."""
    try:
        document = parse_document(text)
        if document.problem is None:
            program = compile_mapping(document.mapping)
            found = program({}, program.scope.outputs)
            return "".join(f"{name} = {shown(value)}\n" for name, value in found.items())
        found = solve_document(document)
    except InputError as error:
        return f"{error}\n".removeprefix(":")
    rows = (*found.variables(), *found.constraints())
    lines = [found.headline, *(f"{r.name} = {round(r.value, 6):g} ({r.state})" for r in rows)]
    return "\n".join([*lines, *found.notes]) + "\n"


def shown(value):
    return np.array2string(np.asarray(value), precision=6, separator=", ").replace("\n", "")


def test_every_example_gives_what_the_page_says():
    examples = EXAMPLE.findall(PAGE.read_text())
    assert len(examples) >= 18
    wrong = [(text, said, found) for text, said in examples if (found := answer(text)) != said]
    assert not wrong


def test_every_block_of_the_language_is_an_example():
    page = PAGE.read_text()
    assert page.count("```bf\n") == len(EXAMPLE.findall(page))


if __name__ == "__main__":
    new = EXAMPLE.sub(lambda m: f"```bf\n{m[1]}```\n\n```text\n{answer(m[1])}```", PAGE.read_text())
    PAGE.write_text(new)
