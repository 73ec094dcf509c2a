"""A posterior as rows of text: what terminal, notebook and report all show."""

from __future__ import annotations

import math
from html import escape
from importlib.metadata import version
from typing import TYPE_CHECKING

import numpy as np

from beamfit.quantity import display_unit
from beamfit.sampling.likelihood import Group, Likelihood  # noqa: F401 - Group for the example

if TYPE_CHECKING:
    from beamfit.sampling.posterior import Posterior

__all__ = [
    "HEADER",
    "as_html",
    "as_text",
    "diagnostic_rows",
    "in_unit",
    "interval_rows",
    "noise_words",
    "plain_name",
]

HEADER = ["", "median", "68 % interval", "95 % interval"]
# A table of more numbers is cut, and says so.
MOST_ROWS = 40


def plain_name(name: str) -> str:
    """Write a name as words.

    Examples
    --------
    >>> plain_name("x.normalized_emittance")
    'x normalised emittance'
    """
    return name.replace(".", " ").replace("_", " ").replace("normalized", "normalised")


def in_unit(values: np.ndarray, unit: str) -> tuple[np.ndarray, str]:
    """Values in a unit in which they are easily read, and that unit.

    Examples
    --------
    >>> in_unit(np.array([7e-7]), "m")[1], in_unit(np.array([7e-8]), "1/s")[1]
    ('µm', '1e-8 1/s')
    """
    size = float(np.quantile(np.abs(values), 0.98))
    factor, shown = display_unit(size, unit)
    if unit != "m" and size > 0 and not 1e-3 <= size < 1e5:
        power = math.floor(math.log10(size))
        factor, shown = 10.0**power, f"1e{power} {shown}".strip()
    return values / factor, shown.replace("^2", "²")


def interval_rows(posterior: Posterior) -> list[list[str]]:
    """One row a number: median and intervals, with the digits that their width allows.

    Parameters
    ----------
    posterior : Posterior
        The posterior.

    Returns
    -------
    list of list of str
        Below `HEADER`.
    """
    rows = []
    for name in posterior.shown[:MOST_ROWS]:
        found = posterior.quantiles(name)
        label = plain_name(name)
        if not np.isfinite(found).all():
            rows.append([label, "not determined", "-", "-"])
            continue
        (low, one, middle, other, high), unit = in_unit(found, posterior.unit(name))
        label = f"{label}, {unit}" if unit else label
        width = 0.5 * (other - one)
        places = 4 if width <= 0 else min(max(1 - math.floor(math.log10(width)), 0), 12)

        def text(value: float, places: int = places) -> str:
            return f"{value:.{places}f}"

        if name in posterior.held:
            rows.append([label, "not determined", "the prior's", "the prior's"])
        elif posterior.apart:
            rows.append([label, "not determined", "walkers disagree", "walkers disagree"])
        else:
            spans = [f"{text(one)} to {text(other)}", f"{text(low)} to {text(high)}"]
            rows.append([label, text(middle), *spans])
    left = len(posterior.shown) - MOST_ROWS
    return [*rows, [f"and {left} more", "", "", ""]] if left > 0 else rows


def diagnostic_rows(posterior: Posterior) -> list[tuple[str, list[str]]]:
    """How the draws were made and what they are worth.

    Parameters
    ----------
    posterior : Posterior
        The posterior.

    Returns
    -------
    list of (str, list of str)
        Label and cell.
    """
    d = posterior.diagnostics
    rows = [
        ("status", posterior.status.value.replace("_", " ")),
        ("errors of the points", noise_words(posterior.target.likelihood)),
        ("priors", "; ".join(f"{n}: {p}" for n, p in posterior.priors.items()) or "flat"),
    ]
    if d.steps:
        rows += [
            ("draws", f"{d.steps} steps of {d.walkers} walkers after {posterior.warmup} left out"),
            ("effective draws, fewest", f"{np.min(d.effective):.0f}"),
            ("autocorrelation time, longest", f"{np.max(d.autocorrelation):.1f} steps"),
            ("split R-hat, largest", f"{np.max(d.rhat):.4f}"),
            ("proposals accepted", f"{100 * posterior.acceptance:.0f} %"),
            ("seed", str(posterior.seed)),
            ("sampler", f"emcee {version('emcee')}"),
        ]
    return [(label, [cell]) for label, cell in rows]


def noise_words(likelihood: Likelihood) -> str:
    """Say of each group of points what is taken of its errors.

    Examples
    --------
    >>> noise_words(Likelihood((Group("x", "inferred"), Group("y"))))
    'x inferred from the residuals; y as stated'
    """
    said = []
    for group in likelihood.groups:
        words = "inferred from the residuals" if group.noise == "inferred" else "as stated"
        said.append(words + (", with outliers" if group.outliers else ""))
    if len(set(said)) == 1:
        return said[0]
    labels = (group.label for group in likelihood.groups)
    return "; ".join(f"{label} {words}" for label, words in zip(labels, said, strict=True))


def as_text(posterior: Posterior) -> str:
    """A table for a terminal."""
    rows = [HEADER, *interval_rows(posterior)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(HEADER))]
    lines = [f"{posterior.status}: {posterior.message}"]
    for row in rows:
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def as_html(posterior: Posterior) -> str:
    """A table for a notebook."""
    head = "".join(f"<th>{escape(cell)}</th>" for cell in HEADER)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>"
        for row in interval_rows(posterior)
    )
    said = f"<p><b>{posterior.status}</b>: {escape(posterior.message)}</p>"
    return f"{said}<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
