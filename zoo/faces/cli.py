"""Command line of the zoo: look, fit, evaluate, forecast, and reproduce an experiment."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from zoo.faces.options import (
    Data,
    Figure,
    Folder,
    Json,
    Output,
    Rate,
    Seed,
    Settings,
    Unseen,
    Version,
)
from zoo.faces.reproduce import experiment, interruptible, leaderboard
from zoo.faces.terminal import said_plainly, show

__all__ = ["app", "main"]

EXIT_CODES = """Exit codes: 0 done; 1 training or reading failed; 2 a wrong argument, name or data
set; 130 interrupted (checkpoints are kept: repeat the command with --resume)."""

app = typer.Typer(
    name="zoo",
    help="A probabilistic programming model zoo for movement.\n\n"
    "Start with `zoo list`, read `zoo card vae-dmp`, then `zoo fit vae-dmp --run-dir runs/first` "
    "and `zoo evaluate runs/first`.",
    epilog=EXIT_CODES,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)


@app.callback()
def root(version: Version = False) -> None:
    """Options of the command itself."""


@app.command("list")
def list_command(
    pattern: Annotated[str, typer.Argument(help="Glob, e.g. `'*dmp*'`.")] = "*",
    can: Annotated[str | None, typer.Option("--can", help="Only models with this task.")] = None,
    json: Json = False,
    markdown: Annotated[bool, typer.Option(help="Print the table as Markdown.")] = False,
) -> None:
    """Models by name, with what they can do."""
    from zoo.catalogue import CATALOGUE
    from zoo.faces.tables import models_markdown, models_table, print_json

    entries = [CATALOGUE[name] for name in CATALOGUE.names(pattern, can=can)]
    if json:
        rows = [
            {"name": e.name, "summary": e.summary, "thesis": e.thesis, "can": e.capabilities}
            for e in entries
        ]
        print_json(rows)
    elif markdown:
        print(models_markdown(entries))
    else:
        show(models_table(entries))


@app.command()
def card(name: Annotated[str, typer.Argument(help="Name of a model.")], json: Json = False) -> None:
    """One model in full: mathematics, thesis section, settings and measured results."""
    from zoo.faces.cards import card as make_card
    from zoo.faces.tables import print_json

    found = make_card(name)
    if json:
        print_json(found.to_json())
    else:
        show(found)


@app.command()
def data(
    name: Annotated[str | None, typer.Argument(help="Name of a data set; none lists all.")] = None,
    folder: Annotated[Path | None, typer.Option(help="Where the files are.")] = None,
    rate: Rate = None,
    json: Json = False,
) -> None:
    """Data sets by name, or one or a file described: movements, frames, rate, channels, groups."""
    from zoo.datasets.library import list_data, load_data
    from zoo.faces.tables import data_table, describe, print_json

    if name is None:
        names = list_data()
        print_json(names) if json else show(data_table(names))
        return
    given: dict[str, Any] = {
        k: v for k, v in {"folder": folder, "rate": rate}.items() if v is not None
    }
    description = describe(load_data(name, **given))
    print_json(description) if json else show(data_table(description))


@app.command()
def fit(
    model: Annotated[str, typer.Argument(help="Name of a model (see `zoo list`).")],
    run_dir: Annotated[Path, typer.Option(help="Folder for checkpoints and the run.")],
    data: Data = None,
    settings: Settings = None,
    by: Annotated[str | None, typer.Option(help="Group column to split by.")] = None,
    parts: Annotated[str, typer.Option(help="train,val,calib,test shares.")] = ".6,.1,.15,.15",
    seed: Seed = 0,
    calibrate: Annotated[str, typer.Option(help="conformal, isotonic, scale or none.")] = (
        "conformal"
    ),
    rate: Rate = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint there.")] = (
        False
    ),
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a run there.")] = False,
    device: Annotated[str, typer.Option(help="cpu, cuda, …")] = "cpu",
    output: Output = None,
    figure: Figure = None,
    json: Json = False,
) -> None:
    """Train a model on four-way split data and calibrate its bands on held-out movements.

    Example: `zoo fit vae-dmp --data cmu-mocap/35-walk --set latent_dim=5 --run-dir runs/walk`

    Of one's own: `zoo fit promp --data walk.csv --run-dir runs/own --figure bands.png`
    """
    from zoo.faces.commands import Recipe, forecast_report, train
    from zoo.faces.tables import print_json, report_table
    from zoo.runs.run import evaluate as score

    recipe = Recipe.parse(model, data, settings or [], by, parts, seed, calibrate, device, rate)
    advice = "repeat the command with --resume to go on from the last checkpoint, if there is one"
    with interruptible(advice):
        run = train(recipe, run_dir, resume=resume, overwrite=overwrite, progress=not json)
    test = recipe.load()[3]
    if output is not None or figure is not None:
        forecast_report(run, test, seen=None, horizon=None, output=output, figure=figure)
    if json:
        print_json(score(run, test).to_json() | {"report": run.report()})
        return
    if run.report():
        show(report_table(run))
    show(score(run, test))
    show(f"Run written to [bold]{run_dir}[/]; next: zoo evaluate {run_dir}")


@app.command()
def evaluate(
    run_dir: Folder,
    data: Unseen = None,
    task: Annotated[list[str] | None, typer.Option(help="Only this task; repeatable.")] = None,
    figure: Figure = None,
    json: Json = False,
) -> None:
    """Scores of a run on its test part, or on all of another data set: errors and calibration."""
    from zoo.faces.commands import open_run, reliability_figure
    from zoo.faces.tables import print_json
    from zoo.runs.run import evaluate as score

    run, test = open_run(run_dir, data)
    table = score(run, test, tasks=task)
    print_json(table.to_json()) if json else show(table)
    if figure is not None:
        reliability_figure(run, test, figure)


@app.command()
def forecast(
    run_dir: Folder,
    data: Unseen = None,
    seen: Annotated[int | None, typer.Option(help="Frames shown to the model.")] = None,
    horizon: Annotated[int | None, typer.Option(help="Frames to forecast.")] = None,
    output: Output = None,
    figure: Figure = None,
    json: Json = False,
) -> None:
    """Forecast the test movements of a run with calibrated bands; print, write or draw them."""
    from zoo.faces.commands import forecast_report, open_run

    run, test = open_run(run_dir, data)
    report = forecast_report(run, test, seen=seen, horizon=horizon, output=output, figure=figure)
    if json:
        from zoo.faces.tables import print_json

        print_json(report.to_json())
    else:
        show(report)


@app.command("play")
def play_command(
    source: Annotated[str, typer.Argument(help="A data set by name, or a run's folder.")],
    output: Annotated[Path, typer.Option(help="The page to write.")] = Path("movement.html"),
    data: Unseen = None,
    movement: Annotated[int, typer.Option(help="Which movement, from 0.")] = 0,
    seen: Annotated[int | None, typer.Option(help="Frames shown to the forecast.")] = None,
    horizon: Annotated[int | None, typer.Option(help="Frames to forecast.")] = None,
    onto: Annotated[int | None, typer.Option(help="Switch to this movement, from 0.")] = None,
    start: Annotated[int, typer.Option(help="With --onto: frame where it begins.")] = 20,
    steps: Annotated[int, typer.Option(help="With --onto: frames it takes.")] = 18,
) -> None:
    """Play a movement in a page: data, reconstruction, forecast with its bands, and a switch."""
    from zoo.faces.screening import screen

    player = screen(
        source,
        data=data,
        item=movement,
        seen=seen,
        horizon=horizon,
        onto=onto,
        start=start,
        steps=steps,
    )
    player.save(output)
    names = ", ".join(track.name for track in player.tracks)
    print(f"{player.title}: {names}; {player.frames} frames")
    print(f"Page written to {output}; open it in any browser")


app.command()(experiment)
app.command()(leaderboard)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; what the user can mend is one line on stderr, not a traceback."""
    from zoo.errors import DamagedRunError, RunLockedError, TrainingError

    try:
        with said_plainly():
            app(arguments)
    except SystemExit as stop:
        return int(stop.code or 0)
    except (DamagedRunError, TrainingError, RunLockedError, OSError, FloatingPointError) as error:
        print(f"zoo: {error}", file=sys.stderr)
        return 1
    except (ValueError, TypeError, LookupError) as error:
        print(f"zoo: {error}", file=sys.stderr)
        return 2
    return 0
