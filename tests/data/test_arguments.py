"""Numbers of the wrong kind, and things that are no records, are refused by name in every verb."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest
from support import movements, run_of

import zoo

DATA, NONE = movements(), movements().arrays


def forecast(**given: Any) -> Any:
    return run_of("last-value").forecast(DATA.first(8), **{"horizon": 3, **given})


def generate(**given: Any) -> Any:
    return run_of("promp").generate(DATA[:1], **given)


def evaluate(**given: Any) -> Any:
    return zoo.evaluate(run_of("last-value"), DATA.resampled(20), **given)


def fit(**given: Any) -> Any:
    return zoo.fit(run_of("pca").assembly, DATA, **given)


def arrays(**given: Any) -> Any:
    return zoo.Sequences.from_arrays(DATA.values.numpy(), rate=30.0, **given)


WRONG: dict[str, tuple[Callable[[], Any], type[Exception], str]] = {
    "horizon 1.5": (lambda: forecast(horizon=1.5), TypeError, "horizon must be a whole number of"),
    "horizon 0": (lambda: forecast(horizon=0), ValueError, "horizon must be at least 1 frame"),
    "draws '9'": (lambda: forecast(draws="9"), TypeError, "draws must be a whole number; got '9'"),
    "draws -3": (lambda: forecast(draws=-3), ValueError, "draws must be at least 1; got -3"),
    "seed 1.5": (lambda: forecast(seed=1.5), TypeError, "seed must be a whole number; got 1.5"),
    "seed None": (lambda: zoo.create("vae", DATA, seed=None), TypeError, "seed must be a whole"),
    "seed 2⁷⁰": (lambda: forecast(seed=2**70), ValueError, "seed must be below 2**63"),
    "load 3": (lambda: zoo.load(3), TypeError, "load takes the folder that a run was saved in: a"),
    "load ''": (lambda: zoo.load(""), ValueError, "got an empty one"),
    "save None": (lambda: run_of("pca").save(None), TypeError, "save needs a folder: a path, as"),
    "run_dir": (lambda: fit(run_dir=3), TypeError, "run_dir must be a folder: a path, as text"),
    "resume": (
        lambda: fit(run_dir="x", resume=[]),
        ValueError,
        "'never', 'auto' or 'must'; got []",
    ),
    "device": (lambda: zoo.create("pca", DATA, device=1.5), TypeError, "device must be text, such"),
    "goal 'x'": (lambda: generate(goal="x"), TypeError, "goal"),
    "goal nan": (lambda: generate(goal=[float("nan")] * 7), ValueError, "goal must be finite in"),
    "goal shape": (lambda: generate(goal=[1.0]), ValueError, "goal has shape (1,); (7,) or (1, 7)"),
    "duration '2'": (
        lambda: generate(duration="2"),
        TypeError,
        "duration must be a number; got '2'",
    ),
    "duration True": (lambda: generate(duration=True), TypeError, "duration must be a number; got"),
    "duration nan": (
        lambda: generate(duration=float("nan")),
        ValueError,
        "must be positive and fin",
    ),
    "start 1.5": (
        lambda: generate(onto=DATA[1], start=1.5),
        TypeError,
        "start must be a whole num",
    ),
    "steps None": (
        lambda: generate(onto=DATA[1], steps=None),
        TypeError,
        "steps must be a whole nu",
    ),
    "onto 3": (lambda: generate(onto=3), TypeError, "got int"),
    "tasks 3": (lambda: evaluate(tasks=3), TypeError, "tasks must be a list; got 3"),
    "tasks text": (
        lambda: evaluate(tasks="forecast"),
        TypeError,
        "tasks must be a list; got 'fore",
    ),
    "tasks none": (lambda: evaluate(tasks=[]), ValueError, "tasks names none; it has"),
    "setup 3": (lambda: evaluate(setup=3), TypeError, "setup must be a zoo.Setup; got int"),
    "pattern": (lambda: zoo.list_models(3), TypeError, "a pattern of names is text, such as"),
    "can": (lambda: zoo.list_models(can=[]), ValueError, "no capability []; there are"),
    "rows": (
        lambda: forecast().rows("x"),
        TypeError,
        "the index of sequences of a prediction must",
    ),
    "rows far": (lambda: forecast().rows([9]), IndexError, "there are 8 sequences of a prediction"),
    "cdf": (lambda: forecast().cdf("x"), TypeError, "value must be a tensor of numbers; got str"),
    "select 3": (lambda: DATA.select(3), TypeError, "channel names must be a list; got 3"),
    "concatenate": (lambda: zoo.concatenate(3), TypeError, "records must be a list; got 3"),
    "concatenate x": (
        lambda: zoo.concatenate(["x"]),
        ValueError,
        "of Sequences or Pairs; got ['x']",
    ),
    "ensemble": (lambda: zoo.Ensemble(members=("x",)), TypeError, "members must be runs; got str"),
    "assemblies": (
        lambda: zoo.fit_ensemble(3, DATA),
        TypeError,
        "assemblies must be a list; got 3",
    ),
    "units": (lambda: arrays(units=3), TypeError, "units must be a list; got 3"),
    "channels": (lambda: arrays(channels=3), TypeError, "channel names must be a list; got 3"),
    "groups": (lambda: arrays(groups=3), TypeError, "groups must be a mapping of names to columns"),
    "play": (lambda: zoo.play(3), TypeError, "play shows Sequences and Predictions; got int"),
    "plot": (lambda: DATA.plot(channels=3), TypeError, "channels must be a list; got 3"),
    "interval 90": (lambda: forecast().interval(90), ValueError, "got 90: for 90 % write 0.9"),
    "interval 0": (lambda: forecast().interval(0), ValueError, "between 0 and 1; got 0"),
    "quantile '0.9'": (lambda: forecast().quantile("0.9"), TypeError, "one number between 0 and"),
    "sample 1.5": (lambda: forecast().sample(1.5), TypeError, "count must be a whole number"),
    "setup": (lambda: zoo.Setup(horizon=1.5), TypeError, "horizon must be a whole number"),
    "first 1.5": (lambda: DATA.first(1.5), TypeError, "frames must be a whole number of frames"),
    "windows 1.5": (lambda: DATA.windows(1.5), TypeError, "length must be a whole number"),
    "parts": (lambda: DATA.split(by="trial", parts=0.5), TypeError, "parts must be a list of"),
    "create": (lambda: zoo.create("dmp", NONE), TypeError, "create takes Sequences or Pairs; got"),
    "create name": (lambda: zoo.create("dmp", "a.csv"), TypeError, "zoo.load_data('a.csv') reads"),
    "fit": (lambda: zoo.fit(run_of("dmp").assembly, NONE), TypeError, "fit takes Sequences or"),
    "fit name": (lambda: zoo.fit("dmp", DATA), TypeError, "fit trains what zoo.create gives"),
    "evaluate": (lambda: zoo.evaluate(run_of("dmp"), NONE), TypeError, "evaluate takes Sequences"),
    "calibrate": (lambda: run_of("dmp").calibrate(NONE), TypeError, "calibrate takes Sequences"),
    "ar": (
        lambda: zoo.fit(zoo.create("ar", DATA.first(2)), DATA.first(2)),
        ValueError,
        "ar needs movements of at least 3 frames",
    ),
    "promp": (
        lambda: zoo.fit(zoo.create("promp", DATA.first(2)), DATA.first(2)),
        ValueError,
        "movements of at least 3 frames are needed; one of them has 2",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_means_nothing_is_refused_by_name(case: str) -> None:
    call, error, message = WRONG[case]
    with pytest.raises(error, match=re.escape(message)):
        call()
