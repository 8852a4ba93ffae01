"""What every entry of the catalogue must keep, whatever its model, guide and inference."""

from __future__ import annotations

import contextlib
import copy
import json
import math
from dataclasses import replace

import numpy as np
import pyro.poutine as poutine
import pytest
import torch
from support import CHANNELS, FRAMES, assembly_of, data_of, movements, pairs, run_of

import zoo
from zoo.catalogue import CATALOGUE
from zoo.contract import capabilities
from zoo.contract.registry import CAPABILITIES, load
from zoo.contract.strategies import Svi
from zoo.datasets.records import Pairs, Sequences
from zoo.datasets.records.scaling import Scaler
from zoo.errors import (
    DamagedRunError,
    NoJointSamplesError,
    NoSpreadError,
    NotCapableError,
    UnknownNameError,
)
from zoo.inference.elbo import tight_bound
from zoo.inference.loader import Loader
from zoo.prediction.prediction import Prediction
from zoo.runs.assembly import assemble, options

NAMES = [e.name for e in CATALOGUE]
VARIATIONAL = [e.name for e in CATALOGUE if isinstance(e.inference, Svi)]
PROTOCOLS = {
    "regress": capabilities.Regresses,
    "represent": capabilities.Represents,
    "reconstruct": capabilities.Reconstructs,
    "forecast": capabilities.Forecasts,
    "impute": capabilities.Imputes,
    "generate": capabilities.Generates,
}
every = pytest.mark.parametrize("name", NAMES)
variational = pytest.mark.parametrize("name", VARIATIONAL)


def answer(run: zoo.Run, task: str) -> Prediction:
    """One prediction of a task on the small data."""
    questions = {
        "regress": lambda: run.regress(pairs()[:7], draws=5),
        "represent": lambda: run.represent(movements(), draws=5),
        "reconstruct": lambda: run.reconstruct(movements(), draws=5),
        "forecast": lambda: run.forecast(movements().first(10), horizon=6, draws=5),
        "impute": lambda: run.impute(movements(missing=True), draws=5),
        "generate": lambda: run.generate(movements()[:3], draws=5),
    }
    return questions[task]()


EXPECTED_SHAPE = {
    "regress": (7, 2),
    "reconstruct": (8, FRAMES, CHANNELS),
    "forecast": (8, 6, CHANNELS),
    "impute": (8, FRAMES, CHANNELS),
    "generate": (3, FRAMES, CHANNELS),
}


def tensors_of(run: zoo.Run) -> dict[str, torch.Tensor]:
    """Everything that training determined."""
    modules = {"model": run.assembly.model, "guide": run.assembly.guide}
    return {
        f"{prefix}.{key}": value
        for prefix, module in modules.items()
        if module is not None
        for key, value in module.state_dict().items()
    }


