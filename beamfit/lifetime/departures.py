"""Departures of a decay from constant a and b: their numbers, priors, and the currents they make.

With x the current over its mean and s the time over the span, the loss rate is
share R x^(1 + g) + (1 - share) R (1 + h f(s)) with the share of a from 0 to 1. The gas changes by h
of itself: in a straight line, f = s - 1/2, or as what is pumped away after a fill, f = 1/k -
exp(-k s)/(1 - exp(-k)), where a is then constant. The exponent g, the change h and the pace k have
priors. The law has a closed form with one integral, taken to rounding on Chebyshev nodes.
"""

from __future__ import annotations

import math
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.polynomial.chebyshev import chebint, chebvander

from beamfit.lifetime.decay_law import closed_form

# Standard deviations of the exponent below and above zero. Bunches lengthen with the current, in
# the potential well by x³ - x ∝ I (`beamfit.lifetime.ring`), so that a goes as I^0 to I^-1/3; that
# they shorten, or the vacuum follows the current, is seldom. A twentieth of the prior is flat.
BELOW, ABOVE, ODD = 0.3, 0.2, 0.05
LEAST, MOST = -0.9, 2.0
# Standard deviation of the change of b in one record: pressures of stored beams are read to 10 %.
DRIFT = 0.1
# Prior probabilities of these and of gas that is pumped away after a fill. The time that takes is
# flat in its logarithm from a thousandth of the span to all of it, its loss at first from a
# thousandth of the mean loss to ten times that.
SMOOTH, OUTGASSING, TIMES, SIZES = 0.74, 0.08, (1e-3, 1.0), (1e-3, 10.0)
# Spans over the time of gas that is pumped away: shorter times are seen by themselves.
PACES = (1.0, 20.0)
# Where the record's bend does not depend on the share its coordinate has this slope.
FLAT = 1e-3
# Nodes of the integral: exact to rounding up to four lifetimes in a record.
NODES = 14

ANGLE = -np.cos(np.pi * np.arange(NODES) / (NODES - 1))
NODE = (1 + ANGLE) / 2
FROM_NODES = np.linalg.inv(chebvander(ANGLE, NODES - 1))
INTEGRAL = chebvander(ANGLE, NODES) @ chebint(FROM_NODES, lbnd=-1) / 2


def from_nodes(s: np.ndarray) -> np.ndarray:
    """Matrix that takes values at the nodes to those at times over the span, shape (n, 14).

    Examples
    --------
    >>> (from_nodes(np.array([0.25])) @ NODE**2).round(9).tolist()
    [0.0625]
    """
    return chebvander(2 * s - 1, NODES - 1) @ FROM_NODES


class Law(StrEnum):
    """Knowledge of the law of a decay.

    Attributes
    ----------
    free
        The exponent of a and a drift of b are free, with priors.
    constant
        a and b are constant, or their dependence is given.
    """

    free = "free"
    constant = "constant"


# Rows of the search's numbers: ln level, ln rate, bend, exponent, change of b, its pace.
BEND, POWER, CHANGE, PACE = range(2, 6)
CONSTANT = (0, 1, BEND)


def gas_change(s, pace, xp=np):
    """Change of the gas at a time over the span, of 1 from the first to the last reading and 0 in
    the mean: a straight line at a pace of 0.

    Examples
    --------
    >>> gas_change(0.0, 0.0).item(), (gas_change(1.0, 3.0) - gas_change(0.0, 3.0)).round(9).item()
    (-0.5, 1.0)
    """
    k = xp.where(pace > 0, pace, 1.0)
    return xp.where(pace > 0, 1 / k + xp.exp(-k * s) / xp.expm1(-k), s - 0.5)


def gas_changed(pace, xp=np):
    """Integral of that up to the nodes, one column a pace."""
    s, k = NODE[:, None], xp.where(pace > 0, pace, 1.0)
    return xp.where(pace > 0, (s - xp.expm1(-k * s) / xp.expm1(-k)) / k, (s**2 - s) / 2)


class Numbers(NamedTuple):
    """First current over the mean, loss in the span at the mean current, share of a, exponent,
    change of the gas over that loss and its pace, and by how much the share changes with the bend.
    """

    level: np.ndarray
    rate: np.ndarray
    share: np.ndarray
    power: np.ndarray
    gas: np.ndarray
    pace: np.ndarray
    unit: np.ndarray

    @classmethod
    def of(cls, found: np.ndarray) -> Numbers:
        """From columns of ln level, ln rate, bend, exponent, change, pace.

        A straight change of the gas is one of b, that of gas which is pumped away one of the whole
        loss. The bend, share (1 + g) - (1 - share) h / R, is how the loss rate falls with the
        current, which the record shows: with it the posterior is nearly normal.
        """
        level, rate = np.exp(np.clip(found[:2], -30.0, 8.0))
        power, change, pace = found[POWER:]
        unit = np.where(pace > 0, 1.0, 1 + power + change / rate)
        unit = np.where(np.abs(unit) < FLAT, FLAT, unit)
        share = (found[BEND] + change / rate) / unit
        gas = np.where(pace > 0, change, (1 - share) * change)
        return cls(level, rate, share, power, gas, pace, 1 / unit)

    @property
    def drift(self) -> np.ndarray:
        """Change of b over b."""
        return self.gas / (1 - self.share)

    def currents(self, gas: np.ndarray) -> np.ndarray:
        """Currents at the nodes over the mean, one column a set; `gas` is ∫ P dt over the mean."""
        changed = gas_changed(self.pace if np.any(self.pace) else np.zeros(1))
        lost = (1 - self.share) * gas[:, None] + self.gas * changed
        return node_currents(self.level, self.share * self.rate, self.power, self.rate * lost)


def node_currents(level, quadratic, power, lost, xp=np):
    """Currents at the nodes over the mean, (14, m), as of `closed_form` with W = ∫ exp(-c B) ds,
    where B is what is lost to gas up to each node.
    """
    c, lost = 1 + power, xp.clip(lost, -200, 200)  # a factor that no beam has, and no overflow
    whole = INTEGRAL @ xp.exp(-c * lost)
    # Where a loss that is no beam's would have ended the record the law has no value.
    inside = c * quadratic * level**c
    least = (1e-3 - 1) / xp.where(inside == 0, 1.0, inside)
    whole = xp.where(inside * whole < 1e-3 - 1, least, whole)
    return closed_form(level, quadratic, power, lost, whole, xp)


def log_prior(power, xp=np):
    """Log density of exponents, and of its flat part alone."""
    width = xp.where(power < 0, BELOW, ABOVE)
    usual = xp.exp(-0.5 * (power / width) ** 2) / (np.sqrt(np.pi / 2) * (BELOW + ABOVE))
    odd = ODD / (MOST - LEAST)
    return xp.log((1 - ODD) * usual + odd), np.log(odd)


def log_straight(change):
    """Log density of straight changes of the gas."""
    return -0.5 * (change / DRIFT) ** 2 - math.log(DRIFT * math.sqrt(2 * math.pi))


def log_pumped(share, gas, pace, xp=np):
    """Log density of gas that is pumped away, and of its pace, with the odds of there being any."""
    size = gas / xp.expm1(-pace)  # of its loss at first
    inside = (size > SIZES[0]) & (size < SIZES[1]) & (-gas < pace * (1 - share))  # some is left
    width = math.log(SIZES[1] / SIZES[0]) * math.log(TIMES[1] / TIMES[0])
    density = math.log(OUTGASSING / SMOOTH / width) - xp.log(xp.where(inside, -gas, 1.0) * pace)
    return xp.where(inside, density, -np.inf)
