"""Reader and writer of the report's XML form of a document (Figure 3 and Appendices A to D).

Elements have the places of their attributes and text. Malicious XML (entities, document types, deep
nesting) is rejected. Dimensions, ranges and attributes are those of the report; `lower` and `upper`
of a network's input and `cells` of a gain are extensions (`beamfit.language.network_xml`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple
from xml.etree import ElementTree as Plain
from xml.sax import ContentHandler, SAXParseException

from defusedxml import DefusedXmlException
from defusedxml.sax import parseString

from beamfit.errors import InputError, nearest
from beamfit.language import document as d
from beamfit.language.expression import Elements, Place, error_at
from beamfit.language.parse import parse_statements
from beamfit.language.text import NAME, format_statements, number_text, values_text

# Largest depth of nested elements.
MAX_DEPTH = 40
MLP_CLASS = "com.pav.pdas.model.mlp.MlpMapping"
EXPRESSIONS = "com.pav.pdas.model.expression.ExpressionMapping"
NLP = "com.pav.pdas.optimization.common.NLPProblem"
# Allowed children and attributes of each element; a misspelt one would otherwise be ignored.
PARTS = {
    "formulation": ("problem mapping solver", ""),
    "problem": ("variable constraint objective", "classname direction"),
    "objective": ("", "label modelVariable coefficient"),
    "variable": ("", "label modelVariable lower upper value useRandomInitial randomLower "
                     "randomUpper randomSeed"),
    "constraint": ("", "label modelVariable lower upper"),
    "solver": ("parameter", "classname"),
    "mapping": ("data set mapping input output parameter expressions", "classname name"),
    "data": ("", "name file rowCount columnCount"),
    "set": ("elements", "name"), "elements": ("", "type start stop step"),
    "input": ("dimension values", "name value isScalar"), "output": ("dimension", "name isScalar"),
    "parameter": ("dimension values", "name value isScalar"),
    "dimension": ("", "type set size"), "values": ("", ""), "expressions": ("", ""),
}  # fmt: skip
NETWORK_PARTS = ["input", "output", "gain", "layer", "connection"]
# Elements that have no text.
WITHOUT_TEXT = {"formulation", "problem", "mapping", "solver", "set", "output"}


class Node(NamedTuple):
    """An element with the places of its attributes; its text is padded to its place in the file."""

    tag: str
    attributes: dict[str, str]
    children: list[Node]
    text: list[str]
    places: dict[str, Place]

    @property
    def at(self) -> Place:
        """Place of the declared name, else of the element."""
        keys = ("modelVariable", "label", "name", "")
        return next(self.places[key] for key in keys if key in self.places)

    def all(self, tag: str) -> list[Node]:
        """Return the children of a tag."""
        return [child for child in self.children if child.tag == tag]

    def error(self, found: str, expected: str, key: str = "") -> InputError:
        """Make an error at the place of the element or one of its attributes."""
        return error_at(self.places[key], found, expected)

    def need(self, key: str) -> str:
        """Return a required attribute."""
        if key not in self.attributes:
            raise self.error(f"<{self.tag}> without {key}", f"an attribute {key}='...'")
        return self.attributes[key]

    def name(self, key: str = "name") -> str:
        """Return a required attribute that must be a valid name."""
        if not NAME.fullmatch(self.need(key)):
            found = f"{key}='{self.attributes[key]}'"
            raise self.error(found, "a name of letters, digits and _", key)
        return self.attributes[key]

    def number(self, key: str, default: Any, kind: Callable[[str], Any] = float) -> Any:
        """Return a numeric attribute."""
        if key not in self.attributes:
            return default
        try:
            value = kind(self.attributes[key].strip())
        except (ValueError, OverflowError):
            value = math.nan
        if value != value:
            kind_text = "a whole number" if kind is int else "a number"
            raise self.error(f"{key}='{self.attributes[key]}' in <{self.tag}>", kind_text, key)
        return value

    def numbers(self) -> tuple[float, ...]:
        """Return the numbers of the text, with or without brackets around them."""
        text = "".join(self.text).strip().removeprefix("[").removesuffix("]")
        try:
            return tuple(map(float, text.replace(",", " ").split()))
        except ValueError as error:
            found = f"{error} in <{self.tag}>"
            raise self.error(found, "numbers separated by commas") from None


class _ElementReader(ContentHandler):
    """Builds nodes; the text of expressions is padded to its line and column in the file."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self.lines = source.splitlines(keepends=True)
        self.root = Node("", {}, [], [], {"": Place(1, 1)})
        self.open = [self.root]
        self.end = Place(1, 1)

    def _here(self) -> Place:
        return Place(self._locator.getLineNumber(), self._locator.getColumnNumber() + 1)

    def startElement(self, name, attrs):
        given = dict(attrs.items())
        node = Node(name, given, [], [], self._places(given))
        if len(self.open) > MAX_DEPTH:
            raise node.error(f"elements within {MAX_DEPTH} others", "fewer")
        self.open[-1].children.append(node)
        self.open.append(node)
        self.end = Place(1, 1)

    def _places(self, given: dict[str, str]) -> dict[str, Place]:
        """Find the places of an element's attribute values; the empty key is its own place."""
        here = self._here()
        # Attributes beyond the twelfth line of a tag get the place where the tag begins.
        first = "".join(self.lines[here.line - 1 : here.line + 12])[here.column - 1 :]
        found = {"": here}
        for key in given:
            match = re.search(rf"\s{re.escape(key)}\s*=\s*['\"]", first)
            found[key] = here.after(first[: match.end()]) if match else here
        return found

    def endElement(self, name):
        self.open.pop()
        self.end = Place(1, 1)

    def characters(self, content):
        if self.open[-1].tag == "expressions":
            here = self._here()
            lines = here.line - self.end.line
            blanks = here.column - (1 if lines else self.end.column)
            self.open[-1].text.append("\n" * lines + " " * blanks)
            self.end = here.after(content)
        self.open[-1].text.append(content)


