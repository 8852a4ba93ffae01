"""The movement player: one self-contained page of moving bodies, for notebooks and as a file."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from zoo.datasets.bodies import Body, body_for
from zoo.datasets.records import Sequences
from zoo.errors import NoJointSamplesError
from zoo.evaluation.figures.postures import COLOURS
from zoo.prediction.prediction import Prediction

__all__ = ["Player", "Track", "play"]

PALETTE = ("#555555", "#0072B2", "#D55E00", "#009E73", "#CC79A7")
HEIGHT = 560
GHOSTS = 12


@dataclass(frozen=True, kw_only=True)
class Track:
    """One moving body: positions in m from frame ``start`` on, and those of joint draws."""

    name: str
    mean: Float[Tensor, "time joint 3"]
    draws: Float[Tensor, "sample time joint 3"] | None = None
    start: int = 0


@dataclass(frozen=True, kw_only=True)
class Player:
    """Bodies that move together, in a notebook by their mere name, or as a file.

    ``marks`` are frames with a word at the time line, such as where a forecast begins. The page
    holds its data and its few lines of script itself and asks nothing of the network.

    >>> arm = body_for([f"joint_{i}" for i in range(1, 7)])
    >>> still = Track(name="still", mean=arm.place(torch.zeros(5, 6), ()))
    >>> "still" in Player(body=arm, tracks=(still,)).page()
    True
    """

    body: Body
    tracks: tuple[Track, ...]
    rate: float | None = None
    title: str = "Movement"
    marks: tuple[tuple[int, str], ...] = ()

    def __post_init__(self) -> None:
        """Refuse an empty stage."""
        if not self.tracks:
            raise ValueError("a player needs at least 1 movement; got none")

    @property
    def frames(self) -> int:
        """Frames until the last body has stopped."""
        return max(track.start + len(track.mean) for track in self.tracks)

    def page(self) -> str:
        """The whole page as HTML."""
        template = files("zoo.faces").joinpath("player.html").read_text(encoding="utf-8")
        data = json.dumps(self._data(), separators=(",", ":"), allow_nan=False)
        safe = data.replace("<", "\\u003c").replace("&", "\\u0026")
        return template.replace("__TITLE__", html.escape(self.title)).replace("__DATA__", safe)

    def save(self, file: str | Path) -> Path:
        """Write the page."""
        Path(file).parent.mkdir(parents=True, exist_ok=True)
        Path(file).write_text(self.page(), encoding="utf-8")
        return Path(file)

    def _repr_html_(self) -> str:
        """A frame of its own, so that several players in a notebook leave each other alone."""
        return (
            f'<iframe title="{html.escape(self.title)}" style="width:100%;height:{HEIGHT}px;'
            f'border:0" srcdoc="{html.escape(self.page())}"></iframe>'
        )

    def _data(self) -> dict[str, Any]:
        return {
            "joints": self.tracks[0].mean.shape[1],
            "frames": self.frames,
            "rate": self.rate,
            "edges": self.body.edges,
            "sides": self.body.sides,
            "colours": {**COLOURS, "middle": "#888888"},
            "marks": self.marks,
            "tracks": [
                {
                    "name": track.name,
                    "colour": PALETTE[i % len(PALETTE)],
                    "start": track.start,
                    "mean": _packed(track.mean),
                    "draws": [] if track.draws is None else [_packed(d) for d in track.draws],
                }
                for i, track in enumerate(self.tracks)
            ],
        }


def play(
    *shown: Sequences | Prediction,
    names: Sequence[str] = (),
    item: int = 0,
    body: Body | None = None,
    title: str = "Movement",
    marks: Sequence[tuple[int, str]] = (),
    ghosts: int = GHOSTS,
    seed: int = 0,
) -> Player:
    """Movement ``item`` of data and predictions, side by side or over each other.

    A prediction brings ``ghosts`` joint draws where it has any; a forecast begins at its own frame
    (``offset``). ``names`` are the tracks' titles; ``marks`` pairs of a frame and a word.

    >>> import zoo
    >>> arm = zoo.load_data("robot-arm")
    >>> play(arm, names=["demonstration"]).frames
    76
    """
    if not shown:
        raise ValueError("play needs at least 1 movement or prediction; got none")
    first = _channels(shown[0])
    for other in shown[1:]:
        if _channels(other) != first:
            raise ValueError("all movements of a player must have the same channels")
    stage = body_for(first, body)
    titles = [*names, *(_title(s) for s in shown[len(names) :])]
    tracks = tuple(
        _track(stage, s, name, item, ghosts, seed) for s, name in zip(shown, titles, strict=True)
    )
    rate = shown[0].rate
    return Player(body=stage, tracks=tracks, rate=rate, title=title, marks=tuple(marks))


def _track(
    body: Body, shown: Sequences | Prediction, name: str, item: int, ghosts: int, seed: int
) -> Track:
    count = len(shown) if isinstance(shown, Sequences) else shown.shape[0]
    if not 0 <= item < count:
        raise ValueError(f"item must be between 0 and {count - 1}; got {item}")
    channels = _channels(shown)
    if isinstance(shown, Sequences):
        length = int(shown.lengths[item])
        return Track(name=name, mean=body.place(shown.values[item, :length], channels))
    draws = None
    if shown.has_spread and ghosts:
        try:
            draws = body.place(shown.sample(ghosts, seed=seed)[:, item], channels)
        except NoJointSamplesError:
            draws = None
    mean = body.place(shown.mean[item], channels)
    return Track(name=name, mean=mean, draws=draws, start=shown.offset)


def _channels(shown: Sequences | Prediction) -> tuple[str, ...]:
    if not isinstance(shown, Sequences | Prediction):
        raise TypeError(f"play shows Sequences and Predictions; got {type(shown).__name__}")
    return shown.channels if isinstance(shown, Sequences) else shown.names


def _title(shown: Sequences | Prediction) -> str:
    return shown.name if isinstance(shown, Sequences) else shown.task


def _packed(places: Tensor) -> list[float]:
    """Millimetres."""
    if not bool(torch.isfinite(places).all()):
        raise ValueError("positions are not finite: missing entries must be filled in before")
    found: list[float] = (places.double() * 1000).round().div(1000).flatten().tolist()
    return found