def check_equal(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> None:
    """The same names and the same bits."""
    assert first.keys() == second.keys()
    for key, value in first.items():
        assert torch.equal(value, second[key]), key


@every
def test_card_is_complete(name: str) -> None:
    card = zoo.card(name)
    words = card.to_json()
    assert len(card.text.split()) >= 40
    assert words["thesis"] and words["summary"] and words["can"] and words["settings"]
    assert card.entry.dataset in zoo.list_data() or "/" in card.entry.dataset
    json.dumps(words)


@every
def test_capabilities_are_those_of_the_protocols(name: str) -> None:
    entry = CATALOGUE[name]
    model = load(entry.model)
    derived = {task for task, protocol in PROTOCOLS.items() if issubclass(model, protocol)}
    assert derived == set(entry.capabilities) & set(PROTOCOLS)
    assert set(entry.capabilities) <= set(CAPABILITIES)


@every
def test_settings_survive_json(name: str) -> None:
    entry = CATALOGUE[name]
    first = assembly_of(entry)
    words = json.loads(json.dumps(dict(first.settings)))
    second = assemble(entry, first.layout, words, seed=first.seed, device="cpu")
    assert second.model.config == first.model.config
    assert second.inference == first.inference


@every
def test_unknown_setting_names_the_nearest(name: str) -> None:
    known = next(iter(options(CATALOGUE[name])))
    with pytest.raises(UnknownNameError, match=known):
        zoo.create(name, data_of(CATALOGUE[name]), **{f"{known}x": 1})


@variational
def test_every_parameter_gets_a_gradient(name: str) -> None:
    assembly = assembly_of(CATALOGUE[name])
    model, guide = copy.deepcopy((assembly.model, assembly.guide))
    data = Scaler.fit(data_of(assembly.entry), assembly.scaling).apply(data_of(assembly.entry))
    strategy = assembly.inference
    loader = Loader(
        data.to(dtype=assembly.dtype),
        batch_size=16,
        window=strategy.window,
        stride=strategy.stride,
        seed=0,
    )
    loss = tight_bound(model, guide, next(iter(loader.epoch(0)))).loss
    loss.backward()
    assert math.isfinite(float(loss.detach()))
    for module in (model, guide):
        for key, parameter in module.named_parameters():
            assert parameter.grad is not None, key
            assert bool(parameter.grad.isfinite().all()), key


@variational
def test_latent_sites_of_model_and_guide_match(name: str) -> None:
    assembly = assembly_of(CATALOGUE[name])
    data = data_of(assembly.entry).to(dtype=assembly.dtype)
    batch = next(iter(Loader(data, batch_size=4, window=assembly.inference.window).epoch(0)))
    guide = poutine.trace(assembly.guide).get_trace(batch)
    model = poutine.trace(poutine.replay(assembly.model, guide)).get_trace(batch)
    assert set(guide.stochastic_nodes) == set(model.stochastic_nodes)
    assert model.observation_nodes


@every
def test_training_is_finite_and_the_seed_reproduces_it(name: str) -> None:
    entry = CATALOGUE[name]
    again = zoo.fit(assembly_of(entry), data_of(entry))
    assert all(bool(v.isfinite().all()) for v in tensors_of(again).values())
    check_equal(tensors_of(run_of(name)), tensors_of(again))


@every
def test_training_leaves_the_assembly_and_the_global_state_alone(name: str) -> None:
    entry = CATALOGUE[name]
    assembly = assembly_of(entry)
    before = {k: v.clone() for k, v in assembly.model.state_dict().items()}
    stream, threads = torch.random.get_rng_state(), torch.get_num_threads()
    zoo.fit(assembly, data_of(entry))
    assert bool((torch.random.get_rng_state() == stream).all())
    assert torch.get_num_threads() == threads
    check_equal(before, assembly.model.state_dict())


@every
def test_predictions_have_shape_names_and_units(name: str) -> None:
    run = run_of(name)
    for task in run.capabilities:
        prediction = answer(run, task)
        assert bool(prediction.mean.isfinite().all())
        if task in EXPECTED_SHAPE:
            assert prediction.shape == EXPECTED_SHAPE[task]
            assert set(prediction.units) == {"N" if task == "regress" else "rad"}
            assert prediction.names == run.assembly.layout.channels


@every
def test_the_spread_is_honest_or_refused(name: str) -> None:
    run = run_of(name)
    for task in set(run.capabilities) - {"represent"}:
        prediction = answer(run, task)
        if not prediction.has_spread:
            with pytest.raises(NoSpreadError):
                _ = prediction.std
            continue
        low, high = prediction.interval(0.9)
        assert bool((low <= high).all()) and bool((prediction.std >= 0).all())
        assert bool((prediction.std > 0).any())


@every
def test_predictions_repeat_with_their_seed(name: str) -> None:
    run = run_of(name)
    for task in run.capabilities:
        assert torch.equal(answer(run, task).mean, answer(run, task).mean)


@pytest.mark.parametrize("name", CATALOGUE.names(can="forecast"))
@pytest.mark.parametrize("draws", [1, 6])
def test_a_forecast_of_few_draws_has_that_many(name: str, draws: int) -> None:
    forecast = run_of(name).forecast(movements().first(12), horizon=5, draws=draws)
    assert bool(forecast.mean.isfinite().all())
    with contextlib.suppress(NoSpreadError, NoJointSamplesError):
        assert bool(forecast.sample(draws).isfinite().all())


@every
def test_saved_and_loaded_runs_predict_the_same(name: str, tmp_path: object) -> None:
    run = run_of(name)
    folder = run.save(f"{tmp_path}/run.zoo")
    again = zoo.load(folder)
    check_equal(tensors_of(run), tensors_of(again))
    for task in run.capabilities:
        assert torch.equal(answer(run, task).mean, answer(again, task).mean)


@every
@pytest.mark.filterwarnings("ignore::zoo.errors.FewGroupsWarning")
def test_calibration_is_kept_in_the_saved_run(name: str, tmp_path: object) -> None:
    entry = CATALOGUE[name]
    data = data_of(entry)
    group = "trial" if entry.data == "sequences" else "series"
    train, calib = data.split(by=group, parts=(0.5, 0.5), seed=0)
    run = zoo.fit(assembly_of(entry), train).calibrate(calib)
    again = zoo.load(run.save(f"{tmp_path}/run.zoo"))
    assert run.calibration.tasks == again.calibration.tasks
    for task in set(run.capabilities) & {"forecast", "regress", "reconstruct"}:
        first, second = answer(run, task), answer(again, task)
        if first.has_spread:
            assert torch.equal(first.interval(0.8)[0], second.interval(0.8)[0])


@variational
def test_interrupted_and_resumed_equals_uninterrupted(name: str, tmp_path: object) -> None:
    entry = CATALOGUE[name]
    whole = zoo.fit(assembly_of(entry, epochs=4), data_of(entry))
    folder = f"{tmp_path}/run"

    class Interrupt(RuntimeError):
        """Raised in the middle of the training."""

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("zoo.inference.svi.Loader", _interrupted(Interrupt, after=3))
        with pytest.raises(Interrupt):
            zoo.fit(assembly_of(entry, epochs=4), data_of(entry), run_dir=folder)
    resumed = zoo.fit(assembly_of(entry, epochs=4), data_of(entry), run_dir=folder, resume="must")
    check_equal(tensors_of(whole), tensors_of(resumed))


def _interrupted(error: type[Exception], after: int) -> type[Loader]:
    class Stopped(Loader):
        epochs = 0

        def epoch(self, epoch: int, first: int = 0):  # type: ignore[no-untyped-def]
            Stopped.epochs += 1
            if Stopped.epochs > after:
                raise error
            return super().epoch(epoch, first)

    return Stopped


@every
def test_missing_entries_are_honoured_or_refused_by_name(name: str) -> None:
    entry = CATALOGUE[name]
    holed = data_of(entry, missing=True)
    try:
        run = zoo.fit(assembly_of(entry), holed)
    except ValueError as error:
        assert "missing" in str(error)
        return
    assert all(bool(v.isfinite().all()) for v in tensors_of(run).values())
    filled = holed.values.clone() if isinstance(holed, Sequences) else holed.targets.clone()
    other = {"values": torch.where(holed.mask, filled, 99.0)}
    if isinstance(holed, Pairs):
        other = {"targets": torch.where(holed.mask, filled, 99.0)}
    poisoned = replace(holed, **other)
    check_equal(tensors_of(run), tensors_of(zoo.fit(assembly_of(entry), poisoned)))


@every
def test_wrong_data_are_refused_with_names(name: str) -> None:
    run = run_of(name)
    entry = CATALOGUE[name]
    rng = np.random.default_rng(0)
    if entry.data == "pairs":
        with pytest.raises(ValueError, match="3"):
            run.regress(rng.normal(size=(4, 7)))
        return
    other = Sequences.from_arrays(rng.normal(size=(2, FRAMES, CHANNELS + 1)), rate=30.0)
    faster = replace(movements(), rate=60.0)
    task = next(t for t in ("reconstruct", "impute", "forecast") if t in run.capabilities)
    ask = {
        "reconstruct": run.reconstruct,
        "impute": run.impute,
        "forecast": lambda d: run.forecast(d, horizon=2),
    }[task]
    with pytest.raises(ValueError, match=f"{CHANNELS + 1} channels"):
        ask(other)
    with pytest.raises(ValueError, match="60 Hz"):
        ask(faster)


@every
def test_tasks_beyond_the_model_are_refused(name: str) -> None:
    run = run_of(name)
    if "forecast" not in run.capabilities and CATALOGUE[name].data == "sequences":
        with pytest.raises(NotCapableError, match="cannot forecast"):
            run.forecast(movements().first(5), horizon=2)
    if "regress" not in run.capabilities:
        with pytest.raises(NotCapableError, match="cannot regress"):
            run.regress(pairs())


@every
def test_damaged_and_foreign_folders_are_refused(name: str, tmp_path: object) -> None:
    folder = run_of(name).save(f"{tmp_path}/run.zoo")
    file = next(folder.glob("run-*.safetensors"))
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    with pytest.raises(DamagedRunError, match="hash"):
        zoo.load(folder)
    file.unlink()
    with pytest.raises(DamagedRunError, match="missing"):
        zoo.load(folder)
    meta = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({**meta, "version": 99}))
    with pytest.raises(DamagedRunError, match="version 99"):
        zoo.load(folder)
