"""Job of a batch: the fit of each file, and its rows in the table of answers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import beamfit
from beamfit.batch.columns import (
    COLUMNS,
    KEY_COLUMNS,
    UNUSABLE,
    csv_text,
    decay_row,
    emittance_rows,
    lifetime_rows,
)
from beamfit.compile_cache import usual_arithmetic
from beamfit.errors import InputError
from beamfit.io.decay_record import read_lifetime_input
from beamfit.io.files import digest
from beamfit.io.lattice import LatticeFile
from beamfit.io.line import Inputs, build_line, read_inputs, read_lattice
from beamfit.io.priors import read_noise
from beamfit.lifetime.record import LifetimeTable
from beamfit.noise.learn import Learned, learn_noise
from beamfit.noise.model import Noise

if TYPE_CHECKING:
    from beamfit.emittance.scan import QuadScan
    from beamfit.optics.beamline import Beamline


class _Lattice(NamedTuple):
    """Lattice file, and the beam line built from it."""

    file: LatticeFile
    line: Beamline


@lru_cache(maxsize=4)  # scans of one line share the built line
def _lattice(path: str, sha256: str, part: tuple[tuple[str, Any], ...]) -> _Lattice:
    """Read and build a lattice; raise if the file has changed since the start of the batch."""
    file = read_lattice(path, **dict(part))
    if file.sha256 != sha256:
        raise InputError("a lattice that was changed meanwhile", "the one of the start", path=path)
    return _Lattice(file, build_line(file))


@dataclass(frozen=True)
class Job:
    """Fit that a batch applies to every file: kind, line, options.

    Parameters
    ----------
    kind : {"emittance", "lifetime"}
        Kind of files.
    lattice : str, optional
        Lattice file of the scans; not needed for rows with their own matrices.
    part : mapping
        ``use, energy, particle, first, last, screen`` of `beamfit.io.line.read_inputs`.
    reading : mapping
        Options of the readers: ``columns, ignore, skip_bad``.
    weights : {"model", "measured"}
        As for `beamfit.fit_emittance`.
    noise : str, optional
        File of priors on the noise of sizes; default: beamfit's own.

    Raises
    ------
    InputError
        If the lattice cannot be read.

    Examples
    --------
    >>> Job("emittance", "lattices/lcls_otr2.toml").kind
    'emittance'
    """

    kind: str
    lattice: str | None = None
    part: Mapping[str, Any] = field(default_factory=dict)
    reading: Mapping[str, Any] = field(default_factory=dict)
    weights: str = "model"
    lattice_sha256: str = ""
    noise: str | None = None
    version: str = beamfit.__version__

    def __post_init__(self) -> None:
        for name in ("part", "reading"):
            given = {k: v for k, v in getattr(self, name).items() if v not in (None, (), False)}
            object.__setattr__(self, name, given)
        if self.lattice is not None and not self.lattice_sha256:
            found = read_lattice(self.lattice, **self.part).sha256
            object.__setattr__(self, "lattice_sha256", found)

    @property
    def key(self) -> tuple[str, str, str]:
        """Inputs of an answer in addition to the file: lattice, options, version."""
        options = {**self.part, **self.reading, "weights": self.weights}
        options |= {} if self.noise is None else {"noise": digest(self.noise)}
        texts = (f"{k}={' '.join(v) if isinstance(v, tuple) else v}" for k, v in options.items())
        return self.lattice_sha256, ", ".join(texts), self.version

    def answer(self, files: Sequence[str]) -> str:
        """Fit files, and return lines of CSV; a file that fails has a row with the reason."""
        if beamfit.__version__ != self.version:
            raise InputError(f"beamfit {beamfit.__version__} on a worker", f"{self.version} there")
        try:
            found = self._emittances(files) if self.kind == "emittance" else self._decays(files)
            with usual_arithmetic():
                return self._csv(found)
        except Exception as error:
            if len(files) > 1:
                return "".join(self.answer([file]) for file in files)
            reason = f"an error in beamfit, please report it: {type(error).__name__}: {error}"
            return self.refused(files[0], reason)

    def refused(self, file: str, reason: str) -> str:
        """Line of CSV for a file without an answer."""
        return self._csv([_unusable_row(file, reason)])

    def _csv(self, rows: Iterable[dict[str, Any]]) -> str:
        """Write rows, with the key of the job, as lines of CSV."""
        key = dict(zip(KEY_COLUMNS[2:], self.key, strict=True))
        return csv_text((row | key for row in rows), COLUMNS[self.kind])

    def read(self, file: str) -> Inputs:
        """Read a scan and its lattice."""
        if self.lattice is None:
            return read_inputs(file, **self.part, **self.reading)
        return read_inputs(file, self._line().file, **self.reading)

    def _line(self) -> _Lattice:
        return _lattice(self.lattice, self.lattice_sha256, tuple(self.part.items()))

    def line_of(self, inputs: Inputs) -> Beamline:
        """Beam line of a scan, built only once if all scans share it."""
        is_shared = self.lattice is not None and inputs.lattice is self._line().file
        return self._line().line if is_shared else build_line(inputs.lattice)

    def fit(self, file: str) -> Any:
        """Fit one file, and return the result for `beamfit.write_report`."""
        if self.kind == "lifetime":
            from beamfit.lifetime.study import study_record

            return (study_record(read_lifetime_input(file, **self.reading)),)
        from beamfit.emittance.slices import fit_slices

        inputs = self.read(file)
        fit = fit_slices if len(inputs.scan.slices) > 1 else beamfit.fit_emittance
        return fit(inputs.scan, self.line_of(inputs), weights=self.weights, noise=self._priors)

    @property
    def _priors(self) -> Noise:
        return Noise() if self.noise is None else read_noise(self.noise)

    def learned_noise(self, files: Sequence[str]) -> Learned:
        """Learn priors on the noise from all scans that certainly show a beam.

        Raises
        ------
        InputError
            If there are fewer than five planes of a kind.
        """
        from beamfit.emittance.fit import noise_samples

        read = (_result_or_error(self.read, file) for file in files)
        whole = (r for r in read if isinstance(r, Inputs) and len(r.scan.slices) < 2)
        pairs = [(inputs.scan, self.line_of(inputs)) for inputs in whole]
        source = f"learned from {len(pairs)} scans by beamfit {self.version}"
        return learn_noise(list(noise_samples(pairs, self._priors)), self._priors, source)

    def _emittances(self, files: Iterable[str]) -> Iterator[dict[str, Any]]:
        """Rows of scans; all of them are fitted together."""
        from beamfit.emittance.fit import fit_many

        read = [_result_or_error(self.read, file) for file in files]
        scans = [_slices(found.scan) if isinstance(found, Inputs) else [] for found in read]
        pairs = []
        for found, own in zip(read, scans, strict=True):
            line = self.line_of(found) if own else None
            pairs += [(scan, line) for scan in own]
        fits = iter(fit_many(pairs, self.weights, self._priors))
        for file, found, own in zip(files, read, scans, strict=True):
            if isinstance(found, InputError):
                yield _unusable_row(file, str(found))
            for scan in own:
                fit, name = next(fits), scan.slices[0] if scan.slice else ""
                common = {"file": file, "sha256": found.scan.sha256, "slice": name}
                if isinstance(fit, InputError):
                    yield common | {"status": UNUSABLE, "message": str(fit)}
                else:
                    yield from (row | common for row in emittance_rows(fit))

    def _decays(self, files: Iterable[str]) -> Iterator[dict[str, Any]]:
        """Rows of decay records and lifetime tables."""
        for file in files:
            rows = _result_or_error(self._decay_rows, file)
            if isinstance(rows, InputError):
                yield _unusable_row(file, str(rows))
                continue
            common = {"file": file, "sha256": digest(file)}
            yield from (row | common for row in rows)

    def _decay_rows(self, file: str) -> list[dict[str, Any]]:
        """Rows of one decay record or lifetime table."""
        from beamfit.lifetime.lifetime_table import fit_lifetimes
        from beamfit.lifetime.study import study_record

        record = read_lifetime_input(file, **self.reading)
        if isinstance(record, LifetimeTable):
            return [decay_row(fit_lifetimes(record).to_json())]
        return list(lifetime_rows(study_record(record)))


def _slices(scan: QuadScan) -> list[QuadScan]:
    """Scan of each slice, or the scan itself without slices."""
    return [scan.of_slice(name) for name in scan.slices] if len(scan.slices) > 1 else [scan]


def _result_or_error(read: Callable[[str], Any], file: str) -> Any:
    """Result of a reader, or the `InputError` it raises."""
    try:
        return read(file)
    except InputError as error:
        return error


def _unusable_row(file: str, reason: str) -> dict[str, Any]:
    """Row of a file that cannot be used."""
    try:
        sha256 = digest(file)
    except InputError:  # the next run tries an unreadable file again
        sha256 = ""
    return {"file": file, "sha256": sha256, "status": UNUSABLE, "message": reason}
