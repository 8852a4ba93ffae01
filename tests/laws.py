"""The laws of the house as functions of a trained run: each fails where the run breaks it.

The contract asks them of every entry; ``tests/house/test_laws.py`` asks them of models that are
broken on purpose.
"""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import numpy as np
import pyro.poutine as poutine
import pytest
import torch
from pyro.distributions import Unit
from scipy import stats
from support import data_of, movements
from torch import Tensor

from zoo.contract.strategies import MarginalLikelihood
from zoo.datasets.records import Pairs, Sequences
from zoo.evaluation.questions import Setup, hide_joints, hide_section
from zoo.evaluation.tasks import outcomes
from zoo.inference.elbo import bound
from zoo.inference.loader import Loader, stream, whole
from zoo.inference.posterior import GuidePosterior
from zoo.prediction.prediction import Prediction
from zoo.prediction.predictive import Predictive
from zoo.runs.run import Run
from zoo.streams import seeded
from zoo.types import Batch

__all__ = [
    "batch_of",
    "check_blind",
    "check_exact",
    "check_program",
    "check_sites",
    "check_uniform",
    "check_weights",
    "drawn",
    "imputed",
    "judged",
]

MOVEMENTS, TABLES = 300, 150
SEEN, HORIZON = 10, 8
# two tests a task, some eighty in all: one false alarm in ten thousand changes of the numbers
LEVEL = 1e-6


def batch_of(run: Run, data: Any = None, *, rows: int | None = None) -> Batch:
    """Data as the model of a run sees them; the small data unless others are given."""
    scaled = run.exchange.scaled(data_of(run.assembly.entry) if data is None else data)
    return whole(scaled if rows is None else scaled[list(range(rows))])


def check_program(run: Run) -> None:
    """The program has a finite density of the data, and draws finite data where it is asked to."""
    batch = batch_of(run)
    with seeded(0), torch.no_grad():
        given = poutine.trace(run.model).get_trace(batch)
        free = poutine.trace(run.model).get_trace(batch.unobserved())
    data = [n for n in given.observation_nodes if _is_data(given.nodes[n])]
    assert data, "the program observes nothing"
    assert bool(torch.as_tensor(given.log_prob_sum()).isfinite())
    for name in data:
        value = free.nodes[name]["value"]
        assert not free.nodes[name]["is_observed"], f"{name} is observed although it is asked for"
        assert bool(value.isfinite().all()), name
        assert not torch.equal(value, given.nodes[name]["value"]), f"{name} is not drawn"


def _is_data(site: dict[str, Any]) -> bool:
    """Whether a site is neither a ``pyro.factor`` nor a ``pyro.deterministic``."""
    return not isinstance(site["fn"], Unit) and not site["infer"].get("_deterministic", False)


def check_exact(run: Run, draws: int = 4) -> float:
    """log p(x, z) − log q(z) is one number, at every draw; returns it."""
    model, guide = run.model, run.assembly.guide
    assert guide is not None, f"{run.name} has no guide"
    batch = batch_of(run)
    with seeded(1), torch.no_grad():
        found = [bound(model, guide, batch) for _ in range(draws)]
    evidence = np.array([float(b.elbo) for b in found])
    assert np.isfinite(evidence).all()
    size = max(sum(abs(float(v)) for v in b.terms.values()) for b in found)
    tolerance = torch.finfo(run.assembly.dtype).eps ** 0.5 * size
    assert np.ptp(evidence) <= tolerance, f"the bound moves by {np.ptp(evidence):.3g}: {evidence}"
    return float(evidence[0])


def check_sites(run: Run) -> None:
    """What the guide draws is what the program does not observe."""
    guide, model = run.assembly.guide, run.model
    batch = batch_of(run)
    with seeded(0), torch.no_grad():
        mine = poutine.trace(guide).get_trace(batch)
        free = poutine.trace(model).get_trace(batch.unobserved())
        given = poutine.trace(poutine.replay(model, trace=mine)).get_trace(batch)
    latent = {n for n in given.stochastic_nodes if _is_data(given.nodes[n])}
    assert latent == set(mine.stochastic_nodes)
    assert latent <= set(free.stochastic_nodes)


