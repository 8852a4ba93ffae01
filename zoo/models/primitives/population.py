r"""Gaussian over the parameters of movements: shared factors and independent channels.

A movement i has one parameter vector θ_ic for every channel c::

    a_i ~ N(0, I_r),   δ_ic ~ N(0, V_c V_cᵀ),   θ_ic = μ_c + L_c a_i + δ_ic

The factors a carry what channels have in common, δ what each has alone. Observed data enter as a
Gaussian likelihood with precision A_c and linear term b_c of every channel; the posterior is of
the same form, exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["ParameterShrinkage", "Population", "estimate"]


@dataclass(frozen=True)
class Population:
    """μ, L and V; ``mean`` may have a leading ``sequence`` axis, and so may the others."""

    mean: Float[Tensor, "*#sequence channel parameter"]
    loadings: Float[Tensor, "*#sequence channel parameter factor"]
    private: Float[Tensor, "*#sequence channel parameter parameter"]

    @classmethod
    def fixed(cls, parameters: Float[Tensor, "sequence channel parameter"]) -> Population:
        """Parameters that are known."""
        shape = parameters.shape
        alone = parameters.new_zeros(*shape, shape[-1])
        return cls(parameters, parameters.new_zeros(*shape, 0), alone)

    def condition(
        self,
        precision: Float[Tensor, "*#sequence #channel parameter parameter"],
        linear: Float[Tensor, "*#sequence channel parameter"],
    ) -> Population:
        """Posterior given likelihoods exp(−½ θᵀAθ + bᵀθ) of every channel."""
        solved = _solve(self, precision, linear)
        shared = _times(solved.keep @ self.loadings, solved.shared_mean[..., None, :])
        mean = self.mean + _times(solved.gain, solved.error) + shared
        root = torch.linalg.solve_triangular(solved.shared_root, solved.eye, upper=False).mT
        loadings = solved.keep @ self.loadings @ root.unsqueeze(-3)
        return Population(mean, loadings, solved.private)

    def log_evidence(
        self,
        precision: Float[Tensor, "*#sequence #channel parameter parameter"],
        linear: Float[Tensor, "*#sequence channel parameter"],
    ) -> Float[Tensor, "*sequence"]:
        """Log of the likelihood, integrated over θ, up to terms free of this population."""
        solved = _solve(self, precision, linear)
        at_mean = (self.mean * (linear + solved.error)).sum((-1, -2)) / 2
        private = (solved.error * _times(solved.gain, solved.error)).sum((-1, -2)) / 2
        shared = (solved.shared_linear * solved.shared_mean).sum(-1) / 2
        return at_mean + private + shared - solved.log_volume

    def log_evidences(
        self,
        scales: Float[Tensor, " scale"],
        precision: Float[Tensor, "#sequence #channel parameter parameter"],
        linear: Float[Tensor, "sequence channel parameter"],
    ) -> Float[Tensor, "scale sequence"]:
        """Those of the populations with s times the deviations, for every s."""
        if len(precision) > 1 or len(scales) == 1:
            s = scales[:, None, None, None, None]
            each = Population(self.mean, s * self.loadings, s * self.private)
            return each.log_evidence(precision, linear)
        return _evidence_of_scales(self, scales, precision[0], linear)

    def shared_posterior(
        self,
        precision: Float[Tensor, "*batch #channel parameter parameter"],
        linear: Float[Tensor, "*batch channel parameter"],
    ) -> tuple[Float[Tensor, "*batch factor"], Float[Tensor, "*batch factor factor"]]:
        """Mean of p(a | x) and a root Q of its precision, Q Qᵀ."""
        solved = _solve(self, precision, linear)
        return solved.shared_mean, solved.shared_root

    def private_posterior(
        self,
        precision: Float[Tensor, "*batch #channel parameter parameter"],
        linear: Float[Tensor, "*batch channel parameter"],
        shared: Float[Tensor, "*batch factor"],
    ) -> tuple[Tensor, Tensor]:
        """Mean of p(V⁻¹δ | a, x) and a root Q of its precision, Q Qᵀ."""
        v, eye = self.private, torch.eye(self.private.shape[-1], dtype=linear.dtype)
        θ = self.mean + _times(self.loadings, shared[..., None, :])
        root = torch.linalg.cholesky(eye + v.mT @ precision @ v)
        pull = _times(v.mT, linear - _times(precision, θ))
        return torch.cholesky_solve(pull[..., None], root)[..., 0], root

    def affine(
        self, scale: Float[Tensor, "*sequence channel parameter"], shift: Tensor
    ) -> Population:
        """The population of scale ⊙ θ + shift."""
        wide = scale[..., None]
        return Population(self.mean * scale + shift, self.loadings * wide, self.private * wide)

    def moments(
        self, design: Float[Tensor, "*channel time parameter"]
    ) -> tuple[Float[Tensor, "sequence time channel"], Float[Tensor, "*#sequence time channel"]]:
        """Mean and variance of design θ_c at every time."""
        root = torch.cat([self.loadings, self.private], dim=-1)
        if self.loadings.shape[-1]:
            root = torch.linalg.qr(root.mT, mode="r")[1].mT
        variance = torch.linalg.vector_norm(design @ root, dim=-1).square()
        return self.path(design).mT, variance.mT

    def path(
        self, design: Float[Tensor, "*channel time parameter"]
    ) -> Float[Tensor, "sequence channel time"]:
        """Mean of design θ_c at every time."""
        if design.ndim == 3 and len(design) > 1:
            return _times(design, self.mean)
        return self.mean @ design.view(design.shape[-2:]).mT

    def sample(self, count: int) -> Float[Tensor, "sample sequence channel parameter"]:
        """Joint draws of θ, from torch's default generator."""
        *_, parameters, rank = self.loadings.shape
        rows, channels = self.mean.shape[:-2], self.mean.shape[-2]
        a = torch.randn(count, *rows, 1, rank, dtype=self.mean.dtype, device=self.mean.device)
        white = torch.randn(
            count, *rows, channels, parameters, dtype=self.mean.dtype, device=self.mean.device
        )
        return self.mean + _times(self.loadings, a) + _times(self.private, white)


