"""Files of one's own: CSV, archives of NumPy, Parquet, folders; errors name file and line."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import zoo
from zoo.datasets.store import FileFormatError, MissingDataError

VALUES = np.random.default_rng(0).normal(size=(3, 9, 2))
ROWS = ["trial,subject,time [ms],hip,knee [rad]"] + [
    f"t{i},{'ab'[i // 2]},{40 * t},{VALUES[i, t, 0]},{VALUES[i, t, 1]}"
    for i in range(3)
    for t in range(9)
]


def write(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


@pytest.mark.parametrize(("name", "delimiter"), [("w.csv", ","), ("w.csv", ";"), ("w.TSV", "\t")])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_a_table_is_movements(
    tmp_path: Path, name: str, delimiter: str, end: str, mark: str
) -> None:
    text = mark + end.join(ROWS).replace(",", delimiter)
    data = zoo.load_data(write(tmp_path, name, text))
    np.testing.assert_array_equal(data.values, VALUES)
    assert data.groups == {"trial": ("t0", "t1", "t2"), "subject": ("a", "a", "b")}
    assert (data.channels, data.units) == (("hip", "knee"), ("", "rad"))
    assert (data.rate, data.provenance, data.name) == (25.0, "own", str(tmp_path / name))


def test_empty_cells_are_missing(tmp_path: Path) -> None:
    file = write(tmp_path, "w.csv", "hip,knee\n1,\n\n2,NaN\n3,4\n")
    data = zoo.load_data(str(file), rate=10.0, units="rad")
    assert data.mask[0].tolist() == [[True, False], [True, False], [True, True]]
    assert data.units == ("rad", "rad") and data.groups == {"trial": ("w",)}


def test_a_folder_is_movements_whose_columns_are_brought_to_one_order(tmp_path: Path) -> None:
    write(tmp_path, "two.csv", "time,knee,hip\n0,3,1\n0.5,4,2\n")
    write(tmp_path, "one.csv", "hip,knee,time\n1,3,0\n2,4,0.5\n3,5,1.0\n")
    write(tmp_path, "notes.md", "not read")
    data = zoo.load_data(tmp_path)
    assert data.groups == {"trial": ("one", "two")} and data.lengths.tolist() == [3, 2]
    assert data.values[:, 0].tolist() == [[1, 3], [1, 3]] and data.rate == 2.0
    write(tmp_path, "three.csv", "hip,ankle,time\n1,3,0\n2,4,0.5\n")
    with pytest.raises(ValueError, match=r"three.csv lacks knee and has ankle besides, where one"):
        zoo.load_data(tmp_path)


ARCHIVES: dict[str, dict[str, Any]] = {
    "matrices": {f"t{i}": v for i, v in enumerate(VALUES)},
    "cube": {"walks": VALUES, "trial": ["t0", "t1", "t2"]},
}


@pytest.mark.parametrize("kind", ARCHIVES)
def test_an_archive_is_movements(tmp_path: Path, kind: str) -> None:
    file = tmp_path / "w.npz"
    np.savez(file, **ARCHIVES[kind], rate=25.0, channels=["hip", "knee"], units="rad")
    data = zoo.load_data(file)
    np.testing.assert_array_equal(data.values, VALUES)
    assert data.groups == {"trial": ("t0", "t1", "t2")}
    assert (data.channels, data.units, data.rate) == (("hip", "knee"), ("rad", "rad"), 25.0)
    with pytest.raises(FileFormatError, match=r"its rate is 25.0; 30.0 was given"):
        zoo.load_data(file, rate=30.0)


def test_pickled_objects_are_never_loaded(tmp_path: Path) -> None:
    file = tmp_path / "w.npz"
    np.savez(file, walk=np.array([{}], dtype=object))
    with pytest.raises(FileFormatError, match="no archive of plain arrays: Object arrays cannot"):
        zoo.load_data(file)


def test_parquet_is_read_as_a_table(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    frame = pd.DataFrame({"trial": np.repeat([1, 2, 3], 9), "hip [m]": VALUES[..., 0].ravel()})
    frame.to_parquet(tmp_path / "w.parquet")
    data = zoo.load_data(tmp_path / "w.parquet", rate=25.0)
    np.testing.assert_array_equal(data.values, VALUES[..., :1])
    assert data.groups == {"trial": ("1", "2", "3")} and data.units == ("m",)
    (tmp_path / "cut.parquet").write_bytes((tmp_path / "w.parquet").read_bytes()[:200])
    with pytest.raises(FileFormatError, match="it is no whole Parquet file"):
        zoo.load_data(tmp_path / "cut.parquet", rate=25.0)


def test_parquet_without_its_reader_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "w.parquet").write_bytes(b"PAR1")
    monkeypatch.setitem(__import__("sys").modules, "pyarrow.parquet", None)
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'movezoo\[parquet\]'"):
        zoo.load_data(tmp_path / "w.parquet")


BROKEN = {
    "w.parquet": ("time,hip\n0,1\n", "it is named .parquet, but holds text, as a .csv has"),
    "w.npz": ("time,hip\n0,1\n", "it is named .npz, but holds text"),
    "p.csv": ("PAR1", "it is named .csv, but holds Parquet: name it .parquet"),
    "z.csv": ("PK\x03\x04", "it is named .csv, but holds a ZIP archive"),
    "b.csv": ("a\0b", "it is named .csv, but holds neither text nor any format known here"),
    "e.csv": ("", "e.csv: the file is empty"),
    "h.csv": ("1,2\n3,4\n", "line 1: a header with the names of the columns is needed"),
    "r.csv": ("hip\n", "there are no rows below the header"),
    "d.csv": ("hip,hip\n1,2\n", "line 1: several columns are named 'hip'"),
    "s.csv": ("hip,knee\n1,2\n\n3\n", "line 4: 1 cells; the header has 2"),
    "n.csv": ("hip\n1\nx\n", "line 3: 'x' in column 'hip' is no finite number"),
    "i.csv": ("hip\n1\ninf\n", "line 3: 'inf' in column 'hip' is no finite number"),
    "c.csv": ("hip;knee\n0,5;1\n", "line 2: '0,5' in column 'hip' is no finite number; a decimal"),
    "g.csv": ("trial,hip\na,1\n,2\n", "column 'trial' of g.csv is empty at row 1"),
    "t.csv": ("time,hip\n0,1\n1,1\n5,1\n", "time of t.csv is irregular"),
    "o.csv": ("time,trial\n0,1\n", "o.csv has no channel"),
    "w.xlsx": ("x", "files are read that are named .csv, .tsv, .txt, .npz, .parquet"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_files_that_are_not_what_they_should_be(tmp_path: Path, name: str) -> None:
    text, reason = BROKEN[name]
    with pytest.raises(ValueError, match=re.escape(reason)):
        zoo.load_data(write(tmp_path, name, text), rate=None)


def test_what_is_not_there_or_has_no_rate(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError, match=r"there is no file walk.csv in "):
        zoo.load_data("walk.csv")
    with pytest.raises(MissingDataError, match=r"holds no file named \.csv"):
        zoo.load_data(tmp_path)
    with pytest.raises(ValueError, match=r"rate is needed, in Hz .*--rate 120"):
        zoo.load_data(write(tmp_path, "w.csv", "hip\n1\n2\n"))
    with pytest.raises(TypeError, match=r"arrays become a record by zoo\.Sequences"):
        zoo.load_data(VALUES)  # type: ignore[arg-type]
