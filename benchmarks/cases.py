"""The data and the trained NPE that all methods of a table share."""

import copy
import hashlib
import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from sbi.inference.posteriors import DirectPosterior
from torch import Tensor

from benchmarks.cells import Cell
from benchmarks.presets import PRESETS, Settings
from sbi_rope.baselines import PlainNPE
from sbi_rope.tasks import Task, get_task
from sbi_rope.utils.files import write_atomically

__all__ = ["Case", "Sources", "posterior_with", "state_of"]

Pairs = tuple[Tensor, Tensor]

# Stored simulated people whom nothing is trained on, for the line "SBI".
HELD_OUT = 0.1
# Banks up to this size are kept between runs, in bytes.
MAX_CACHED = 100e6


@dataclass(frozen=True, kw_only=True)
class Sources:
    """Where recorded and stored data are; an output folder belongs to one of these.

    Attributes:
        root: Folder of the chambers' recordings.
        hemodynamics: Folder with simulator.npz and real.npz; the small sets inside the
            package if None.
    """

    root: Path | None = None
    hemodynamics: Path | None = None

    def task(self, cell: Cell) -> Task:
        """Return the task of a cell."""
        options = json.loads(cell.options)
        if cell.task == "hemodynamics" and self.hemodynamics is not None:
            options["simulations"] = self.hemodynamics / "simulator.npz"
            # There reality is the simulator, and its people serve as real ones too.
            if cell.variant != "well_specified":
                options["observations"] = self.hemodynamics / "real.npz"
        return get_task(
            cell.task, variant=cell.variant or None, root=self.root, **options
        )


def cached(folder: Path, kind: str, content: Any, compute: Callable[[], Any]) -> Any:
    """Return what cells share: tensors and numbers, and collections of these.

    This is not joblib's ``Memory``, because reading a pickle can run code.

    Args:
        folder: Where it is kept.
        kind: First part of the file's name.
        content: What it depends on, as JSON.
        compute: Returns it.
    """
    text = json.dumps(content, sort_keys=True)
    path = folder / f"{kind}-{hashlib.sha256(text.encode()).hexdigest()[:20]}.pt"
    if not path.exists():
        value = compute()
        with write_atomically(path) as temporary:
            torch.save(value, temporary)
    return torch.load(path, weights_only=True)


class CountingSimulator:
    """A simulator that knows how many simulations it made."""

    def __init__(self, simulator: Callable[[Tensor], Tensor]) -> None:
        self.simulator, self.count = simulator, 0

    def __call__(self, theta: Tensor) -> Tensor:
        """Simulate, theta ``(n, k)`` to x ``(n, *event)``."""
        self.count += len(theta)
        return self.simulator(theta)


