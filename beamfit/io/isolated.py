"""Files that a library parses (HDF5, MATLAB, SDDS, images), read in a process of its own.

These libraries may crash, never end or fill the memory over a file with a few changed bits. That is
one line of error here.
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

# Seconds and bytes of memory that reading a file may take.
PATIENCE, ROOM = 10, 1_000_000_000
# Bytes for which a busy machine may have another second.
MUCH = 10_000_000
CHILD = "from beamfit.io.isolated import answer; answer(0, 1)"
# What a process ended by says that its time was over.
OVER = (-signal.SIGXCPU, -signal.SIGKILL)
# Filters that are part of every HDF5 library: deflate, shuffle, fletcher32, and h5py's own lzf.
FILTERS = {1, 2, 3, 32000}
# A stack of images, and the width of its pixels in µm.
IMAGES, PIXEL = "images", "pixel_um"
# Letters of an attribute that is kept as a comment; a whole log may stand in one.
LONGEST_COMMENT = 1000
ELSEWHERE = "datasets that hold their numbers in this file"
MATLAB = (
    "a MATLAB file of version 5 to 7: save(name, 'data', '-v7'), or columns as CSV, by writetable"
)
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
# Classes of MATLAB's arrays that are numbers.
NUMBERS = {f"{u}int{n}" for u in ("", "u") for n in (8, 16, 32, 64)}
NUMBERS |= {"double", "single", "logical"}
SDDS_HEAD = re.compile(rb"&data\b.*?&end[^\n]*\n", re.DOTALL)
# How the name of a magnet's setting ends.
SETTING_ENDS = tuple(f"_{unit}" for unit in SETTINGS)
# Values by name, the unit that the file says of each, and its comments.
Columns = tuple[dict[str, Sequence[Any]], dict[str, str], list[str]]


def isolated(
    library: str, path: str | PathLike[str], expected: str, read: Callable[..., Any], *given: Any
) -> Any:
    """Call a function that reads a file, in a process with bounds of time and memory.

    Parameters
    ----------
    library : str
        What reads it there, for messages.
    path : str or path
        The file, for messages.
    expected : str
        What it should be.
    read : callable
        A function of a module.
    *given
        Its arguments, such as the content of the file.

    Returns
    -------
    object
        What it gives.

    Raises
    ------
    InputError
        What it raises, with the file; and if the process crashes or comes to its bounds.

    Examples
    --------
    >>> isolated("Python", "a.txt", "a number", float, "2.5")
    2.5
    """
    asked = pickle.dumps((read, given))
    # No filter from a folder of plugins; the package's own libraries, wherever they are.
    own = {"HDF5_PLUGIN_PRELOAD": "::", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", CHILD],
            input=asked,
            capture_output=True,
            env=os.environ | own | {"OPENBLAS_NUM_THREADS": "1"},
            timeout=PATIENCE + len(asked) / MUCH,
            start_new_session=True,
            check=True,
        )
        # The process has this user's rights anyway: what it says may be unpickled.
        found, refused = pickle.loads(done.stdout)
    except (subprocess.TimeoutExpired, subprocess.CalledProcessError) as error:
        late = getattr(error, "returncode", OVER[0]) in OVER
        damaged = f"a file that is not {library}, or is damaged"
        slow = f"a file that {library} does not read within {PATIENCE} s"
        raise InputError(slow if late else damaged, expected, path) from None
    except (pickle.UnpicklingError, EOFError, ValueError, TypeError, IndexError):
        raise InputError(
            f"a damaged file, of which {library} makes nothing", expected, path
        ) from None
    if refused is not None:
        found, expected, place, line, column = refused
        raise InputError(found, expected, place or path, line, column)
    return found


def answer(stdin: int, stdout: int) -> None:
    """Do in this process what `isolated` asks for, and end it."""
    with open(stdin, "rb") as stream:
        read, given = pickle.load(stream)
    with os.fdopen(os.dup(stdout), "wb") as said:
        os.dup2(2, stdout)  # a library may print
        answered(read, given, said)


def answered(read: Callable[..., Any], given: tuple[Any, ...], said: BinaryIO) -> None:
    """Call a function within the bounds, and write what it gives or refuses."""
    pages = Path("/proc/self/statm")
    used = int(pages.read_text().split()[0]) * resource.getpagesize() if pages.exists() else 0
    resource.setrlimit(resource.RLIMIT_AS, (used + ROOM, used + ROOM))
    resource.setrlimit(resource.RLIMIT_CPU, (PATIENCE, PATIENCE))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        found = read(*given), None
    except InputError as error:
        found = None, (error.found, error.expected, error.path, error.line, error.column)
    except MemoryError:
        refused = f"a file that takes more than {ROOM // 1_000_000} MB to read"
        found = None, (refused, "a smaller one", None, None, None)
    pickle.dump(found, said, protocol=pickle.HIGHEST_PROTOCOL)


def library_columns(
    path: str | PathLike[str], library: str, rows: int, texts: int
) -> tuple[dict[str, Sequence[Any]], tuple[str, ...]]:
    """Read the columns of an HDF5 or SDDS file.

    Parameters
    ----------
    path : str or path
        The file.
    library : {"HDF5", "SDDS"}
        What reads it. Columns are the datasets at the top of an HDF5 file; of an SDDS file of
        parameters alone there is a row for each page.
    rows, texts : int
        Most values of a column, and of one of texts.

    Returns
    -------
    dict of str to array or list of str, tuple of str
        Values by name, and attributes or parameters of the file.

    Raises
    ------
    InputError
        If soliday-sdds is not installed, the file is damaged or too large, has several pages of
        columns, or a dataset is no column, has its numbers in another file or is packed by a
        filter that HDF5 does not bring.
    """
    if library == "SDDS" and find_spec("sdds") is None:
        expected = "pip install 'beamfit[sdds]', or a table: sdds2spreadsheet writes one"
        raise InputError("an SDDS file, which needs soliday-sdds to read", expected, path)
    read, expected = LIBRARIES[library]
    content = read_bytes(path, f"{expected.partition(';')[0]} of readings; fewer of them")
    return _with_units(path, *isolated(library, path, expected, read, content, rows, texts))


def _with_units(
    path: str | PathLike[str],
    columns: Mapping[str, Sequence[Any]],
    units: Mapping[str, str],
    comments: Sequence[str],
) -> tuple[dict[str, Sequence[Any]], tuple[str, ...]]:
    """Columns under names with the units of their attributes, which may not say others."""
    found = {}
    for header, values in columns.items():
        name, unit = plain(header), units.get(header, "")
        own, known = unit_at_end(standard_header(name)), known_unit(unit)
        said = unit.strip() not in ("", "1", "none", "dimensionless")
        if said and own is None:
            name = name_with_unit(name, known or unit)
        elif said and known != own:
            expected = f"one unit, {own} or the attribute's"
            raise InputError(f"the attribute units = '{unit}'", expected, path, column=name)
        found[name] = values
    return found, tuple(comments)


def hdf5_content(content: bytes, rows: int, texts: int) -> Columns:
    """Read the datasets of an HDF5 file; called in a process of its own."""
    import h5py

    with h5py.File(io.BytesIO(content), "r") as store:
        if "openPMD" in store.attrs:
            return _openpmd(store, rows), {}, []
        place = _place(store)
        if IMAGES in (names := _names(place)):
            return _projections(place, names, rows, texts), {}, []
        columns = {name: _column(place, name, rows, texts) for name in names}
        units = {name: _unit(place[name], name) for name in columns}
        said = [f"{key}: {value}"[:LONGEST_COMMENT] for key, value in store.attrs.items()]
    return columns, units, said


def _projections(
    place: Any, names: Sequence[str], rows: int, texts: int
) -> dict[str, Sequence[Any]]:
    """A line a bin of the projections of a stack of images."""
    data = place[IMAGES]
    _check_stored(data, IMAGES)
    if len(data.shape or ()) != 3 or data.dtype.kind not in "iuf":
        found = f"a dataset of shape {data.shape}, type {data.dtype}"
        raise InputError(found, "images of shape (n, rows, columns)", column=IMAGES)
    if PIXEL not in names:
        raise InputError(f"images and no dataset {PIXEL}", "the width of a pixel", column=IMAGES)
    count, bins = data.shape[0], max(data.shape[1:])
    check_length(count * bins, rows, column=IMAGES)
    told = {n: _column(place, n, rows, texts) for n in names if n not in (IMAGES, PIXEL)}
    for name, values in told.items():
        if len(values) != count:
            raise InputError(f"{len(values)} values", f"{count}, one an image", column=name)
    pixel = np.full(count, float(np.ravel(place[PIXEL][()])[0]))
    columns = columns_of_images([projections(np.asarray(image, float)) for image in data], pixel)
    of = columns["shot"]
    return columns | {name: [values[i] for i in of] for name, values in told.items()}


def projections(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project an image on x and y."""
    return image.sum(axis=0), image.sum(axis=1)