def drawn(run: Run, count: int, seed: int) -> Sequences:
    """Movements from the run's own program under its parameters, in the data's units."""
    like = movements()[[0] * count]
    with seeded(stream(seed, "movements")), torch.no_grad():
        trace = poutine.trace(run.model).get_trace(batch_of(run, like).unobserved())
    scaler = run.scaler
    values = trace.nodes["x"]["value"].double() * scaler.channel_scale + scaler.channel_shift
    assert values.shape == like.values.shape, f"the program draws {tuple(values.shape)}"
    groups = {"trial": tuple(map(str, range(count)))}
    return replace(like, values=values, groups=groups)


def judged(run: Run, task: str, seed: int = 0) -> Tensor:
    """Independent PIT values of a task's answers about what the run's own program drew."""
    ask = {
        "forecast": _forecast,
        "impute joints": _impute_joints,
        "impute section": _impute_section,
        "regress": _regressed,
    }
    return ask[task](run, seed)


def check_uniform(pit: Tensor) -> None:
    """PIT values are uniform, and so is how far they are from the middle."""
    u = pit.double().numpy()
    assert np.isfinite(u).all()
    for what, values in (("PIT values", u), ("distances from the middle", np.abs(2 * u - 1))):
        found = stats.kstest(values, "uniform")
        assert found.pvalue > LEVEL, (
            f"{what} are not uniform: KS {found.statistic:.3f}, p {found.pvalue:.1e}; "
            f"mean {values.mean():.2f}, deciles {np.histogram(values, 10, (0, 1))[0]}"
        )


def _forecast(run: Run, seed: int) -> Tensor:
    data = drawn(run, MOVEMENTS, seed)
    prediction = run.forecast(data.first(SEEN), horizon=HORIZON, draws=64)
    future = data.frames(SEEN, SEEN + HORIZON)
    return _one_of_each(prediction, future.values, future.mask, seed)


def _impute_joints(run: Run, seed: int) -> Tensor:
    return _imputed(run, hide_joints, seed)


def _impute_section(run: Run, seed: int) -> Tensor:
    return _imputed(run, hide_section, seed)


def _imputed(run: Run, hide: Any, seed: int) -> Tensor:
    data = drawn(run, MOVEMENTS, seed)
    holed = hide(data, 0.3)
    prediction = run.impute(holed, draws=64)
    return _one_of_each(prediction, data.values, ~holed.mask, seed)


def _one_of_each(prediction: Prediction, truth: Tensor, asked: Tensor, seed: int) -> Tensor:
    """The PIT of one coordinate that was asked for, of every movement: those are independent."""
    generator = torch.Generator().manual_seed(stream(seed, "pick"))
    pick = torch.multinomial(asked.flatten(1).double(), 1, generator=generator)
    return prediction.cdf(truth).flatten(1).gather(1, pick)[:, 0]


def _regressed(run: Run, seed: int) -> Tensor:
    """One new item a target of many tables of training and new items, drawn together."""
    known: Pairs = run.exchange.scaled(data_of(run.assembly.entry))
    generator = torch.Generator().manual_seed(stream(seed, "inputs"))
    found = []
    for table in range(TABLES):
        inputs = torch.randn(1, known.inputs.shape[1], generator=generator).to(known.inputs)
        both = _pairs(known, torch.cat([known.inputs, inputs]))
        with seeded(stream(seed, table)), torch.no_grad():
            trace = poutine.trace(run.model).get_trace(whole(both).unobserved())
        targets = _targets(trace, len(both))
        answer = _conditioned(run, replace(known, targets=targets[:-1])).regress(inputs, draws=0)
        score = (targets[-1] - answer.location[0, 0]) / _std(answer)[0, 0]
        found.append(torch.special.ndtr(score))
    return torch.cat(found)


def _pairs(like: Pairs, inputs: Tensor) -> Pairs:
    targets = inputs.new_zeros(len(inputs), len(like.channels))
    groups = {"item": tuple(map(str, range(len(inputs))))}
    mask = torch.ones_like(targets, dtype=torch.bool)
    return replace(like, inputs=inputs, targets=targets, mask=mask, groups=groups)