@dataclass(frozen=True, kw_only=True)
class Case:
    """The data of a cell, drawn when they are asked for, and the NPE trained on them.

    Real data depend on task, variant and repetition, simulations on task and
    repetition: all methods see the same.
    """

    task: Task
    settings: Settings
    cell: Cell
    cache: Path
    device: str

    @classmethod
    def of(cls, cell: Cell, sources: Sources, cache: Path, device: str) -> "Case":
        """Return the case of a cell."""
        task = sources.task(cell)
        return cls(
            task=task,
            settings=PRESETS[cell.preset](task),
            cell=cell,
            cache=cache,
            device=device,
        )

    @property
    def seed(self) -> int:
        """Seed of everything random."""
        return self.cell.repetition

    @cached_property
    def simulator(self) -> CountingSimulator | None:
        """The simulator; None for stored people, who cannot be simulated at will."""
        if self.task.name == "hemodynamics":
            return None
        return CountingSimulator(self.task.get_simulator())

    @cached_property
    def simulations(self) -> Pairs:
        """Pairs to train on."""
        return self._simulated["train"]

    @cached_property
    def stored(self) -> Pairs:
        """Pairs that RoPE uses where there is no simulator."""
        return self._simulated["stored"]

    @cached_property
    def _simulated(self) -> dict[str, Pairs]:
        def draw() -> dict[str, Pairs]:
            if self.task.name == "hemodynamics":
                return self._split_people()
            pairs = self.task.get_simulations(
                self.settings.num_simulations, seed=self.seed
            )
            return {"train": pairs}

        size = 4 * self.settings.num_simulations * math.prod(self.task.x_shape)
        if size > MAX_CACHED:
            pairs = draw()
        else:
            content = {
                "task": [self.cell.task, self.cell.variant, self.cell.options],
                "number": self.settings.num_simulations,
                "seed": self.seed,
            }
            pairs = cached(self.cache, "simulations", content, draw)
        return {
            name: (theta.to(self.device), x.to(self.device))
            for name, (theta, x) in pairs.items()
        }

    def _split_people(self) -> dict[str, Pairs]:
        """Split stored people: recordings to train on, one more of each, held out."""
        people = len(self.task.get_simulator().theta)  # type: ignore[attr-defined]
        count = int(HELD_OUT * people)
        rounds = max(1, self.settings.num_simulations // (people - count))
        theta, x = self.task.get_simulations((rounds + 1) * people, seed=self.seed)
        # Stroke volumes tell people apart: they are drawn from a continuum.
        kept = ~torch.isin(theta[:, 0], theta[:count, 0])
        last = torch.arange(len(theta)) >= rounds * people
        return {
            "train": (theta[kept & ~last], x[kept & ~last]),
            "stored": (theta[kept & last], x[kept & last]),
            "held_out": (theta[:count], x[:count]),
        }

    @cached_property
    def calibration(self) -> Pairs:
        """Labelled real observations."""
        theta, x = self.task.get_calibration_set(
            self.cell.n_calibration, seed=self.seed
        )
        return theta.to(self.device), x.to(self.device)

    @cached_property
    def test_set(self) -> Pairs:
        """Real observations to infer, with their parameters."""
        recorded = self.task.num_recorded("test", seed=self.seed)
        n = self.settings.n_test if recorded is None else recorded
        theta, x = self.task.get_test_set(min(n, self.settings.n_test), seed=self.seed)
        return theta.to(self.device), x.to(self.device)

    @property
    def held_out(self) -> Pairs | None:
        """Simulated people for the line "SBI" where there is no simulator."""
        return self._simulated.get("held_out")

    @cached_property
    def builder(self) -> Any:
        """The builder of untrained estimators."""
        with torch.random.fork_rng():
            torch.manual_seed(self.seed)
            return self.settings.builder(self.task)

    @property
    def npe(self) -> Any:
        """The trained posterior of NPE."""
        return self._npe["posterior"]

    @property
    def npe_seconds(self) -> float:
        """How long the training of NPE took, whenever that was."""
        return self._npe["seconds"]

    @cached_property
    def _npe(self) -> dict[str, Any]:
        def train() -> dict[str, Any]:
            start = time.perf_counter()
            npe = PlainNPE(
                self.task.get_prior(),
                self.builder,
                npe_training=self.settings.training,
                device=self.device,
            )
            npe.append_simulations(*self.simulations)
            npe.train(seed=self.seed, show_progress_bars=False)
            seconds = time.perf_counter() - start
            return {"state": state_of(npe.build_posterior()), "seconds": seconds}

        # By their content: variants that change real data only share an NPE.
        content = {
            "simulations": [digest(part) for part in self.simulations],
            "seed": self.seed,
            "training": asdict(self.settings.training),
            "flow": [self.settings.flow, self.settings.flow_options],
            "light_net": self.settings.light_net,
            "device": self.device,
        }
        kept = cached(self.cache, "npe", content, train)
        posterior = posterior_with(
            kept["state"],
            prior=self.task.get_prior(),
            build=self.builder,
            simulations=self.simulations,
            device=self.device,
        )
        return {"posterior": posterior, "seconds": kept["seconds"]}


def digest(tensor: Tensor) -> str:
    """Return a checksum of a tensor's values."""
    values = tensor.detach().cpu().contiguous().numpy()
    return hashlib.sha256(values.tobytes()).hexdigest()


# Trained estimators as tensors, so that reading them runs no code --------------------


def state_of(posterior: Any) -> dict[str, Tensor]:
    """Return the weights and buffers of the estimator in a posterior of NPE."""
    state = posterior.posterior_estimator.state_dict()
    return {name: values.detach().cpu().clone() for name, values in state.items()}


def posterior_with(
    state: Mapping[str, Tensor],
    *,
    prior: Any,
    build: Callable[[Tensor, Tensor], Any],
    simulations: tuple[Tensor, Tensor],
    device: str = "cpu",
) -> DirectPosterior:
    """Build a posterior of NPE anew, and give it the weights of a trained one.

    Args:
        state: What :func:`state_of` returned.
        prior: The prior.
        build: What sbi's ``posterior_nn(...)`` returns.
        simulations: Pairs of the shapes that it was trained on.
        device: Where to put it.

    Raises:
        RuntimeError: If the weights are those of another estimator.
    """
    # Its first weights are random, and none of them is kept.
    with torch.random.fork_rng():
        # `build` may put its own embedding net into each estimator that it builds.
        estimator = copy.deepcopy(build(*simulations))
    estimator.load_state_dict(state)
    estimator = estimator.to(device).eval()
    prior = copy.deepcopy(prior)
    if hasattr(prior, "to"):
        prior.to(device)
    return DirectPosterior(estimator, prior, device=device)
