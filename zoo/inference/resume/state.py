"""All that a training by gradient steps must remember to go on in the same bits."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from zoo.contract.strategies import Svi
from zoo.datasets.records import Pairs, Sequences
from zoo.datasets.records.digest import contents
from zoo.errors import OtherTrainingError
from zoo.inference.resume import checkpoint
from zoo.inference.resume.history import History

__all__ = ["FIGURES", "FREE", "Best", "Parts", "Place", "State", "fingerprint"]

FIGURES = ("loss", "reconstruction", "kl", "grad_norm")
FREE = ("checkpoint_every",)

Tensors = dict[str, Tensor]


@dataclass(frozen=True, kw_only=True)
class Place:
    """The next batch to take, the sums of the epoch so far, and validations without progress."""

    epoch: int = 0
    batch: int = 0
    step: int = 0
    waited: int = 0
    sums: tuple[float, ...] = (0.0,) * len(FIGURES)

    def after(self, figures: tuple[float, ...]) -> Place:
        """One batch further, with its figures added."""
        sums = tuple(a + b for a, b in zip(self.sums, figures, strict=True))
        return Place(
            epoch=self.epoch,
            batch=self.batch + 1,
            step=self.step + 1,
            waited=self.waited,
            sums=sums,
        )


@dataclass(frozen=True, kw_only=True)
class Best:
    """The best validation bound so far, per datum."""

    epoch: int
    elbo: float


@dataclass(frozen=True)
class Parts:
    """What training changes: model, guide and the optimiser's moments."""

    model: nn.Module
    guide: nn.Module
    optimizer: torch.optim.Optimizer

    def modules(self) -> Tensors:
        """Copies of the tensors of model and guide."""
        return checkpoint.capture("model", self.model) | checkpoint.capture("guide", self.guide)

    def tensors(self) -> Tensors:
        """Copies of all tensors."""
        return self.modules() | checkpoint.capture("optimizer", self.optimizer)

    def put_modules(self, tensors: Tensors) -> None:
        """Put model and guide back."""
        checkpoint.restore("model", self.model, tensors)
        checkpoint.restore("guide", self.guide, tensors)

    def put(self, tensors: Tensors) -> None:
        """Put everything back."""
        self.put_modules(tensors)
        checkpoint.restore("optimizer", self.optimizer, tensors)


@dataclass
class State:
    """Place, best state, and the last good state, at the start of an epoch with a finite step."""

    good: Tensors
    place: Place = field(default_factory=Place)
    good_place: Place = field(default_factory=Place)
    best: Best | None = None
    best_tensors: Tensors = field(default_factory=dict)
    tries: int = 0
    finished: bool = False
    history: History = field(default_factory=History)

    def save(self, folder: Path, parts: Parts, training: dict[str, Any]) -> None:
        """Write a checkpoint; ``training`` says what it belongs to."""
        groups = {"now": parts.tensors(), "good": self.good, "best": self.best_tensors}
        tensors = {f"{g}/{n}": v for g, kept in groups.items() for n, v in kept.items()}
        meta = {
            "training": training,
            "place": asdict(self.place),
            "good_place": asdict(self.good_place),
            "best": None if self.best is None else asdict(self.best),
            "tries": self.tries,
            "finished": self.finished,
            "history": self.history.rows,
        }
        checkpoint.write(folder, {**tensors, "rng": torch.get_rng_state()}, meta)

    @classmethod
    def load(cls, folder: Path, parts: Parts, training: dict[str, Any]) -> State:
        """Read a checkpoint of the same training and put its tensors in place."""
        tensors, meta = checkpoint.read(folder)
        if gap := checkpoint.difference(meta.get("training", {}), training):
            raise OtherTrainingError(
                f"the checkpoint in {folder} is of another training: {gap} (take another folder)"
            )
        parts.put(_group("now", tensors))
        torch.set_rng_state(tensors["rng"])
        return cls(
            good=_group("good", tensors),
            place=_place(meta["place"]),
            good_place=_place(meta["good_place"]),
            best=None if meta["best"] is None else Best(**meta["best"]),
            best_tensors=_group("best", tensors),
            tries=meta["tries"],
            finished=meta["finished"],
            history=History(meta["history"]),
        )


def fingerprint(
    parameters: dict[str, nn.Parameter],
    strategy: Svi,
    seed: int,
    **data: Sequences | Pairs | None,
) -> dict[str, Any]:
    """What a checkpoint is compared by: strategy, seed, shapes and data."""
    settings = {k: v for k, v in asdict(strategy).items() if k not in FREE}
    shapes = {f"shape of {n}": list(p.shape) for n, p in parameters.items()}
    found = {"seed": seed, **settings, **shapes}
    for role, record in data.items():
        found |= contents(record, role)
    return found


def _place(kept: dict[str, Any]) -> Place:
    return Place(**{**kept, "sums": tuple(kept["sums"])})


def _group(name: str, tensors: Tensors) -> Tensors:
    return {k[len(name) + 1 :]: v for k, v in tensors.items() if k.startswith(f"{name}/")}