def _syntax_error(message: str, at: Place, reader: _ElementReader) -> tuple[str, str]:
    """Describe the error in a text that is not well-formed XML, and what is expected."""
    line = reader.lines[at.line - 1] if at.line <= len(reader.lines) else ""
    closing = re.search(r"</\s*([^\s>]*)", line[max(0, at.column - 3) :])
    inner = reader.open[-1]
    if message == "mismatched tag" and closing and len(reader.open) > 1:
        found = f"</{closing[1]}> where <{inner.tag}> of line {inner.places[''].line} is open"
        return found, f"</{inner.tag}>, or <{closing[1]}> in line {inner.places[''].line}"
    remedy = "well-formed XML: values in quotes, < written as &lt;, & as &amp;"
    return f"{message} in <{inner.tag}>" if inner.tag else message, remedy


def read_elements(text: str) -> Node:
    """Read the root element of a text.

    Raises
    ------
    InputError
        With its place, if it is not XML, has entities or a document type, or is nested too deep.
    """
    reader = _ElementReader(text)
    try:
        parseString(text.encode(), reader, forbid_dtd=True)
    except SAXParseException as error:
        at = Place(error.getLineNumber(), error.getColumnNumber() + 1)
        raise error_at(at, *_syntax_error(error.getMessage(), at, reader)) from None
    except DefusedXmlException as error:
        raise InputError(f"{error}", "XML without entities or a document type") from None
    except InputError:
        raise
    except (LookupError, ValueError) as error:
        raise InputError(f"{error}", "XML in UTF-8", line=1) from None
    return reader.root.children[0]


# ---- reading


@lru_cache(maxsize=64)
def parse_xml(text: str) -> d.Document:
    """Read a document from its XML form.

    Parameters
    ----------
    text : str
        XML with the root element ``<formulation>``, or ``<mapping>`` for a mapping alone.

    Returns
    -------
    Document

    Raises
    ------
    InputError
        With line and column, if it is not such a document or has entities, a document type or deep
        nesting.

    Examples
    --------
    >>> found = parse_xml("<mapping><output name='y'/><expressions>y = 2;</expressions></mapping>")
    >>> found.mapping.outputs[0].name, str(found.mapping.statements[0].value)
    ('y', '2')
    """
    root = read_elements(text)
    if root.tag not in ("formulation", "mapping"):
        raise root.error(f"an element <{root.tag}>", "<formulation> or <mapping>")
    _check(root)
    if root.tag == "mapping":
        return d.Document(_mapping(root))
    mapping, problem, solver = (
        _single_child(root, tag) for tag in ("mapping", "problem", "solver")
    )
    if mapping is None:
        raise root.error("<formulation> without <mapping>", "a mapping to optimise")
    return d.Document(
        _mapping(mapping),
        None if problem is None else _problem(problem),
        None if solver is None else _solver(solver),
    )


def _check(node: Node) -> None:
    """Raise an error for unknown children, attributes and text; networks are checked later."""
    network = node.attributes.get("classname") == MLP_CLASS
    children, attributes = (part.split() for part in PARTS[node.tag])
    children = NETWORK_PARTS if network else children
    for child in node.children:
        if child.tag not in children:
            suggestion = nearest(child.tag, children) if children else "no elements"
            raise child.error(f"<{child.tag}> in <{node.tag}>", suggestion)
    if node.tag in WITHOUT_TEXT and "".join(node.text).strip():
        raise node.error(f"text in <{node.tag}>", "elements only")
    for key, value in node.attributes.items():
        if key not in attributes:
            raise node.error(f"{key}='{value}' in <{node.tag}>", nearest(key, attributes), key)
    for child in () if network else node.children:
        _check(child)


