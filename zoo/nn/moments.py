"""Networks that give the moments of a Gaussian."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from jaxtyping import Float
from torch import Tensor, nn

from zoo.nn.mlp import Activation, trunk

__all__ = ["ConstantNoiseHead", "GaussianHead", "GaussianNetwork", "Noise"]

Noise = Literal["state", "constant", "shared"]


class GaussianHead(nn.Module):
    """Mean and standard deviation, the latter with the square as transfer function (§4.3.1).

    μ = W_μ h + b_μ and σ = (W_σ h + b_σ)² + floor. The bias b_σ starts at √``initial``, so that σ
    starts near ``initial``.

    >>> import torch
    >>> mean, std = GaussianHead(8, 3)(torch.randn(4, 8))
    >>> mean.shape, bool((std > 0).all())
    (torch.Size([4, 3]), True)
    """

    def __init__(
        self, inputs: int, outputs: int, *, floor: float = 1e-3, initial: float = 1.0
    ) -> None:
        """Heads from ``inputs`` features to ``outputs`` coordinates."""
        super().__init__()
        self.floor = floor
        self.mean = nn.Linear(inputs, outputs)
        self.root = nn.Linear(inputs, outputs)
        nn.init.constant_(self.root.bias, initial**0.5)

    def forward(
        self, features: Float[Tensor, "*batch feature"]
    ) -> tuple[Float[Tensor, "*batch output"], Float[Tensor, "*batch output"]]:
        """Mean and standard deviation."""
        std = self.root(features).square() + self.floor
        return self.mean(features), std


class ConstantNoiseHead(nn.Module):
    """Mean from the features and constant standard deviations σ = s² + floor.

    One σ a coordinate, or one for all where ``shared``.

    >>> import torch
    >>> mean, std = ConstantNoiseHead(8, 3)(torch.randn(4, 8))
    >>> mean.shape, std.shape
    (torch.Size([4, 3]), torch.Size([4, 3]))
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        *,
        shared: bool = False,
        floor: float = 1e-3,
        initial: float = 1.0,
    ) -> None:
        """Head from ``inputs`` features to ``outputs`` coordinates."""
        super().__init__()
        self.floor = floor
        self.mean = nn.Linear(inputs, outputs)
        start = self.mean.bias.detach().new_full((1 if shared else outputs,), initial**0.5)
        self.root = nn.Parameter(start)

    def forward(
        self, features: Float[Tensor, "*batch feature"]
    ) -> tuple[Float[Tensor, "*batch output"], Float[Tensor, "*batch output"]]:
        """Mean and standard deviation."""
        mean = self.mean(features)
        return mean, (self.root.square() + self.floor).expand_as(mean)


class GaussianNetwork(nn.Module):
    """Hidden layers and a head: p(y | x) = N(y; μ(x), σ²), (30).

    ``noise`` says what σ depends on: the ``state`` x, a ``constant`` of each output, or one
    constant ``shared`` by all. Without hidden layers μ is linear in x.

    >>> import torch
    >>> mean, std = GaussianNetwork(5, (512,), 50, noise="shared")(torch.randn(8, 70, 5))
    >>> mean.shape, std.unique().numel()
    (torch.Size([8, 70, 50]), 1)
    """

    def __init__(
        self,
        inputs: int,
        hidden: Sequence[int],
        outputs: int,
        *,
        activation: Activation = "relu",
        noise: Noise = "state",
        floor: float = 1e-3,
        initial: float = 1.0,
    ) -> None:
        """A network from ``inputs`` over the ``hidden`` layers to the moments of ``outputs``."""
        super().__init__()
        sizes = [inputs, *hidden]
        self.trunk = trunk(sizes, activation)
        self.head: nn.Module
        if noise == "state":
            self.head = GaussianHead(sizes[-1], outputs, floor=floor, initial=initial)
        else:
            self.head = ConstantNoiseHead(
                sizes[-1], outputs, shared=noise == "shared", floor=floor, initial=initial
            )

    def forward(
        self, x: Float[Tensor, "*batch input"]
    ) -> tuple[Float[Tensor, "*batch output"], Float[Tensor, "*batch output"]]:
        """Mean and standard deviation."""
        moments: tuple[Tensor, Tensor] = self.head(self.trunk(x))
        return moments
