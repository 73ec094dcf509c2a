"""Read HDF5, MATLAB, SDDS and image files by their libraries, in a child process.

On a damaged file these libraries may crash, never end or fill the memory; the child process turns
that into an error of one line.
"""

from __future__ import annotations

import io
import math
import os
import pickle
import re
import resource
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from importlib.util import find_spec
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from beamfit.errors import InputError, plain
from beamfit.io.cells import check_length
from beamfit.io.columns import SETTINGS, known_unit, name_with_unit, standard_header, unit_at_end
from beamfit.io.files import digest_now, read_bytes
from beamfit.particles import LIGHT

# Largest CPU time in s, and largest memory in bytes, for reading a file.
MAX_SECONDS, MAX_MEMORY = 10, 1_000_000_000
# One more second of wall time is allowed per this many bytes, for a busy machine.
BYTES_PER_SECOND = 10_000_000
CHILD_CODE = "from beamfit.io.isolated import child_main; child_main(0, 1)"
# Signals that end a child process at its limit of time.
TIME_SIGNALS = (-signal.SIGXCPU, -signal.SIGKILL)
# Numbers of the filters of every HDF5 library (deflate, shuffle, fletcher32) and of h5py (lzf).
HDF5_FILTERS = {1, 2, 3, 32000}
# Datasets of a stack of images, and of its pixel width in um.
IMAGES, PIXEL = "images", "pixel_um"
# Attributes are cut to this many characters as comments: some hold a whole log.
MAX_COMMENT = 1000
OWN_NUMBERS_TEXT = "datasets that hold their numbers in this file"
MATLAB_TEXT = (
    "a MATLAB file of version 5 to 7: save(name, 'data', '-v7'), or columns as CSV, by writetable"
)
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
# Numeric classes of MATLAB.
NUMERIC = {f"{u}int{n}" for u in ("", "u") for n in (8, 16, 32, 64)}
NUMERIC |= {"double", "single", "logical"}
SDDS_HEAD = re.compile(rb"&data\b.*?&end[^\n]*\n", re.DOTALL)
# Endings of the names of magnet settings.
SETTING_SUFFIXES = tuple(f"_{unit}" for unit in SETTINGS)
# Values by name, units by name, comments.
Columns = tuple[dict[str, Sequence[Any]], dict[str, str], list[str]]


