"""Regression data in the form of the UCI benchmarks, with published train and test indices."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from zoo.datasets.records import Pairs
from zoo.datasets.split import nearest
from zoo.datasets.store import FileFormatError, require

__all__ = ["load"]


@dataclass(frozen=True, kw_only=True)
class Columns:
    """Names and units of a data set, ``name:unit`` each."""

    features: str
    target: str


COLUMNS = {
    "concrete": Columns(
        features="cement:kg/m³ slag:kg/m³ fly_ash:kg/m³ water:kg/m³ superplasticizer:kg/m³ "
        "coarse_aggregate:kg/m³ fine_aggregate:kg/m³ age:d",
        target="compressive_strength:MPa",
    ),
    "energy": Columns(
        features="relative_compactness: surface_area:m² wall_area:m² roof_area:m² height:m "
        "orientation: glazing_area: glazing_distribution:",
        target="heating_load:kWh/m²",
    ),
    "yacht": Columns(
        features="buoyancy_position: prismatic_coefficient: length_displacement: beam_draught: "
        "length_beam: froude_number:",
        target="residuary_resistance:",
    ),
}


def load(
    what: str, *, folder: str | Path | None = None, split: int | None = None
) -> Pairs | tuple[Pairs, Pairs]:
    """The data set in folder ``uci/<what>``; with ``split=k`` the k-th published (train, test).

    The folder holds ``data.txt`` (one item a line), ``index_features.txt``, ``index_target.txt``
    and ``index_train_k.txt``, ``index_test_k.txt``, all counting from 0, as published with the
    splits of Hernández-Lobato & Adams (2015). Any folder of this form is a data set ``uci/...``.
    """
    files = _Folder(what, folder)
    table = files.table("data.txt")
    x = files.index("index_features.txt", table.shape[1], "columns")
    y = files.index("index_target.txt", table.shape[1], "columns")
    if set(x) & set(y):
        raise FileFormatError(
            files.path("index_target.txt"), None, f"columns {set(x) & set(y)} are features as well"
        )
    provenance = "public" if what in COLUMNS else "own"
    pairs = Pairs.from_arrays(table[:, x], table[:, y], name=f"uci/{what}", provenance=provenance)
    if what in COLUMNS:
        pairs = _named(pairs, COLUMNS[what])
    return pairs if split is None else _published(files, pairs, split)


@dataclass(frozen=True)
class _Folder:
    what: str
    folder: str | Path | None

    def path(self, name: str) -> Path:
        meant = "" if self.what in COLUMNS else nearest(self.what, COLUMNS)
        return require(
            f"{self.what}/{name}",
            dataset="uci",
            folder=self.folder,
            advice=f"get the data set and its splits as published with Hernández-Lobato & Adams "
            f"(2015) and put its text files into $MOVEZOO_DATA/uci/{self.what}/ "
            f"or name their folder with folder=...{meant}",
        )

    def table(self, name: str) -> NDArray[np.float64]:
        path = self.path(name)
        rows: list[list[float]] = []
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            if line.strip():
                rows.append([_number(word, path, number) for word in line.split()])
                if len(rows[-1]) != len(rows[0]):
                    reason = f"{len(rows[-1])} values; the first line has {len(rows[0])}"
                    raise FileFormatError(path, number, reason)
        if not rows:
            raise FileFormatError(path, None, "the file is empty")
        return np.array(rows)

    def index(self, name: str, count: int, what: str) -> list[int]:
        path = self.path(name)
        table = self.table(name)
        index = table[:, 0].astype(int)
        if table.shape[1] != 1 or (index != table[:, 0]).any():
            raise FileFormatError(path, None, "one whole number a line is needed")
        if index.min() < 0 or index.max() >= count:
            line = int(np.argmax((index < 0) | (index >= count))) + 1
            raise FileFormatError(path, line, f"{index[line - 1]} is none of the {count} {what}")
        if len(set(index.tolist())) != len(index):
            raise FileFormatError(path, None, f"{what} are named more than once")
        return [int(i) for i in index]


def _number(word: str, path: Path, line: int) -> float:
    try:
        return float(word)
    except ValueError:
        raise FileFormatError(path, line, f"{word!r} is not a number") from None


def _named(pairs: Pairs, columns: Columns) -> Pairs:
    features = [word.split(":") for word in columns.features.split()]
    target = columns.target.split(":")
    if len(features) != len(pairs.features) or len(pairs.channels) != 1:
        raise ValueError(
            f"{pairs.name} has {len(pairs.features)} features and {len(pairs.channels)} targets; "
            f"{len(features)} and 1 are published"
        )
    return replace(
        pairs,
        features=tuple(name for name, _ in features),
        feature_units=tuple(unit for _, unit in features),
        channels=(target[0],),
        units=(target[1],),
    )


def _published(files: _Folder, pairs: Pairs, split: int) -> tuple[Pairs, Pairs]:
    train = files.index(f"index_train_{split}.txt", len(pairs), "items")
    test = files.index(f"index_test_{split}.txt", len(pairs), "items")
    both = sorted(set(train) & set(test))
    if both:
        raise FileFormatError(
            files.path(f"index_test_{split}.txt"),
            None,
            f"{len(both)} items are in the training part as well (first: {both[0]})",
        )
    return pairs[train], pairs[test]
