"""Movements in files that people have: CSV, NumPy's archives and Parquet, or a folder of them."""

from __future__ import annotations

import csv
import io
import math
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from zoo.datasets.records.agreement import agreed
from zoo.datasets.records.columns import Part, parts_of_table, role
from zoo.datasets.records.sequences import Sequences
from zoo.datasets.store import FileFormatError, MissingDataError

__all__ = ["is_file", "load"]

TEXT, PARQUET, ZIP = "text", "Parquet", "a ZIP archive"
MAGIC = {
    b"PAR1": PARQUET,
    b"PK\x03\x04": ZIP,
    b"\x93NUMPY": "one array of NumPy (.npy): save it by np.savez",
    b"\x89HDF": "HDF5: read it by h5py or xarray, and give the arrays to Sequences.from_arrays",
    b"\x1f\x8b": "gzip: unpack it",
}
NOTHING = ("", "nan", "na", "n/a", "null", "none")
_ABOUT = ("rate", "channels", "units")


def is_file(name: str) -> bool:
    """Whether a name of data means a file or folder: by its ending, or because it is there."""
    return Path(name).suffix.lower() in READERS or Path(name).exists()


def load(
    path: str | Path, *, rate: float | None = None, units: str | Sequence[str] = ""
) -> Sequences:
    r"""The movements in a file, or in all files of a folder, in the order of their names.

    A table (CSV with a header, Parquet) has a row a frame: columns named movement, trial, subject,
    group or session say which rows belong together, one named time, t or seconds has the times
    and tells the rate, all others are channels, their units in brackets: ``knee [rad]``. An empty
    cell is missing. An archive (``np.savez``) holds an array (time, channel) for each movement, or
    one (movement, time, channel); ``rate``, ``channels`` and ``units`` may stand beside, and group
    columns as arrays of text.

    ``rate`` is in Hz: needed where the file has no times, else it must agree with them. Raises
    FileFormatError, which names file and line, and MissingDataError where there is no such file.

    >>> _ = Path("walk.csv").write_text("time,knee [rad]\n0.0,0.1\n0.1,0.2\n0.2,\n")
    >>> data = load("walk.csv")
    >>> data.rate, data.channels, data.units, data.groups, data.mask[0, :, 0].tolist()
    (10.0, ('knee',), ('rad',), {'trial': ('walk',)}, [True, True, False])
    """
    path = Path(path)
    parts: list[Part] = []
    for file in _files(path):
        read, told_rate, told_units = READERS[file.suffix.lower()](file)
        rate = _agreed(rate, told_rate, file, "rate")
        units = _agreed(units, told_units, file, "units")
        parts += [_owned(part, file, path.is_dir()) for part in read]
    found = agreed(parts, channels=None, units=units, rate=rate, groups=None)
    return Sequences.from_arrays(
        found.arrays,
        rate=found.rate,
        channels=found.names,
        units=found.units,
        groups=found.groups,
        name=str(path),
    )


Read = tuple[list[Part], float | None, Any]


def _files(path: Path) -> list[Path]:
    """The file, or those of a folder; all must be of a kind that is read, and be what they say."""
    if not path.exists():
        raise MissingDataError(f"there is no file {path} in {Path.cwd()}")
    known = ", ".join(READERS)
    files = [path]
    if path.is_dir():
        files = sorted(f for f in path.iterdir() if f.suffix.lower() in READERS)
    if not files:
        raise MissingDataError(f"the folder {path} holds no file named {known}")
    for file in files:
        if file.suffix.lower() not in READERS:
            raise FileFormatError(file, None, f"files are read that are named {known}")
        _check_content(file)
    return files


def _check_content(file: Path) -> None:
    """Refuse a file that is not what its name says."""
    with file.open("rb") as stream:
        head = stream.read(4096)
    if not head:
        raise FileFormatError(file, None, "the file is empty")
    kind = next((k for magic, k in MAGIC.items() if head.startswith(magic)), TEXT)
    if kind == TEXT and b"\0" in head:
        kind = "neither text nor any format known here"
    suffix = file.suffix.lower()
    wanted = {".parquet": PARQUET, ".npz": ZIP}.get(suffix, TEXT)
    if kind != wanted:
        other = {TEXT: "text, as a .csv has", PARQUET: "Parquet: name it .parquet"}.get(kind, kind)
        raise FileFormatError(file, None, f"it is named {suffix}, but holds {other}")


