"""Single steps of variational inference: checked once, seeded by place, with named errors."""

from __future__ import annotations

import math
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from zoo.contract.strategies import Svi
from zoo.inference.elbo import Bound, check, tight_bound
from zoo.inference.loader import Loader, stream
from zoo.inference.resume.state import Place
from zoo.inference.schedules import learning_rate
from zoo.types import Batch

__all__ = ["Advances", "NotFiniteError", "Steps"]


@runtime_checkable
class Advances(Protocol):
    """A model or guide whose objective depends on the share of the training that is behind.

    ``settled`` says that the objective is the final one; only then epochs are selected.
    """

    settled: bool

    def advance(self, done: float) -> None:
        """Take the objective of the share ``done``, from 0 to 1, and of it alone."""
        ...


class NotFiniteError(ArithmeticError):
    """What of the bound or its gradient is not finite, by name."""


class Steps:
    """Model, guide and their optimiser; the noise of a call depends on its place alone."""

    def __init__(
        self,
        model: nn.Module,
        guide: nn.Module,
        loader: Loader,
        strategy: Svi,
        *,
        seed: int,
        device: str,
    ) -> None:
        """Run every check of Pyro on two data; a guide that waits for its first call is built."""
        self.model, self.guide, self.strategy = model, guide, strategy
        self.count = strategy.epochs * len(loader)
        self.seed, self.device = seed, torch.device(device)
        self.mode(training=False)
        self.noise("check")
        check(model, guide, loader.take(loader.order(0)[:2]))
        self.parameters = _parameters(model, guide)
        self.optimizer = torch.optim.Adam(
            self.parameters.values(), lr=strategy.learning_rate, fused=True
        )

    def take(
        self, batch: Batch, place: Place, *, tries: int, c: float, beta: float
    ) -> tuple[float, ...]:
        """One step; loss, reconstruction, KL and gradient norm, weighted by the batch's size."""
        self.noise("step", place.step, tries)
        self.advance(place.step / self.count)
        for parameter in self.parameters.values():
            parameter.grad = None
        terms = tight_bound(self.model, self.guide, batch, c=c, beta=beta)
        (terms.loss / batch.total).backward()
        gradients = [p.grad for p in self.parameters.values() if p.grad is not None]
        norm = torch.linalg.vector_norm(torch.stack(torch._foreach_norm(gradients)))
        parts = (terms.loss.detach(), terms.reconstruction, terms.kl, norm)
        *sums, length = torch.stack(parts).tolist()
        if length == math.inf and self.strategy.clip is not None:
            length = _long_norm(gradients)
        if not all(map(math.isfinite, (*sums, length))):
            raise NotFiniteError(self._blame(terms))
        self._clip(gradients, length)
        self.optimizer.param_groups[0]["lr"] = self.rate(place.step, tries)
        self.optimizer.step()
        share = len(batch) / batch.total
        return *(value * share for value in sums), length * len(batch)

    def rate(self, step: int, tries: int) -> float:
        """Step size: the schedule's, halved at every return to the last good state."""
        return learning_rate(self.strategy, step / self.count) * 0.5**tries

    @torch.no_grad()
    def plain_bound(self, loader: Loader) -> float:
        """The un-tempered bound per datum, on the same noise at every call."""
        self.mode(training=False)
        self.advance(1.0)
        self.noise("validation")
        total = 0.0
        for batch in loader.sweep():
            terms = tight_bound(self.model, self.guide, batch)
            if broken := terms.broken():
                raise NotFiniteError(f"{', '.join(broken)} on the validation data")
            total += terms.elbo.item() * len(batch) / batch.total
        return total / loader.total

    def advance(self, done: float) -> None:
        """Tell model and guide how far the training is, if they have stages."""
        for part in self._staged():
            part.advance(done)

    def settled(self, step: int) -> bool:
        """Whether the objective at ``step`` is the final one."""
        self.advance(step / self.count)
        return all(part.settled for part in self._staged())

    def mode(self, *, training: bool) -> None:
        """Switch model and guide between training and evaluation."""
        self.model.train(training)
        self.guide.train(training)

    def noise(self, *position: int | str) -> None:
        """Seed the default generator for one place of the training."""
        seed = stream(self.seed, *position)
        torch.default_generator.manual_seed(seed)
        if self.device.type == "cuda":
            torch.cuda.manual_seed(seed)

    def _staged(self) -> list[Advances]:
        return [part for part in (self.model, self.guide) if isinstance(part, Advances)]

    def _clip(self, gradients: list[Tensor], length: float) -> None:
        if self.strategy.clip is not None and length > self.strategy.clip:
            torch._foreach_mul_(gradients, self.strategy.clip / length)

    def _blame(self, terms: Bound) -> str:
        if broken := terms.broken():
            return f"the bound's term {', '.join(broken)}"
        for name, parameter in self.parameters.items():
            if parameter.grad is not None and not bool(parameter.grad.isfinite().all()):
                return f"the gradient of {name}"
        return "the norm of the gradient"


def _long_norm(gradients: list[Tensor]) -> float:
    """Norm of gradients that are finite but whose squares overflow their number type."""
    return math.hypot(*(g.double().norm().item() for g in gradients))


def _parameters(model: nn.Module, guide: nn.Module) -> dict[str, nn.Parameter]:
    named = {f"model.{n}": p for n, p in model.named_parameters() if p.requires_grad}
    known = set(map(id, named.values()))
    rest = guide.named_parameters()
    return named | {f"guide.{n}": p for n, p in rest if p.requires_grad and id(p) not in known}
