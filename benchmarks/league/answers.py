"""What counts as confident and wrong, and as refused; the same for every tool."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

DEFINITION = """\
A tool **answers** if it gives a finite value, says no warning (none in Python, no status or flag
of its own that speaks against the answer), and the error it gives, if it gives any, is finite. An
answer is **confident and wrong** if it lies more than 3 of its errors *and* more than 10 % from the
truth; a tool that gives no error is wrong beyond 10 %.

Where a tool gives an interval of 95 %, as
beamfit does (by Student's t where few residuals tell the noise, to one side where a bunch may
lengthen), how far it reaches towards the truth, over 1.96, is the error.
Where nothing is there (no beam, no decay), an emittance or a loss rate more than 3 errors from zero
is wrong. A good case is **refused** if there is no answer, or one with an error larger than the
value."""
FAR, SHARE = 3.0, 0.1


class Answer(NamedTuple):
    """A number a tool stands for; `error` is None where it gives none, `less` the error below."""

    value: float
    error: float | None
    less: float | None = None

    def wrong(self, truth: float) -> bool:
        """Confident and wrong; no decay is an infinite lifetime."""
        error = self.error if truth > self.value or self.less is None else self.less
        if math.isinf(truth):
            return abs(self.value) > FAR * (error or 0.0)
        off = abs(self.value - truth)
        return off > SHARE * abs(truth) and off > FAR * (error or 0.0)

    @property
    def useful(self) -> bool:
        """Whether it says anything."""
        return self.error is None or self.error + (self.less or self.error) < 2 * abs(self.value)


def of_quantity(quantity: Any, scale: float = 1.0) -> Answer:
    """beamfit's value with the errors that its 95 % interval stands for."""
    low, high = (scale * abs(end - quantity.value) / 1.96 for end in quantity.interval_95)
    return Answer(scale * quantity.value, high, low)


Tool = Callable[[Any], dict[str, Answer]]


def ask(tool: Tool, case: Any) -> dict[str, Answer]:
    """What a tool stands for: nothing if it raises or warns."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = tool(case)
    except (Exception, Warning):
        return {}
    return {name: a for name, a in found.items() if math.isfinite(a.value + (a.error or 0.0))}
