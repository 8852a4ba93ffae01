"""What a training reports: a row per epoch, kept as JSON lines and, on request, for TensorBoard."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from zoo.archive import replace_file

__all__ = ["History", "Log", "Row"]

Row = dict[str, Any]


@dataclass
class History:
    """Rows of a training in order; losses are per datum (window or item), in nats.

    ``epoch``, ``loss`` (tempered), ``reconstruction`` and ``kl`` (free of c and β), ``c`` of (87),
    ``beta``, ``lr``, ``grad_norm`` (mean before clipping), ``val_elbo`` (plain bound on the
    validation data; None where it was not computed) and ``seconds`` (wall clock).

    >>> history = History([{"epoch": 0, "loss": 2.0}, {"epoch": 1, "loss": 1.5}])
    >>> history.column("loss"), len(history)
    ([2.0, 1.5], 2)
    """

    rows: list[Row] = field(default_factory=list)

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.rows)

    def __iter__(self) -> Iterator[Row]:
        """The rows in order."""
        return iter(self.rows)

    def column(self, name: str) -> list[Any]:
        """One quantity over the rows."""
        if self.rows and name not in self.rows[0]:
            raise ValueError(f"history has no {name!r}; there are {', '.join(self.rows[0])}")
        return [row[name] for row in self.rows]

    def back_to(self, epoch: int) -> None:
        """Forget the rows from ``epoch`` on."""
        self.rows = [row for row in self.rows if row["epoch"] < epoch]

    @classmethod
    def load(cls, path: Path) -> Self:
        """A history from its JSON lines."""
        return cls([json.loads(line) for line in path.read_text().splitlines()])


class Log:
    """Writes rows to ``history.jsonl`` in ``folder``, each once however often training resumed."""

    def __init__(self, folder: Path | None, *, tensorboard: bool = False) -> None:
        """Log to ``folder``; TensorBoard needs a folder and the extra ``train``."""
        if tensorboard and folder is None:
            raise ValueError("tensorboard needs a run folder to write to")
        self._path = None if folder is None else folder / "history.jsonl"
        self._events = folder / "tensorboard" if tensorboard and folder else None
        self._board: Any = None

    def start(self, history: History) -> None:
        """Make the log hold exactly the rows of ``history``."""
        self._close()
        if self._events is not None:
            self._board = _board(self._events, len(history))
        if self._path is not None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            replace_file(self._path, "".join(map(_line, history)).encode())

    def add(self, row: Row) -> None:
        """Append one row."""
        if self._path is not None:
            with self._path.open("a") as file:
                file.write(_line(row))
        if self._board is not None:
            for name, value in row.items():
                if name != "epoch" and value is not None:
                    self._board.add_scalar(name, value, row["epoch"])

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._close()

    def _close(self) -> None:
        if self._board is not None:
            self._board.close()


def _line(row: Row) -> str:
    return json.dumps(row, allow_nan=False) + "\n"


def _board(folder: Path, epoch: int) -> Any:
    """A writer whose earlier events from ``epoch`` on are void."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise ImportError("tensorboard is missing; pip install 'movezoo[train]'") from None
    return SummaryWriter(str(folder), purge_step=epoch)
