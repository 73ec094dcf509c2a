"""XML elements with the places of their attributes and text; what attacks is refused."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any, NamedTuple
from xml.sax import ContentHandler, SAXParseException

from defusedxml import DefusedXmlException
from defusedxml.sax import parseString

from beamfit.errors import InputError
from beamfit.language.expression import Place, error_at

# Most nested elements, and most lines of an opening tag.
MOST_DEEP, MOST_LINES = 40, 12
NAME = re.compile(r"[^\W\d]\w*")


class Node(NamedTuple):
    """An element: its text begins where it stands in the file, so that places in it are right."""

    tag: str
    given: dict[str, str]
    children: list[Node]
    text: list[str]
    places: dict[str, Place]

    @property
    def at(self) -> Place:
        """Place of the name it declares, or else of its beginning."""
        keys = ("modelVariable", "label", "name", "")
        return next(self.places[key] for key in keys if key in self.places)

    def all(self, tag: str) -> list[Node]:
        """Children of a name."""
        return [child for child in self.children if child.tag == tag]

    def error(self, found: str, expected: str, key: str = "") -> InputError:
        """An error at its place, or at the place of an attribute."""
        return error_at(self.places[key], found, expected)

    def need(self, key: str) -> str:
        """An attribute that must be there."""
        if key not in self.given:
            raise self.error(f"<{self.tag}> without {key}", f"an attribute {key}='...'")
        return self.given[key]

    def name(self, key: str = "name") -> str:
        """An attribute that names something in expressions."""
        if not NAME.fullmatch(self.need(key)):
            found = f"{key}='{self.given[key]}'"
            raise self.error(found, "a name of letters, digits and _", key)
        return self.given[key]

    def number(self, key: str, default: Any, kind: Callable[[str], Any] = float) -> Any:
        """A numeric attribute."""
        if key not in self.given:
            return default
        try:
            value = kind(self.given[key].strip())
        except (ValueError, OverflowError):
            value = math.nan
        if value != value:
            said = "a whole number" if kind is int else "a number"
            raise self.error(f"{key}='{self.given[key]}' in <{self.tag}>", said, key)
        return value

    def numbers(self) -> tuple[float, ...]:
        """The numbers of its text, with brackets around them or without."""
        text = "".join(self.text).strip().removeprefix("[").removesuffix("]")
        try:
            return tuple(map(float, text.replace(",", " ").split()))
        except ValueError as error:
            found = f"{error} in <{self.tag}>"
            raise self.error(found, "numbers separated by commas") from None


class _ElementReader(ContentHandler):
    """Builds nodes; text is padded to the line and column where it stands in the file."""

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
        if len(self.open) > MOST_DEEP:
            raise node.error(f"elements within {MOST_DEEP} others", "fewer")
        self.open[-1].children.append(node)
        self.open.append(node)
        self.end = Place(1, 1)

    def _places(self, given: dict[str, str]) -> dict[str, Place]:
        """Places of an element's attribute values; its own under the empty key."""
        here = self._here()
        first = "".join(self.lines[here.line - 1 : here.line + MOST_LINES])[here.column - 1 :]
        found = {"": here}
        for key in given:
            match = re.search(rf"\s{re.escape(key)}\s*=\s*['\"]", first)
            if match:
                before = first[: match.end()]
                more = before.count("\n")
                column = len(before) - before.rfind("\n") if more else here.column + len(before)
                found[key] = Place(here.line + more, column)
            else:
                found[key] = here
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
            more = content.count("\n")
            column = len(content) - content.rfind("\n") if more else here.column + len(content)
            self.end = Place(here.line + more, column)
        self.open[-1].text.append(content)


def _ill_formed(said: str, at: Place, reader: _ElementReader) -> tuple[str, str]:
    """Error in a text that is not well-formed XML, and what was expected."""
    line = reader.lines[at.line - 1] if at.line <= len(reader.lines) else ""
    closing = re.search(r"</\s*([^\s>]*)", line[max(0, at.column - 3) :])
    inner = reader.open[-1]
    if said == "mismatched tag" and closing and len(reader.open) > 1:
        found = f"</{closing[1]}> where <{inner.tag}> of line {inner.places[''].line} is open"
        return found, f"</{inner.tag}>, or <{closing[1]}> in line {inner.places[''].line}"
    remedy = "well-formed XML: values in quotes, < written as &lt;, & as &amp;"
    return f"{said} in <{inner.tag}>" if inner.tag else said, remedy


def read_elements(text: str) -> Node:
    """Read the root element of a text.

    Raises
    ------
    InputError
        With its place, if it is not XML, or has entities, a document type, or nests too deep.
    """
    reader = _ElementReader(text)
    try:
        parseString(text.encode(), reader, forbid_dtd=True)
    except SAXParseException as error:
        at = Place(error.getLineNumber(), error.getColumnNumber() + 1)
        raise error_at(at, *_ill_formed(error.getMessage(), at, reader)) from None
    except DefusedXmlException as error:
        raise InputError(f"{error}", "XML without entities or a document type") from None
    except InputError:
        raise
    except (LookupError, ValueError) as error:
        raise InputError(f"{error}", "XML in UTF-8", line=1) from None
    return reader.root.children[0]
