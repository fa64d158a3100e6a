"""A cell of the benchmark: one method on one set of data."""

import hashlib
import json
from dataclasses import asdict, dataclass, replace


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One method on one set of data: all that its result depends on.

    Attributes:
        task: Name of the task.
        variant: Name of the variant; empty for none.
        options: Options of the task as JSON.
        preset: Name of the settings, see `presets.py`.
        method: Name of the method, see `methods.py`.
        n_calibration: Calibration pairs; 0 for methods that see none.
        gamma: Of the coupling; None for methods without one.
        tau: Of the coupling; None for methods without one.
        cost_scale: Of the coupling; empty for methods without one.
        repetition: Seed of the data and of everything random.
    """

    task: str
    variant: str = ""
    options: str = "{}"
    preset: str = "standard"
    method: str
    n_calibration: int = 0
    gamma: float | None = None
    tau: float | None = None
    cost_scale: str = ""
    repetition: int = 0

    @property
    def key(self) -> str:
        """A name for files, the same whenever the cell is."""
        text = json.dumps(asdict(self), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:20]

    @property
    def training(self) -> "Cell":
        """What cells have in common that share a training: all but gamma and tau."""
        return replace(self, gamma=None, tau=None)

    @property
    def data(self) -> "Cell":
        """What cells have in common that share an NPE and a test set."""
        return replace(self.training, method="", n_calibration=0, cost_scale="")

    def __str__(self) -> str:
        parts = [*data_in_words(self.task, self.variant, self.options), self.method]
        if self.n_calibration:
            parts.append(f"n_c={self.n_calibration}")
        if self.gamma is not None:
            parts.append(f"gamma={self.gamma:g} tau={self.tau:g}")
        return " ".join([*parts, f"#{self.repetition}"])


def data_in_words(task: str, variant: str = "", options: str = "{}") -> list[str]:
    """Return what a cell's data are as the parts of a title."""
    parts = [task, variant] if variant else [task]
    for name, value in json.loads(options).items():
        words = name.replace("_", " ")
        parts.append(words if value is True else f"{words} {value}")
    return parts
