"""Text and XML say the same: any document survives both ways. XML that attacks is refused."""

import random

import pytest

from beamfit.errors import InputError
from beamfit.language import document as d
from beamfit.language import expression as x
from beamfit.language.parse import parse_document
from beamfit.language.plan import check_document
from beamfit.language.text import format_document
from beamfit.language.xml import format_xml, parse_xml
from tests.language.documents import SHORT

WORDS = ["a", "B2", "input", "set", "real", "dx_model", "ε", "data", "table", "maxi", "inf"]
NUMBERS = ["0", "1", "2.50", ".5", "1e8", "3.E-2"]
TEXTS = ["two words", "a", 'a "quoted" \\ one', "1e-6", "ä; }", "-", "true", "<&>'"]


class Writer:
    """Random documents, whatever they mean."""

    def __init__(self, seed):
        self.random = random.Random(seed)

    def word(self):
        return self.random.choice(WORDS)

    def text(self):
        return self.random.choice(TEXTS)

    def value(self):
        return self.random.choice([0.0, -0.0, 1.0, -2.5, 1e300, 5e-324, self.random.gauss(0, 9)])

    def several(self, make, least, most):
        return tuple(make() for _ in range(self.random.randint(least, most)))

    def maybe(self, make):
        return make() if self.random.random() < 0.5 else None

    def formula(self, depth=4):
        if depth == 0 or self.random.random() < 0.2:
            return self.random.choice([x.Literal(self.random.choice(NUMBERS)), x.Name(self.word())])
        inner = lambda: self.formula(depth - 1)  # noqa: E731
        kind = self.random.randrange(6)
        if kind == 0:
            return x.Arithmetic("-", (inner(),))
        if kind == 1:
            return x.Application(self.word(), self.several(inner, 1, 3))
        if kind == 2:
            return x.Name(self.word(), self.several(lambda: self.maybe(inner) or x.Whole(), 1, 2))
        if kind == 3:
            each = self.several(lambda: self.iterator(depth - 1), 1, 2)
            return x.Reduction(self.random.choice(x.REDUCTIONS), each, inner())
        return x.Arithmetic(self.random.choice("+-*/@^"), (inner(), inner()))

    def elements(self, depth):
        ranged = self.random.random() < 0.5
        return x.Elements(self.several(lambda: self.formula(depth), 2, 3), ranged)

    def iterator(self, depth=2):
        return x.Iterator(self.word(), self.maybe(lambda: self.elements(depth)) or self.word())

    def each(self, least=0):
        return self.several(self.iterator, least, 2)

    def target(self):
        return x.Name(self.word(), self.several(lambda: self.formula(1), 0, 2))

    def wire(self):
        return d.Assignment(self.target(), self.formula(2), self.each())

    def wires(self):
        return self.several(self.wire, 0, 2)

    def dimension(self):
        return self.maybe(self.word) or self.random.randint(1, 9)

    def dimensions(self):
        return self.several(self.dimension, 0, 2)

    def statement(self, depth=2):
        kind = self.random.randrange(6 if depth else 5)
        if kind == 0:
            return d.IndexedSet(self.word(), self.elements(2))
        if kind == 1:
            return d.Real(self.word(), self.dimensions(), self.maybe(self.formula))
        if kind == 2:
            return d.Function(self.word(), self.several(self.word, 1, 2), self.formula())
        if kind == 3:
            return d.Assignment(self.target(), self.formula(), self.each())
        if kind == 4:
            return d.Call(self.word(), self.wires(), self.wires(), self.each())
        return d.Block(self.each(1), self.several(lambda: self.statement(depth - 1), 0, 2))

    def declared(self):
        values = self.maybe(lambda: self.several(self.value, 1, 3))
        return d.Declared(self.word(), self.dimensions(), values)

    def network(self):
        named = lambda kind: d.NetworkElement(kind, (("name", self.word()), ("layer", self.text())))  # noqa: E731
        pair = (("srcName", self.word()), ("dstName", self.word()))
        numbers = self.several(self.value, 1, 3)
        return d.NetworkDefinition(
            self.word(),
            (named("input"), named("gain"), d.NetworkElement("connection", pair, numbers)),
        )

    def table(self):
        size = (self.random.randint(1, 9), self.random.randint(1, 9))
        return d.DataTable(self.word(), self.text(), *(self.maybe(lambda: size) or (None, None)))

    def mapping(self, depth=1):
        inner = [self.network, *[lambda: self.mapping(depth - 1)] * depth]
        return d.Mapping(
            self.word(),
            self.several(self.table, 0, 1),
            self.several(lambda: self.random.choice(inner)(), 0, 2),
            self.several(self.declared, 0, 2),
            self.several(lambda: d.Declared(self.word(), self.dimensions()), 0, 2),
            self.several(self.declared, 0, 2),
            self.several(self.statement, 0, 4),
        )

    def bounds(self):
        return self.value(), self.random.choice([self.value(), float("inf"), float("-inf")])

    def variable(self):
        pair = lambda: (self.value(), self.value())  # noqa: E731
        start = self.maybe(self.value), self.maybe(pair), self.random.randrange(99)
        return d.FreeInput(self.text(), self.word(), *self.bounds(), *start)

    def problem(self):
        return d.ProblemStatement(
            self.several(lambda: d.Goal(self.text(), self.word(), self.value()), 1, 2),
            self.several(self.variable, 0, 2),
            self.several(lambda: d.Limit(self.text(), self.word(), *self.bounds()), 0, 2),
            self.random.random() < 0.5,
        )

    def solver(self):
        return d.Solver(self.text(), self.several(lambda: (self.text(), self.text()), 0, 2))

    def document(self):
        return d.Document(self.mapping(), self.maybe(self.problem), self.maybe(self.solver))


