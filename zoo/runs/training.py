"""What of ``zoo.fit`` decides the bits of a run: its scaling and the training of its parts."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from typing import Any

from zoo.datasets.records import Pairs, Sequences
from zoo.datasets.records.scaling import Scaler, suited
from zoo.inference.harness import Session, train_model
from zoo.runs.assembly import Assembly

__all__ = ["Learned", "learn"]


@dataclass(frozen=True, kw_only=True)
class Learned:
    """A trained copy of an assembly, the scaling of its data and a row per epoch or iteration."""

    assembly: Assembly
    scaler: Scaler
    history: list[dict[str, Any]]


def learn(
    assembly: Assembly,
    train: Pairs | Sequences,
    val: Pairs | Sequences | None,
    session: Session,
) -> Learned:
    """Train copies of model and guide on scaled data; the assembly itself stays untouched."""
    asked = "scaling" in assembly.settings
    scaler = Scaler.fit(train, assembly.scaling if asked else suited(train, assembly.scaling))
    model, guide = copy.deepcopy((assembly.model, assembly.guide))

    def prepared(data: Any) -> Any:
        return scaler.apply(data).to(dtype=assembly.dtype, device=assembly.device)

    held_out = None if val is None else prepared(val)
    history = train_model(model, guide, assembly.inference, prepared(train), held_out, session)
    trained = replace(assembly, model=model, guide=guide)
    return Learned(assembly=trained, scaler=scaler, history=history)
