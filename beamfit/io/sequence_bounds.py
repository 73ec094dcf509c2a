"""Bounds for pyAT's parsers: a line of text may stand for a number or a line without end."""

from __future__ import annotations

import ast
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from types import CodeType
from typing import Any

from beamfit.errors import InputError
from beamfit.io.files import read_text

# Elements of a line, files that call one another, bits of a whole number.
MOST, MOST_CALLS, BITS = 50_000, 50, 64


def bound(parser: Any) -> None:
    """Have a parser compute no more than a lattice needs, and read files as beamfit does."""
    parser.env |= {name: function for name, function in OPERATORS.values()}
    parser.evaluate = lambda text: _value(parser, text, parser)
    parser.parse_files = _reader(parser)
    if hasattr(parser, "_assign_deferred"):
        parser._assign_deferred = lambda text: _deferred(parser, text)
    if hasattr(parser, "rpn"):
        parser.rpn.operators["*"] = (_product, 2)


def _value(parser: Any, text: str, names: Any) -> Any:
    return eval(_code(parser._format_command(text)), parser.env, names)


def _deferred(parser: Any, text: str) -> Any:
    """What := gives: a number, or the expression. (pyAT reads 2^3 here as the bits of 1.)"""
    from at.load.parser import StrParameter
    from at.load.utils import protect, restore

    if text[:1] == "(" and text[-1:] == ")":
        inner, matches = protect(text[1:-1], fence=(r"\(", r"\)"))
        return tuple(_deferred(parser, part) for part in restore(matches, *inner.split(",")))
    try:
        return _value(parser, text, {})
    except Exception:  # a name that is not known yet, say
        return StrParameter(parser, text)


@lru_cache(maxsize=100_000)
def _code(text: str) -> CodeType:
    tree = _Bounded().visit(ast.parse(text.strip(), mode="eval"))
    return compile(ast.fix_missing_locations(tree), "<string>", "eval")


class _Bounded(ast.NodeTransformer):
    """Puts functions in the place of operators whose results may be without end."""

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        self.generic_visit(node)
        if type(node.op) not in OPERATORS:
            return node
        name = ast.Name(OPERATORS[type(node.op)][0], ast.Load())
        return ast.Call(name, [node.left, node.right], [])


def _power(base: Any, exponent: Any) -> Any:
    whole = isinstance(base, int) and isinstance(exponent, int)
    if whole and 0 <= exponent * base.bit_length() <= BITS:
        return base**exponent
    return float(base) ** float(exponent)


def _product(one: Any, other: Any) -> Any:
    if isinstance(one, int) and isinstance(other, int):
        small = one.bit_length() + other.bit_length() <= BITS
        return one * other if small else float(one) * float(other)
    for count, many in ((one, other), (other, one)):
        if isinstance(count, int) and not isinstance(many, float):
            _check(count * _length(many))
    return one * other


def _sum(one: Any, other: Any) -> Any:
    _check(_length(one) + _length(other))
    return one + other


def _length(value: Any) -> int:
    return len(value) if isinstance(value, str | list | tuple) else 1


def _check(count: int) -> None:
    if count > MOST:
        raise ValueError(f"more than {MOST} elements")


OPERATORS = {ast.Pow: ("_power", _power), ast.Mult: ("_product", _product), ast.Add: ("_sum", _sum)}


def _reader(parser: Any) -> Callable[..., None]:
    """In the place of the parser's own, which would wait for a pipe and read a device for ever."""
    calls = 0

    def read(*names: str, **_: Any) -> None:
        nonlocal calls
        for name in names:
            calls += 1
            path = (Path(parser.bases[-1]) / name).resolve()
            if calls > MOST_CALLS:
                raise ValueError(f"more than {MOST_CALLS} files called")
            parser.bases.append(path.parent)
            try:
                parser.parse_lines(read_text(path).splitlines(keepends=True), final=False)
            except InputError as error:  # the parser makes its errors anew, of one argument
                raise ValueError(str(error)) from None
            finally:
                parser.bases.pop()

    return read


def check_count(parser: Any, members: Any, known: dict[int, int] | None = None) -> int:
    """How many elements and lines a line or sequence holds, without making them.

    Raises
    ------
    ValueError
        If they are more than any lattice has: ten lines, each twice the one before, are a thousand.
    """
    known = {} if known is None else known
    if not isinstance(members, list | tuple):
        return 1
    if id(members) not in known:
        known[id(members)] = 1  # for what holds itself, which expanding it will tell
        named = hasattr(members, "refer")  # a sequence, of names with their places
        inner = [parser.get(one[0]) for one in members] if named else members
        known[id(members)] += sum(check_count(parser, one, known) for one in inner)
        _check(known[id(members)])
    return known[id(members)]
