"""Suites: lists of cells, one TOML file each."""

import itertools
import json
import sys
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.cells import Cell
from benchmarks.methods import METHODS

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

FOLDER = Path(__file__).parent / "suites"
KEYS = {"tasks", "variants", "methods", "n_calibration", "gammas", "taus", "options"}


@dataclass(frozen=True)
class Suite:
    """A list of cells, each once.

    Attributes:
        name: Name of the file.
        x_axis: Column that its picture is drawn against.
        cells: The cells.
    """

    name: str
    x_axis: str
    cells: tuple[Cell, ...]

    def select(self, **wanted: Collection[Any] | None) -> list[Cell]:
        """Return the cells whose fields are among those that are wanted.

        Cells that need no pairs are of any ``n_calibration``.

        Raises:
            SystemExit: If the suite does not know a value, or nothing is left.
        """
        cells = [*self.cells]
        for name, values in wanted.items():
            if not values:
                continue
            known = {getattr(cell, name) for cell in self.cells}
            if unknown := {*values} - known:
                raise SystemExit(
                    f"{self.name}: expected {name} among {sorted(known)}; "
                    f"got {sorted(unknown)}."
                )
            among = {*values, 0} if name == "n_calibration" else values
            cells = [cell for cell in cells if getattr(cell, name) in among]
        if not cells:
            raise SystemExit(f"{self.name}: no cell is in all of these; got {wanted}.")
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
        for what, named, known in (
            ("key", block, KEYS),
            ("method", block["methods"], METHODS),
        ):
            if unknown := {*named} - {*known}:
                raise SystemExit(
                    f"{path}: expected each {what} among {sorted(known)}; "
                    f"got {sorted(unknown)}."
                )
        for repetition in range(data["repetitions"]):
            cells |= dict.fromkeys(_cells_of(block, data["preset"], repetition))
    return Suite(path.stem, data.get("x_axis", "n_calibration"), tuple(cells))


def _cells_of(block: dict[str, Any], preset: str, repetition: int) -> Iterator[Cell]:
    options = {
        name: values if isinstance(values, list) else [values]
        for name, values in block.get("options", {}).items()
    }
    grid = [
        json.dumps(dict(zip(options, values, strict=True)), sort_keys=True)
        for values in itertools.product(*options.values())
    ]
    couplings = [
        {"cost_scale": scale, "gamma": float(gamma), "tau": float(tau)}
        for scale, gammas in block.get("gammas", {"simulated": [0.1]}).items()
        for gamma, tau in itertools.product(gammas, block.get("taus", [1.0]))
    ]
    for task, variant, option, method in itertools.product(
        block["tasks"], block.get("variants", [""]), grid, block["methods"]
    ):
        # What a method does not depend on is left empty, so that no cell is computed
        # twice.
        entry = METHODS[method]
        for n, coupling in itertools.product(
            block["n_calibration"] if entry.pairs else [0],
            couplings if entry.couples else [{}],
        ):
            yield Cell(
                task=task,
                variant=variant,
                options=option,
                preset=preset,
                method=method,
                n_calibration=n,
                repetition=repetition,
                **coupling,
            )
