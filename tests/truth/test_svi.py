"""Training: reaches the evidence, repeats, resumes, recovers, and says what it did."""

import contextlib
import importlib.util
import json
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from zoo.contract.strategies import Svi
from zoo.errors import OtherTrainingError, PosteriorCollapseWarning, TrainingError, TrainingWarning
from zoo.inference.elbo import bound, tight_bound
from zoo.inference.loader import Loader, stream
from zoo.inference.resume.history import History
from zoo.inference.svi import fit_svi
from zoo.types import Batch


def _load(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


lg = _load("linear_gaussian")
QUICK = Svi(epochs=6, batch_size=32, learning_rate=1e-2, temper_epochs=2, validate_every=2)


def fresh() -> tuple[nn.Module, nn.Module]:
    """Model and guide, the same at every call."""
    torch.manual_seed(0)
    return lg.Factors(), lg.Recognition()


def bits(*modules: nn.Module) -> list[Tensor]:
    """Every tensor of the modules."""
    return [v.clone() for m in modules for v in m.state_dict().values()]


def same(a: list[Tensor], b: list[Tensor]) -> bool:
    """Equal bit for bit."""
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def figures(history: History) -> list[dict[str, Any]]:
    """The rows without wall-clock time."""
    return [{k: v for k, v in row.items() if k != "seconds"} for row in history]


def test_reaches_the_exact_evidence() -> None:
    model, guide = fresh()
    model.requires_grad_(False)
    data = lg.frames(20)
    strategy = Svi(epochs=60, batch_size=50, learning_rate=3e-2, patience=None, temper_epochs=5)
    history = fit_svi(model, guide, data, strategy, val=data)
    exact = lg.evidence(model, data)
    everything = Loader(data, batch_size=200, window=1).take(torch.arange(200))
    with torch.no_grad():
        draws = torch.stack([bound(model, guide, everything).elbo / 200 for _ in range(20)])
        noisy = torch.stack([tight_bound(model, guide, everything).elbo / 200 for _ in range(20)])
    assert exact - 0.005 < float(draws.mean()) < exact + 0.001
    assert abs(history.rows[-1]["val_elbo"] - exact) < 5 * float(noisy.std())
    assert history.rows[0]["c"] == 0.01 and history.rows[-1]["c"] == 1.0


def test_learns_the_model_up_to_the_evidence_of_the_truth() -> None:
    model, guide = fresh()
    data = lg.frames(20)
    truth = lg.evidence(model, data)
    with torch.no_grad():
        model.loadings.mul_(0.3)
        model.log_sigma.fill_(0.5)
    fit_svi(model, guide, data, Svi(epochs=80, batch_size=50, learning_rate=3e-2, patience=None))
    assert lg.evidence(model, data) > truth - 0.01


def test_an_epoch_sums_to_the_full_gradient() -> None:
    """Short last batch included: batch gradients weighted by their size give the whole."""
    model, guide = fresh()
    with torch.no_grad():
        guide.log_scale.fill_(-30.0)
    parameters = [model.loadings, guide.mean.weight]

    def gradients(batch: Batch) -> list[Tensor]:
        loss = bound(model, guide, batch).loss / batch.total
        return list(torch.autograd.grad(loss, parameters))

    data = lg.frames(5)
    full = gradients(Loader(data, batch_size=50, window=1).take(torch.arange(50)))
    loader = Loader(data, batch_size=16, window=1)
    sums = [torch.zeros_like(p) for p in parameters]
    for batch in loader.epoch(0):
        for total, part in zip(sums, gradients(batch), strict=True):
            total += part * len(batch) / batch.total
    assert len(loader) == 4 and loader.total % loader.batch_size
    torch.testing.assert_close(sums, full, rtol=1e-4, atol=1e-5)


def test_seed_decides_every_bit() -> None:
    runs = []
    for seed in (0, 0, 1):
        model, guide = fresh()
        torch.manual_seed(int(torch.randint(100, ())))
        before = torch.get_rng_state()
        history = fit_svi(model, guide, lg.frames(), QUICK, val=lg.frames(3, 1), seed=seed)
        assert torch.equal(torch.get_rng_state(), before)
        runs.append((bits(model, guide), figures(history)))
    assert same(runs[0][0], runs[1][0]) and runs[0][1] == runs[1][1]
    assert not same(runs[0][0], runs[2][0])


class Stop(Exception):
    """Ends a training where a kill would."""


@pytest.mark.parametrize(("after", "seconds"), [(1, 60.0), (3, 60.0), (4, 0.0)])
def test_resumed_equals_uninterrupted(tmp_path: Path, after: int, seconds: float) -> None:
    model, guide = fresh()
    data, val = lg.frames(), lg.frames(3, 1)
    expected = figures(fit_svi(model, guide, data, QUICK, val=val))
    whole = bits(model, guide)

    def stop(row: dict[str, Any]) -> None:
        if row["epoch"] == after:
            raise Stop

    strategy = Svi(**{**vars(QUICK), "checkpoint_every": 2})
    options: dict[str, Any] = {"val": val, "folder": tmp_path, "checkpoint_seconds": seconds}
    model, guide = fresh()
    with pytest.raises(Stop):
        fit_svi(model, guide, data, strategy, on_epoch=stop, **options)
    model, guide = fresh()
    history = fit_svi(model, guide, data, strategy, resume="auto", **options)
    assert same(bits(model, guide), whole) and figures(history) == expected
    logged = [json.loads(line) for line in (tmp_path / "history.jsonl").read_text().splitlines()]
    assert logged == history.rows
    model, guide = fresh()
    again = fit_svi(model, guide, data, strategy, resume="must", **options)
    assert same(bits(model, guide), whole) and again.rows == history.rows


def test_resume_refuses_another_training(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"resume must be .* got 'yes'"):
        fit_svi(*fresh(), lg.frames(), QUICK, folder=tmp_path, resume="yes")
    with pytest.raises(FileNotFoundError, match="no checkpoint"):
        fit_svi(*fresh(), lg.frames(), QUICK, folder=tmp_path, resume="must")
    fit_svi(*fresh(), lg.frames(), QUICK, folder=tmp_path)
    with pytest.raises(OtherTrainingError, match="seed was 0 and is 1 now"):
        fit_svi(*fresh(), lg.frames(), QUICK, folder=tmp_path, resume="auto", seed=1)
    with pytest.raises(OtherTrainingError, match="values of the training data changed"):
        fit_svi(*fresh(), lg.frames(seed=5), QUICK, folder=tmp_path, resume="auto")


class Fragile(type(lg.Factors())):  # type: ignore[misc]
    """Draws a NaN at chosen calls."""

    def __init__(self, calls: set[int]) -> None:
        super().__init__()
        self.calls, self.count = calls, 0

    def forward(self, batch: Batch) -> None:
        self.count += self.training
        broken = self.training and self.count in self.calls
        with torch.no_grad():
            kept = self.log_sigma.clone()
            self.log_sigma.add_(torch.nan if broken else 0.0)
        super().forward(batch)
        with torch.no_grad():
            self.log_sigma.copy_(kept)


def test_non_finite_loss_goes_back_with_half_the_step() -> None:
    torch.manual_seed(0)
    model, guide = Fragile({7}), lg.Recognition()
    strategy = Svi(epochs=4, batch_size=32, schedule="constant", learning_rate=0.01)
    with pytest.warns(TrainingWarning, match=r"p\(x\) is not finite at step 6 \(epoch 1\).*0.005"):
        history = fit_svi(model, guide, lg.frames(), strategy)
    assert history.column("lr") == [0.01, 0.005, 0.005, 0.005]
    assert history.column("epoch") == [0, 1, 2, 3]


def test_non_finite_at_the_first_step_of_an_epoch_goes_one_further_back() -> None:
    torch.manual_seed(0)
    strategy = Svi(epochs=3, batch_size=50, schedule="constant", learning_rate=0.01)
    with pytest.warns(TrainingWarning, match="step 2 .*start of epoch 0"):
        history = fit_svi(Fragile({3}), lg.Recognition(), lg.frames(), strategy)
    assert history.column("lr") == [0.005] * 3


class Unlucky(type(lg.Factors())):  # type: ignore[misc]
    """Overflows under the noise of one step at the first try, whoever runs it."""

    def forward(self, batch: Batch) -> None:
        unlucky = torch.default_generator.initial_seed() == stream(0, "step", 9, 0)
        super().forward(replace(batch, values=batch.values * 1e30) if unlucky else batch)


@pytest.mark.parametrize("after", [0, 1, 2, 4])
def test_resumed_equals_uninterrupted_across_a_return(tmp_path: Path, after: int) -> None:
    def stop(row: dict[str, Any]) -> None:
        if row["epoch"] == after:
            raise Stop

    strategy = Svi(epochs=6, batch_size=32, checkpoint_every=1, validate_every=1)
    runs = []
    for folder in (None, tmp_path):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TrainingWarning)
            for on_epoch in (None,) if folder is None else (stop, None):
                torch.manual_seed(0)
                model, guide = Unlucky(), lg.Recognition()
                options: dict[str, Any] = {"folder": folder, "on_epoch": on_epoch}
                options |= {"val": lg.frames(3, 1), "checkpoint_seconds": 0.0}
                with contextlib.suppress(Stop):
                    history = fit_svi(model, guide, lg.frames(), strategy, resume="auto", **options)
        runs.append((bits(model, guide), figures(history)))
    assert same(runs[0][0], runs[1][0]) and runs[0][1] == runs[1][1]
    rates = [row["lr"] for row in runs[0][1]]
    assert rates[2] < 0.6 * rates[1]