def columns_of_images(
    seen: Sequence[tuple[np.ndarray, np.ndarray]], pixel_um: np.ndarray
) -> dict[str, np.ndarray]:
    """A line a bin of projections on x and y; the shorter one of each is filled with NaN."""
    bins = [max(map(len, planes)) for planes in seen]
    shot = np.repeat(np.arange(len(seen)), bins)
    place = np.concatenate([np.arange(n) for n in bins])
    columns = {"shot": shot, "position_um": place * pixel_um[shot]}
    for i, plane in enumerate("xy"):
        columns[f"counts_{plane}"] = np.concatenate([
            np.pad(planes[i], (0, n - len(planes[i])), constant_values=np.nan)
            for planes, n in zip(seen, bins, strict=True)
        ])  # fmt: skip
    return columns


def _openpmd(store: Any, rows: int) -> dict[str, Sequence[Any]]:
    """A row for each group of particles: rms sizes, mean momentum, settings in attributes."""
    beams: list[Any] = []
    store.visititems(lambda _, held: beams.append(held) if _is_beam(held) else None)
    lines = [_beam_row(beam, rows) for beam in beams]
    return {name: [row.get(name, "") for row in lines] for name in (lines[0] if lines else ())}


def _is_beam(held: Any) -> bool:
    return hasattr(held, "keys") and {"position", "momentum"} <= set(held)