def both_ways(document):
    assert parse_document(format_document(document)) == document
    assert parse_xml(format_xml(document)) == document


def test_any_document():
    for seed in range(150):
        both_ways(Writer(seed).document())


@pytest.mark.parametrize("name", SHORT)
def test_short_documents(name):
    both_ways(parse_document(SHORT[name]))


BOMB = "<!DOCTYPE b [<!ENTITY a 'aaaa'><!ENTITY b '&a;&a;&a;&a;'>]><mapping>&b;</mapping>"
OUTSIDE = "<!DOCTYPE b [<!ENTITY a SYSTEM 'file:///etc/passwd'>]><mapping>&a;</mapping>"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (BOMB, "XML without entities"),
        (OUTSIDE, "XML without entities"),
        ("<!DOCTYPE mapping SYSTEM 'http://127.0.0.1/m.dtd'><mapping/>", "XML without entities"),
        ("<mapping>" * 100 + "</mapping>" * 100, "elements within 40 others"),
        ("<mapping><expressions>y = &nothing;</expressions></mapping>", "undefined entity"),
        ("<mapping><expressions>" + "(" * 99 + "</expressions></mapping>", "more than 60 brackets"),
        ("<mapping><expressions>y = 1" + "+1" * 9999 + ";</expressions></mapping>", "120 levels"),
        (
            "<mapping><expressions>y = 1 foreach t in |1:1"
            + "+1" * 9999
            + "|;</expressions></mapping>",
            "120 levels",
        ),
        ("<mapping><output nam='y'/></mapping>", "nam='y' in <output>.*did you mean name"),
        ("<mapping><output/></mapping>", "<output> without name"),
        ("<mapping><input name='y' size='3'/></mapping>", "size='3' in <input>"),
        ("<mapping><expressions><set name='K'/></expressions></mapping>", "<set> in"),
        ("<mapping><outputs name='y'/></mapping>", "did you mean output"),
        ("<mapping><input name='y z'/></mapping>", "a name of letters"),
        ("<mapping>", "well-formed XML"),
        ("<formulation/>", "a mapping to optimise"),
        ("<mapping><set name='I'><elements start='a' stop='2'/></set></mapping>", "start='a'"),
    ],
)
def test_xml_that_cannot_be_used(text, said):
    with pytest.raises(InputError, match=said):
        parse_xml(text)


@pytest.mark.parametrize(
    ("old", "new", "culprit", "said"),
    [
        ('modelVariable="s12"', 'modelVariable="s21"', "s21", "one of s11, s12, s22"),
        ('upper="10"', 'upper="-1"', 's11" lower', "bounds of 's11'"),
        ('rowCount="14"', 'rowCount="many"', "many", "rowCount='many' in <data>"),
        ('randomSeed="12"', 'randomSeed="-2"', "-2", "a whole number from 0"),
        ('set="K"', 'set="L"', 'dx_model"', "no set 'L'"),
        ("sqrt(dx2_model[k])", "sqrt(dx2_modl[k])", "dx2_modl", "did you mean dx2_model"),
        ('direction="minimize"', 'direction="minimise"', "minimise", "did you mean minimize"),
        ("2*A[k]", "2 &amp; A[k]", "&amp;", "'&'"),
        ('<input name="s22" />', "<inputs/>", "<inputs/>", "did you mean input"),
    ],
)
def test_mistakes_in_xml_have_their_place(root, old, new, culprit, said):
    text = (root / "formulations/appendix_a.xml").read_text().replace(old, new, 1)
    at = text.index(culprit)
    place = text.count("\n", 0, at) + 1, at - text.rfind("\n", 0, at)
    with pytest.raises(InputError, match=said) as found:
        check_document(parse_xml(text))
    assert (found.value.line, found.value.column) == place
