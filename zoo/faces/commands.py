"""What the command line and the demo do with a run: train, reopen, forecast and draw."""

from __future__ import annotations

import csv
import json
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.table import Table as RichTable

from zoo import archive
from zoo.catalogue import CATALOGUE
from zoo.datasets.library import load_data, means_file
from zoo.datasets.records import Pairs, Sequences
from zoo.errors import DamagedRunError, NotCapableError
from zoo.evaluation.answers import clusters
from zoo.evaluation.questions import Setup, beginning
from zoo.evaluation.tasks import outcomes
from zoo.prediction.prediction import Prediction
from zoo.runs.assembly import create
from zoo.runs.fitting import fit
from zoo.runs.run import Run, load
from zoo.runs.units import fingerprints

__all__ = ["ForecastReport", "Recipe", "forecast_report", "open_run", "reliability_figure", "train"]

_PLAN = "plan.json"
_WORDS = {"none": None, "null": None, "true": True, "false": False}


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """What ``zoo fit`` was asked for; kept beside the run so that its test part can be found."""

    model: str
    data: str
    settings: dict[str, Any]
    by: str | None
    parts: tuple[float, ...]
    seed: int
    calibrate: str
    device: str
    rate: float | None = None

    @classmethod
    def parse(
        cls,
        model: str,
        data: str | None,
        settings: Sequence[str],
        by: str | None,
        parts: str,
        seed: int,
        calibrate: str,
        device: str,
        rate: float | None = None,
    ) -> Recipe:
        """A recipe from the words of a command line; each is checked and named when wrong."""
        methods = ("conformal", "isotonic", "scale", "none")
        if calibrate not in methods:
            raise ValueError(f"--calibrate is one of {', '.join(methods)}; got {calibrate!r}")
        return cls(
            model=model,
            data=_lasting(data or _own_data(model)),
            settings=dict(_setting(word) for word in settings),
            by=by,
            parts=_shares(parts),
            seed=seed,
            calibrate=calibrate,
            device=device,
            rate=rate,
        )

    def load(self) -> tuple[Any, Any, Any, Any]:
        """The data, split into train, val, calib and test."""
        given: dict[str, Any] = {} if self.rate is None else {"rate": self.rate}
        data = load_data(self.data, **given)
        by = self.by or next(iter(data.groups))
        train, val, calib, test = data.split(by=by, parts=self.parts, seed=self.seed)
        return train, val, calib, test

    @classmethod
    def kept(cls, folder: Path) -> Recipe | None:
        """The recipe that a folder's training followed."""
        path = folder / _PLAN
        if not path.is_file():
            return None
        try:
            saved = json.loads(path.read_text(encoding="utf-8"))
            return cls(**{**saved, "parts": tuple(saved["parts"])})
        except (ValueError, TypeError, KeyError) as error:
            raise DamagedRunError(f"{path} is not a recipe of `zoo fit`: {error}") from None


def train(
    recipe: Recipe,
    folder: Path,
    *,
    resume: bool = False,
    overwrite: bool = False,
    progress: bool = False,
) -> Run:
    """Fit, calibrate and save by a recipe.

    A folder that holds a training is taken only to ``resume`` the same one, or to ``overwrite``
    it, see :func:`zoo.fit`.
    """
    train, val, calib, _ = recipe.load()
    assembly = create(
        recipe.model, train, seed=recipe.seed, device=recipe.device, **recipe.settings
    )
    run = fit(
        assembly,
        train,
        val=val,
        run_dir=folder,
        resume="auto" if resume else "never",
        overwrite=overwrite,
        progress=progress,
    )
    archive.replace_file(folder / _PLAN, json.dumps(asdict(recipe), indent=1).encode())
    if recipe.calibrate != "none" and _enough(calib):
        run.calibrate(calib, method=recipe.calibrate)  # type: ignore[arg-type]
    run.save(folder)
    return run


def _enough(calib: Pairs | Sequences) -> bool:
    count = len(clusters(calib.groups, len(calib)).unique())
    if count < 2:
        warnings.warn(
            f"the calibration part holds {count} movement or item and at least 2 are needed: "
            "bands stay as the model gives them (more data, or other --parts)",
            stacklevel=3,
        )
    return count >= 2


def open_run(folder: Path, data: str | None = None) -> tuple[Run, Any]:
    """A run and the data to try it on: another data set, or the test part of its own.

    A run that was trained in Python is tried on the movements of its data set that it was neither
    trained nor calibrated on, nor chosen by.
    """
    run = load(folder)
    if data is not None:
        rate = run.assembly.layout.rate
        given: dict[str, Any] = {"rate": rate} if rate and means_file(data) else {}
        return run, load_data(data, **given)
    recipe = Recipe.kept(folder)
    return run, _unseen(run, folder) if recipe is None else recipe.load()[3]


def _unseen(run: Run, folder: Path) -> Any:
    """What is held out, for a run without a recipe, of the data that it names."""
    name, known = run.trained_on["name"], run.trained_on["fingerprints"]
    advice = f"{folder} holds no {_PLAN}: name a data set with --data"
    try:
        whole = load_data(name)
    except (LookupError, OSError, ValueError) as error:
        raise DamagedRunError(f"{advice} ({error})") from None
    found = fingerprints(whole)
    if not set(known) <= set(found):
        raise DamagedRunError(f"{advice}; {name!r} does not hold the movements it was trained on")
    seen = {*known, *run.calibrated_on, *run.trained_on.get("selected_on", ())}
    rows = [i for i, f in enumerate(found) if f not in seen]
    if not rows:
        raise DamagedRunError(f"{advice}; it was trained or calibrated on all of {name!r}")
    return whole[rows]


