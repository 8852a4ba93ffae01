"""Between the data's own units and a model's numbers: scaling, equal lengths, random streams."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from zoo.contract.capabilities import FollowsPhase, Reaches, Reports
from zoo.datasets.records import Pairs, Sequences
from zoo.datasets.records.arrays import doubles
from zoo.datasets.records.scaling import Scaler
from zoo.errors import ExtrapolationWarning, WindowsWarning
from zoo.inference.loader import whole
from zoo.inference.posterior import GuidePosterior
from zoo.prediction.predictive import Predictive
from zoo.runs.assembly import Assembly
from zoo.streams import seeded
from zoo.types import Batch, Posterior

__all__ = ["Ask", "Exchange", "check_unseen", "fingerprints"]

FAR = 0.1
Ask = Callable[[Batch, Posterior | None, list[int]], Predictive]


@dataclass(frozen=True, kw_only=True)
class Exchange:
    """What goes into a trained model is scaled here, what comes out is brought back."""

    assembly: Assembly
    scaler: Scaler

    def scaled(self, data: Any) -> Any:
        """Data of the right layout, in the model's scale, number type and device."""
        self.assembly.layout.check(data.layout)
        return self.scaler.apply(data).to(dtype=self.assembly.dtype, device=self.assembly.device)

    def unscaled(self, predictive: Predictive, task: str) -> Predictive:
        """A finite answer in the data's units."""
        if not _finite(predictive.location):
            raise FloatingPointError(
                f"{self.assembly.entry.name}: {task} gave values that are not finite"
            )
        like = predictive.location
        return predictive.affine(
            self.scaler.channel_scale.to(like), self.scaler.channel_shift.to(like)
        )

    def movements(self, data: Any) -> Sequences:
        """Scaled movements; regression data are refused."""
        if not isinstance(data, Sequences):
            remedy = "" if isinstance(data, Pairs) else ": zoo.Sequences.from_arrays(...) makes one"
            raise TypeError(
                f"{self.assembly.entry.name} predicts Sequences; got {type(data).__name__}{remedy}"
            )
        model = self.assembly.model
        if isinstance(model, FollowsPhase) and model.phased:
            _check_begin(self.assembly, data)
        scaled: Sequences = self.scaled(data)
        return scaled

    def answer(self, data: Sequences, ask: Ask, seed: int) -> tuple[Predictive, Tensor]:
        """Ask about movements of one length at a time, on a random stream of its own.

        ``ask`` is told which rows of ``data`` its batch holds; beside the answers stands how
        many frames each movement got.
        """
        scaled = self.movements(data)
        lengths = scaled.lengths.tolist()
        guide = self.assembly.guide
        posterior = None if guide is None else GuidePosterior(guide)
        parts, frames = [], torch.zeros(len(scaled), dtype=torch.long)
        with seeded(seed, self.assembly.device), torch.no_grad():
            for length in sorted(set(lengths)):
                rows = [i for i, n in enumerate(lengths) if n == length]
                some = scaled if len(rows) == len(scaled) else scaled[rows]
                parts.append((rows, ask(whole(some), posterior, rows)))
                frames[rows] = parts[-1][1].location.shape[2]
        return parts[0][1] if len(parts) == 1 else _merge(parts), frames

    def report(self) -> dict[str, Any]:
        """What the model tells of itself, its standard deviations in the data's units."""
        model = self.assembly.model
        if not isinstance(model, Reports):
            return {}
        scale = self.scaler.channel_scale.double().cpu()
        return {
            name: (torch.tensor(value) * scale).tolist() if "_std" in name else value
            for name, value in model.report().items()
            if value != []
        }

    def goal(self, goal: ArrayLike, count: int) -> Tensor:
        """A last frame to reach, for each of ``count`` movements, in the model's scale."""
        layout = self.assembly.layout
        width = len(layout.channels)
        array = doubles(goal, "goal")
        if array.shape not in ((width,), (count, width)):
            raise ValueError(
                f"goal has shape {array.shape}; ({width},) or ({count}, {width}) is needed, "
                f"in {layout.units[0] or 'the units of the data'}"
            )
        if not np.isfinite(array).all():
            raise ValueError("goal must be finite in every channel")
        rows = torch.from_numpy(np.broadcast_to(array, (count, width)).copy())
        self._warn_beyond(rows)
        scaled = (rows - self.scaler.channel_shift) / self.scaler.channel_scale
        return scaled.to(dtype=self.assembly.dtype, device=self.assembly.device)

    def _warn_beyond(self, goals: Float[Tensor, "sequence channel"]) -> None:
        """Say which goals are further beyond what was demonstrated than a tenth of its range."""
        model, layout = self.assembly.model, self.assembly.layout
        if not isinstance(model, Reaches) or not model.reached.numel():
            return
        scale, shift = self.scaler.channel_scale, self.scaler.channel_shift
        low, high = model.reached.to(goals) * scale + shift
        beyond = torch.maximum(low - goals, goals - high) > FAR * (high - low)
        beyond &= low.isfinite()
        told = [
            f"{layout.channels[c]} to {goals[i, c]:.4g} "
            f"(demonstrated {low[c]:.4g} to {high[c]:.4g} {layout.units[c]}".rstrip()
            + ")"
            for i, c in beyond.nonzero().tolist()
        ]
        if told:
            more = f" and {len(told) - 3} more" if len(told) > 3 else ""
            warnings.warn(
                f"{self.assembly.entry.name}: goals beyond the demonstrations: "
                f"{', '.join(told[:3])}{more}; the movement is an extrapolation",
                ExtrapolationWarning,
                stacklevel=8,
            )

    def onto(self, onto: Sequences, count: int) -> Sequences:
        """Movements to switch to, one for each of ``count``, in the model's scale."""
        scaled = self.movements(onto)
        if len(onto) not in (1, count):
            raise ValueError(f"onto has {len(onto)} movements; 1 or {count} are needed")
        frames = scaled.lengths.unique().tolist()
        if len(frames) > 1:
            raise ValueError(
                f"onto has movements of {frames[0]} to {frames[-1]} frames; one length is needed: "
                f"bring them to it by onto.resampled({frames[0]})"
            )
        return scaled[[0] * count] if len(onto) == 1 else scaled

    def pairs(self, data: Pairs | ArrayLike) -> Pairs:
        """Inputs without targets as pairs of the model's layout."""
        if isinstance(data, Pairs):
            return data
        if isinstance(data, Sequences):
            raise TypeError(f"{self.assembly.entry.name} predicts Pairs; got Sequences")
        layout = self.assembly.layout
        inputs = doubles(data, "inputs")
        if inputs.ndim != 2 or inputs.shape[1] != len(layout.inputs):
            raise ValueError(
                f"inputs have shape {inputs.shape}; (item, {len(layout.inputs)}) is needed"
            )
        return Pairs.from_arrays(
            inputs,
            np.full((len(inputs), len(layout.channels)), np.nan),
            features=layout.inputs,
            feature_units=layout.input_units,
            channels=layout.channels,
            units=layout.units,
        )