def _csv(file: Path) -> Read:
    try:
        text = file.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileFormatError(file, None, f"it is not in UTF-8: {error.reason}") from None
    header = text.partition("\n")[0]
    delimiter = max(",;\t", key=header.count)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, skipinitialspace=True)
    rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    names = [cell.strip() for cell in rows[0][1]] if rows else []
    if not names or any(_number(name) is not None for name in names):
        raise FileFormatError(file, 1, "a header with the names of the columns is needed")
    if len(rows) < 2:
        raise FileFormatError(file, None, "there are no rows below the header")
    if len(set(names)) < len(names):
        twice = next(n for n in names if names.count(n) > 1)
        raise FileFormatError(file, 1, f"several columns are named {twice!r}")
    for line, row in rows[1:]:
        if len(row) != len(names):
            raise FileFormatError(file, line, f"{len(row)} cells; the header has {len(names)}")
    columns = {
        name: _column(file, name, [(line, row[i].strip()) for line, row in rows[1:]])
        for i, name in enumerate(names)
    }
    return parts_of_table(columns, file.name), None, None


def _column(file: Path, name: str, cells: Sequence[tuple[int, str]]) -> Any:
    """Text of a group column, numbers of all others."""
    if role(name) == "group":
        return [cell for _, cell in cells]
    numbers = []
    for line, cell in cells:
        number = _number(cell)
        if number is None or math.isinf(number):
            comma = "; a decimal point is needed" if "," in cell else ""
            reason = f"{cell!r} in column {name!r} is no finite number{comma}"
            raise FileFormatError(file, line, reason)
        numbers.append(number)
    return np.array(numbers)


def _number(cell: str) -> float | None:
    if cell.lower() in NOTHING:
        return math.nan
    try:
        return float(cell)
    except ValueError:
        return None


def _parquet(file: Path) -> Read:
    try:
        import pyarrow.parquet
    except ImportError:
        raise ModuleNotFoundError(
            f"{file}: Parquet is read by pyarrow, which is not installed: "
            "pip install 'movezoo[parquet]', or save the table as .csv"
        ) from None
    try:
        table = pyarrow.parquet.read_table(file)
    except (OSError, pyarrow.ArrowException) as error:
        raise FileFormatError(file, None, f"it is no whole Parquet file: {error}") from None
    columns = {name: table[name].to_numpy() for name in table.column_names}
    return parts_of_table(columns, file.name), None, None


def _npz(file: Path) -> Read:
    try:
        with np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (ValueError, OSError, zipfile.BadZipFile) as error:
        raise FileFormatError(file, None, f"it is no archive of plain arrays: {error}") from None
    about = {name: arrays.pop(name).tolist() for name in _ABOUT if name in arrays}
    groups = {k: v for k, v in arrays.items() if v.ndim == 1 and v.dtype.kind in "UiT"}
    movements = {k: v for k, v in arrays.items() if k not in groups}
    values = [(k, v) for k, v in movements.items() if v.ndim != 3]
    if len(movements) == 1 and not values:
        name, cube = next(iter(movements.items()))
        values = [(f"{name} {i}", v) for i, v in enumerate(cube)]
    bad = next((f"{k} of shape {v.shape}" for k, v in values if v.ndim != 2), None)
    if bad or len(values) not in (len(movements), *(len(v) for v in movements.values())):
        bad = bad or "several arrays with three axes"
        raise FileFormatError(file, None, f"arrays (time, channel) are needed; it holds {bad}")
    if not values:
        raise FileFormatError(file, None, "it holds no array (time, channel)")
    for key, column in groups.items():
        if len(column) != len(values):
            reason = f"{key} has {len(column)} values for {len(values)} movements"
            raise FileFormatError(file, None, reason)
    names = about.get("channels")
    parts = [
        Part(
            what=f"{name} of {file.name}",
            values=value,
            names=None if names is None else tuple(map(str, np.atleast_1d(names).tolist())),
            groups={k: str(v[i]) for k, v in groups.items()} or {"trial": name},
        )
        for i, (name, value) in enumerate(values)
    ]
    return parts, about.get("rate"), about.get("units")


READERS: dict[str, Callable[[Path], Read]] = {
    ".csv": _csv,
    ".tsv": _csv,
    ".txt": _csv,
    ".npz": _npz,
    ".parquet": _parquet,
}


def _owned(part: Part, file: Path, several: bool) -> Part:
    """A part with the name of its file as a group."""
    if not {"movement", "trial"} & set(part.groups):
        return replace(part, groups={**part.groups, "trial": file.stem})
    return replace(part, groups={**part.groups, "file": file.stem}) if several else part


def _agreed(given: Any, told: Any, file: Path, what: str) -> Any:
    """What was given, or what a file tells; both where they are the same."""
    if told is None:
        return given
    if given in (None, ""):
        return told
    if given != told:
        raise FileFormatError(file, None, f"its {what} is {told!r}; {given!r} was given or before")
    return given
