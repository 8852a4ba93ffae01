"""Random streams of their own, one thread at a time: the generator is one for the whole process."""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from zoo.arguments import seed_of

__all__ = ["alone", "seeded"]


class _Turns:
    """A lock that a thread may take again, given to others in the order in which they ask."""

    def __init__(self) -> None:
        self._change = threading.Condition()
        self._waiting: deque[object] = deque()
        self._owner: int | None = None
        self._depth = 0

    def take(self) -> None:
        me, ticket = threading.get_ident(), object()
        with self._change:
            if self._owner != me:
                self._waiting.append(ticket)
                try:
                    self._change.wait_for(
                        lambda: self._owner is None and self._waiting[0] is ticket
                    )
                    self._owner = me
                finally:
                    self._waiting.remove(ticket)
                    self._change.notify_all()
            self._depth += 1

    def give(self) -> None:
        with self._change:
            self._depth -= 1
            if not self._depth:
                self._owner = None
                self._change.notify_all()


_turns = _Turns()


def _anew() -> None:
    global _turns
    _turns = _Turns()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_anew)


@contextmanager
def alone() -> Iterator[None]:
    """Run a block while no other thread of this process is in one; blocks may be nested.

    Torch's generator and the handlers and settings of Pyro are one for all threads. Who waits is
    served in turn, so that forecasts are answered between the epochs of a training.
    """
    turns = _turns
    turns.take()
    try:
        yield
    finally:
        turns.give()


@contextmanager
def seeded(seed: int, device: torch.device | str = "cpu") -> Iterator[None]:
    """Run a block on its own random stream, alone, and leave the caller's untouched.

    >>> before = torch.random.get_rng_state()
    >>> with seeded(0):
    ...     first = torch.randn(1)
    >>> bool((torch.random.get_rng_state() == before).all())
    True
    """
    kind = torch.device(device)
    devices = [] if kind.type == "cpu" else [kind]
    seed = seed_of(seed)
    with alone(), torch.random.fork_rng(devices=devices):
        if devices:
            torch.manual_seed(seed)
        else:
            torch.default_generator.manual_seed(seed)
        yield
