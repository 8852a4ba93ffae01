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


WRONG: dict[str, tuple[Callable[[], Any], type[Exception], str]] = {
    "horizon 1.5": (lambda: forecast(horizon=1.5), TypeError, "horizon must be a whole number of"),
    "horizon 0": (lambda: forecast(horizon=0), ValueError, "horizon must be at least 1 frame"),
    "draws '9'": (lambda: forecast(draws="9"), TypeError, "draws must be a whole number; got '9'"),
    "draws -3": (lambda: forecast(draws=-3), ValueError, "draws must be at least 1; got -3"),
    "seed 1.5": (lambda: forecast(seed=1.5), TypeError, "seed must be a whole number; got 1.5"),
    "seed None": (lambda: zoo.create("vae", DATA, seed=None), TypeError, "seed must be a whole"),
    "seed 2⁷⁰": (lambda: forecast(seed=2**70), ValueError, "seed must be below 2**63"),
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
