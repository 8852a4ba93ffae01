"""Commands that repeat what is stored: experiments of the thesis, and leaderboards."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from zoo.faces.options import Json
from zoo.faces.terminal import show

__all__ = ["experiment", "interruptible", "leaderboard"]


def experiment(
    identifier: Annotated[
        str | None, typer.Argument(help="Id, e.g. E6.1; none lists all.", metavar="ID")
    ] = None,
    output: Annotated[Path, typer.Option(help="Folder for table and figure.")] = Path("results"),
    quick: Annotated[bool, typer.Option(help="A short training, to see that it runs.")] = False,
    json: Json = False,
) -> None:
    """Reproduce an experiment of the thesis: its table and figure beside the printed ones."""
    from zoo.faces.tables import data_table, print_json
    from zoo.studies import EXPERIMENTS, run_experiment

    if identifier is None:
        listing = {k: e.summary for k, e in EXPERIMENTS.items()}
        print_json(listing) if json else show(data_table(listing))
        return
    _announce(identifier, quick)
    with interruptible("repeat the command to go on from the last checkpoint"):
        result = run_experiment(identifier, output, quick=quick, progress=not json)
    print_json(result.to_json()) if json else show(result)


def leaderboard(
    name: Annotated[
        str | None, typer.Argument(help="A protocol; none lists all.", metavar="PROTOCOL")
    ] = None,
    models: Annotated[str, typer.Option(help="Entries, a comma between; a+b: an ensemble.")] = "",
    seeds: Annotated[int, typer.Option(help="Trainings of each entry, seeds 0, 1, …")] = 1,
    folds: Annotated[
        int, typer.Option(help="Folds of whole groups: one judged, one calibrates, others train.")
    ] = 4,
    data: Annotated[str | None, typer.Option(help="Not a protocol: movements by name.")] = None,
    seen: Annotated[int, typer.Option(help="With --data: frames observed.")] = 0,
    horizon: Annotated[int, typer.Option(help="With --data: frames to forecast.")] = 0,
    hidden: Annotated[
        str,
        typer.Option(help="With --data: channels or joints to impute, commas between."),
    ] = "",
    by: Annotated[str, typer.Option(help="With --data: group column of the folds.")] = "trial",
    jobs: Annotated[int, typer.Option(help="Processes, of one thread each.")] = 1,
    output: Annotated[Path, typer.Option(help="Folder for table and figure.")] = Path("results"),
    json: Json = False,
) -> None:
    """Compare models on movements held out, with intervals over groups and paired tests.

    Example: `zoo leaderboard --data cmu-mocap/35-run --seen 20 --horizon 40 --models mean,promp`
    """
    from zoo.faces.tables import data_table, print_json
    from zoo.studies.leaderboard import PROTOCOLS, run_leaderboard
    from zoo.studies.leaderboard.own import asked_for

    if name is None and data is None:
        listing = {k: f"{p.summary}; {p.protocol}" for k, p in PROTOCOLS.items()}
        print_json(listing) if json else show(data_table(listing))
        return
    with interruptible("repeat the command: what was found is kept under runs/leaderboard"):
        result = run_leaderboard(
            asked_for(name, data, seen, horizon, hidden, by),
            output,
            models=[m for m in models.split(",") if m],
            seeds=seeds,
            folds=folds,
            jobs=jobs,
            note=lambda line: print(line, file=sys.stderr),
        )
    print_json(result.to_json()) if json else show(result)


def _announce(identifier: str, quick: bool) -> None:
    """Say how long an experiment took when its stored result was measured."""
    from zoo.inference.progress import spoken
    from zoo.studies.stored import stored

    try:
        took = stored(identifier).payload
    except (OSError, LookupError, ValueError):
        return
    seconds = max(took.get("training_seconds") or 0.0, took.get("seconds") or 0.0)
    if seconds and not quick:
        told = f"{identifier}: {spoken(seconds)} of training when it was last measured"
        print(f"{told}; what is trained already under runs/ is not trained again", file=sys.stderr)


@contextmanager
def interruptible(advice: str) -> Iterator[None]:
    """Say where a command was stopped and how to go on, and end with code 130."""
    try:
        yield
    except KeyboardInterrupt as stop:
        where = str(stop).partition(";")[0] or "interrupted"
        print(f"zoo: {where}; {advice}", file=sys.stderr)
        raise typer.Exit(130) from None