def run_isolated(
    library: str, path: str | PathLike[str], expected: str, read: Callable[..., Any], *given: Any
) -> Any:
    """Call a function in a child process with limits of time and memory.

    Parameters
    ----------
    library : str
        Name of the library, for messages.
    path : str or path
        The file, for messages.
    expected : str
        Expected kind of file, for messages.
    read : callable
        A module-level function.
    *given
        Its arguments, such as the content of the file.

    Returns
    -------
    object
        Its result.

    Raises
    ------
    InputError
        As the function, with the path; and if the process crashes or exceeds its limits.

    Examples
    --------
    >>> run_isolated("Python", "a.txt", "a number", float, "2.5")
    2.5
    """
    request = pickle.dumps((read, given))
    # No HDF5 filters from plugin folders; the same import path as here.
    own = {"HDF5_PLUGIN_PRELOAD": "::", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    try:
        child = subprocess.run(
            [sys.executable, "-P", "-c", CHILD_CODE],
            input=request,
            capture_output=True,
            env=os.environ | own | {"OPENBLAS_NUM_THREADS": "1"},
            timeout=MAX_SECONDS + len(request) / BYTES_PER_SECOND,
            start_new_session=True,
            check=True,
        )
        # Unpickling is safe: the child runs this package with the user's own rights.
        found, failure = pickle.loads(child.stdout)
    except (subprocess.TimeoutExpired, subprocess.CalledProcessError) as error:
        is_late = getattr(error, "returncode", TIME_SIGNALS[0]) in TIME_SIGNALS
        damaged = f"a file that is not {library}, or is damaged"
        slow = f"a file that {library} does not read within {MAX_SECONDS} s"
        raise InputError(slow if is_late else damaged, expected, path) from None
    except (pickle.UnpicklingError, EOFError, ValueError, TypeError, IndexError):
        raise InputError(
            f"a damaged file, of which {library} makes nothing", expected, path
        ) from None
    if failure is not None:
        found, expected, error_path, line, column = failure
        raise InputError(found, expected, error_path or path, line, column)
    return found


def child_main(stdin: int, stdout: int) -> None:
    """Run the request of `run_isolated`; the main function of the child process."""
    with open(stdin, "rb") as stream:
        read, arguments = pickle.load(stream)
    with os.fdopen(os.dup(stdout), "wb") as stream_out:
        os.dup2(2, stdout)  # a library may print
        run_limited(read, arguments, stream_out)


def run_limited(read: Callable[..., Any], arguments: tuple[Any, ...], output: BinaryIO) -> None:
    """Call a function within the limits, and write its result or error."""
    pages = Path("/proc/self/statm")
    used = int(pages.read_text().split()[0]) * resource.getpagesize() if pages.exists() else 0
    resource.setrlimit(resource.RLIMIT_AS, (used + MAX_MEMORY, used + MAX_MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, (MAX_SECONDS, MAX_SECONDS))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        found = read(*arguments), None
    except InputError as error:
        found = None, (error.found, error.expected, error.path, error.line, error.column)
    except MemoryError:
        found_text = f"a file that takes more than {MAX_MEMORY // 1_000_000} MB to read"
        found = None, (found_text, "a smaller one", None, None, None)
    pickle.dump(found, output, protocol=pickle.HIGHEST_PROTOCOL)


def library_columns(
    path: str | PathLike[str], library: str, rows: int, texts: int
) -> tuple[dict[str, Sequence[Any]], tuple[str, ...]]:
    """Read the columns of an HDF5 or SDDS file.

    Parameters
    ----------
    path : str or path
        The file.
    library : {"HDF5", "SDDS"}
        The library. Columns are the datasets at the top of an HDF5 file, or the columns of an
        SDDS file; one with parameters only has a row for each page.
    rows, texts : int
        Largest number of values in a column of numbers, and of texts.

    Returns
    -------
    dict of str to array or list of str, tuple of str
        Values by name, and attributes or parameters of the file.

    Raises
    ------
    InputError
        If soliday-sdds is not installed, the file is damaged or too large, has several pages of
        columns, or a dataset is no column, has its numbers in another file or needs a filter that
        is not part of HDF5.
    """
    if library == "SDDS" and find_spec("sdds") is None:
        expected = "pip install 'beamfit[sdds]', or a table: sdds2spreadsheet writes one"
        raise InputError("an SDDS file, which needs soliday-sdds to read", expected, path)
    read, expected = LIBRARIES[library]
    content = read_bytes(path, f"{expected.partition(';')[0]} of readings; fewer of them")
    return _add_units(path, *run_isolated(library, path, expected, read, content, rows, texts))


def _add_units(
    path: str | PathLike[str],
    columns: Mapping[str, Sequence[Any]],
    units: Mapping[str, str],
    comments: Sequence[str],
) -> tuple[dict[str, Sequence[Any]], tuple[str, ...]]:
    """Add the units of attributes to the names of columns, which may not have others."""
    found = {}
    for header, values in columns.items():
        name, unit = plain(header), units.get(header, "")
        header_unit, unit_name = unit_at_end(standard_header(name)), known_unit(unit)
        has_unit = unit.strip() not in ("", "1", "none", "dimensionless")
        if has_unit and header_unit is None:
            name = name_with_unit(name, unit_name or unit)
        elif has_unit and unit_name != header_unit:
            expected = f"one unit, {header_unit} or the attribute's"
            raise InputError(f"the attribute units = '{unit}'", expected, path, column=name)
        found[name] = values
    return found, tuple(comments)


def hdf5_content(content: bytes, rows: int, texts: int) -> Columns:
    """Read the datasets of an HDF5 file; called in the child process."""
    import h5py

    with h5py.File(io.BytesIO(content), "r") as store:
        if "openPMD" in store.attrs:
            return _openpmd(store, rows), {}, []
        group = _dataset_group(store)
        if IMAGES in (names := _dataset_names(group)):
            return _projections(group, names, rows, texts), {}, []
        columns = {name: _column(group, name, rows, texts) for name in names}
        units = {name: _attribute_unit(group[name], name) for name in columns}
        comments = [f"{key}: {value}"[:MAX_COMMENT] for key, value in store.attrs.items()]
    return columns, units, comments


def _projections(
    group: Any, names: Sequence[str], rows: int, texts: int
) -> dict[str, Sequence[Any]]:
    """Projections of a stack of images, with a row for each bin."""
    data = group[IMAGES]
    _check_stored(data, IMAGES)
    if len(data.shape or ()) != 3 or data.dtype.kind not in "iuf":
        found = f"a dataset of shape {data.shape}, type {data.dtype}"
        raise InputError(found, "images of shape (n, rows, columns)", column=IMAGES)
    if PIXEL not in names:
        raise InputError(f"images and no dataset {PIXEL}", "the width of a pixel", column=IMAGES)
    count, bins = data.shape[0], max(data.shape[1:])
    check_length(count * bins, rows, column=IMAGES)
    others = {n: _column(group, n, rows, texts) for n in names if n not in (IMAGES, PIXEL)}
    for name, values in others.items():
        if len(values) != count:
            raise InputError(f"{len(values)} values", f"{count}, one an image", column=name)
    pixel = np.full(count, float(np.ravel(group[PIXEL][()])[0]))
    columns = columns_of_images([projections(np.asarray(image, float)) for image in data], pixel)
    shots = columns["shot"]
    return columns | {name: [values[i] for i in shots] for name, values in others.items()}


def projections(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project an image on x and y."""
    return image.sum(axis=0), image.sum(axis=1)


def columns_of_images(
    projected: Sequence[tuple[np.ndarray, np.ndarray]], pixel_um: np.ndarray
) -> dict[str, np.ndarray]:
    """Columns of projections on x and y, a row for each bin; the shorter one ends with NaN."""
    bins = [max(map(len, planes)) for planes in projected]
    shot = np.repeat(np.arange(len(projected)), bins)
    position = np.concatenate([np.arange(n) for n in bins])
    columns = {"shot": shot, "position_um": position * pixel_um[shot]}
    for i, plane in enumerate("xy"):
        columns[f"counts_{plane}"] = np.concatenate([
            np.pad(planes[i], (0, n - len(planes[i])), constant_values=np.nan)
            for planes, n in zip(projected, bins, strict=True)
        ])  # fmt: skip
    return columns


def _openpmd(store: Any, rows: int) -> dict[str, Sequence[Any]]:
    """Row of each openPMD particle group: rms sizes, mean momentum, settings from attributes."""
    beams: list[Any] = []
    store.visititems(lambda _, node: beams.append(node) if _is_beam(node) else None)
    lines = [_beam_row(beam, rows) for beam in beams]
    return {name: [row.get(name, "") for row in lines] for name in (lines[0] if lines else ())}


def _is_beam(node: Any) -> bool:
    """True if a node of a file is an openPMD particle group."""
    return hasattr(node, "keys") and {"position", "momentum"} <= set(node)


def _beam_row(beam: Any, rows: int) -> dict[str, Any]:
    """Row of one openPMD particle group."""
    place, momentum = beam["position"], [_openpmd_values(beam["momentum"], k, rows) for k in "xyz"]
    weight = _openpmd_values(beam, "weight", rows) if "weight" in beam else np.ones(1)
    attributes = {**beam.parent.attrs, **beam.attrs}
    row = {name: float(v) for name, v in attributes.items() if name.endswith(SETTING_SUFFIXES)}
    if (name := attributes.get("latticeElementName")) is not None or not row:
        row["screen"] = name.decode() if isinstance(name, bytes) else name or beam.parent.name[1:]
    for plane in "xy":
        values, weights = np.broadcast_arrays(_openpmd_values(place, plane, rows), weight)
        mean = np.average(values, weights=weights)
        row[f"size_{plane}_m"] = math.sqrt(np.average((values - mean) ** 2, weights=weights))
    row["momentum_MeV"] = float(np.mean(np.linalg.norm(np.broadcast_arrays(*momentum), axis=0)))
    row["momentum_MeV"] *= LIGHT / 1.602176634e-13  # from kg m/s
    return row


def _openpmd_values(group: Any, name: str, rows: int) -> np.ndarray:
    """Numbers of an openPMD record in SI; a constant record has its value as attribute."""
    record = group[name]
    constant = hasattr(record, "keys")
    values = record.attrs["value"] if constant else _column(group, name, rows, 0)
    return np.atleast_1d(np.asarray(values, float)) * float(record.attrs.get("unitSI", 1.0))


def _dataset_group(store: Any) -> Any:
    """Group that holds the datasets: the top, or its only sub-group."""
    import h5py

    only_name = next(iter(store)) if len(store) == 1 else None
    if only_name is None or not isinstance(store.get(only_name, getlink=True), h5py.HardLink):
        return store
    return store[only_name] if store.get(only_name, getclass=True) is h5py.Group else store


def _dataset_names(store: Any) -> list[str]:
    """Names of the datasets of a group; links are refused, as they may lead to other files."""
    import h5py

    names = []
    for name in store:
        if not isinstance(store.get(name, getlink=True), h5py.HardLink):
            raise InputError("a link", OWN_NUMBERS_TEXT, column=name)
        if store.get(name, getclass=True) is h5py.Dataset:
            names.append(name)
    return names


def _column(store: Any, name: str, rows: int, texts: int) -> list[str] | np.ndarray:
    """Values of a dataset; its shape, type and size are checked before it is read."""
    import h5py

    data = store[name]
    _check_stored(data, name)
    is_text = h5py.check_string_dtype(data.dtype) is not None
    if data.shape is None or data.size != max(data.shape, default=1):
        raise InputError(
            f"a dataset of shape {data.shape}", "a one-dimensional dataset", column=name
        )
    if not is_text and data.dtype.kind not in "iuf":
        raise InputError(f"values of type {data.dtype}", "numbers or text", column=name)
    check_length(data.size, texts if is_text else rows, column=name)
    if not is_text:
        return np.ravel(data[()]).astype(float)
    try:
        return [str(value) for value in np.ravel(data.asstr("utf-8")[()])]
    except UnicodeDecodeError:
        raise InputError("bytes that are not text", "UTF-8 text", column=name) from None


def _check_stored(data: Any, name: str) -> None:
    """Refuse numbers in other files, and filters that are not part of HDF5."""
    properties = data.id.get_create_plist()
    filters = {properties.get_filter(i)[0] for i in range(properties.get_nfilters())}
    if data.is_virtual or properties.get_external_count():
        raise InputError("numbers in another file", OWN_NUMBERS_TEXT, column=name)
    if not filters <= HDF5_FILTERS:
        allowed = "gzip, lzf, shuffle, fletcher32 or none"
        raise InputError(f"a filter of number {min(filters - HDF5_FILTERS)}", allowed, column=name)


def _attribute_unit(data: Any, name: str) -> str:
    """Unit in the attributes of a dataset; a scale factor or offset is refused."""
    attributes = {str(key).lower(): value for key, value in data.attrs.items()}
    for key, neutral in (("scale_factor", 1.0), ("add_offset", 0.0)):
        if key in attributes and not np.all(np.asarray(attributes[key]) == neutral):
            raise InputError(
                f"the attribute {key} = {attributes[key]}", "numbers that contain it", column=name
            )
    unit = next((attributes[key] for key in ("units", "unit", "egu") if key in attributes), "")
    return str(unit.decode("utf-8", "replace") if isinstance(unit, bytes) else unit)[:40]


def matlab_variables(path: str | PathLike[str], name: str = "") -> dict[str, np.ndarray]:
    """Read a variable of a MATLAB file; without one of that name, all vectors of numbers.

    Parameters
    ----------
    path : str or path
        A file of version 5 to 7.
    name : str
        The variable.

    Returns
    -------
    dict of str to ndarray
        The variable as SciPy reads it; or all vectors of at least two numbers, flat.

    Raises
    ------
    InputError
        If the file is of another kind, damaged or too large.

    Examples
    --------
    >>> import pathlib, scipy.io, tempfile
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "a.mat"
    >>> scipy.io.savemat(file, {"size_x_um": [90.0, 60.0], "note": "noon"})
    >>> matlab_variables(file, "data")["size_x_um"].tolist()
    [90.0, 60.0]
    """
    return _cached_variables(os.fspath(path), name, digest_now(path))


@lru_cache(maxsize=1)  # a file of emittance_gui is read several times
def _cached_variables(path: str, name: str, sha256: str) -> dict[str, np.ndarray]:
    """Read variables of a MATLAB file; cached by the digest of the file."""
    content = read_bytes(path, MATLAB_TEXT)
    if HDF5_SIGNATURE in (content[:8], content[512:520]):
        raise InputError("a MATLAB file of version 7.3", MATLAB_TEXT, path)
    if content[126:128] not in (b"IM", b"MI"):
        raise InputError("no MATLAB file of version 5 to 7", MATLAB_TEXT, path)
    return run_isolated("MATLAB's", path, MATLAB_TEXT, matlab_content, content, name)


def matlab_content(content: bytes, name: str) -> dict[str, np.ndarray]:
    """Read variables of a MATLAB file; called in the child process."""
    from scipy.io import loadmat, whosmat

    shapes = {
        n: shape for n, shape, kind in whosmat(io.BytesIO(content)) if kind in NUMERIC or n == name
    }
    wanted = [n for n, shape in shapes.items() if n == name or math.prod(shape) == max(shape) > 1]
    wanted = [name] if name in wanted else wanted
    found = loadmat(io.BytesIO(content), variable_names=wanted)
    if name in wanted:
        return {name: found[name]}
    return {n: found[n].ravel().astype(float) for n in wanted if found[n].dtype.kind in "biuf"}


def sdds_content(content: bytes, rows: int, texts: int) -> Columns:
    """Read an SDDS file; called in the child process."""
    if b"&include" in content:
        raise InputError(
            "an SDDS file with &include", "a file that is whole: sddsconvert makes one"
        )
    data = _sdds_loaded(content)
    # The library stops silently at a page that it cannot read. Appending the data once more doubles
    # the number of pages only if all were read.
    head = SDDS_HEAD.search(content).end()
    whole, gap = content, b""
    if data.mode == data.SDDS_ASCII:
        whole, gap = content.rstrip() + b"\n", b"\n" * (b"no_row_counts=1" in content[:head])
    if _sdds_loaded(whole + gap + whole[head:]).loaded_pages != 2 * data.loaded_pages:
        expected = "as many rows as it announces: sddscheck and sddsconvert -recover mend it"
        raise InputError("an SDDS file with another number of rows than it announces", expected)
    parameters, columns = (
        {name: (_sdds_unit(about[1]), pages) for name, about, pages in zip(*held, strict=True)}
        for held in (
            (data.parameterName, data.parameterDefinition, data.parameterData),
            (data.columnName, data.columnDefinition, data.columnData),
        )
    )
    comments = [f"{name}: {pages[0]} {unit}".strip() for name, (unit, pages) in parameters.items()]
    if columns and (count := data.loaded_pages) != 1:
        raise InputError(f"{count} pages", "one; sddscombine -merge makes one of all")
    held = {n: (unit, pages[0]) for n, (unit, pages) in columns.items()} or parameters
    found = {name: _sdds_values(name, values, rows, texts) for name, (_, values) in held.items()}
    return found, {name: unit for name, (unit, _) in held.items()}, comments if columns else []


def _sdds_loaded(content: bytes) -> Any:
    """Load all readable pages of a file."""
    import sdds

    with tempfile.NamedTemporaryFile() as file:
        file.write(content)
        file.flush()
        return sdds.load(file.name)


def _sdds_values(name: str, values: list[Any], rows: int, texts: int) -> Sequence[Any]:
    """Values of a column or parameter: texts, or numbers as an array."""
    is_text = bool(values) and isinstance(values[0], str)
    check_length(len(values), texts if is_text else rows, column=name)
    return values if is_text else np.array(values, float)


def _sdds_unit(unit: str) -> str:
    """Unit without SDDS markup of exponents and indices: 1/m$a2$n becomes 1/m^2."""
    return re.sub(r"\$[bne]", "", unit.replace("$a", "^"))


# Library -> function of the child process, and the expected kind of file.
LIBRARIES = {
    "HDF5": (hdf5_content, "an HDF5 file; text is .csv"),
    "SDDS": (sdds_content, "an SDDS file; sdds2spreadsheet writes a table"),
}
