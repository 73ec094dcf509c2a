"""Laws between an input and what it moves, such as a play or a dead zone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# Laws, and half widths of each as shares of an input's range: prior flat in their logarithm. A stop
# hands on other values as soon as its width passes a move. The others change smoothly with it, so
# that it is a number to be fitted, with a prior about each of these as wide as half their distance.
# A saturation leaves this share of the range on one side of its place, flat in the logarithm of
# what is cut off. A square law bends up or down; as wide as the range it is a square from one end.
LAWS = {law: np.geomspace(0.005, 0.4, count) for law, count in
        (("play", 8), ("hysteresis", 8), ("stop", 24), ("shift", 8), ("rate limit", 8),
         ("dead zone", 8))}  # fmt: skip
LAWS |= {
    "saturation": 1.0 - np.geomspace(0.02, 0.9, 8),
    "square law": np.outer((1.0, -1.0), np.geomspace(0.1, 50.0, 8)).ravel(),
}
# Places in the range about which a law lies, as shares of it: prior flat. A dead zone may lie about
# 0 as well; a saturation about an end of the range is one of the other end.
PLACES = {
    "dead zone": (0.1, 0.3, 0.5, 0.7, 0.9),
    "saturation": (0.0, 0.5, 1.0),
    "square law": (0.5,),
}
# Laws of the value alone, whatever came before.
STATIC = tuple(PLACES)
# Parts of a law's width and of its place that are looked at between neighbours.
FINER = 5
# Plays of a hysteresis, as shares of the widest, which is twice its half width.
PLAYS = (0.0, 0.4, 0.8, 1.2, 1.6, 2.0)


def _played(at: np.ndarray, now: float, width: np.ndarray) -> np.ndarray:
    return np.clip(at, now - width, now + width)


def _stopped(at: np.ndarray, now: float, width: np.ndarray) -> np.ndarray:
    return np.where(np.abs(now - at) > width, now, at)


def _limited(at: np.ndarray, now: float, width: np.ndarray) -> np.ndarray:
    return np.clip(now, at - width, at + width)


# Laws that follow an input row by row: where they are after each, by where they were, the input
# and the width.
FOLLOWING = {"play": _played, "hysteresis": _played, "stop": _stopped, "rate limit": _limited}


def moved(u: np.ndarray, law: str, width: float | np.ndarray, place: float = 0.0) -> np.ndarray:
    """One input as a law hands it on, shape (rows,), for each of several widths if given.

    A play follows when its clearance is used up; a hysteresis is the mean of plays of several
    widths (Prandtl, Ishlinskii); a stop (Coulomb friction) goes all the way once it moves at all; a
    shift (friction against a spring) is to the side that the input last came from. A rate limit
    goes its width a row at most. A dead zone lies
    about a place, a saturation leaves what is about one, and a square law bends about one.
    """
    half = np.asarray(width)[..., None]
    if law in FOLLOWING:  # what rests with the input, but for a rate limit
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
    """A law of an input that goes from `low` to `high`, as wide as `width` about `place`.

    `step` is half the distance to the next width, in the logarithm, and the width of a prior about
    this one; `stride` half the distance to the next place.
    """

    kind: str
    input: str
    width: float
    step: float
    place: float
    stride: float
    low: float
    high: float

    def behind(self, u: np.ndarray) -> np.ndarray:
        """The input as it is handed on, and its change by a step of the width, shape (rows, 2)."""
        widths = self.width * np.exp(self.step * np.array([0.0, 1.0, -1.0]))
        at, wider, closer = moved(u, self.kind, widths, self.place)
        return np.stack([at, 0.5 * (wider - closer)], axis=1)

    def changed(self, change: float) -> InputLaw:
        """The law `change` steps wider; a dead zone to an end of the range is a saturation."""
        law = self._replace(width=self.width * float(np.exp(change * self.step)))
        ends = law.place - law.width, law.place + law.width
        if law.kind == "dead zone" and ends[1] >= law.high > ends[0] > law.low:
            return law._replace(kind="saturation", place=law.low, width=ends[0] - law.low)
        if law.kind == "dead zone" and ends[0] <= law.low < ends[1] < law.high:
            return law._replace(kind="saturation", place=law.high, width=law.high - ends[1])
        return law

    def finer(self, change: float) -> list[InputLaw]:
        """Laws between this one, `change` steps wider, and those next to it."""
        at = np.linspace(-1.0, 1.0, FINER + 1)
        at = 0.5 * (at[1:] + at[:-1])
        widths = self.width * np.exp(self.step * (change + at))
        places = self.place + self.stride * at if self.stride else [self.place]
        less = {"step": self.step / FINER, "stride": self.stride / FINER}
        return [self._replace(width=float(w), place=float(p), **less)
                for p in places for w in widths]  # fmt: skip

    def words(self) -> str:
        """The law in words."""
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
    """The laws that are looked at of an input with this range."""
    found = []
    for kind, shares in LAWS.items():
        places = low + np.array(PLACES[kind]) * (high - low) if kind in PLACES else np.zeros(1)
        stride = 0.5 * (places[1] - places[0]) if len(places) > 1 else 0.0
        if kind == "dead zone" and low < 0 < high:
            places = np.append(places, 0.0)
        apart = np.abs(np.diff(np.log(np.abs(shares))))
        near = 0.5 * np.minimum(np.append(apart, np.inf), np.append(np.inf, apart))
        for place in places:
            ended = kind == "saturation" and place in (low, high)
            reach = max(place - low, high - place) if kind == "saturation" else high - low
            found += [
                InputLaw(kind, name, w * reach, 0.0 if kind == "stop" else float(step),
                         float(place), 0.0 if ended else float(stride), low, high)
                for w, step in zip(shares, near, strict=True)
            ]  # fmt: skip
    return found
