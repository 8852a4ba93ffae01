"""Network heads that give the moments of a Gaussian."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

__all__ = ["ConstantNoiseHead", "GaussianHead"]


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
    """Mean from the features and one constant standard deviation a coordinate, σ = s² + floor.

    >>> import torch
    >>> mean, std = ConstantNoiseHead(8, 3)(torch.randn(4, 8))
    >>> mean.shape, std.shape
    (torch.Size([4, 3]), torch.Size([4, 3]))
    """

    def __init__(
        self, inputs: int, outputs: int, *, floor: float = 1e-3, initial: float = 1.0
    ) -> None:
        """Head from ``inputs`` features to ``outputs`` coordinates."""
        super().__init__()
        self.floor = floor
        self.mean = nn.Linear(inputs, outputs)
        self.root = nn.Parameter(self.mean.bias.detach().new_full((outputs,), initial**0.5))

    def forward(
        self, features: Float[Tensor, "*batch feature"]
    ) -> tuple[Float[Tensor, "*batch output"], Float[Tensor, "*batch output"]]:
        """Mean and standard deviation."""
        mean = self.mean(features)
        return mean, (self.root.square() + self.floor).expand_as(mean)