def test_gives_up_with_advice() -> None:
    torch.manual_seed(0)
    model = Fragile(set(range(3, 999)))
    with (
        warnings.catch_warnings(),
        pytest.raises(TrainingError, match=r"p\(x\).* 6 times .*smaller learning_rate"),
    ):
        warnings.simplefilter("ignore", TrainingWarning)
        fit_svi(model, lg.Recognition(), lg.frames(), QUICK)


@pytest.mark.parametrize("value", [torch.inf, torch.nan])
def test_broken_gradient_is_named(value: float) -> None:
    class Kinked(type(lg.Recognition())):  # type: ignore[misc]
        def forward(self, batch: Batch) -> None:
            self.log_scale.register_hook(lambda g: g * value)
            super().forward(batch)

    with (
        pytest.raises(TrainingError, match=r"gradient of guide.log_scale"),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore", TrainingWarning)
        fit_svi(lg.Factors(), Kinked(), lg.frames(), QUICK)


def test_clipping_bounds_the_step_and_reports_the_unclipped_norm() -> None:
    strategy = Svi(epochs=1, batch_size=100, clip=1e-3, schedule="constant")
    model, guide = fresh()
    history = fit_svi(model, guide, lg.frames(), strategy)
    gradients = [p.grad for m in (model, guide) for p in m.parameters()]
    norm = torch.linalg.vector_norm(torch.stack([g.norm() for g in gradients]))
    torch.testing.assert_close(norm, torch.tensor(1e-3))
    assert history.rows[0]["grad_norm"] > 1e-2


def test_a_huge_gradient_is_clipped_and_not_taken_for_infinite() -> None:
    model, guide = fresh()
    model.loadings.register_hook(lambda g: g * 1e30)
    history = fit_svi(model, guide, lg.frames(), Svi(epochs=2, batch_size=50, clip=1.0))
    assert min(history.column("grad_norm")) > 1e25
    assert all(bool(v.isfinite().all()) for v in bits(model, guide))
    with pytest.raises(TrainingError, match="norm of the gradient"), warnings.catch_warnings():
        warnings.simplefilter("ignore", TrainingWarning)
        fit_svi(model, guide, lg.frames(), Svi(epochs=2, batch_size=50, clip=None))


def test_early_stopping_restores_the_best_state() -> None:
    model, guide = fresh()
    train, val = lg.frames(1, 2), lg.frames(8, 3)
    kept: dict[int, list[Tensor]] = {}

    def keep(row: dict[str, Any]) -> None:
        kept[row["epoch"]] = bits(model, guide)

    strategy = Svi(
        epochs=400, batch_size=10, learning_rate=0.02, patience=3, validate_every=2, temper_epochs=4
    )
    history = fit_svi(model, guide, train, strategy, val=val, on_epoch=keep)
    eligible = [r for r in history if r["val_elbo"] is not None and r["c"] == 1.0]
    best = max(eligible, key=lambda r: float(r["val_elbo"]))
    assert len(history) < 400 and history.rows[-1]["epoch"] == best["epoch"] + 6
    assert same(bits(model, guide), kept[best["epoch"]])


def test_collapse_is_named_once() -> None:
    model, guide = lg.Factors(), lg.Recognition()
    with torch.no_grad():
        model.loadings[1] = 0.0
    model.requires_grad_(False)
    strategy = Svi(epochs=80, batch_size=25, learning_rate=0.03)
    with pytest.warns(PosteriorCollapseWarning, match=r"in z \[1\]:") as caught:
        fit_svi(model, guide, lg.frames(), strategy)
    assert len(caught) == 1


def test_interrupt_says_where_to_go_on(tmp_path: Path) -> None:
    def interrupt(row: dict[str, Any]) -> None:
        if row["epoch"] == 3:
            raise KeyboardInterrupt

    strategy = Svi(**{**vars(QUICK), "checkpoint_every": 1})
    with pytest.raises(KeyboardInterrupt, match=r"epoch 3 of 6; resume='auto' goes on"):
        fit_svi(*fresh(), lg.frames(), strategy, folder=tmp_path, on_epoch=interrupt)
    assert len(fit_svi(*fresh(), lg.frames(), strategy, folder=tmp_path, resume="must")) == 6


def test_tensorboard_is_an_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="needs a run folder"):
        fit_svi(*fresh(), lg.frames(), QUICK, tensorboard=True)
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(ImportError, match=r"movezoo\[train\]"):
        fit_svi(*fresh(), lg.frames(), QUICK, folder=tmp_path, tensorboard=True)


def test_tensorboard_holds_every_epoch(tmp_path: Path) -> None:
    loading = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    history = fit_svi(*fresh(), lg.frames(), QUICK, folder=tmp_path, tensorboard=True)
    events = loading.EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    written = [event.value for event in events.Scalars("kl")]
    assert written == pytest.approx(history.column("kl"), rel=1e-6)


def test_progress_bar_shows_both_terms(capsys: pytest.CaptureFixture[str]) -> None:
    fit_svi(*fresh(), lg.frames(), QUICK, progress=True)
    printed = capsys.readouterr()
    assert all(words in printed.err for words in ("log p(x|z)", "KL", "6/6"))
    assert printed.out == ""
