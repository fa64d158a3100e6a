"""The cells of the benchmark's tables, and the suites they are listed in."""

import hashlib
import itertools
import json
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.methods import METHODS

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

__all__ = [
    "FOLDER",
    "Cell",
    "Suite",
    "data_in_words",
    "list_suites",
    "load_suite",
]

FOLDER = Path(__file__).parent / "suites"
KEYS = {"tasks", "variants", "methods", "n_calibration", "gammas", "taus", "options"}


def data_in_words(task: str, variant: str = "", options: str = "{}") -> list[str]:
    """Return task, variant and options of a :class:`Cell` as parts of a title."""
    parts = [task, variant] if variant else [task]
    for name, value in json.loads(options).items():
        words = name.replace("_", " ")
        parts.append(words if value is True else f"{words} {value}")
    return parts


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
    def group(self) -> tuple[Any, ...]:
        """What cells that are computed together have in common."""
        return (
            self.task,
            self.variant,
            self.options,
            self.preset,
            self.repetition,
            self.method,
            self.n_calibration,
            self.cost_scale,
        )

    def __str__(self) -> str:
        parts = [*data_in_words(self.task, self.variant, self.options), self.method]
        if self.n_calibration:
            parts.append(f"n_c={self.n_calibration}")
        if self.gamma is not None:
            parts.append(f"gamma={self.gamma:g} tau={self.tau:g}")
        return " ".join(part for part in (*parts, f"#{self.repetition}") if part)


@dataclass(frozen=True, kw_only=True)
class Suite:
    """A list of cells and the question they answer.

    Attributes:
        name: Name of the file.
        title: Title of the report.
        question: What is asked, in a sentence or two.
        x_axis: Column that its figure is drawn against.
        cells: The cells, each once.
    """

    name: str
    title: str
    question: str
    x_axis: str
    cells: tuple[Cell, ...]

    def select(
        self,
        *,
        tasks: list[str] | None = None,
        methods: list[str] | None = None,
        repetitions: list[int] | None = None,
    ) -> list[Cell]:
        """Return the cells of some tasks, methods and repetitions.

        Raises:
            SystemExit: If a name is not in the suite or nothing is left.
        """
        wanted = {"task": tasks, "method": methods, "repetition": repetitions}
        for what, chosen in wanted.items():
            known = sorted({getattr(cell, what) for cell in self.cells})
            for name in chosen or ():
                if name not in known:
                    raise SystemExit(
                        f"No {what} {name!r} in the suite {self.name}; it has {known}."
                    )
        cells = [
            cell
            for cell in self.cells
            if all(
                not chosen or getattr(cell, what) in chosen
                for what, chosen in wanted.items()
            )
        ]
        if not cells:
            raise SystemExit(f"Nothing of the suite {self.name} is selected.")
        return cells


def list_suites() -> list[str]:
    """Return the names of all suites."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def load_suite(name: str) -> Suite:
    """Read a suite, by its name or from a TOML file.

    Raises:
        SystemExit: If there is none, or it holds an unknown key or method.
    """
    path = Path(name) if name.endswith(".toml") else FOLDER / f"{name}.toml"
    if not path.exists():
        raise SystemExit(f"No suite {name!r}; there are {list_suites()}.")
    data = tomllib.loads(path.read_text(encoding="utf-8"))
    cells: dict[Cell, None] = {}
    for block in data["cells"]:
        unknown = set(block) - KEYS
        if unknown:
            raise SystemExit(
                f"Unknown key(s) {sorted(unknown)} in {path}; there are {sorted(KEYS)}."
            )
        for repetition in range(data["repetitions"]):
            for cell in _cells_of(block, data, repetition):
                cells.setdefault(cell)
    return Suite(
        name=path.stem,
        title=data["title"],
        question=data["question"],
        x_axis=data.get("x_axis", "n_calibration"),
        cells=tuple(cells),
    )


def _cells_of(
    block: dict[str, Any], suite: dict[str, Any], repetition: int
) -> Iterator[Cell]:
    options = block.get("options", {})
    grid = [
        json.dumps(dict(zip(options, values, strict=True)), sort_keys=True)
        for values in itertools.product(*map(_as_list, options.values()))
    ]
    for task, variant, option, method in itertools.product(
        block["tasks"], block.get("variants", [""]), grid, block["methods"]
    ):
        shared = {
            "task": task,
            "variant": variant,
            "options": option,
            "preset": suite["preset"],
            "method": method,
            "repetition": repetition,
        }
        # What a method does not depend on is left empty, so that no cell is computed
        # twice.
        entry = METHODS.get(method)
        if entry is None or entry.past:
            raise SystemExit(f"No method {method!r}; there are {[*METHODS]}.")
        sizes = block["n_calibration"] if entry.pairs else [0]
        couplings: list[dict[str, Any]] = [{}]
        if entry.couples:
            couplings = [
                {"cost_scale": scale, "gamma": float(gamma), "tau": float(tau)}
                for scale, gammas in block.get("gammas", {"simulated": [0.1]}).items()
                for gamma, tau in itertools.product(gammas, block.get("taus", [1.0]))
            ]
        for n, coupling in itertools.product(sizes, couplings):
            yield Cell(**shared, n_calibration=n, **coupling)


def _as_list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]
