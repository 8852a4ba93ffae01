"""Checkpoints: exact, atomic, and refused with their reason when damaged or foreign."""

import json
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from zoo import archive
from zoo.errors import DamagedRunError
from zoo.inference.resume import checkpoint

TENSORS = {"a/w": torch.tensor([1.0, torch.nan, -0.0]), "b": torch.arange(5, dtype=torch.uint8)}


def saved(folder: Path) -> Path:
    """A folder with a checkpoint."""
    checkpoint.write(folder, TENSORS, {"epoch": 3, "elbo": 0.1 + 0.2})
    return folder


def test_round_trip_is_exact(tmp_path: Path) -> None:
    tensors, state = checkpoint.read(saved(tmp_path))
    assert state == {"epoch": 3, "elbo": 0.1 + 0.2}
    for name, value in TENSORS.items():
        assert tensors[name].dtype == value.dtype
        assert tensors[name].numpy().tobytes() == value.numpy().tobytes()


def test_only_the_last_is_kept(tmp_path: Path) -> None:
    saved(tmp_path)
    checkpoint.write(tmp_path, {"b": torch.zeros(1)}, {})
    assert sorted(p.suffix for p in tmp_path.iterdir()) == [".json", ".safetensors"]
    checkpoint.clear(tmp_path)
    assert not checkpoint.exists(tmp_path) and not list(tmp_path.iterdir())


@pytest.mark.parametrize("step", ["fsync", "replace", "unlink"])
def test_a_crash_while_writing_leaves_a_whole_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    """Crash at the first, second, … call of each system call in turn."""
    for call in range(6):
        folder = saved(tmp_path / str(call))
        _crash(monkeypatch, step, call)
        try:
            checkpoint.write(folder, {"b": torch.ones(2)}, {"epoch": 4})
        except OSError:
            pass
        finally:
            monkeypatch.undo()
        tensors, state = checkpoint.read(folder)
        assert (state["epoch"], len(tensors)) in {(3, 2), (4, 1)}


def _crash(monkeypatch: pytest.MonkeyPatch, step: str, at: int) -> None:
    owner = Path if step == "unlink" else archive.os
    original, count = getattr(owner, step), iter(range(99))

    def crash(*args: object, **options: object) -> object:
        if next(count) == at:
            raise OSError("power cut")
        return original(*args, **options)

    monkeypatch.setattr(owner, step, crash)


def test_damaged_tensors_are_refused(tmp_path: Path) -> None:
    path = next(saved(tmp_path).glob("*.safetensors"))
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(DamagedRunError, match="damaged"):
        checkpoint.read(tmp_path)
    path.unlink()
    with pytest.raises(DamagedRunError, match="missing"):
        checkpoint.read(tmp_path)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"format": "other"}, "format is 'other'"),
        ({"version": 99}, "format version 99; this movezoo reads 1"),
        ({"state": {"epoch": 4}}, "seal differs"),
    ],
)
def test_foreign_or_edited_index_is_refused(
    tmp_path: Path, change: dict[str, object], reason: str
) -> None:
    index = saved(tmp_path) / "checkpoint.json"
    index.write_text(json.dumps({**json.loads(index.read_text()), **change}))
    with pytest.raises(DamagedRunError, match=reason):
        checkpoint.read(tmp_path)


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", "null"])
def test_anything_else_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "checkpoint.json").write_text(text)
    with pytest.raises(DamagedRunError, match="not a readable checkpoint"):
        checkpoint.read(tmp_path)


def test_modules_and_optimisers_come_back_bit_for_bit() -> None:
    def trained(steps: int) -> tuple[nn.Module, torch.optim.Optimizer]:
        torch.manual_seed(0)
        net = nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4))
        adam = torch.optim.Adam(net.parameters(), fused=True)
        return net, adam if steps == 0 else _train(net, adam, steps)

    net, adam = trained(3)
    kept = checkpoint.capture("n", net) | checkpoint.capture("o", adam)
    other, fresh = trained(0)
    checkpoint.restore("n", other, kept)
    checkpoint.restore("o", fresh, kept)
    _train(net, adam, 2)
    _train(other, fresh, 2)
    for a, b in zip(net.state_dict().values(), other.state_dict().values(), strict=True):
        assert torch.equal(a, b)


def _train(net: nn.Module, adam: torch.optim.Optimizer, steps: int) -> torch.optim.Optimizer:
    x: Tensor = torch.linspace(-1, 1, 12).view(4, 3)
    for _ in range(steps):
        adam.zero_grad()
        net(x).pow(3).sum().backward()
        adam.step()
    return adam


def test_tensors_of_another_model_are_refused() -> None:
    kept = checkpoint.capture("n", nn.Linear(2, 3))
    with pytest.raises(DamagedRunError, match=r"weight was \[3, 2\] and is \[3, 4\] now"):
        checkpoint.restore("n", nn.Linear(4, 3), kept)
