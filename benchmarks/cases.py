"""The data of a cell, and the trained NPE that all methods of a table share."""

import hashlib
import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.cells import Cell
from benchmarks.presets import PRESETS, Settings
from sbi_rope.baselines import PlainNPE
from sbi_rope.saving import load, save
from sbi_rope.tasks import Task, get_task
from sbi_rope.utils.files import write_atomically

Pairs = tuple[Tensor, Tensor]

# Stored simulated people whom nothing is trained on, for the line "SBI".
HELD_OUT = 0.1
# Banks up to this size are kept between runs, in bytes.
MAX_CACHED = 100e6


@dataclass(frozen=True)
class Workplace:
    """Where a run reads and writes, and what it runs on.

    Attributes:
        folder: A folder for each suite, and `cache` for what cells share.
        root: Folder of the recorded data.
        hemodynamics: Folder with simulator.npz and real.npz; the small sets inside the
            package if None.
        device: Where networks are trained.
    """

    folder: Path
    root: Path | None = None
    hemodynamics: Path | None = None
    device: str = "cpu"

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


class CountingSimulator:
    """A simulator that knows how many simulations it made."""

    def __init__(self, simulator: Callable[[Tensor], Tensor]) -> None:
        self.simulator, self.count = simulator, 0

    def __call__(self, theta: Tensor) -> Tensor:
        """Simulate, theta ``(n, k)`` to x ``(n, *event)``."""
        self.count += len(theta)
        return self.simulator(theta)


@dataclass(frozen=True)
class Case:
    """The data of a cell, drawn when they are asked for, and the NPE trained on them.

    Real data depend on task, variant and repetition, simulations on task and
    repetition: all methods see the same.
    """

    cell: Cell
    place: Workplace

    @cached_property
    def task(self) -> Task:
        """The task."""
        return self.place.task(self.cell)

    @cached_property
    def settings(self) -> Settings:
        """What methods are run with."""
        return PRESETS[self.cell.preset](self.task)

    @property
    def device(self) -> str:
        """Where networks are trained."""
        return self.place.device

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

    @property
    def num_simulated(self) -> int:
        """Simulations that methods made so far."""
        return 0 if self.simulator is None else self.simulator.count

    @property
    def simulations(self) -> Pairs:
        """Pairs to train on."""
        return self._simulated["train"]

    @property
    def stored(self) -> Pairs:
        """Pairs that RoPE uses where there is no simulator."""
        return self._simulated["stored"]

    @cached_property
    def _simulated(self) -> dict[str, Pairs]:
        size = 4 * self.settings.num_simulations * math.prod(self.task.x_shape)
        path = self._cached(
            "simulations",
            task=[self.cell.task, self.cell.variant, self.cell.options],
            number=self.settings.num_simulations,
            seed=self.seed,
        )
        if path.exists():
            pairs = torch.load(path, weights_only=True)
        else:
            pairs = self._drawn()
            if size <= MAX_CACHED:
                with write_atomically(path) as temporary:
                    torch.save(pairs, temporary)
        return {
            name: (theta.to(self.device), x.to(self.device))
            for name, (theta, x) in pairs.items()
        }

    def _cached(self, kind: str, **content: Any) -> Path:
        """Return the file of what cells share, named by what it depends on."""
        text = json.dumps(content, sort_keys=True)
        key = hashlib.sha256(text.encode()).hexdigest()[:20]
        return self.place.folder / "cache" / f"{kind}-{key}.pt"

    def _drawn(self) -> dict[str, Pairs]:
        if self.task.name == "hemodynamics":
            return self._split_people()
        number = self.settings.num_simulations
        return {"train": self.task.get_simulations(number, seed=self.seed)}

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
    def held_out(self) -> Pairs:
        """Simulated people for the line "SBI" where there is no simulator."""
        return self._simulated["held_out"]

    @cached_property
    def builder(self) -> Any:
        """The builder of untrained estimators."""
        with torch.random.fork_rng():
            torch.manual_seed(self.seed)
            return self.settings.builder(self.task)

    @property
    def npe(self) -> Any:
        """The trained posterior of NPE."""
        return self._npe[0]

    @property
    def npe_seconds(self) -> float:
        """How long the training of NPE took, whenever that was."""
        return self._npe[1]

    @cached_property
    def _npe(self) -> tuple[Any, float]:
        # By their content: variants that change real data only share an NPE.
        path = self._cached(
            "npe",
            simulations=[digest(part) for part in self.simulations],
            seed=self.seed,
            training=asdict(self.settings.training),
            flow=[self.settings.flow, self.settings.flow_options],
            light_net=self.settings.light_net,
            device=self.device,
            # A file is read by the versions that wrote it only.
            versions=[version("sbi"), version("sbi-rope")],
        )
        seconds = path.with_suffix(".seconds")
        if not path.exists():
            start = time.process_time()
            npe = PlainNPE(
                self.task.get_prior(),
                self.builder,
                npe_training=self.settings.training,
                device=self.device,
            )
            npe.append_simulations(*self.simulations)
            npe.train(seed=self.seed, show_progress_bars=False)
            path.parent.mkdir(parents=True, exist_ok=True)
            seconds.write_text(str(time.process_time() - start))
            save(npe.build_posterior(), path, overwrite=True)
        posterior = load(path)
        if self.device != "cpu":
            posterior.to(self.device)
        return posterior, float(seconds.read_text())


def digest(tensor: Tensor) -> str:
    """Return a checksum of a tensor's values."""
    values = tensor.detach().cpu().contiguous().numpy()
    return hashlib.sha256(values.tobytes()).hexdigest()