def _beam_row(beam: Any, rows: int) -> dict[str, Any]:
    place, momentum = beam["position"], [_record(beam["momentum"], k, rows) for k in "xyz"]
    weight = _record(beam, "weight", rows) if "weight" in beam else np.ones(1)
    said = {**beam.parent.attrs, **beam.attrs}
    row = {name: float(v) for name, v in said.items() if name.endswith(SETTING_ENDS)}
    if (name := said.get("latticeElementName")) is not None or not row:
        row["screen"] = name.decode() if isinstance(name, bytes) else name or beam.parent.name[1:]
    for plane in "xy":
        values, shares = np.broadcast_arrays(_record(place, plane, rows), weight)
        middle = np.average(values, weights=shares)
        row[f"size_{plane}_m"] = math.sqrt(np.average((values - middle) ** 2, weights=shares))
    row["momentum_MeV"] = float(np.mean(np.linalg.norm(np.broadcast_arrays(*momentum), axis=0)))
    row["momentum_MeV"] *= LIGHT / 1.602176634e-13  # from kg m/s
    return row


def _record(group: Any, name: str, rows: int) -> np.ndarray:
    """The numbers of an openPMD record in SI; one that is the same for all has it as attribute."""
    record = group[name]
    constant = hasattr(record, "keys")
    values = record.attrs["value"] if constant else _column(group, name, rows, 0)
    return np.atleast_1d(np.asarray(values, float)) * float(record.attrs.get("unitSI", 1.0))


def _place(store: Any) -> Any:
    """Find the group of the datasets: the top, or its only group."""
    import h5py

    only = next(iter(store)) if len(store) == 1 else None
    if only is None or not isinstance(store.get(only, getlink=True), h5py.HardLink):
        return store
    return store[only] if store.get(only, getclass=True) is h5py.Group else store


def _names(store: Any) -> list[str]:
    """The datasets at the top; a link may lead anywhere."""
    import h5py

    names = []
    for name in store:
        if not isinstance(store.get(name, getlink=True), h5py.HardLink):
            raise InputError("a link", ELSEWHERE, column=name)
        if store.get(name, getclass=True) is h5py.Dataset:
            names.append(name)
    return names


def _column(store: Any, name: str, rows: int, texts: int) -> list[str] | np.ndarray:
    """The values of a dataset: what it claims to be is looked at before it is read."""
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
    """Refuse numbers in another file, and filters that HDF5 does not bring."""
    plan = data.id.get_create_plist()
    filters = {plan.get_filter(i)[0] for i in range(plan.get_nfilters())}
    if data.is_virtual or plan.get_external_count():
        raise InputError("numbers in another file", ELSEWHERE, column=name)
    if not filters <= FILTERS:
        said = "gzip, lzf, shuffle, fletcher32 or none"
        raise InputError(f"a filter of number {min(filters - FILTERS)}", said, column=name)


