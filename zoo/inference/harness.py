"""One call for every strategy: closed form, marginal likelihood or stochastic variational."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from zoo.contract.parts import (
    Adopts,
    Builds,
    Conditions,
    LearnsNoise,
    LearnsPrior,
    MaximisesEvidence,
    Prepares,
)
from zoo.contract.strategies import Exact, Inference, MarginalLikelihood, Svi
from zoo.datasets.records import Pairs, Sequences
from zoo.inference.loader import whole
from zoo.inference.marginal import fit_marginal
from zoo.inference.posterior import GuidePosterior
from zoo.inference.svi import fit_svi
from zoo.streams import alone, seeded
from zoo.types import Posterior

__all__ = ["Session", "kept_out", "train_model"]

ENOUGH = 8


@dataclass(frozen=True, kw_only=True)
class Session:
    """How a training is run: seed, device, where its checkpoints are, and what it shows.

    A training that was begun in ``folder`` is gone on with.
    """

    seed: int = 0
    device: str = "cpu"
    folder: Path | None = None
    progress: bool = False
    tensorboard: bool = False


def train_model(
    model: nn.Module,
    guide: nn.Module | None,
    strategy: Inference,
    train: Sequences | Pairs,
    val: Sequences | Pairs | None,
    session: Session,
) -> list[dict[str, Any]]:
    """Train ``model`` and ``guide`` in place on scaled data; returns the history's rows.

    Movements that the networks were not trained on, ``val`` or a share of ``train``, teach a model
    that learns its noise so (:class:`LearnsNoise`) how far its frames are from new ones. A prior
    over movements is then learned from all of ``train``.
    """
    known, held_out = kept_out(model, strategy, train, val, session.seed)
    history = _TRAINERS[type(strategy)](model, guide, strategy, known, val, session)
    model.eval()
    if guide is not None:
        guide.eval()
        with seeded(session.seed, session.device), torch.no_grad():
            _learn(model, GuidePosterior(guide), train, held_out)
    _settle(model)
    return history


def _learn(model: nn.Module, posterior: Posterior, train: Any, held_out: Any) -> None:
    """What is estimated through the trained guide."""
    if held_out is not None and isinstance(model, LearnsNoise):
        model.learn_noise(whole(held_out), posterior)
    if isinstance(model, LearnsPrior):
        model.learn_prior(whole(train), posterior)


def kept_out(
    model: nn.Module, strategy: Inference, train: Any, val: Any, seed: int
) -> tuple[Any, Any]:
    """The movements to train on and those that are kept out, if any."""
    share = strategy.kept_out if isinstance(strategy, Svi) else 0.0
    if share and not isinstance(model, LearnsNoise):
        raise ValueError(
            f"kept_out must be 0 for {type(model).__name__}, whose noise is not estimated again on "
            f"movements kept out of the training; got {share:g}"
        )
    if val is not None or not share:
        return train, val
    columns = [n for n, v in train.groups.items() if n != "start" and len(set(v)) >= ENOUGH]
    if not columns:
        return train, None
    known, held_out = train.split(by=columns[0], parts=(1 - share, share), seed=seed)
    return known, held_out


def _settle(model: nn.Module) -> None:
    """Lay statistics out as a file will: the same bits in, the same bits out of every product."""
    for module in model.modules():
        for name, buffer in module._buffers.items():
            if buffer is not None and not buffer.is_contiguous():
                module._buffers[name] = buffer.contiguous()


def _exact(
    model: Any, guide: Any, strategy: Any, train: Any, val: Any, session: Session
) -> list[dict[str, Any]]:
    _need(model, Conditions, "condition")
    with alone():
        model.condition(train)
    return []


def _marginal(
    model: Any, guide: Any, strategy: Any, train: Any, val: Any, session: Session
) -> list[dict[str, Any]]:
    _need(model, MaximisesEvidence, "condition", "objective", "settle")
    return fit_marginal(
        model,
        train,
        strategy,
        seed=session.seed,
        progress=session.progress,
        folder=session.folder,
        resume="auto",
    )


def _variational(
    model: Any, guide: Any, strategy: Any, train: Any, val: Any, session: Session
) -> list[dict[str, Any]]:
    if guide is None:
        raise TypeError(f"{type(model).__name__} has no guide to train by variational inference")
    with seeded(session.seed, session.device):
        for part in (model, guide):
            if isinstance(part, Prepares):
                part.prepare(train)
        if isinstance(guide, Builds):
            guide.build()
    history = fit_svi(
        model,
        guide,
        train,
        strategy,
        val=val,
        seed=session.seed,
        device=session.device,
        folder=session.folder,
        resume="auto",
        progress=session.progress,
        tensorboard=session.tensorboard,
    )
    if isinstance(guide, Builds) and isinstance(model, Adopts):
        model.adopt(guide.moments())
    return history.rows


def _need(model: nn.Module, protocol: type, *names: str) -> None:
    if not isinstance(model, protocol):
        lacking = ", ".join(n for n in names if not hasattr(model, n))
        raise TypeError(
            f"{type(model).__name__} has no {lacking}, which this inference calls "
            f"(see zoo.contract.parts.{protocol.__name__})"
        )


_TRAINERS: dict[type, Callable[..., list[dict[str, Any]]]] = {
    Exact: _exact,
    MarginalLikelihood: _marginal,
    Svi: _variational,
}