def _targets(trace: Any, items: int) -> Tensor:
    y: Tensor = trace.nodes["y"]["value"]
    return y if len(y) == items else y.mT


def _std(answer: Predictive) -> Tensor:
    spread = answer.spread
    assert spread is not None
    return spread.expand_as(answer.location)


def _conditioned(run: Run, data: Pairs) -> Any:
    """The model under the run's parameters, given other targets of the same items."""
    if not isinstance(run.assembly.inference, MarginalLikelihood):
        return run.model
    model: Any = copy.deepcopy(run.model)
    kept = {name: p.detach().clone() for name, p in model.named_parameters()}
    with seeded(run.assembly.seed):
        model.condition(data)
        with torch.no_grad():
            for name, parameter in model.named_parameters():
                parameter.copy_(kept[name])
        model.settle()
    return model


def imputed(run: Run, batch: Batch) -> Predictive:
    """What the model itself, without the run about it, fills in."""
    guide = run.assembly.guide
    posterior = None if guide is None else GuidePosterior(guide)
    model: Any = run.model
    with seeded(2), torch.no_grad():
        answer: Predictive = model.impute(batch, posterior, draws=8)
    return answer


def check_weights(run: Run) -> None:
    """A minibatch stands for the whole training set: its sites are scaled by what it leaves out."""
    strategy: Any = run.assembly.inference
    scaled = run.exchange.scaled(data_of(run.assembly.entry))
    loader = Loader(scaled, batch_size=4, window=strategy.window, stride=strategy.stride)
    last = loader.total - 1
    batch = loader.take(torch.tensor([0, 1, last // 2, last]))
    rows = len(batch.movements)
    scales = {len(batch): batch.total / len(batch), rows: batch.total_sequences / rows}
    for program in (run.model, run.assembly.guide):
        with seeded(0), torch.no_grad():
            trace = poutine.trace(program).get_trace(batch)
        sites = {n: trace.nodes[n] for n in (*trace.stochastic_nodes, *trace.observation_nodes)}
        for name, site in sites.items():
            plates = [f for f in site["cond_indep_stack"] if f.vectorized]
            if plates:
                assert site["scale"] == pytest.approx(scales[plates[0].size]), name


def check_blind(run: Run, task: str) -> None:
    """A question asks for what it hides, and noise in its place leaves the answer's bits."""
    data = data_of(run.assembly.entry)
    hidden, noisy = _noisy(data, task)
    setup = Setup(seen=SEEN, horizon=HORIZON, draws=8)
    (asked,), (blind,) = (outcomes(run, d, [task], setup) for d in (data, noisy))
    values = data.targets if isinstance(data, Pairs) else data.values
    if task == "forecast":
        hidden, values = (v[:, SEEN : SEEN + HORIZON] for v in (hidden, values))
    assert torch.equal(asked.mask, hidden), "what is judged is not what is hidden"
    assert torch.equal(asked.truth[hidden], values[hidden])
    assert torch.equal(asked.prediction.mean, blind.prediction.mean)
    if asked.prediction.has_spread:
        assert torch.equal(asked.prediction.std, blind.prediction.std)


def _noisy(data: Any, task: str) -> tuple[Tensor, Any]:
    """Which entries a question hides, and the data with noise there."""
    generator = torch.Generator().manual_seed(3)
    if isinstance(data, Pairs):
        noise = torch.randn(data.targets.shape, generator=generator, dtype=torch.float64)
        return data.mask, replace(data, targets=noise)
    hide = {"impute joints": hide_joints, "impute section": hide_section, "forecast": _later}
    hidden = data.mask & ~hide[task](data, Setup().hidden).mask
    noise = torch.randn(data.values.shape, generator=generator, dtype=torch.float64)
    return hidden, replace(data, values=torch.where(hidden, noise, data.values))


def _later(data: Sequences, share: float) -> Sequences:
    later = torch.arange(data.values.shape[1]) >= SEEN
    return replace(data, mask=data.mask & ~later[:, None])