def _single_child(node: Node, tag: str) -> Node | None:
    found = node.all(tag)
    if len(found) > 1:
        raise found[1].error(f"a second <{tag}>", "one")
    return found[0] if found else None


def _problem(node: Node) -> d.ProblemStatement:
    """Read the problem with its goals, variables and limits."""
    direction = node.attributes.get("direction", "minimize").strip().lower()
    if direction not in ("minimize", "maximize"):
        found = f"direction='{direction}'"
        raise node.error(found, nearest(direction, ["minimize", "maximize"]), "direction")
    goals = tuple(
        d.Goal(*_labels(e), e.number("coefficient", 1.0), at=e.at) for e in node.all("objective")
    )
    limits = tuple(d.Limit(*_labels(e), *_bounds(e), at=e.at) for e in node.all("constraint"))
    variables = tuple(map(_variable, node.all("variable")))
    return d.ProblemStatement(goals, variables, limits, direction == "maximize")


def _labels(e: Node) -> tuple[str, str]:
    key = "modelVariable" if "modelVariable" in e.attributes else "label"
    return e.attributes.get("label", e.name(key)), e.name(key)


def _bounds(e: Node) -> tuple[float, float]:
    return e.number("lower", -math.inf), e.number("upper", math.inf)


def _variable(e: Node) -> d.FreeInput:
    """Read a free input."""
    low, high = _bounds(e)
    random = None
    if e.attributes.get("useRandomInitial", "false").strip().lower() == "true":
        random = e.number("randomLower", low), e.number("randomUpper", high)
    seed = e.number("randomSeed", 0, int)
    if seed < 0:
        raise e.error(f"randomSeed='{seed}'", "a whole number from 0", "randomSeed")
    return d.FreeInput(*_labels(e), low, high, e.number("value", None), random, seed, at=e.at)


def _solver(node: Node) -> d.Solver:
    settings = tuple((e.need("name"), e.need("value")) for e in node.all("parameter"))
    return d.Solver(node.attributes.get("classname", "default"), settings, at=node.at)


# ---- mappings


def _mapping(node: Node) -> d.Mapping:
    """Read a mapping with its tables, inner mappings, declarations and statements."""
    kind = node.attributes.get("classname", EXPRESSIONS)
    if kind != EXPRESSIONS:
        found = f"classname='{kind}'"
        raise node.error(found, nearest(kind, [EXPRESSIONS, MLP_CLASS]), "classname")
    tables = tuple(map(_table, node.all("data")))
    inner = tuple(_network(e) if e.attributes.get("classname") == MLP_CLASS else _mapping(e)
                  for e in node.all("mapping"))  # fmt: skip
    for e in node.all("mapping"):
        e.name()
    groups = (tuple(map(_declared, node.all(tag))) for tag in ("input", "output", "parameter"))
    sets = tuple(map(_set, node.all("set")))
    text = _single_child(node, "expressions")
    statements = parse_statements("".join(text.text)) if text else ()
    return d.Mapping(
        node.attributes.get("name", ""), tables, inner, *groups, (*sets, *statements), at=node.at
    )


def _table(e: Node) -> d.DataTable:
    rows, columns = e.number("rowCount", None, int), e.number("columnCount", None, int)
    if (rows is None) != (columns is None):
        raise e.error("one of rowCount and columnCount", "both, or neither")
    return d.DataTable(e.name(), e.need("file"), rows, columns, at=e.at)


def _declared(e: Node) -> d.Declared:
    """Read an input, output or parameter."""
    dimensions: list[str | int] = []
    for dim in e.all("dimension"):
        if "set" in dim.attributes:
            dimensions.append(dim.name("set"))
        else:
            dim.need("size")
            dimensions.append(dim.number("size", 1, int))
    values = _single_child(e, "values")
    if values is not None:
        return d.Declared(e.name(), tuple(dimensions), values.numbers(), at=e.at)
    given = (e.number("value", 0.0),) if "value" in e.attributes else None
    return d.Declared(e.name(), tuple(dimensions), given, at=e.at)


def _set(e: Node) -> d.IndexedSet:
    """Read a set."""
    inner = _single_child(e, "elements")
    if inner is None:
        raise e.error("<set> without <elements>", "<elements type='range' start='1' stop='9'/>")
    kind = inner.attributes.get("type", "range")
    if kind not in ("range", "list"):
        raise inner.error(f"type='{kind}'", nearest(kind, ["range", "list"]), "type")
    numbers = "".join(inner.text).replace(",", " ").split()
    if kind == "range":
        keys = ("start", "stop", *(["step"] if "step" in inner.attributes else []))
        numbers = [str(inner.number(key, inner.need(key), int)) for key in keys]
    parts = parse_statements(f"set s = |{', '.join(numbers)}|;")[0].elements.parts
    return d.IndexedSet(e.name(), Elements(parts, kind == "range", at=e.at), at=e.at)


