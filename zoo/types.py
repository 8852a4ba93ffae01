"""Names of the tensor axes and the records that models, guides and the harness exchange.

Axes used in every shape annotation of the package:

=============  ==========================================================
``sequence``   one movement (a trial, a demonstration)
``frame``      a time step of a complete movement
``window``     a sub-sequence cut from a movement; an item of a minibatch
``time``       a time step of a window
``channel``    an observed quantity (a joint angle in rad, a pixel, ...)
``latent``     a dimension of the latent space
``item``       a row of a regression data set
``feature``    an input of a regression data set
``target``     an output of a regression data set
``sample``     a draw of the Monte Carlo approximation
``component``  a component of a predictive mixture
=============  ==========================================================
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Literal, Protocol, Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

if TYPE_CHECKING:
    from pyro.distributions import TorchDistribution

__all__ = ["Batch", "Layout", "Posterior", "Sites"]


@dataclass(frozen=True, kw_only=True)
class Layout:
    """What a model must know of its data before it sees any: names, units, rate and lengths.

    ``frames`` is the length that all movements have, if any, and ``span`` the shortest and the
    longest where they differ; ``windows`` says that they are cut from longer ones.
    """

    kind: Literal["sequences", "pairs"]
    channels: tuple[str, ...]
    units: tuple[str, ...]
    inputs: tuple[str, ...] = ()
    input_units: tuple[str, ...] = ()
    rate: float | None = None
    frames: int | None = None
    span: tuple[int, int] | None = None
    windows: bool = False

    def __post_init__(self) -> None:
        """Refuse labels that do not go together."""
        for what, units in (("channels", self.units), ("inputs", self.input_units)):
            names = getattr(self, what)
            if len(units) != len(names):
                raise ValueError(f"{len(names)} {what} have {len(units)} units")
            if len(set(names)) != len(names):
                raise ValueError(f"names of {what} must be distinct; got {', '.join(names)}")

    def check(self, other: Layout) -> None:
        """Raise a ValueError that names the first difference that matters for prediction."""
        if self.kind != other.kind:
            raise ValueError(f"data are {other.kind}; this model was made for {self.kind}")
        for what in ("channels", "inputs"):
            mine, theirs = getattr(self, what), getattr(other, what)
            if len(mine) != len(theirs):
                raise ValueError(
                    f"data have {len(theirs)} {what}; this model was made for "
                    f"{len(mine)} ({', '.join(mine[:3])}, …)"
                )
            if mine != theirs:
                i = next(i for i, (a, b) in enumerate(zip(mine, theirs, strict=True)) if a != b)
                raise ValueError(
                    f"{what} {i} of the data is {theirs[i]!r}; this model was made for {mine[i]!r}"
                )
        if self.units != other.units:
            raise ValueError(f"data are in {other.units}; this model was made for {self.units}")
        if self.rate and other.rate and abs(self.rate - other.rate) > 1e-6 * self.rate:
            raise ValueError(
                f"data run at {other.rate:g} Hz; this model was made for {self.rate:g} Hz"
            )


@dataclass(frozen=True, kw_only=True)
class Batch:
    """A minibatch: windows of movements with the complete movements they were cut from.

    For regression data ``values`` are the targets, ``inputs`` the features, ``time`` is absent
    and ``movements`` is empty. Missing entries are 0 in ``values`` and False in ``mask``;
    ``mask`` is None where nothing is missing. ``total`` and ``total_sequences`` count the whole
    training set, so that a plate of that size scales a minibatch rightly. ``lengths`` are those of
    ``movements``, None where none of them is padded. Where ``observed`` is False a program draws
    its data instead of observing them; see :meth:`unobserved`.
    """

    values: Float[Tensor, "window *time channel"]
    mask: Bool[Tensor, "window *time channel"] | None
    inputs: Float[Tensor, "window *known control"] | None
    start: Int[Tensor, " window"]
    sequence: Int[Tensor, " window"]
    movements: Float[Tensor, "sequence frame observed"]
    movement_mask: Bool[Tensor, "sequence frame observed"] | None
    total: int
    total_sequences: int
    lengths: Int[Tensor, " sequence"] | None = None
    observed: bool = True

    @classmethod
    def blank(cls, layout: Layout, dtype: torch.dtype) -> Self:
        """One movement or item of zeros: what a program must see to know the sizes of its sites."""
        longest = layout.frames or (layout.span or (1, 1))[1]
        frames = () if layout.kind == "pairs" else (longest,)
        values = torch.zeros(1, *frames, len(layout.channels), dtype=dtype)
        inputs = torch.zeros(1, *frames, len(layout.inputs), dtype=dtype)
        zero = torch.zeros(1, dtype=torch.long)
        return cls(
            values=values,
            mask=None,
            inputs=inputs if layout.inputs else None,
            start=zero,
            sequence=zero,
            movements=values if frames else values.new_empty(0, 0, values.shape[-1]),
            movement_mask=None,
            total=1,
            total_sequences=len(frames),
        )

    @property
    def frames(self) -> Int[Tensor, " sequence"]:
        """Length of every movement."""
        if self.lengths is not None:
            return self.lengths
        return self.sequence.new_full((len(self.movements),), self.movements.shape[1])

    def __len__(self) -> int:
        """Number of windows."""
        return int(self.values.shape[0])

    def unobserved(self) -> Self:
        """The same batch for a program that draws its data: prior and posterior predictive.

        Sizes, inputs and masks stay; so do the values, which only a guide may read.
        """
        return replace(self, observed=False)

    def given(self, data: Tensor) -> Tensor | None:
        """``obs=`` of an observed site: ``data``, or None where the program is to draw them."""
        return data if self.observed else None

    def repeat(self, times: int) -> Self:
        """``times`` copies of the whole batch, one after the other, each with its own movements."""
        tiled: dict[str, Any] = {
            f.name: torch.cat([value] * times)
            for f in fields(self)
            if isinstance(value := getattr(self, f.name), Tensor)
        }
        shift = torch.arange(times, device=self.sequence.device) * self.movements.shape[0]
        tiled["sequence"] = (self.sequence + shift[:, None]).flatten()
        return replace(self, **tiled)


@dataclass(frozen=True, kw_only=True)
class Wishes:
    """How new movements are to differ from their demonstrations, in the model's scale.

    ``goal`` is the last frame to reach, ``duration`` stretches time, ``onto`` are the movements to
    switch to, from frame ``start`` of the new movement over ``steps`` frames, (89).
    """

    goal: Float[Tensor, "sequence channel"] | None = None
    duration: float = 1.0
    onto: Batch | None = None
    start: int = 0
    steps: int = 1


@dataclass(frozen=True, kw_only=True)
class Sites:
    """The latent sites of an exact posterior, in the order in which they are drawn.

    ``of`` gives the distribution of each site from the values drawn before it, by name, so that
    p(a, b | x) = p(a | x) p(b | a, x) is ``{"a": lambda _: p_a, "b": lambda drawn: ...}``. All
    stand in the plate ``plate`` of ``size`` independent parts, ``rows`` of which are in the batch;
    ``plate`` is None for a posterior that is not such a product.
    """

    plate: str | None
    size: int
    rows: int
    of: Mapping[str, Callable[[Mapping[str, Tensor]], TorchDistribution]]


class Posterior(Protocol):
    """What a model may ask of its guide when it predicts; the model never sees the guide."""

    def draw(self, batch: Batch, draws: int) -> dict[str, Tensor]:
        """Joint draws of every latent site, each with a leading ``sample`` axis."""
        ...

    def encode(
        self,
        values: Float[Tensor, "*batch channel"],
        mask: Bool[Tensor, "*batch channel"] | None = None,
    ) -> torch.distributions.Normal:
        """q(z_t | x_t) of single frames."""
        ...
