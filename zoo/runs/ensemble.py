"""Several trained models as one: an equal mixture of their predictions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NoReturn, Self

from pydantic import TypeAdapter

from zoo import archive
from zoo.arguments import list_of
from zoo.datasets.records import Pairs, Sequences
from zoo.display import facts
from zoo.errors import DamagedRunError, NotCapableError
from zoo.evaluation.calibration.calibration import Calibration
from zoo.prediction.prediction import Prediction
from zoo.prediction.predictive import pooled
from zoo.runs.answering import Answers, Query
from zoo.runs.assembly import Assembly
from zoo.runs.fitting import fit
from zoo.runs.run import Run, load
from zoo.runs.rundir import Resume

__all__ = ["Ensemble", "fit_ensemble"]

FORMAT_VERSION = 2
_OWN = "every member has latent coordinates of its own; ask one of its members"


@dataclass(frozen=True, kw_only=True)
class _Index:
    members: int
    calibration: list[dict[str, Any]]
    calibrated_on: list[str]


@dataclass(kw_only=True)
class Ensemble(Answers):
    r"""Runs of one layout whose predictions are averaged as distributions.

    p(y | x) = 1/M Σ_m p_m(y | x)

    Lakshminarayanan, Pritzel & Blundell, *Simple and scalable predictive uncertainty estimation
    using deep ensembles*, NIPS 2017. Members that are deterministic, such as ae-dmp, get bands
    here: that of the members, and with few of them a coarse one, so that it wants calibration. The
    members may be of different entries. Latent coordinates of different members mean different
    things: an ensemble does not represent. The members' own calibrations are not used; the
    ensemble keeps its own.

    >>> import numpy as np, zoo
    >>> data = zoo.Sequences.from_arrays(np.random.default_rng(0).normal(size=(4, 20, 3)), rate=30.)
    >>> runs = [zoo.fit(zoo.create(name, data), data) for name in ("mean", "last-value")]
    >>> zoo.Ensemble(members=tuple(runs)).forecast(data.frames(0, 12), horizon=8).shape
    (4, 8, 3)
    """

    members: tuple[Run, ...]
    calibration: Calibration = field(default_factory=Calibration)
    calibrated_on: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Refuse an empty ensemble, and members of different channels, units or rates."""
        members = list_of(self.members, "members")
        if not members:
            raise ValueError("an ensemble needs at least 1 member; got none")
        if alien := [m for m in members if not isinstance(m, Run)]:
            raise TypeError(f"members must be runs; got {type(alien[0]).__name__}")
        first = self.members[0].assembly.layout
        for run in self.members[1:]:
            first.check(run.assembly.layout)

    def _repr_html_(self) -> str:
        rows: dict[str, object] = {
            "members": [run.name for run in self.members],
            "trained on": self.trained_on["name"],
            "can": self.capabilities,
            "calibrated for": self.calibration.tasks,
        }
        return facts(self.name.capitalize(), rows)

    @property
    def name(self) -> str:
        """The members' entries, each once."""
        return "ensemble of " + " + ".join(dict.fromkeys(run.name for run in self.members))

    @property
    def capabilities(self) -> tuple[str, ...]:
        """What every member can do, but for latent trajectories."""
        common = set.intersection(*(set(run.capabilities) for run in self.members))
        return tuple(c for c in self.members[0].capabilities if c in common and c != "represent")

    @property
    def trained_on(self) -> dict[str, Any]:
        """Names and fingerprints of all the data that a member was trained on."""
        names = dict.fromkeys(run.trained_on["name"] for run in self.members)
        return {"name": ", ".join(names), "fingerprints": self.fingerprints}

    @property
    def fingerprints(self) -> list[str]:
        """Those of the movements or items that a member was trained on."""
        return sorted({f for run in self.members for f in run.fingerprints})

    def uncorrected(self, query: Query) -> Prediction:
        """The members' answers as an equal mixture, each with a seed of its own."""
        found = [
            run.uncorrected(replace(query, seed=query.seed + i))
            for i, run in enumerate(self.members)
        ]
        return replace(found[0], predictive=pooled([p.predictive for p in found]))

    def _bare(self) -> Ensemble:
        return replace(self, calibration=Calibration(), calibrated_on=[])

    def _keep(self, calibration: Calibration) -> None:
        self.calibration = calibration

    def encode(self, data: Sequences) -> NoReturn:
        """Refused: members have latent coordinates of their own; ask one of :attr:`members`."""
        raise NotCapableError(f"{self.name} cannot encode: {_OWN}")

    def decode(self, latent: object) -> NoReturn:
        """Refused as :meth:`encode` is."""
        raise NotCapableError(f"{self.name} cannot decode: {_OWN}")

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write the members and the ensemble's calibration as folders of safetensors and JSON.

        Members of another training are replaced only with ``overwrite``, as :meth:`zoo.Run.save`.
        """
        folder = Path(folder)
        for i, run in enumerate(self.members):
            run.save(folder / f"member-{i}", overwrite=overwrite)
        states, tensors = self.calibration.state()
        meta = {
            "members": len(self.members),
            "calibration": states,
            "calibrated_on": self.calibrated_on,
        }
        archive.write(folder, "ensemble", meta, tensors, version=FORMAT_VERSION)
        return folder

    @classmethod
    def load(cls, folder: str | Path) -> Self:
        """An ensemble that :meth:`save` wrote; a damaged or foreign folder is refused."""
        folder = Path(folder)
        meta, tensors = archive.read(folder, "ensemble", version=FORMAT_VERSION)
        try:
            index = TypeAdapter(_Index).validate_python(meta)
            found = Calibration.from_state(index.calibration, tensors)
        except (LookupError, RuntimeError, TypeError, ValueError) as error:
            raise DamagedRunError(
                f"{folder}/ensemble.json does not describe an ensemble: {error}"
            ) from error
        members = tuple(load(folder / f"member-{i}") for i in range(index.members))
        return cls(members=members, calibration=found, calibrated_on=index.calibrated_on)


def fit_ensemble(
    assemblies: Sequence[Assembly],
    train: Pairs | Sequences,
    *,
    val: Pairs | Sequences | None = None,
    run_dir: str | Path | None = None,
    resume: Resume = "never",
    overwrite: bool = False,
    progress: bool = False,
) -> Ensemble:
    """Train every member on ``train``, each in a folder of its own below ``run_dir``.

    ``resume`` and ``overwrite`` are those of :func:`zoo.fit`, for every member.

    >>> import numpy as np, zoo
    >>> data = zoo.Sequences.from_arrays(np.random.default_rng(0).normal(size=(4, 20, 3)), rate=30.)
    >>> members = [zoo.create("vae", data, seed=s, latent_dim=1, epochs=2) for s in range(2)]
    >>> zoo.fit_ensemble(members, data).name
    'ensemble of vae'
    """
    if run_dir is not None and overwrite:
        archive.clear(Path(run_dir), "ensemble")
    return Ensemble(
        members=tuple(
            fit(
                assembly,
                train,
                val=val,
                run_dir=None if run_dir is None else Path(run_dir) / f"member-{i}",
                resume=resume,
                overwrite=overwrite,
                progress=progress,
            )
            for i, assembly in enumerate(list_of(assemblies, "assemblies"))
        )
    )
