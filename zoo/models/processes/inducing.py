"""Items as inducing inputs explain them: settings and covariances of sparse processes."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor

from zoo.contract.settings import Count, Positive, settings
from zoo.errors import FewerInducingWarning, NoiseDivergenceWarning
from zoo.models.processes.collapsed import Collapsed
from zoo.models.processes.covariances import Name
from zoo.models.processes.kernels import squared_distances
from zoo.types import Batch, Layout

__all__ = ["Config", "ProjectedItems", "Training", "warn_of_divergence"]


@settings
class Config:
    """Settings of :class:`~zoo.models.processes.sparse_gp.SparseGaussianProcess`.

    ``kernel``: the covariance, with a learned α where it is the rational quadratic; all but the
    squared exponential hold the matrix of items × inducing inputs several times.
    ``inducing``: how many inducing inputs are drawn from the data, or which fraction of it (17 %
    in §3.3.4). A fraction gives up to ``most_inducing``, with a warning: cost grows with items · m²
    and memory with items · m, while for this smooth covariance a number m that grows with a power
    of log(items) is enough (Burt et al., ICML 2019); a number is taken as it is.
    ``learn_inducing`` moves them by gradient; ``ard``: a length scale for each feature;
    ``jitter``: variance, in units of σ_f², of the noise with which u observes f at the inducing
    inputs, a part of the model; ``noise_floor``: smallest σ_n²/σ_f²; ``noise``: its starting value;
    ``compare``: fit the other bound beside FITC and warn where the noise standard deviations
    differ by more than the factor ``divergence``; ``joint_items``: up to so many new items are
    drawn jointly.
    """

    bound: Literal["fitc", "vfe"] = "fitc"
    kernel: Name = "squared-exponential"
    inducing: Annotated[int | float, Field(gt=0)] = 0.17
    most_inducing: Count = 1000
    learn_inducing: bool = False
    ard: bool = False
    noise: Positive = 0.1
    noise_floor: Positive = 1e-6
    jitter: Annotated[float, Field(ge=0)] = 1e-8
    compare: bool = True
    divergence: Annotated[float, Field(gt=1)] = 2.0
    joint_items: Annotated[int, Field(ge=0)] = 512

    def __post_init__(self) -> None:
        """Refuse what is neither a number nor a fraction, and a floor above the noise."""
        if self.inducing > 1 and not float(self.inducing).is_integer():
            raise ValueError(f"inducing is a number or a fraction up to 1; got {self.inducing}")
        if not self.noise_floor < self.noise:
            raise ValueError(
                f"noise_floor must be below noise; got {self.noise_floor} and {self.noise}"
            )

    def count(self, items: int) -> int:
        """Number of inducing inputs for a training set of so many items.

        >>> Config(inducing=0.17).count(1000), Config(inducing=300).count(1000)
        (170, 300)
        """
        if isinstance(self.inducing, float) and self.inducing <= 1:
            return self._capped(max(1, round(self.inducing * items)), items)
        if self.inducing > items:
            raise ValueError(f"{self.inducing} inducing inputs cannot be drawn from {items} items")
        return int(self.inducing)

    def _capped(self, asked: int, items: int) -> int:
        if asked > self.most_inducing:
            warnings.warn(
                f"inducing={self.inducing:g} of {items} items would be {asked} inducing inputs; "
                f"{self.most_inducing} are taken (most_inducing), since cost grows with their "
                "square: give a number to choose it",
                FewerInducingWarning,
                stacklevel=5,
            )
        return min(asked, self.most_inducing)


class Training(NamedTuple):
    """What only training needs: inputs, the bound of their targets, and squared distances."""

    inputs: Float[Tensor, "item feature"]
    bound: Collapsed
    among: Float[Tensor, "inducing inducing"]
    across: Float[Tensor, "item inducing"]

    @classmethod
    def of(
        cls,
        inputs: Float[Tensor, "item feature"],
        bound: Collapsed,
        inducing: Float[Tensor, "inducing feature"],
    ) -> Training:
        """Distances among the inducing inputs and from them to all others, computed once."""
        among = squared_distances(inducing, inducing).fill_diagonal_(0)
        return cls(inputs, bound, among, squared_distances(inputs, inducing))


@dataclass(frozen=True)
class ProjectedItems:
    """Items whose y given u = σ_f L v is N(σ_f Vᵀv, σ_f² ``diagonal``), in units of σ_f².

    ``factor`` is L, ``projection`` V = L⁻¹K_uf, ``left`` diag(K − Q), which is 1 − diag VᵀV.
    """

    y: Float[Tensor, "target item"]
    mask: Bool[Tensor, "target item"]
    factor: Float[Tensor, "inducing inducing"]
    projection: Float[Tensor, "inducing item"]
    left: Float[Tensor, " item"]
    diagonal: Float[Tensor, " item"]

    @classmethod
    def of(
        cls,
        batch: Batch,
        k_uu: Float[Tensor, "inducing inducing"],
        k_uf: Float[Tensor, "inducing item"],
        noise: Float[Tensor, ""],
        bound: Literal["fitc", "vfe"],
    ) -> ProjectedItems:
        """The items of ``batch`` under FITC or VFE, with covariances of unit signal variance."""
        factor = torch.linalg.cholesky(k_uu)
        projection = torch.linalg.solve_triangular(factor, k_uf, upper=False)
        left = 1 - projection.square().sum(0)
        diagonal = (left if bound == "fitc" else torch.zeros_like(left)) + noise
        y = batch.values.flatten(1).mT
        mask = torch.ones_like(y).bool() if batch.mask is None else batch.mask.flatten(1).mT
        return cls(y, mask, factor, projection, left, diagonal)


def warn_of_divergence(
    layout: Layout,
    fitc: Float[Tensor, " target"],
    vfe: Float[Tensor, " target"],
    limit: float,
) -> None:
    """Name the target whose noise standard deviations are furthest apart, beyond the factor."""
    ratio = torch.maximum(fitc / vfe, vfe / fitc)
    if bool((ratio > limit).any()):
        worst = int(ratio.argmax())
        warnings.warn(
            f"{layout.channels[worst]}: FITC's noise is {fitc[worst]:.3g}, "
            f"VFE's {vfe[worst]:.3g} (scaled), a factor {ratio[worst]:.1f} apart; "
            "more inducing inputs bring them together",
            NoiseDivergenceWarning,
            stacklevel=3,
        )
