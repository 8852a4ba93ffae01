"""Where the files of a data set are: a folder, ``MOVEZOO_DATA``, or a checked download."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

__all__ = ["FileFormatError", "MissingDataError", "download", "find", "listed", "require"]

VARIABLE = "MOVEZOO_DATA"


class MissingDataError(FileNotFoundError):
    """Files of a data set are not at hand; the message says how to get them."""


class FileFormatError(ValueError):
    """A file that is not what its format demands; the message gives file, line and reason."""

    def __init__(self, file: str | Path, line: int | None, reason: str) -> None:
        """``line`` counts from 1; None where the whole file is meant."""
        self.file, self.line, self.reason = str(file), line, reason
        where = self.file if line is None else f"{self.file}, line {line}"
        super().__init__(f"{where}: {reason}")


def find(relative: str, *, dataset: str, folder: str | Path | None = None) -> Path | None:
    """The file in ``folder`` or else in ``$MOVEZOO_DATA``; None where it is in neither.

    ``folder`` may hold all data sets, be that of ``dataset``, or hold the files themselves.

    >>> find("35/35.asf", dataset="cmu-mocap", folder="/nowhere") is None
    True
    """
    root = folder if folder is not None else os.environ.get(VARIABLE)
    if not root:
        return None
    places = (Path(dataset, relative), Path(relative), Path(Path(relative).name))
    return next((f for p in places if (f := Path(root) / p).is_file()), None)


def listed(pattern: str, *, dataset: str, folder: str | Path | None = None) -> list[Path]:
    """All files like ``07/07_*.amc`` in the first place that has any, sought as :func:`find` does.

    >>> listed("07/*.amc", dataset="cmu-mocap", folder="/nowhere")
    []
    """
    root = folder if folder is not None else os.environ.get(VARIABLE)
    if not root:
        return []
    places = (f"{dataset}/{pattern}", pattern, Path(pattern).name)
    found = (sorted(Path(root).glob(place)) for place in places)
    return next((files for files in found if files), [])


def require(relative: str, *, dataset: str, folder: str | Path | None, advice: str) -> Path:
    """The file, or an error that says where it was sought and how to get it."""
    found = find(relative, dataset=dataset, folder=folder)
    if found is None:
        raise MissingDataError(f"{dataset}: {relative} is not {sought(folder)}; {advice}")
    return found


def sought(folder: str | Path | None) -> str:
    """Where a file was looked for, in words."""
    if folder is not None:
        return f"in the folder {folder}"
    root = os.environ.get(VARIABLE)
    return f"in {VARIABLE}={root}" if root else f"at hand ({VARIABLE} is not set)"


def download(relative: str, *, base: str, hashes: Mapping[str, str], dataset: str) -> Path:
    """The file from the cache, fetched from ``base`` first if need be, with its SHA-256 checked.

    A file without a known hash is refused: nothing unchecked is trained on.
    """
    if relative not in hashes:
        raise MissingDataError(
            f"{dataset}: no hash is known for {relative}, so that it is not downloaded unchecked; "
            f"fetch {base}{relative} yourself and put it into $MOVEZOO_DATA/{dataset}/{relative} "
            f"(or name its folder with folder=...)"
        )
    import pooch  # type: ignore[import-untyped]

    cache = pooch.os_cache("movezoo") / dataset
    try:
        got = pooch.retrieve(
            base + relative,
            known_hash=f"sha256:{hashes[relative]}",
            fname=Path(relative).name,
            path=cache / Path(relative).parent,
            downloader=pooch.HTTPDownloader(progressbar=_Bar(relative), timeout=30),
        )
    except OSError as error:
        raise MissingDataError(
            f"{dataset}: downloading {base}{relative} failed ({error}); fetch it yourself and put "
            f"it into $MOVEZOO_DATA/{dataset}/{relative}, or name its folder with folder=..."
        ) from error
    except ValueError as error:
        raise FileFormatError(base + relative, None, f"refused: {error}") from error
    return Path(got)


class _Bar:
    """A rich progress bar behind the four names that pooch asks of one."""

    def __init__(self, what: str) -> None:
        from rich.console import Console
        from rich.progress import Progress

        self._progress = Progress(console=Console(stderr=True), transient=True)
        self._task = self._progress.add_task(what)
        self._total = 0

    @property
    def total(self) -> int:
        """Size in bytes; setting it starts the bar."""
        return self._total

    @total.setter
    def total(self, size: int) -> None:
        self._total = size
        self._progress.start()
        self._progress.update(self._task, total=size)

    def update(self, size: int) -> None:
        """Advance by ``size`` bytes."""
        self._progress.advance(self._task, size)

    def reset(self) -> None:
        """Back to the start; pooch then reports the whole size once more."""
        self._progress.reset(self._task, total=self._total)

    def close(self) -> Any:
        """Take the bar off the screen."""
        self._progress.stop()
