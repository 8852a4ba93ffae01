"""Sealed run folders: whole after a crash at any step; hostile ones refused with their reason."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from support import assembly_of, movements
from torch import Tensor

import zoo
from zoo import archive
from zoo.catalogue import CATALOGUE
from zoo.errors import DamagedRunError, NotRegisteredError
from zoo.runs.disk import FORMAT_VERSION

Meta, Tensors = dict[str, Any], dict[str, Tensor]
STEPS = ("open", "fsync", "replace", "unlink")
pytestmark = pytest.mark.usefixtures("unannotated")


@pytest.fixture(scope="module")
def run() -> zoo.Run:
    """A calibrated run whose tensors are of every kind that a run can keep."""
    assembly = assembly_of(CATALOGUE["pca"])
    run = zoo.fit(assembly, movements()[:4])
    return run.calibrate(movements()[4:], method="isotonic", tasks=["reconstruct"])


@pytest.fixture(scope="module")
def parts(run: zoo.Run, tmp_path_factory: pytest.TempPathFactory) -> tuple[Meta, Tensors]:
    """What a run folder holds, without its seal."""
    folder = run.save(tmp_path_factory.mktemp("good"))
    meta, tensors = archive.read(folder, "run", version=FORMAT_VERSION)
    return {k: v for k, v in meta.items() if k not in _HEAD}, tensors


_HEAD = ("format", "version", "tensors", "sha256")


def forged(folder: Path, meta: Meta, tensors: Tensors) -> Path:
    """A folder whose hash and seal are right, whatever it holds."""
    archive.write(folder, "run", meta, tensors, version=FORMAT_VERSION)
    return folder


def forged_index(folder: Path, **change: object) -> Path:
    """The index of a folder changed and sealed anew."""
    index = folder / "run.json"
    body = {**json.loads(index.read_text()), **change}
    del body["seal"]
    index.write_text(json.dumps({**body, "seal": archive._seal(body)}))
    return folder


def test_what_is_not_changed_loads(parts: tuple[Meta, Tensors], tmp_path: Path) -> None:
    """The forger of these tests is not what makes loading fail."""
    again = zoo.load(forged_index(forged(tmp_path / "run", *parts)))
    assert again.calibration.tasks == ("reconstruct",)


def test_a_run_saved_without_its_questions_keeps_its_bands(
    run: zoo.Run, parts: tuple[Meta, Tensors], tmp_path: Path
) -> None:
    """Corrections were kept by task alone before: they are read, as of unknown questions."""
    meta, tensors = parts
    (state,) = meta["calibration"]
    old = {k: v for k, v in state.items() if k in ("kind", "groups")}
    names = {k: k.replace("calibration.0", "recalibration.reconstruct") for k in tensors}
    body = {k: v for k, v in meta.items() if k != "calibration"}
    again = zoo.load(
        forged(
            tmp_path / "run",
            {**body, "recalibrations": {"reconstruct": old}},
            {names[k]: v for k, v in tensors.items()},
        )
    )
    one, two = (r.reconstruct(movements()[4:]).interval(0.9) for r in (run, again))
    assert torch.equal(one[0], two[0]) and torch.equal(one[1], two[1])


@pytest.mark.parametrize("step", STEPS)
def test_a_crash_while_saving_leaves_the_old_run_or_the_new(
    run: zoo.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    """Crash at the first, second, … call of each system call; a second try then succeeds."""
    new = zoo.fit(assembly_of(CATALOGUE["pca"]), movements()[2:])
    means = [r.model.mean for r in (run, new)]
    crashes = 0
    for call in range(6):
        folder = run.save(tmp_path / f"{step}{call}")
        _crash(monkeypatch, step, call)
        try:
            new.save(folder, overwrite=True)
        except OSError:
            crashes += 1
        finally:
            monkeypatch.undo()
        assert any(torch.equal(zoo.load(folder).model.mean, m) for m in means)
        new.save(folder, overwrite=True)
        assert torch.equal(zoo.load(folder).model.mean, means[1])
        assert len(list(folder.iterdir())) == 2
    assert crashes


def _crash(patch: pytest.MonkeyPatch, step: str, at: int) -> None:
    owner: Any = Path if step in ("open", "unlink") else archive.os
    original, count = getattr(owner, step), iter(range(99))

    def crash(*args: object, **options: object) -> object:
        if next(count) == at:
            raise OSError("power cut")
        return original(*args, **options)

    patch.setattr(owner, step, crash)


@pytest.mark.parametrize(
    "name",
    ["../good/run.json", "..", "", "/etc/passwd", "run-0.safetensors", "a\0b", "\ud800", 5, None],
)
def test_tensors_outside_the_folder_are_not_opened(
    parts: tuple[Meta, Tensors], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: object
) -> None:
    folder = forged_index(forged(tmp_path / "run", *parts), tensors=name)
    index, read = folder / "run.json", Path.read_bytes
    opened: list[Path] = []
    monkeypatch.setattr(Path, "read_bytes", lambda path: opened.append(path) or read(path))
    with pytest.raises(DamagedRunError, match="a run keeps no such file"):
        zoo.load(folder)
    assert opened == [index]


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a": ' * 100_000, "\0", '{"format": 1}', "5"])
def test_json_that_is_no_index_is_refused(run: zoo.Run, tmp_path: Path, text: str) -> None:
    folder = run.save(tmp_path)
    (folder / "run.json").write_text(text)
    with pytest.raises(DamagedRunError, match="not a readable run"):
        zoo.load(folder)


def test_numbers_that_json_has_not_are_refused(run: zoo.Run, tmp_path: Path) -> None:
    folder = run.save(tmp_path)
    text = (folder / "run.json").read_text()
    (folder / "run.json").write_text(text.replace('"seed": 0', '"seed": NaN'))
    with pytest.raises(DamagedRunError, match="NaN is not JSON"):
        zoo.load(folder)


def test_a_file_that_is_no_safetensors_is_refused(
    parts: tuple[Meta, Tensors], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(archive, "save_tensors", lambda tensors: b"\x80\x04cos\nsystem\n.")
    with pytest.raises(DamagedRunError, match="not a safetensors file"):
        zoo.load(forged(tmp_path / "run", *parts))


WRONG: list[tuple[str, object]] = [
    *((key, bad) for key in ("entry", "settings", "layout", "scaler") for bad in (None, 5, [1])),
    *((key, bad) for key in ("seed", "seconds") for bad in (None, "x", [1], {"a": 1})),
    *((key, bad) for key in ("history", "versions") for bad in (None, "x", [1], {"a": 1})),
    *(("trained_on", bad) for bad in (None, "x", {}, {"name": "a", "fingerprints": 5})),
    *(("calibration", bad) for bad in (None, {"a": 1}, [{"kind": "scale"}])),
    *(("recalibrations", bad) for bad in (None, [1], {"reconstruct": {"kind": "other"}})),
    ("entry", "os:system"),
    ("entry", "gp"),
    ("settings", {"no_such_setting": 1}),
    ("settings", {"latent_dim": "five"}),
    ("settings", {"latent_dim": 10**12}),
    ("seed", 2**70),
]


@pytest.mark.parametrize(("key", "bad"), WRONG)
def test_an_index_of_wrong_types_is_refused(
    parts: tuple[Meta, Tensors], tmp_path: Path, key: str, bad: object
) -> None:
    meta, tensors = parts
    with pytest.raises(DamagedRunError, match="does not describe a run"):
        zoo.load(forged(tmp_path / "run", {**meta, key: bad}, tensors))


def test_a_run_of_an_entry_that_nobody_registered_is_told_of(
    parts: tuple[Meta, Tensors], tmp_path: Path
) -> None:
    meta, tensors = parts
    with pytest.raises(NotRegisteredError, match=r"'no-such-model'.* is not registered here"):
        zoo.load(forged(tmp_path / "run", {**meta, "entry": "no-such-model"}, tensors))


@pytest.mark.parametrize(
    ("key", "name", "bad", "reason"),
    [
        ("layout", "units", ["rad"], "7 channels have 1 units"),
        ("layout", "channels", ["hip"] * 7, "must be distinct"),
        ("layout", "kind", "images", "kind"),
        ("scaler", "kind", "log", "scaling is one of"),
        ("scaler", "channel_scale", [1.0], "two equal vectors"),
        ("scaler", "channel_scale", [0.0] * 7, "must be positive"),
        ("scaler", "channel_scale", [[1.0] * 7], "two equal vectors"),
        ("scaler", "input_shift", None, "does not describe"),
        ("scaler", "evil", [1.0], "evil"),
    ],
)
def test_parts_that_contradict_each_other_are_refused(
    parts: tuple[Meta, Tensors], tmp_path: Path, key: str, name: str, bad: object, reason: str
) -> None:
    meta, tensors = copy.deepcopy(parts)
    meta[key][name] = bad
    with pytest.raises(DamagedRunError, match=reason):
        zoo.load(forged(tmp_path / "run", meta, tensors))


def test_scaling_of_other_channels_is_refused(parts: tuple[Meta, Tensors], tmp_path: Path) -> None:
    meta, tensors = copy.deepcopy(parts)
    meta["scaler"].update(channel_scale=[1.0], channel_shift=[0.0])
    with pytest.raises(DamagedRunError, match="1 channels; the run has 7"):
        zoo.load(forged(tmp_path / "run", meta, tensors))


@pytest.mark.parametrize("key", ["entry", "settings", "layout", "scaler", "seed", "trained_on"])
def test_what_is_missing_is_named(parts: tuple[Meta, Tensors], tmp_path: Path, key: str) -> None:
    meta, tensors = parts
    with pytest.raises(DamagedRunError, match=key):
        zoo.load(forged(tmp_path / "run", {k: v for k, v in meta.items() if k != key}, tensors))


def _with_nan(value: Tensor) -> Tensor:
    return torch.full_like(value, torch.nan)


@pytest.mark.parametrize("change", [Tensor.float, Tensor.long, Tensor.cfloat, _with_nan])
@pytest.mark.parametrize("name", ["model.mean", "model.loading"])
def test_tensors_of_another_type_are_refused(
    parts: tuple[Meta, Tensors], tmp_path: Path, name: str, change: Callable[[Tensor], Tensor]
) -> None:
    meta, tensors = parts
    with pytest.raises(DamagedRunError, match=f"{name} must hold finite torch.float64"):
        zoo.load(forged(tmp_path / "run", meta, {**tensors, name: change(tensors[name])}))


def test_parameters_of_another_shape_are_refused(tmp_path: Path) -> None:
    run = zoo.fit(assembly_of(CATALOGUE["vae"], epochs=1), movements())
    meta, tensors = archive.read(run.save(tmp_path), "run", version=FORMAT_VERSION)
    name = next(k for k in tensors if k.endswith("weight"))
    kept = {k: v for k, v in meta.items() if k not in _HEAD}
    with pytest.raises(DamagedRunError, match=f"{name} has shape"):
        zoo.load(forged(tmp_path / "run", kept, {**tensors, name: tensors[name][:-1]}))


def test_missing_and_extra_tensors_are_named(parts: tuple[Meta, Tensors], tmp_path: Path) -> None:
    meta, tensors = parts
    for name in tensors:
        few = {k: v for k, v in tensors.items() if k != name}
        with pytest.raises(DamagedRunError, match=name.rpartition(".")[2]):
            zoo.load(forged(tmp_path / "few", meta, few))
    for name in ("model.evil", "evil", "guide.evil", "recalibration.forecast.evil"):
        with pytest.raises(DamagedRunError, match="evil"):
            zoo.load(forged(tmp_path / "many", meta, {**tensors, name: torch.zeros(1)}))


@pytest.mark.parametrize(
    "change",
    [
        lambda v: v.new_zeros(0),
        lambda v: v.expand(2, *v.shape),
        Tensor.neg,
        _with_nan,
        Tensor.cfloat,
    ],
    ids=["empty", "one axis more", "negative", "nan", "complex"],
)
def test_recalibrations_that_are_none_are_refused(
    parts: tuple[Meta, Tensors], tmp_path: Path, change: Callable[[Tensor], Tensor]
) -> None:
    meta, tensors = parts
    for name in tensors:
        if name.startswith("recalibration."):
            hostile = {**tensors, name: change(tensors[name]).contiguous()}
            with pytest.raises(DamagedRunError, match=r"factor|curve"):
                zoo.load(forged(tmp_path / "run", meta, hostile))
