"""Lifetime from a decay record: I0, a and b, and what the record could not tell."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from beamfit.errors import InputError
from beamfit.studies.decay.model import padded, padded_size, solve_decay, solve_decays
from beamfit.studies.decay.record import DecayRecord
from beamfit.studies.decay.result import DecayFit
from beamfit.studies.decay.verdict import judge, judge_constant

__all__ = ["fit_decay", "fit_decays"]

FEWEST = 5
# Records solved in one call; fewer are filled up, so that one number is compiled.
TOGETHER = 16


def fit_decay(record: DecayRecord, shape: Callable[[Any], Any] | None = None) -> DecayFit:
    """Fit the decay law to one decay.

    Parameters
    ----------
    record : DecayRecord
        One decay, without refills or steps: cut others with `split_record` first.
    shape : callable, optional
        How a depends on the current in mA, up to a factor, where it is not constant; for
        example `beamfit.lifetime.touschek.touschek_shape(ring, operation)`. The rate equation is
        then integrated, and `a` is the value at the mean current.

    Returns
    -------
    DecayFit
        Values, errors, and a verdict. A record from which nothing can be learned is a result
        with the status `unidentified`, not an error.

    Raises
    ------
    InputError
        If the record has fewer than five readings, or rises.

    Notes
    -----
    Least squares with report equation 44, or with equation 42 if `shape` is given. Errors are
    those of the linearised problem.

    Examples
    --------
    >>> import numpy as np
    >>> from beamfit.lifetime.decay import current
    >>> t = np.linspace(0, 8 * 3600, 1000)
    >>> noise = 1e-3 * np.random.default_rng(1).normal(size=t.size)
    >>> fit = fit_decay(DecayRecord(t, np.array(current(t, 500.0, 2e-8, 1e-6)) + noise))
    >>> print(fit.status, fit.lifetime_mean)
    converged 28.704763 ± 0.000026 h
    """
    if _says_nothing(record):
        return judge_constant(record)
    if shape is not None:
        shaped = judge(record, solve_decay(*padded(record), shape=shape))
        return replace(shaped, shaped=True)
    return judge(record, solve_decay(*padded(record)))


def fit_decays(records: Sequence[DecayRecord]) -> tuple[DecayFit, ...]:
    """Fit many decays; records of similar length are solved together.

    Parameters
    ----------
    records : sequence of DecayRecord
        As for `fit_decay`.

    Returns
    -------
    tuple of DecayFit
        In the order of the records.

    Raises
    ------
    InputError
        As for `fit_decay`.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.linspace(0, 36000, 50)
    >>> records = [DecayRecord(t, i0 / (1 + i0 * 1e-8 * t)) for i0 in (100.0, 200.0)]
    >>> [f"{fit.a.value:.3e}" for fit in fit_decays(records)]
    ['1.000e-08', '1.000e-08']
    """
    fits: dict[int, DecayFit] = {}
    groups: dict[int, list[int]] = {}
    for k, record in enumerate(records):
        if _says_nothing(record):
            fits[k] = judge_constant(record)
        else:
            groups.setdefault(padded_size(len(record)), []).append(k)
    for members in groups.values():
        for first in range(0, len(members), TOGETHER):
            chosen = members[first : first + TOGETHER]
            rows = [padded(records[k]) for k in chosen]
            rows += rows[:1] * (TOGETHER - len(chosen))
            stacked = [np.stack(arrays) for arrays in zip(*rows, strict=True)]
            solutions = solve_decays(*stacked)
            for row, k in enumerate(chosen):
                one = jax.tree.map(lambda leaf, r=row: leaf[r], solutions)
                fits[k] = judge(records[k], one)
    return tuple(fits[k] for k in range(len(records)))


def _says_nothing(record: DecayRecord) -> bool:
    """Whether all readings are equal; a record too short for any fit is an error."""
    if len(record) < FEWEST:
        expected = f"{FEWEST} or more for a decay"
        raise InputError(f"{len(record)} readings", expected, path=record.name)
    return bool(np.ptp(record.current) == 0)
