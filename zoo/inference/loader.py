"""Minibatches: windows of movements or items of regression data, in an order set by a seed."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

import torch
from torch import Tensor

from zoo.datasets.records import Pairs, Sequences
from zoo.types import Batch

__all__ = ["Loader", "stream", "whole"]


def stream(*position: int | str) -> int:
    """A seed for one place of a computation, so that its noise depends on the place alone.

    >>> stream(0, "step", 1) == stream(0, "step", 1) != stream(0, "step", 2)
    True
    """
    key = "/".join(map(str, position)).encode()
    return int.from_bytes(hashlib.blake2b(key, digest_size=4).digest(), "big")


class Loader:
    """Shuffled minibatches of ``data``; the order depends on the seed and the epoch only.

    Movements are cut into windows of ``window`` frames every ``stride`` frames, none across the
    end of its movement; ``window=None`` takes each movement whole, padded to the longest. A batch
    brings the complete movements its windows come from, in the order of the data. Of regression
    data a batch holds items. The last batch of an epoch holds what is left.

    >>> import numpy as np
    >>> data = Sequences.from_arrays([np.zeros((5, 2)), np.ones((7, 2))], rate=100.0)
    >>> loader = Loader(data, batch_size=4, window=3, stride=1, seed=0)
    >>> loader.total, len(loader), [len(batch) for batch in loader.epoch(0)]
    (8, 2, [4, 4])
    """

    def __init__(
        self,
        data: Sequences | Pairs,
        *,
        batch_size: int,
        window: int | None = None,
        stride: int = 1,
        seed: int = 0,
    ) -> None:
        """Cut ``data``; a movement shorter than ``window`` raises a ValueError that names it."""
        if batch_size < 1:
            raise ValueError(f"batch_size must be at least 1; got {batch_size}")
        self.batch_size, self.seed = batch_size, seed
        self._cut: _Windows | _Items = (
            _Items(data) if isinstance(data, Pairs) else _Windows(data, window, stride)
        )
        self.total = self._cut.total

    def __len__(self) -> int:
        """Batches of an epoch."""
        return -(-self.total // self.batch_size)

    def epoch(self, epoch: int, first: int = 0) -> Iterator[Batch]:
        """The batches of an epoch in random order, from batch ``first`` on."""
        order = self.order(epoch)
        for i in range(first, len(self)):
            yield self.take(order[i * self.batch_size : (i + 1) * self.batch_size])

    def sweep(self) -> Iterator[Batch]:
        """All batches in the order of the data."""
        return (self.take(rows) for rows in torch.arange(self.total).split(self.batch_size))

    def order(self, epoch: int) -> Tensor:
        """The random order of an epoch."""
        generator = torch.Generator().manual_seed(stream(self.seed, "order", epoch))
        return torch.randperm(self.total, generator=generator)

    def take(self, rows: Tensor) -> Batch:
        """The windows or items of these numbers as one batch."""
        return self._cut.take(rows)


def whole(data: Sequences | Pairs) -> Batch:
    """All movements from frame 0, or all items, as one batch; its mask is None when complete.

    Movements of unequal length are padded to the longest and the padding is False in the mask.

    >>> import numpy as np
    >>> batch = whole(Sequences.from_arrays(np.zeros((3, 5, 2)), rate=100.0))
    >>> batch.values.shape, batch.mask, batch.start.tolist()
    (torch.Size([3, 5, 2]), None, [0, 0, 0])
    """
    return Loader(data, batch_size=len(data)).take(torch.arange(len(data)))


class _Windows:
    """Windows of movements, gathered from one flat tensor of frames."""

    def __init__(self, data: Sequences, window: int | None, stride: int) -> None:
        frames = data.values.shape[1]
        self.window, self.is_whole = frames if window is None else window, window is None
        if window is not None:
            _check(data, window, stride)
        padded = data.lengths.clamp(min=self.window)
        self.sequence, self.start = _places(padded.tolist(), self.window, stride)
        self.total = len(self.sequence)
        self.movements = data.values
        self.movement_mask = None if bool(data.mask.all()) else data.mask
        self.lengths = None if bool((data.lengths == frames).all()) else data.lengths
        self.device = data.values.device
        self.frames = data.values.flatten(0, 1)
        self.first = self.sequence * frames + self.start
        self.step = torch.arange(self.window)
        gapless = self._is_gapless(data, window)
        self.frame_mask = None if gapless else data.mask.flatten(0, 1)
        self.controls = data.controls
        self.known = self.window if data.controls is None else data.controls.shape[1]

    def _is_gapless(self, data: Sequences, window: int | None) -> bool:
        if window is None:
            return bool(data.mask.all())
        inside = torch.arange(data.mask.shape[1]) < data.lengths.cpu()[:, None]
        return bool(data.mask.cpu()[inside].all())

    def take(self, rows: Tensor) -> Batch:
        index = (self.first[rows, None] + self.step).flatten().to(self.device)
        shape = (len(rows), self.window, -1)
        movements, movement_mask, lengths, sequence = self._movements(self.sequence[rows])
        every = self.is_whole and len(rows) == self.total and bool((rows.diff() == 1).all())
        values = self.movements.clone() if every else self.frames.index_select(0, index)
        return Batch(
            values=values.view(shape),
            mask=_gather(self.frame_mask, index, shape),
            inputs=self._inputs(rows),
            start=self.start[rows].to(self.device),
            sequence=sequence.to(self.device),
            movements=movements,
            movement_mask=movement_mask,
            total=self.total,
            total_sequences=len(self.movements),
            lengths=lengths,
        )

    def _inputs(self, rows: Tensor) -> Tensor | None:
        """Controls of the windows; of whole movements those of the frames to come as well."""
        if self.controls is None:
            return None
        steps = torch.arange(self.known) if self.is_whole else self.step
        frame = self.start[rows, None] + steps
        return self.controls[self.sequence[rows, None], frame]

    def _movements(self, sequence: Tensor) -> tuple[Tensor, Tensor | None, Tensor | None, Tensor]:
        kept, inverse = torch.unique(sequence, return_inverse=True)
        mask, lengths = self.movement_mask, self.lengths
        if len(kept) == len(self.movements):
            return self.movements, mask, lengths, sequence
        kept = kept.to(self.device)
        kept_mask = None if mask is None else mask.index_select(0, kept)
        kept_lengths = None if lengths is None else lengths.index_select(0, kept)
        return self.movements.index_select(0, kept), kept_mask, kept_lengths, inverse


class _Items:
    """Items of regression data."""

    def __init__(self, data: Pairs) -> None:
        self.total = len(data)
        self.data = data
        self.mask = None if bool(data.mask.all()) else data.mask
        self.none = data.targets.new_empty(0, 0, data.targets.shape[1])

    def take(self, rows: Tensor) -> Batch:
        index = rows.to(self.data.targets.device)
        zero = torch.zeros_like(index)
        return Batch(
            values=self.data.targets.index_select(0, index),
            mask=None if self.mask is None else self.mask.index_select(0, index),
            inputs=self.data.inputs.index_select(0, index),
            start=zero,
            sequence=zero,
            movements=self.none,
            movement_mask=None,
            total=self.total,
            total_sequences=0,
        )


def _check(data: Sequences, window: int, stride: int) -> None:
    if window < 1 or stride < 1:
        raise ValueError(f"window and stride must be at least 1; got {window} and {stride}")
    short = int(data.lengths.argmin())
    if data.lengths[short] < window:
        group = ", ".join(f"{k} {v[short]}" for k, v in data.groups.items())
        raise ValueError(
            f"movement {short} of {data.name!r} ({group}) has {int(data.lengths[short])} frames; "
            f"windows of {window} frames need at least as many (set a shorter window)"
        )


def _places(lengths: list[int], window: int, stride: int) -> tuple[Tensor, Tensor]:
    starts = [torch.arange(0, n - window + 1, stride) for n in lengths]
    sequence = torch.repeat_interleave(torch.tensor([len(s) for s in starts]))
    return sequence, torch.cat(starts)


def _gather(frames: Tensor | None, index: Tensor, shape: tuple[int, ...]) -> Tensor | None:
    return None if frames is None else frames.index_select(0, index).view(shape)
