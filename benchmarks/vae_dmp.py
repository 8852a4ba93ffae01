"""A training step of VAE-DMP against the bound by hand, with a site a step, and in NumPyro.

``python -m benchmarks.vae_dmp`` writes ``results/benchmark_vae_dmp.json``.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from pyro.infer import Trace_ELBO
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence

from benchmarks.harness import interleave, ratio, report, store
from zoo.datasets.records import Sequences
from zoo.guides.filtering import Config as GuideConfig
from zoo.guides.filtering import FilteringGuide
from zoo.inference.elbo import bound, tight_bound
from zoo.inference.loader import Loader
from zoo.models.filters.vae_dmp import Config, VaeDmp
from zoo.types import Batch

__all__ = ["main"]

CHANNELS, FRAMES, MOVEMENTS = 50, 70, 16
SHAPES = {"64x10": (64, 10), "8x70": (8, None)}
BARS = {"64x10": {"plain": 1.1, "per-step": 2.0}, "8x70": {"plain": 0.75, "per-step": 6.0}}


class Plain(nn.Module):
    """The bound as one would write it by hand: a loop over time, autograd, everything a window."""

    def __init__(self, model: VaeDmp, guide: FilteringGuide) -> None:
        """The same networks and constants."""
        super().__init__()
        self.model, self.guide = model, guide

    def forward(self, batch: Batch) -> Tensor:
        """Negative bound of the minibatch, KL in closed form."""
        model, guide, system = self.model, self.guide, self.model.system
        x, latent = batch.values, model.latent_dim
        movements = batch.movements[batch.sequence]
        w = guide.g_2(guide.g_1(movements).flatten(1)).view(len(x), -1, latent)
        goal_mean, goal_std = guide.encoder(guide.trunk(movements[:, -1]))
        goal = model.embed(goal_mean + goal_std * torch.randn_like(goal_mean))
        h = guide.trunk(x)
        mean, std = guide.encoder(h)
        z = mean + std * torch.randn_like(mean)
        v_mean, v_std = guide.velocity(h[:, :2].flatten(1))
        velocity = model.config.velocity_scale * (v_mean + v_std * torch.randn_like(v_mean))
        position = model.embed(z[:, 0])
        features = guide.noise.features(x[:, 1:])
        f = model.config.w_scale * (model.basis[_steps(batch)] @ w)
        path, kl_noise = [position], x.new_zeros(())
        for t in range(x.shape[1] - 1):
            μ, σ = guide.noise(features[:, t], position)
            ε = μ + σ * torch.randn_like(μ)
            kl_noise = kl_noise + _kl(μ, σ)
            force = system.stiffness * (goal - position + f[:, t] + ε @ model.w_noise)
            velocity = velocity + (force - system.alpha * velocity) * system.dt
            position = position + velocity * system.dt
            path.append(position)
        spread = model.output_std
        rolled = model.decoder(torch.stack(path, 1))
        single = model.decoder(model.embed(z))
        log_p = _log_normal(x, rolled, spread) + _log_normal(x, single, spread)
        windows = log_p - kl_noise - _kl(mean, std) - _kl(v_mean, v_std)
        movement = _kl(goal_mean, goal_std) + _half_square(w)
        a = batch.total / len(x)
        return -(a * windows - batch.total_sequences / len(x) * movement)


def per_step(model: VaeDmp, guide: FilteringGuide) -> tuple[Callable[[Batch], None], ...]:
    """The same model and guide as Pyro programs with a site a time step."""
    system, latent = model.system, model.latent_dim

    def forces(w: Tensor, goal: Tensor, batch: Batch, t: int) -> Tensor:
        f = model.config.w_scale * (model.basis[batch.start + t, None] @ w)[:, 0]
        return system.stiffness * (goal + f)

    def step(s: tuple[Tensor, Tensor], force: Tensor, ε: Tensor) -> tuple[Tensor, Tensor]:
        position, velocity = s
        total = force + system.stiffness * (ε @ model.w_noise - position)
        velocity = velocity + (total - system.alpha * velocity) * system.dt
        return position + velocity * system.dt, velocity

    def unit(*shape: int) -> Any:
        return dist.Normal(torch.zeros(shape), 1.0).to_event(len(shape) - 1)

    def generative(batch: Batch) -> None:
        rows = len(batch)
        with pyro.plate("windows", batch.total, subsample=torch.arange(rows)):
            share = batch.total_sequences / batch.total
            with pyro.poutine.scale(scale=share):
                w = pyro.sample("w", unit(rows, model.kernels, latent))
                goal = model.embed(pyro.sample("goal", unit(rows, latent)))
            velocity = pyro.sample("velocity", unit(rows, latent)) * model.config.velocity_scale
            spread = model.output_std
            s: tuple[Tensor, Tensor] | None = None
            for t in range(batch.values.shape[1]):
                z = model.embed(pyro.sample(f"z_{t}", unit(rows, latent)))
                if s is None:
                    s = z, velocity
                else:
                    ε = pyro.sample(f"epsilon_{t}", unit(rows, latent))
                    s = step(s, forces(w, goal, batch, t - 1), ε)
                for name, state in (("x", s[0]), ("single", z)):
                    x = dist.Normal(model.decoder(state), spread).to_event(1)
                    pyro.sample(f"{name}_{t}", x, obs=batch.values[:, t])

    def posterior(batch: Batch) -> None:
        movements, x = batch.movements[batch.sequence], batch.values
        with pyro.plate("windows", batch.total, subsample=torch.arange(len(batch))):
            with pyro.poutine.scale(scale=batch.total_sequences / batch.total):
                w = guide.g_2(guide.g_1(movements).flatten(1)).view(len(x), -1, latent)
                pyro.sample("w", dist.Delta(w).to_event(2))
                last = guide.encoder(guide.trunk(movements[:, -1]))
                goal = model.embed(pyro.sample("goal", dist.Normal(*last).to_event(1)))
            h = guide.trunk(x[:, :2])
            first = dist.Normal(*guide.velocity(h.flatten(1))).to_event(1)
            velocity = pyro.sample("velocity", first) * model.config.velocity_scale
            s: tuple[Tensor, Tensor] | None = None
            for t in range(x.shape[1]):
                q = dist.Normal(*guide.encoder(guide.trunk(x[:, t]))).to_event(1)
                z = pyro.sample(f"z_{t}", q)
                if s is None:
                    s = model.embed(z), velocity
                    continue
                net = guide.noise
                noise = dist.Normal(*net(net.features(x[:, t]), s[0])).to_event(1)
                ε = pyro.sample(f"epsilon_{t}", noise)
                s = step(s, forces(w, goal, batch, t - 1), ε)

    return generative, posterior


def numpyro_step(model: VaeDmp, batch: Batch, hidden: int) -> Callable[[], object]:
    """A jitted NumPyro SVI step of the same networks and shapes: scan over time, TraceMeanField."""
    import jax
    import jax.numpy as jnp
    import numpyro
    from numpyro import distributions as nd
    from numpyro.infer import SVI
    from numpyro.infer import Trace_ELBO as NumpyroElbo

    system, latent, settings = model.system, model.latent_dim, model.config
    x = jnp.asarray(batch.values.numpy())
    movements = jnp.asarray(batch.movements.numpy())
    sequence = jnp.asarray(batch.sequence.numpy())
    windows, time_steps, channels = x.shape
    rows, a = len(movements), batch.total / windows
    basis = jnp.asarray(model.basis[_steps(batch)].numpy())
    generator = torch.Generator().manual_seed(0)

    def linear(name: str, inputs: int, outputs: int, scale: float = 1.0) -> Callable[[Any], Any]:
        weight = scale * torch.randn(inputs, outputs, generator=generator) / math.sqrt(inputs)
        w = numpyro.param(f"{name}.w", jnp.asarray(weight.numpy()))
        b = numpyro.param(f"{name}.b", jnp.zeros(outputs))
        return lambda v: v @ w + b

    def embed(g_in: Any, g_out: Any, z: Any) -> Any:
        return z + g_out(jnp.tanh(g_in(z)))

    def networks() -> tuple[Any, ...]:
        return (
            linear("g_in", latent, settings.transition_hidden),
            linear("g_out", settings.transition_hidden, latent, 0.1),
            numpyro.param("w_noise", settings.noise_scale * jnp.eye(latent)),
        )

    def roll(z: Any, velocity: Any, pull: Any, ε: Any, w_noise: Any) -> Any:
        def step(s: Any, u: Any) -> Any:
            position, speed = s
            total = system.stiffness * (u[0] + u[1] @ w_noise - position)
            speed = speed + (total - system.alpha * speed) * system.dt
            position = position + speed * system.dt
            return (position, speed), position

        _, path = jax.lax.scan(step, (z, velocity), (pull, ε))
        return jnp.concatenate([z[None], path])

    def pulls(w: Any, goal: Any) -> Any:
        f = settings.w_scale * jnp.einsum("btk,bkl->tbl", basis, w[sequence])
        return goal[sequence] + f

    def generative() -> None:
        g_in, g_out, w_noise = networks()
        inner, outer = linear("d_in", latent, hidden), linear("d_out", hidden, channels)
        spread = numpyro.param("spread", jnp.full(channels, 0.55)) ** 2 + 1e-3
        w = numpyro.sample("w", nd.Normal(0, 1).expand([rows, model.kernels, latent]).to_event(3))
        goal = numpyro.sample("goal", nd.Normal(0, 1).expand([rows, latent]).to_event(2))
        with numpyro.handlers.scale(scale=a):
            shape = [time_steps, windows, latent]
            z = numpyro.sample("z", nd.Normal(0, 1).expand(shape).to_event(3))
            velocity = numpyro.sample("velocity", nd.Normal(0, 1).expand(shape[1:]).to_event(2))
            shape[0] -= 1
            ε = numpyro.sample("epsilon", nd.Normal(0, 1).expand(shape).to_event(3))
            moved = embed(g_in, g_out, z)
            pull = pulls(w, embed(g_in, g_out, goal))
            path = roll(moved[0], settings.velocity_scale * velocity, pull, ε, w_noise)
            target = jnp.swapaxes(x, 0, 1)
            for name, states in (("x", path), ("single", moved)):
                mean = outer(jax.nn.relu(inner(states)))
                numpyro.sample(name, nd.Normal(mean, spread).to_event(3), obs=target)

    def posterior() -> None:
        g_in, g_out, w_noise = networks()
        first = linear("g_1", channels, 10)
        second = linear("g_2", movements.shape[1] * 10, model.kernels * latent)
        inner, mean = linear("e_in", channels, hidden), linear("e_mean", hidden, latent)
        root = linear("e_root", hidden, latent)
        v_mean, v_root = linear("v_mean", 2 * hidden, latent), linear("v_root", 2 * hidden, latent)
        features, lift = linear("n_x", channels, hidden), linear("n_z", latent, hidden)
        n_mean, n_root = linear("n_mean", hidden, latent), linear("n_root", hidden, latent)

        def q(h: Any, μ: Any, r: Any) -> Any:
            return nd.Normal(μ(h), (r(h) + 0.55) ** 2 + 1e-3)

        w = second(jax.nn.softmax(first(movements)).reshape(rows, -1))
        w = numpyro.sample("w", nd.Delta(w.reshape(rows, -1, latent), event_dim=3))
        last = jax.nn.relu(inner(movements[:, -1]))
        goal = numpyro.sample("goal", q(last, mean, root).to_event(2))
        h = jax.nn.relu(inner(jnp.swapaxes(x, 0, 1)))
        with numpyro.handlers.scale(scale=a):
            z = numpyro.sample("z", q(h, mean, root).to_event(3))
            two = jnp.concatenate([h[0], h[1]], axis=1)
            velocity = numpyro.sample("velocity", q(two, v_mean, v_root).to_event(2))
            pull = pulls(w, embed(g_in, g_out, goal))
            noise = jax.random.normal(numpyro.prng_key(), (time_steps - 1, windows, latent))
            seen = features(jnp.swapaxes(x, 0, 1)[1:])

            def step(s: Any, u: Any) -> Any:
                hidden_t = jax.nn.relu(u[0] + lift(s[0]))
                μ, σ = n_mean(hidden_t), (n_root(hidden_t) + 0.55) ** 2 + 1e-3
                ε = μ + σ * u[2]
                total = system.stiffness * (u[1] + ε @ w_noise - s[0])
                speed = s[1] + (total - system.alpha * s[1]) * system.dt
                return (s[0] + speed * system.dt, speed), (ε, μ, σ)

            begin = embed(g_in, g_out, z[0]), settings.velocity_scale * velocity
            _, (ε, μ, σ) = jax.lax.scan(step, begin, (seen, pull, noise))
            log_q = nd.Normal(μ, σ).log_prob(ε).sum()
            numpyro.sample("epsilon", nd.Delta(ε, log_density=log_q, event_dim=3))

    svi = SVI(generative, posterior, numpyro.optim.Adam(1e-3), NumpyroElbo())
    state = svi.init(jax.random.PRNGKey(0))
    update = jax.jit(svi.update)
    kept = [state]

    def call() -> object:
        kept[0], loss = update(kept[0])
        return jax.block_until_ready(loss)

    return call


def main(rounds: int = 30) -> None:
    """Time every program at both shapes, print the tables and store the result."""
    torch.set_num_threads(1)
    started, payload = time.monotonic(), {}
    pyro.enable_validation(False)
    for name, (windows, length) in SHAPES.items():
        torch.manual_seed(0)
        batch = _batch(windows, length)
        begin = time.monotonic()
        programs = _programs(batch)
        for call in programs.values():
            call()
        compiled = time.monotonic() - begin
        timings = interleave(programs, rounds=rounds)
        report(f"{name}: {windows} windows of {batch.values.shape[1]} frames", timings)
        ratios = {
            "zoo / plain": ratio(timings, "zoo", "plain"),
            "zoo / plain, fused Adam": ratio(timings, "zoo", "plain, fused Adam"),
            "per-step Pyro / zoo": ratio(timings, "per-step Pyro", "zoo"),
            "zoo / NumPyro jitted": ratio(timings, "zoo", "NumPyro jitted"),
        }
        print("".join(f"{k}: {v:.2f}\n" for k, v in ratios.items()))
        payload[name] = {
            "timings": timings,
            "ratios": ratios,
            "bars": BARS[name],
            "first_calls_seconds": round(compiled, 1),
        }
    card = {
        "model": "vae-dmp",
        "what": "time of a training step against hand-written PyTorch, d = 50",
        "value": ", ".join(f"{n}: {p['ratios']['zoo / plain']:.2f}×" for n, p in payload.items()),
        "source": "simulated",
        "command": "python -m benchmarks.vae_dmp",
    }
    store(
        "benchmark_vae_dmp",
        {"shapes": payload, "cards": [card]},
        label="simulated",
        libraries=("numpyro", "jax"),
        seed=0,
        started=started,
    )


def _batch(windows: int, length: int | None) -> Batch:
    values = torch.randn(MOVEMENTS, FRAMES, CHANNELS).cumsum(1) / FRAMES**0.5
    data = Sequences.from_arrays(values.double().numpy(), rate=30.0).to(dtype=torch.float32)
    return next(Loader(data, batch_size=windows, window=length, seed=0).epoch(0))


def _programs(batch: Batch) -> dict[str, Callable[[], object]]:
    channels = batch.values.shape[2]
    layout = Sequences.from_arrays(torch.zeros(1, FRAMES, channels).numpy(), rate=30.0).layout

    def pair() -> tuple[VaeDmp, FilteringGuide]:
        torch.manual_seed(0)
        model = VaeDmp(layout, Config())
        return model, FilteringGuide(layout, model, GuideConfig())

    zoo, sampled = pair(), pair()
    plain, fused = Plain(*pair()), Plain(*pair())
    naive = pair()
    naive_elbo, naive_programs = Trace_ELBO(), per_step(*naive)
    return {
        "zoo": _step(lambda: tight_bound(*zoo, batch).loss, zoo, fused=True),
        "zoo, sampled KL": _step(lambda: bound(*sampled, batch).loss, sampled, fused=True),
        "plain": _step(lambda: plain(batch), (plain,), fused=False),
        "plain, fused Adam": _step(lambda: fused(batch), (fused,), fused=True),
        "per-step Pyro": _step(
            lambda: naive_elbo.differentiable_loss(*naive_programs, batch), naive, fused=False
        ),
        "NumPyro jitted": numpyro_step(zoo[0], batch, zoo[0].config.hidden),
    }


def _steps(batch: Batch) -> Tensor:
    return batch.start[:, None] + torch.arange(batch.values.shape[1] - 1)


def _step(
    loss: Callable[[], Tensor], modules: tuple[nn.Module, ...], *, fused: bool
) -> Callable[[], object]:
    parameters = [p for m in modules for p in m.parameters()]
    optimiser = torch.optim.Adam(parameters, lr=1e-3, fused=fused or None)

    def call() -> None:
        optimiser.zero_grad()
        torch.autograd.backward(loss())
        optimiser.step()

    return call


def _kl(mean: Tensor, std: Tensor) -> Tensor:
    return kl_divergence(Normal(mean, std), Normal(0.0, 1.0)).sum()


def _half_square(w: Tensor) -> Tensor:
    return 0.5 * w.square().sum() + 0.5 * math.log(2 * math.pi) * w.numel()


def _log_normal(x: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    return Normal(mean, std).log_prob(x).sum()


if __name__ == "__main__":
    main()
