"""What `zoo play` shows: data, or what a run makes of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from zoo import archive
from zoo.datasets.library import load_data
from zoo.datasets.records import Pairs, Sequences
from zoo.errors import NotCapableError, UnknownNameError
from zoo.evaluation.questions import Setup, beginning
from zoo.faces.commands import open_run
from zoo.faces.play import Player, play
from zoo.runs.run import Run

__all__ = ["screen", "screen_run"]


def screen(
    source: str,
    *,
    data: str | None = None,
    item: int = 0,
    seen: int | None = None,
    horizon: int | None = None,
    onto: int | None = None,
    start: int = 20,
    steps: int = 18,
) -> Player:
    """A player of a data set by name, or of a run by its folder, on its test part or ``data``."""
    if not archive.exists(Path(source), "run"):
        asked = {"seen": seen, "horizon": horizon, "onto": onto, "data": data}
        found = _recorded(source, [k for k, v in asked.items() if v is not None])
        _check(item, found)
        return play(found, names=["data"], item=item, title=_title(found, item))
    run, unseen = open_run(Path(source), data)
    return screen_run(
        run,
        _movements(unseen),
        item=item,
        seen=seen,
        horizon=horizon,
        onto=onto,
        start=start,
        steps=steps,
    )


def screen_run(
    run: Run,
    data: Sequences,
    *,
    item: int = 0,
    seen: int | None = None,
    horizon: int | None = None,
    onto: int | None = None,
    start: int = 20,
    steps: int = 18,
) -> Player:
    """Movement ``item`` beside its reconstruction, its forecast and its switch to ``onto``.

    The reconstruction and the forecast, after ``seen`` frames, are shown where the model can give
    them; a switch only where ``onto``, another movement of ``data``, is named.
    """
    _check(item, data)
    one, marks = data[item : item + 1], list[tuple[int, str]]()
    shown = [play(one, names=["data"])]
    if "reconstruct" in run.capabilities:
        shown.append(play(run.reconstruct(one), names=["reconstruction"]))
    if "forecast" in run.capabilities:
        known, ahead = Setup(seen=seen, horizon=horizon).frames(one, beyond=True)
        forecast = run.forecast(beginning(one, known, ahead), horizon=ahead)
        shown.append(play(forecast, names=["forecast"]))
        marks.append((known, "forecast begins"))
    if onto is not None:
        if "generate" not in run.capabilities:
            raise NotCapableError(
                f"{run.name} cannot switch movements; it can {', '.join(run.capabilities)}"
            )
        _check(onto, data)
        switched = run.generate(one, onto=data[onto : onto + 1], start=start, steps=steps)
        shown += [
            play(data[onto : onto + 1], names=["switched to"]),
            play(switched, names=["switch"]),
        ]
        marks += [(start, "switch begins"), (start + steps, "switch ends")]
    tracks = tuple(track for player in shown for track in player.tracks)
    title = f"{run.name}: {_title(data, item)}"
    return replace(shown[0], tracks=tracks, title=title, marks=tuple(marks), rate=data.rate)


def _recorded(source: str, asked: list[str]) -> Sequences:
    """The data set of that name, of which nothing can be asked that needs a model."""
    try:
        found = _movements(load_data(source))
    except UnknownNameError as error:
        raise UnknownNameError(f"{source} is no folder with a run, and {error}") from None
    if asked:
        raise ValueError(
            f"{asked[0]} needs a trained model, and {source} is a data set: "
            "zoo fit MODEL --run-dir FOLDER, then zoo play FOLDER"
        )
    return found


def _movements(data: Sequences | Pairs) -> Sequences:
    if not isinstance(data, Sequences):
        raise TypeError("only movements can be played; these data are pairs of input and target")
    return data


def _check(item: int, data: Sequences) -> None:
    if not 0 <= item < len(data):
        raise ValueError(f"movement must be between 0 and {len(data) - 1}; got {item}")


def _title(data: Sequences, item: int) -> str:
    said = ", ".join(_said(k, v[item]) for k, v in data.groups.items())
    return f"{data.name}, movement {item} ({said})" if said else f"{data.name}, movement {item}"


def _said(column: str, value: object) -> str:
    """``subject 35``, but ``trial_004`` where the value says its column."""
    return str(value) if str(value).startswith(column) else f"{column} {value}"
