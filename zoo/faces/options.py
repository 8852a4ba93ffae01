"""Arguments that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = [
    "Data",
    "Figure",
    "Folder",
    "Json",
    "Output",
    "Rate",
    "Seed",
    "Settings",
    "Unseen",
    "Version",
]

Json = Annotated[bool, typer.Option("--json", help="Print JSON for machines.")]
Data = Annotated[
    str | None,
    typer.Option(
        "--data",
        help="Data set (see `zoo data`), or one's own file; default: the model's.",
    ),
]
Unseen = Annotated[
    str | None,
    typer.Option("--data", help="Data set or file; default: the run's test part."),
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", help="KEY=VALUE, a setting of the model; repeatable (see `zoo card`)."),
]
Folder = Annotated[Path, typer.Argument(help="Folder of a run that `zoo fit` wrote.")]
Seed = Annotated[int, typer.Option("--seed", help="Seed of split, parameters and noise.")]
Figure = Annotated[Path | None, typer.Option("--figure", help="Write a figure to this PNG.")]
Output = Annotated[
    Path | None, typer.Option("--output", help="Write a forecast with its bands: .csv or .nc.")
]
Rate = Annotated[
    float | None, typer.Option("--rate", help="Hz of a file of one's own that has no times.")
]


def _version(asked: bool) -> None:
    """Print the version and stop."""
    if asked:
        from zoo.version import __version__

        print(f"movezoo {__version__}")
        raise typer.Exit


Version = Annotated[
    bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
]