def _unit(data: Any, name: str) -> str:
    """The unit that the attributes of a dataset say; numbers that wait for a factor are refused."""
    said = {str(key).lower(): value for key, value in data.attrs.items()}
    for key, usual in (("scale_factor", 1.0), ("add_offset", 0.0)):
        if key in said and not np.all(np.asarray(said[key]) == usual):
            raise InputError(
                f"the attribute {key} = {said[key]}", "numbers that contain it", column=name
            )
    unit = next((said[key] for key in ("units", "unit", "egu") if key in said), "")
    return str(unit.decode("utf-8", "replace") if isinstance(unit, bytes) else unit)[:40]


def matlab_variables(path: str | PathLike[str], name: str = "") -> dict[str, np.ndarray]:
    """Read a variable of a MATLAB file; where there is none of that name, all vectors of numbers.

    Parameters
    ----------
    path : str or path
        A file of version 5 to 7.
    name : str
        The variable.

    Returns
    -------
    dict of str to ndarray
        The variable as SciPy gives it; or the vectors of two numbers or more, flat.

    Raises
    ------
    InputError
        If it is no such file, is damaged, or is larger than any scan.

    Examples
    --------
    >>> import pathlib, scipy.io, tempfile
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "a.mat"
    >>> scipy.io.savemat(file, {"size_x_um": [90.0, 60.0], "note": "noon"})
    >>> matlab_variables(file, "data")["size_x_um"].tolist()
    [90.0, 60.0]
    """
    return _matlab(os.fspath(path), name, digest_now(path))


@lru_cache(maxsize=1)  # a file of emittance_gui is asked several times what it is
def _matlab(path: str, name: str, sha256: str) -> dict[str, np.ndarray]:
    content = read_bytes(path, MATLAB)
    if HDF5_SIGNATURE in (content[:8], content[512:520]):
        raise InputError("a MATLAB file of version 7.3", MATLAB, path)
    if content[126:128] not in (b"IM", b"MI"):
        raise InputError("no MATLAB file of version 5 to 7", MATLAB, path)
    return isolated("MATLAB's", path, MATLAB, matlab_content, content, name)


def matlab_content(content: bytes, name: str) -> dict[str, np.ndarray]:
    """Read variables of a MATLAB file; called in a process of its own."""
    from scipy.io import loadmat, whosmat

    held = {
        n: shape for n, shape, kind in whosmat(io.BytesIO(content)) if kind in NUMBERS or n == name
    }
    wanted = [n for n, shape in held.items() if n == name or math.prod(shape) == max(shape) > 1]
    wanted = [name] if name in wanted else wanted
    found = loadmat(io.BytesIO(content), variable_names=wanted)
    if name in wanted:
        return {name: found[name]}
    return {n: found[n].ravel().astype(float) for n in wanted if found[n].dtype.kind in "biuf"}


def sdds_content(content: bytes, rows: int, texts: int) -> Columns:
    """Read an SDDS file; called in a process of its own."""
    if b"&include" in content:
        raise InputError(
            "an SDDS file with &include", "a file that is whole: sddsconvert makes one"
        )
    data = _sdds_loaded(content)
    # The library stops in silence where no further page can be read: the data twice are twice the
    # pages only if nothing was left over.
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
    said = [f"{name}: {pages[0]} {unit}".strip() for name, (unit, pages) in parameters.items()]
    if columns and (count := data.loaded_pages) != 1:
        raise InputError(f"{count} pages", "one; sddscombine -merge makes one of all")
    held = {n: (unit, pages[0]) for n, (unit, pages) in columns.items()} or parameters
    found = {name: _sdds_values(name, values, rows, texts) for name, (_, values) in held.items()}
    return found, {name: unit for name, (unit, _) in held.items()}, said if columns else []


def _sdds_loaded(content: bytes) -> Any:
    """All pages of a file that can be read."""
    import sdds

    with tempfile.NamedTemporaryFile() as file:
        file.write(content)
        file.flush()
        return sdds.load(file.name)


def _sdds_values(name: str, values: list[Any], rows: int, texts: int) -> Sequence[Any]:
    words = bool(values) and isinstance(values[0], str)
    check_length(len(values), texts if words else rows, column=name)
    return values if words else np.array(values, float)


def _sdds_unit(unit: str) -> str:
    """A unit without the marks of its exponents and indices, 1/m$a2$n."""
    return re.sub(r"\$[bne]", "", unit.replace("$a", "^"))


LIBRARIES = {
    "HDF5": (hdf5_content, "an HDF5 file; text is .csv"),
    "SDDS": (sdds_content, "an SDDS file; sdds2spreadsheet writes a table"),
}