def _lasting(data: str) -> str:
    """The name of a data set, or where a file is, whatever folder a later command runs in."""
    return str(Path(data).resolve()) if means_file(data) else data


@dataclass(frozen=True, kw_only=True)
class ForecastReport:
    """A forecast with its 90 % bands, movement by movement."""

    prediction: Prediction
    seen: int
    groups: dict[str, tuple[str, ...]]

    def rows(self) -> list[dict[str, Any]]:
        """One row for every movement, frame and channel."""
        p = self.prediction
        low, high = p.interval(0.9)
        return [
            {
                **{k: v[s] for k, v in self.groups.items()},
                "frame": self.seen + t,
                "channel": name,
                "unit": p.units[c],
                "mean": float(p.mean[s, t, c]),
                "low_90": float(low[s, t, c]),
                "high_90": float(high[s, t, c]),
            }
            for s in range(p.shape[0])
            for t in range(p.shape[1])
            for c, name in enumerate(p.names)
        ]

    def to_json(self) -> list[dict[str, Any]]:
        """The rows as plain data."""
        return self.rows()

    def __rich__(self) -> RichTable:
        """The last forecast frame of every movement's first channels."""
        table = RichTable("movement", "frame", "channel", "mean", "90 % band", box=None)
        wanted = set(self.prediction.names[:4])
        last = self.seen + self.prediction.shape[1] - 1
        keys = list(self.groups)
        for row in self.rows():
            if row["frame"] == last and row["channel"] in wanted:
                who = " ".join(f"{k} {row[k]}" for k in keys)
                band = f"{row['low_90']:.3f} … {row['high_90']:.3f} {row['unit']}"
                table.add_row(who, str(last), row["channel"], f"{row['mean']:.3f}", band)
        return table


def forecast_report(
    run: Run,
    data: Sequences,
    *,
    seen: int | None,
    horizon: int | None,
    output: Path | None = None,
    figure: Path | None = None,
) -> ForecastReport:
    """Forecast all movements after their first frames; write and draw what was asked for.

    The forecast may go on beyond the last frame known.
    """
    if "forecast" not in run.capabilities:
        raise NotCapableError(f"{run.name} cannot forecast; it can {', '.join(run.capabilities)}")
    setup = Setup(seen=seen, horizon=horizon)
    first, ahead = setup.frames(data, beyond=True)
    prediction = run.forecast(beginning(data, first, ahead), horizon=ahead)
    report = ForecastReport(prediction=prediction, seen=first, groups=data.groups)
    if output is not None:
        _write(output, report)
    if figure is not None:
        forecast_figure(prediction, data, first, figure)
    return report


def forecast_figure(prediction: Prediction, data: Sequences, seen: int, path: Path) -> None:
    """Draw the bands of the channels that move most, for the first movement."""
    from zoo.evaluation.figures.bands import forecast_bands

    figure = forecast_bands(prediction, data.values, seen=seen, mask=data.mask)
    figure.savefig(path, dpi=150)


def reliability_figure(run: Run, data: Pairs | Sequences, path: Path) -> None:
    """Draw nominal against observed coverage of every task."""
    from zoo.evaluation.figures.bands import reliability

    answers = [t for t in outcomes(run, data) if t.prediction.has_spread]
    lines = {t.task: (t.prediction, t.truth, t.mask, t.groups) for t in answers}
    reliability(lines).savefig(path, dpi=150)


def _own_data(model: str) -> str:
    """The data set that an entry names for itself."""
    found = CATALOGUE[model].dataset
    if found is None:
        raise ValueError(f"{model} names no data set of its own: give one with --data")
    return found


def _setting(word: str) -> tuple[str, Any]:
    key, equals, value = word.partition("=")
    if not equals or not key:
        raise ValueError(f"--set takes KEY=VALUE; got {word!r}")
    return key.strip().replace("-", "_"), _value(value.strip())


def _value(word: str) -> Any:
    """A number, several with commas, true, false, none, or the word itself."""
    if word.lower() in _WORDS:
        return _WORDS[word.lower()]
    try:
        return json.loads(f"[{word}]" if "," in word and not word.startswith("[") else word)
    except ValueError:
        return word


def _shares(words: str) -> tuple[float, ...]:
    try:
        shares = tuple(float(w) for w in words.split(","))
    except ValueError:
        raise ValueError(f"--parts takes four shares like .6,.1,.15,.15; got {words!r}") from None
    if len(shares) != 4:
        raise ValueError(f"--parts takes four shares (train,val,calib,test); got {len(shares)}")
    return shares


def _write(path: Path, report: ForecastReport) -> None:
    """CSV, or NetCDF where the file is named so."""
    if path.suffix != ".nc":
        _write_csv(path, report.rows())
        return
    from zoo.evaluation.labelled import dataset

    dataset(report.prediction, report.groups).to_netcdf(path, engine="h5netcdf")


def _write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