@dataclass(frozen=True)
class ParameterShrinkage:
    """What of its covariance over movements each channel has alone, and of that every parameter.

    The sample covariance of n movements has rank n − 1: under it alone a few frames would settle
    the rest of the movement. An entry counts as ``information`` of an independent one.
    """

    alone: Float[Tensor, " channel"] | float = 0.5
    independent: float = 0.5
    information: float = 1.0


def estimate(
    parameters: Float[Tensor, "sequence channel parameter"],
    uncertainty: Float[Tensor, "channel parameter parameter"],
    shrinkage: ParameterShrinkage,
    floor: Float[Tensor, " parameter"],
) -> Population:
    """Population of several movements, its covariance shrunk towards independent parameters.

    The sample covariance over movements keeps the share 1 − ``alone``. The rest goes to every
    channel alone, with a shape pooled over channels and each channel's own size; of that shape only
    the diagonal keeps the share ``independent``. ``uncertainty`` of the single estimates and the
    variance ``floor`` are added. A new movement is 1 + 1/count times as far from the mean.
    """
    count, channels, _ = parameters.shape
    mean = parameters.mean(0)
    private = uncertainty + torch.diag(floor)
    if count == 1:
        return Population(mean, mean.new_zeros(*mean.shape, 0), _root(private))
    inflation = (1 + 1 / count) / (count - 1)
    deviation = (parameters - mean) * inflation**0.5
    size = deviation.square().sum((0, 2)).clamp_min(torch.finfo(mean.dtype).tiny)
    scaled = deviation / size.sqrt()[:, None]
    shape = torch.einsum("scp,scq->pq", scaled, scaled) / channels
    shape = torch.lerp(shape, torch.diag(shape.diagonal()), shrinkage.independent)
    alone = torch.as_tensor(shrinkage.alone, dtype=mean.dtype).view(-1, 1, 1)
    private = private + alone * size[:, None, None] * shape
    loadings = (1 - alone).sqrt() * deviation.permute(1, 2, 0)
    return Population(mean, loadings, _root(private))


@dataclass(frozen=True)
class _Solved:
    """Quantities that posterior and evidence share."""

    error: Tensor
    gain: Tensor
    keep: Tensor
    private: Tensor
    shared_root: Tensor
    shared_linear: Tensor
    shared_mean: Tensor
    log_volume: Tensor
    eye: Tensor


