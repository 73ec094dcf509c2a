"""Damaged documents are read or refused in one line: no traceback, no hang, no growth.

`make soak` reads 10 000; BEAMFIT_DOCUMENTS says how many. Each is parsed and checked, every
tenth of those that are right is compiled and evaluated too.
"""

import os
import random
import re

import jax
import numpy as np

from beamfit.errors import InputError
from beamfit.language.parse import parse_document
from beamfit.language.plan import check_document
from beamfit.language.problem import formulate, starts_of
from beamfit.language.text import format_document
from beamfit.language.trace import cause_of
from beamfit.language.xml import format_xml, parse_xml
from tests.conftest import resident
from tests.language.documents import SHORT

COUNT = int(os.environ.get("BEAMFIT_DOCUMENTS", "300"))
# MB that reading so many documents may leave behind: caches of compiled code and of the parser.
GROWTH = 150
TOKEN = re.compile(r"\s+|\w+|.", re.DOTALL)
ODD = ["1e999", "99999999999", "-1", "0", "nan", "'", '"', "é", "²", "\0", "|1:5000000|", "(" * 70]
ODD += ["::", "foreach k in K", "sum(k in K | 1)", "&lt;", "<a>", "]]>", "/*", "#", "x" * 5000]


def mutated(text, rng):
    """A document with one to ten words left out, doubled, exchanged or replaced."""
    words = TOKEN.findall(text)
    for _ in range(rng.choice([1, 1, 1, 2, 4, 10])):
        at, other = rng.randrange(len(words)), rng.randrange(len(words))
        what = rng.randrange(6)
        if what == 0:
            del words[at : at + rng.choice([1, 1, 3, 20])]
        elif what == 1:
            words.insert(at, words[other])
        elif what == 2:
            words[at], words[other] = words[other], words[at]
        elif what == 3:
            words[at] = rng.choice(ODD)
        elif what == 4:
            words[at] = words[other]
        else:
            words[at:at] = words[other : other + rng.choice([2, 10, 40])]
        words = words or [" "]
    return "".join(words)


def read_and_tried(text, compiled):
    """Parse, check, write again; compile and look for what is not finite, if asked to."""
    document = parse_xml(text) if text.lstrip().startswith("<") else parse_document(text)
    assert parse_document(format_document(document)) == document
    check_document(document)
    if compiled and document.problem is not None:
        tables = {t.name: np.ones((t.rows, t.columns)) for t in document.mapping.tables}
        made = formulate(document, tables)
        cause_of(made.program, next(starts_of(made)), [g.model for g in document.problem.goals])


def test_damaged_documents_are_read_or_refused(root):
    texts = list(SHORT.values()) + [format_xml(parse_document(text)) for text in SHORT.values()]
    files = (root / "formulations").glob("appendix_*")
    texts += [path.read_text() for path in sorted(files) if path.stat().st_size < 5000]
    rng = random.Random(13)
    before = None
    right, refused = 0, []
    for number in range(COUNT):
        if number == COUNT // 5:
            before = resident()
        if number % 500 == 499:
            jax.clear_caches()
        text = mutated(rng.choice(texts), rng)
        try:
            read_and_tried(text, compiled=right % 10 == 0)
            right += 1
        except InputError as error:
            refused.append(str(error))
    assert not [said for said in refused if "\n" in said or len(said) > 391]
    assert 0.03 * COUNT < right < 0.9 * COUNT
    assert resident() - before < GROWTH
