"""Laws between an input and what it moves, such as a play or a dead zone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# Laws, and half widths of each as shares of the input's range; the prior is flat in their
# logarithm. A stop changes its output as soon as its width passes a step of the input, so it needs
# a fine grid. The other laws change smoothly with the width, which is then a free number with a
# prior as wide as half the distance of the grid points. A saturation leaves this share of the range
# on one side of its place, on a grid even in the logarithm of the share cut off. A square law bends
# up or down; with the width of the range it is a square from one end.
LAWS = {law: np.geomspace(0.005, 0.4, count) for law, count in
        (("play", 8), ("hysteresis", 8), ("stop", 24), ("shift", 8), ("rate limit", 8),
         ("dead zone", 8))}  # fmt: skip
LAWS |= {
    "saturation": 1.0 - np.geomspace(0.02, 0.9, 8),
    "square law": np.outer((1.0, -1.0), np.geomspace(0.1, 50.0, 8)).ravel(),
}
# Places about which a law lies, as shares of the range; the prior is flat. A dead zone may also lie
# about 0. A saturation about one end of the range limits at the other end.
PLACES = {
    "dead zone": (0.1, 0.3, 0.5, 0.7, 0.9),
    "saturation": (0.0, 0.5, 1.0),
    "square law": (0.5,),
}
# Laws that depend on the present value alone.
STATIC = tuple(PLACES)
# Number of new grid points of width, and of place, between neighbours in each refinement.
FINER = 5
# Widths of the plays that make up a hysteresis, in units of its half width.
PLAYS = (0.0, 0.4, 0.8, 1.2, 1.6, 2.0)


def _follow_play(at: np.ndarray, now: float, width: np.ndarray) -> np.ndarray:
    return np.minimum(np.maximum(at, now - width), now + width)


def _follow_stop(at: np.ndarray, now: float, width: np.ndarray) -> np.ndarray:
    return np.where(np.abs(now - at) > width, now, at)


def _follow_rate_limit(at: np.ndarray, now: float, width: np.ndarray) -> np.ndarray:
    return np.minimum(np.maximum(now, at - width), at + width)


# Laws that follow an input row by row: the new position from the last one, the input and the width.
FOLLOWING = {
    "play": _follow_play,
    "hysteresis": _follow_play,
    "stop": _follow_stop,
    "rate limit": _follow_rate_limit,
}


def apply_law(u: np.ndarray, law: str, width: float | np.ndarray, place: float = 0.0) -> np.ndarray:
    """Apply a law to one input, shape (rows,); for an array of widths one row for each.

    A play follows once its clearance is used up. A hysteresis is the mean of plays of several
    widths (Prandtl, Ishlinskii). A stop (Coulomb friction) jumps to the input once it moves at all.
    A shift (friction against a spring) is an offset to the side that the input last came from. A
    rate limit moves by its width per row at most. A dead zone removes changes about its place, a
    saturation those away from it, and a square law bends about it.
    """
    half = np.asarray(width)[..., None]
    if law in FOLLOWING:
        # All but a rate limit rest while the input rests.
        changes = (np.diff(u, prepend=np.nan) != 0) | (law == "rate limit")
        widths = np.multiply.outer(width, PLAYS if law == "hysteresis" else (1.0,))
        at, found = u[0] + 0 * widths, []
        for now in u[changes]:
            at = FOLLOWING[law](at, now, widths)
            found.append(at)
        return np.moveaxis(np.mean(found, axis=-1), 0, -1)[..., np.cumsum(changes) - 1]
    if law == "shift":
        sign = np.sign(np.diff(u, prepend=u[0]))
        last = np.maximum.accumulate(np.where(sign != 0, np.arange(len(u)), 0))
        return u - half * sign[last]
    near = np.clip(u - place, -half, half)
    if law == "dead zone":
        return u - near
    return place + near if law == "saturation" else u + (u - place) ** 2 / half


class InputLaw(NamedTuple):
    """A law of an input with range `low` to `high`: half width `width`, about `place`.

    `step` is half the distance to the next width, in its logarithm, and the standard deviation of
    the prior about this width; `stride` is half the distance to the next place.
    """

    kind: str
    input: str
    width: float
    step: float
    place: float
    stride: float
    low: float
    high: float

    def output_and_slope(self, u: np.ndarray) -> np.ndarray:
        """Give the output of the law and its change by one step of the width, shape (rows, 2)."""
        widths = self.width * np.exp(self.step * np.array([0.0, 1.0, -1.0]))
        at, wider, closer = apply_law(u, self.kind, widths, self.place)
        return np.stack([at, 0.5 * (wider - closer)], axis=1)

    def widened(self, change: float) -> InputLaw:
        """Widen by `change` steps; a dead zone that reaches an end becomes a saturation."""
        law = self._replace(width=self.width * float(np.exp(change * self.step)))
        ends = law.place - law.width, law.place + law.width
        if law.kind == "dead zone" and ends[1] >= law.high > ends[0] > law.low:
            return law._replace(kind="saturation", place=law.low, width=ends[0] - law.low)
        if law.kind == "dead zone" and ends[0] <= law.low < ends[1] < law.high:
            return law._replace(kind="saturation", place=law.high, width=law.high - ends[1])
        return law

    def finer(self, change: float) -> list[InputLaw]:
        """List laws in finer steps of width and place about this one, widened by `change` steps."""
        at = np.linspace(-1.0, 1.0, FINER + 1)
        at = 0.5 * (at[1:] + at[:-1])
        widths = self.width * np.exp(self.step * (change + at))
        places = self.place + self.stride * at if self.stride else [self.place]
        less = {"step": self.step / FINER, "stride": self.stride / FINER}
        return [self._replace(width=float(w), place=float(p), **less)
                for p in places for w in widths]  # fmt: skip

    def words(self) -> str:
        """Describe the law in words."""
        width, name = self.width, self.input
        if self.kind == "saturation":
            ends = self.place - width, self.place + width
            below = [f"below {ends[0]:.3g}"] if ends[0] > self.low else []
            above = [f"above {ends[1]:.3g}"] if ends[1] < self.high else []
            return f"a saturation of {name} {' and '.join(below + above)}"
        if self.kind == "square law":
            ends = 1.0 + np.array([-1.0, 1.0]) * (self.high - self.low) / width
            return f"a square law of {name} (gain {ends[0]:.2g} to {ends[1]:.2g} of its mean)"
        if self.kind == "rate limit":
            return f"a rate limit of {name}"
        about = f" about {self.place:.3g}" if self.kind in STATIC else ""
        return f"a {self.kind} of {name} by ±{width:.2g}{about}"


def laws_between(name: str, low: float, high: float) -> list[InputLaw]:
    """List the laws that are tried for an input with this range."""
    laws = []
    for kind, shares in LAWS.items():
        places = low + np.array(PLACES[kind]) * (high - low) if kind in PLACES else np.zeros(1)
        stride = 0.5 * (places[1] - places[0]) if len(places) > 1 else 0.0
        if kind == "dead zone" and low < 0 < high:
            places = np.append(places, 0.0)
        distance = np.abs(np.diff(np.log(np.abs(shares))))
        steps = 0.5 * np.minimum(np.append(distance, np.inf), np.append(np.inf, distance))
        for place in places:
            at_end = kind == "saturation" and place in (low, high)
            span = max(place - low, high - place) if kind == "saturation" else high - low
            laws += [
                InputLaw(kind, name, w * span, 0.0 if kind == "stop" else float(step),
                         float(place), 0.0 if at_end else float(stride), low, high)
                for w, step in zip(shares, steps, strict=True)
            ]  # fmt: skip
    return laws
