"""Sums of squares found in formulas, so that least squares can be used for them."""

from __future__ import annotations

from typing import NamedTuple

from beamfit.language import document as d
from beamfit.language import expression as x


class Square(NamedTuple):
    """A term of a sum of squares: weight times (body for all iterators) squared."""

    weight: float
    body: x.Expression
    each: tuple[x.Iterator, ...] = ()


def squares_of(m: d.Mapping, name: str, weight: float = 1.0) -> list[Square] | None:
    """The terms of an output that is a sum of squares, None for any other."""
    set_by = {s.target.name: s.value for s in m.statements
              if isinstance(s, d.Assignment) and not s.each and not s.target.indices}  # fmt: skip

    def terms(e: x.Expression, factor: float, seen: tuple[str, ...]) -> list[Square] | None:
        match e:
            case x.Name(n, ()) if n in set_by and n not in seen:
                return terms(set_by[n], factor, (*seen, n))
            case x.Arithmetic("^", (body, x.Literal() as two)) if two.value == 2.0 and factor > 0:
                return [Square(factor, body)]
            case x.Arithmetic("+", (left, right)):
                both = terms(left, factor, seen), terms(right, factor, seen)
                return None if None in both else both[0] + both[1]
            case x.Arithmetic("*", (x.Literal() as n, inner)):
                return terms(inner, factor * n.value, seen)
            case x.Arithmetic("/", (inner, x.Literal() as n)) if n.value != 0:
                return terms(inner, factor / n.value, seen)
            case x.Reduction("sum", each, inner):
                found = terms(inner, factor, seen)
                return found and [s._replace(each=(*each, *s.each)) for s in found]
        return None

    return terms(x.Name(name), weight, ())