def _network(node: Node) -> d.NetworkDefinition:
    """Read the parts of a network without building it."""
    parts = []
    for e in node.children:
        heads = ("srcName", "dstName") if e.tag == "connection" else ("name",)
        rest = [(k, v) for k, v in e.attributes.items() if k not in heads]
        values = e.numbers() if "".join(e.text).strip() else None
        head = [(k, e.name(k)) for k in heads]
        parts.append(d.NetworkElement(e.tag, (*head, *rest), values, at=e.at))
    return d.NetworkDefinition(node.name(), tuple(parts), at=node.at)


# ---- writing


def format_xml(document: d.Document) -> str:
    """Write a document in the report's XML form.

    Parameters
    ----------
    document : Document
        The document to write.

    Returns
    -------
    str
    """
    mapping = _mapping_element(document.mapping)
    root = mapping
    if document.problem is not None or document.solver is not None:
        root = Plain.Element("formulation")
        root.extend(_problem_elements(document.problem))
        root.append(mapping)
        if document.solver is not None:
            e = Plain.SubElement(root, "solver", classname=document.solver.name)
            for name, value in document.solver.settings:
                Plain.SubElement(e, "parameter", name=name, value=value)
    Plain.indent(root)
    head = '<?xml version="1.0" encoding="UTF-8"?>\n'
    return head + Plain.tostring(root, encoding="unicode") + "\n"


def _problem_elements(p: d.ProblemStatement | None) -> list[Plain.Element]:
    """Make the element of the problem; an empty list without a problem."""
    if p is None:
        return []
    e = Plain.Element("problem", classname=NLP, direction="maximize" if p.maximize else "minimize")
    for v in p.variables:
        given = _label_attributes(v)
        if v.value is not None:
            given["value"] = number_text(v.value)
        if v.random is not None:
            low, high = map(number_text, v.random)
            given |= {"useRandomInitial": "true", "randomLower": low, "randomUpper": high}
        if v.seed:
            given["randomSeed"] = str(v.seed)
        Plain.SubElement(e, "variable", given)
    for limit in p.limits:
        Plain.SubElement(e, "constraint", _label_attributes(limit))
    for goal in p.goals:
        weight = {} if goal.weight == 1.0 else {"coefficient": number_text(goal.weight)}
        Plain.SubElement(e, "objective", _label_attributes(goal) | weight)
    return [e]


def _label_attributes(declared: d.FreeInput | d.Limit | d.Goal) -> dict[str, str]:
    given = {"label": declared.label, "modelVariable": declared.model}
    for key, default in (("lower", -math.inf), ("upper", math.inf)):
        if (value := getattr(declared, key, default)) != default:
            given[key] = number_text(value)
    return given


def _mapping_element(m: d.Mapping) -> Plain.Element:
    """Make the element of a mapping."""
    e = Plain.Element("mapping", {"classname": EXPRESSIONS} | ({"name": m.name} if m.name else {}))
    for t in m.tables:
        size = {"rowCount": t.rows, "columnCount": t.columns}
        given = {k: str(v) for k, v in size.items() if v is not None}
        Plain.SubElement(e, "data", {"name": t.name, "file": t.file} | given)
    for inner in m.mappings:
        e.append(
            _mapping_element(inner) if isinstance(inner, d.Mapping) else _network_element(inner)
        )
    for tag, group in (("input", m.inputs), ("output", m.outputs), ("parameter", m.parameters)):
        for declared in group:
            _declare(Plain.SubElement(e, tag, name=declared.name), declared)
    if m.statements:
        Plain.SubElement(e, "expressions").text = f"\n{format_statements(m.statements)}\n"
    return e


def _declare(e: Plain.Element, declared: d.Declared) -> None:
    """Write dimensions and values to the element of an input, output or parameter."""
    if declared.dimensions:
        e.set("isScalar", "false")
    for dim in declared.dimensions:
        given = {"type": "ID", "set": dim} if isinstance(dim, str) else None
        Plain.SubElement(e, "dimension", given or {"type": "size", "size": str(dim)})
    if declared.values is not None and (declared.dimensions or len(declared.values) != 1):
        Plain.SubElement(e, "values").text = values_text(declared.values)
    elif declared.values is not None:
        e.set("value", number_text(declared.values[0]))


def _network_element(n: d.NetworkDefinition) -> Plain.Element:
    e = Plain.Element("mapping", classname=MLP_CLASS, name=n.name)
    for part in n.parts:
        inner = Plain.SubElement(e, part.kind, dict(part.attributes))
        if part.values is not None:
            inner.text = ", ".join(map(number_text, part.values))
    return e