def _solve(prior: Population, precision: Tensor, linear: Tensor) -> _Solved:
    v, loadings = prior.private, prior.loadings
    if precision.ndim == 4 and len(precision) == 1:
        precision = precision[0]
    eye = torch.eye(v.shape[-1], dtype=v.dtype, device=v.device)
    root = torch.linalg.cholesky(eye + v.mT @ precision @ v)
    private = torch.linalg.solve_triangular(root, v.mT, upper=False).mT
    gain = private @ private.mT
    keep = eye - gain @ precision
    error = linear - _times(precision, prior.mean)
    shared_eye = torch.eye(loadings.shape[-1], dtype=v.dtype, device=v.device)
    kept = keep @ loadings
    informed = (precision @ kept).flatten(-3, -2)
    shared = shared_eye + loadings.flatten(-3, -2).mT @ informed
    shared_root = torch.linalg.cholesky((shared + shared.mT) / 2)
    shared_linear = _across(kept.flatten(-3, -2).mT, error.flatten(-2))
    log_volume = root.diagonal(dim1=-2, dim2=-1).log().sum((-1, -2))
    return _Solved(
        error=error,
        gain=gain,
        keep=keep,
        private=private,
        shared_root=shared_root,
        shared_linear=shared_linear,
        shared_mean=_across(shared_root, shared_linear, torch.cholesky_solve),
        log_volume=log_volume + shared_root.diagonal(dim1=-2, dim2=-1).log().sum(-1),
        eye=shared_eye,
    )


def _evidence_of_scales(
    prior: Population, scales: Tensor, precision: Tensor, linear: Tensor
) -> Float[Tensor, "scale sequence"]:
    """Log evidences with VᵀAV = U D Uᵀ, so that s acts on D alone."""
    v, rank = prior.private, prior.loadings.shape[-1]
    eye = torch.eye(rank, dtype=v.dtype, device=v.device)
    values, turned = torch.linalg.eigh(v.mT @ precision @ v)
    d, basis = values.clamp_min(0).flatten(), v @ turned
    loadings = torch.linalg.solve(basis, prior.loadings).flatten(0, 1)
    error = linear - _times(precision, prior.mean)
    white = _times(basis.mT, error).flatten(-2)
    found = []
    for s in scales:
        wide = 1 + s.square() * d
        shared = eye + loadings.mT @ (loadings * (s.square() * d / wide)[:, None])
        root = torch.linalg.cholesky(shared)
        told = loadings.mT @ (s * white / wide).mT
        pull = torch.linalg.solve_triangular(root, told, upper=False)
        private = (s * white).square() @ (1 / wide)
        volume = wide.log().sum() / 2 + root.diagonal().log().sum()
        found.append((private + pull.square().sum(0)) / 2 - volume)
    at_mean = (prior.mean * (linear + error)).sum((-1, -2)) / 2
    return at_mean + torch.stack(found)


def _times(
    matrix: Float[Tensor, "*sequence #channel p q"], vector: Float[Tensor, "*batch #channel q"]
) -> Float[Tensor, "*rows channel p"]:
    if matrix.ndim == 3:
        return torch.einsum("cpq,...cq->...cp", matrix, vector)
    if matrix.shape[-4] > 1 or vector.ndim < 3:
        product: Tensor = matrix @ vector[..., None]
        return product[..., 0]
    columns: Tensor = matrix.squeeze(-4) @ vector.movedim(-3, -1)
    return columns.movedim(-1, -3)


def _across(
    matrix: Float[Tensor, "*#sequence p q"],
    vector: Float[Tensor, "*batch q"],
    solve: Callable[[Tensor, Tensor], Tensor] = lambda b, a: a @ b,
) -> Float[Tensor, "*rows p"]:
    """Matrix times vector; a matrix of all movements takes their vectors as columns."""
    if vector.ndim == 1 or (matrix.ndim > 2 and matrix.shape[-3] > 1):
        return solve(vector[..., None], matrix)[..., 0]
    shared = matrix.squeeze(-3) if matrix.ndim > 2 else matrix
    return solve(vector.mT, shared).mT


def _root(covariance: Float[Tensor, "*c p p"]) -> Float[Tensor, "*c p p"]:
    values, vectors = torch.linalg.eigh(covariance)
    root: Tensor = vectors * values.clamp_min(0).sqrt()[..., None, :]
    return root