def _check_begin(assembly: Assembly, data: Sequences) -> None:
    """Warn where movements begin or end elsewhere than those trained on."""
    name, layout = assembly.entry.name, assembly.layout
    longest = int(data.lengths.max())
    begins = {int(s) for s in data.groups.get("start", ()) if s.isdigit()}
    if layout.windows and not begins and longest > (layout.frames or longest):
        warnings.warn(
            f"{name} was trained on windows of {layout.frames} frames and takes each movement of "
            f"up to {longest} frames for one of them: cut them by data.windows({layout.frames})",
            WindowsWarning,
            stacklevel=7,
        )
    if not layout.windows and begins - {0}:
        warnings.warn(
            f"{name} was trained on whole movements and takes the first frame of each window for "
            f"the beginning of one; these begin at frame {min(begins - {0})} and later: train it "
            "on windows too, or give movements from their first frame on",
            WindowsWarning,
            stacklevel=7,
        )


def _finite(values: Tensor) -> bool:
    """Whether all are finite; a finite sum says so at once."""
    return bool(values.sum().isfinite()) or bool(values.isfinite().all())


def fingerprints(data: Pairs | Sequences) -> list[str]:
    """A short hash of every movement or item: equal data have equal ones."""
    rows: Iterable[tuple[NDArray[np.float64], ...]]
    if isinstance(data, Pairs):
        rows = zip(_doubles(data.inputs), _doubles(data.targets), strict=True)
    else:
        lengths = data.lengths.tolist()
        rows = ((v[:n],) for v, n in zip(_doubles(data.values), lengths, strict=True))
    return [_digest(*row) for row in rows]


def check_unseen(
    data: Pairs | Sequences, known: Iterable[str], purpose: str, used: str = "trained on"
) -> None:
    """Warn where movements or items, or their equals, were trained or calibrated on."""
    known = set(known)
    again = sum(f in known for f in fingerprints(data))
    if again:
        warnings.warn(
            f"{again} of {len(data)} movements or items given for {purpose} were {used} "
            "(these or equal ones); bands on them look better than they are",
            stacklevel=3,
        )


def _doubles(values: Tensor) -> NDArray[np.float64]:
    return np.ascontiguousarray(values.double().cpu().numpy())


def _digest(*parts: NDArray[np.float64]) -> str:
    content = hashlib.blake2b(digest_size=8)
    for part in parts:
        content.update(part.data)
    return content.hexdigest()


def _merge(parts: Sequence[tuple[Sequence[int], Predictive]]) -> Predictive:
    """Predictives of movements of several lengths as one, padded with zeros in time."""
    longest = max(p.location.shape[2] for _, p in parts)

    def padded(part: Tensor) -> Tensor:
        return nn.functional.pad(part, (0, 0, 0, longest - part.shape[2]))

    order = torch.tensor([row for rows, _ in parts for row in rows]).argsort()
    return Predictive.concat([p.map(padded) for _, p in parts]).rows(order)
