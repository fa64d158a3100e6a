"""Committed results, as the pages and pictures select and compare them."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.stats import t as student

from benchmarks.methods import METHODS, STACK, STACKS
from benchmarks.store import Results
from benchmarks.suites import Suite, list_suites, load_suite

SIZE = 50
# Where fewer than 200 pairs are recorded, 150 take their place.
MOST = (150, 200)
# The paper's letters; from G on they are ours.
LETTERS = {
    "cs": "A",
    "sir": "B",
    "pendulum": "C",
    "hemodynamics": "D",
    "light_tunnel": "E",
    "wind_tunnel": "F",
    "light_tunnel_sensors": "G",
    "ocean_colour": "H",
    "near_infrared": "I",
    "linear_gaussian": "J",
}
# "SBI" is no method, and other stacks are compared apart.
NO_RIVALS = ("SBI", *STACKS)
# The goals, fixed beforehand, are in nats.
NEAR = 0.1
CONFIDENCE = 0.95


class Setting(NamedTuple):
    """A setting of the coupling."""

    gamma: float
    tau: float
    cost_scale: str

    def __str__(self) -> str:
        scale = " of the embedding" if self.cost_scale == "none" else ""
        return f"gamma {self.gamma:g}{scale}, tau {self.tau:g}"


# RoPE and OT-only compete in the first, fixed beforehand.
FIXED = Setting(0.1, 1.0, "simulated")
PAPER = Setting(0.5, 1.0, "none")


@dataclass(frozen=True)
class Published:
    """The suites, and the rows of each by its name, read from a folder.

    Methods of `main` that were not run again are in the suite `earlier`. Its rows are
    among those of `main`, too.
    """

    folder: Path
    suites: dict[str, Suite]
    rows: dict[str, pd.DataFrame]

    @classmethod
    def read(cls, folder: Path) -> "Published":
        """Read the tables in a folder; a suite without one has no rows."""
        if not [*folder.glob("*/results.csv")]:
            raise SystemExit(f"No results in {folder}. Use `run` first, or --out.")
        suites = {name: load_suite(name) for name in list_suites()}
        rows = {name: Results(folder / name).rows for name in suites}
        rows["main"] = pd.concat([rows["main"], rows["earlier"]])
        return cls(folder, suites, rows)

    def select(
        self,
        method: str,
        *,
        suite: str = "main",
        size: int = SIZE,
        setting: Setting = FIXED,
        **fields: str,
    ) -> pd.DataFrame:
        """Return the rows of a method with so many pairs or none, one a repetition."""
        rows = self.rows[suite]
        sizes = [0, *MOST] if size in MOST else [0, size]
        chosen = (rows["method"] == method) & rows["n_calibration"].isin(sizes)
        for name, value in fields.items():
            chosen &= rows[name] == value
        return rows[chosen & _with_setting(rows, setting)]

    @property
    def num_repetitions(self) -> int:
        """Repetitions of which `main` has rows."""
        return self.rows["main"]["repetition"].nunique()

    @property
    def main(self) -> pd.DataFrame:
        """What was run in the suite `main`, with one setting of the couplings."""
        rows = known(self.rows["main"])
        return rows[_with_setting(rows, FIXED) & rows["task"].isin([*LETTERS])]

    def name(self, task: str, *, suite: str = "main") -> str:
        """Name a task with its letter, marked if a model stands in for real data."""
        rows = self.rows[suite]
        stands_in = (rows["stand_in"][rows["task"] == task] == True).any()  # noqa: E712
        return f"{LETTERS[task]} {task}" + (" (stand-in)" if stands_in else "")


def _with_setting(rows: pd.DataFrame, setting: Setting) -> pd.Series:
    gamma, tau, scale = setting
    same = (rows["gamma"] == gamma) & (rows["tau"] == tau)
    return rows["gamma"].isna() | (same & (rows["cost_scale"] == scale))


def known(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of methods that are not gone."""
    return rows[rows["method"].isin([*METHODS])]


def finished(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows that have scores."""
    return rows[rows["status"] == "finished"].infer_objects()


def mean(rows: pd.DataFrame, column: str = "lpp_z") -> float | None:
    """Return the mean over repetitions; None of no rows."""
    values = finished(rows)[column]
    return float(values.mean()) if len(values) else None


# A method against all others ----------------------------------------------------------


class Comparison(NamedTuple):
    """A method on a task with so many pairs, and how far it is above all others."""

    task: str
    size: int
    rows: pd.DataFrame
    gaps: dict[str, pd.Series]

    def best(self, *, unlabelled: bool = True) -> str | None:
        """Return the method that it is least above; None if there is no other.

        Args:
            unlabelled: Whether those that see the test observations are among them.
        """
        others = [
            name for name in self.gaps if unlabelled or not METHODS[name].observations
        ]
        return min(others, key=self.gap, default=None)

    def gap(self, name: str) -> float:
        """Return how far it is above a method, as a mean over their repetitions."""
        return float(self.gaps[name].mean())

    def is_near(self, name: str) -> bool:
        """Tell whether it is above a method, or hardly below it."""
        return self.gap(name) >= -NEAR


def compare(rows: pd.DataFrame, method: str = STACK) -> list[Comparison]:
    """Compare a method with all others, by task and number of pairs.

    Args:
        rows: Finished rows of `main`, with one setting of each method.
        method: Its name.
    """
    compared = []
    ours = rows[rows["method"] == method]
    for task in LETTERS:
        of_task = rows[rows["task"] == task]
        for size in sorted(ours["n_calibration"][ours["task"] == task].unique()):
            there = of_task[of_task["n_calibration"].isin([0, size])]
            scores = there.pivot_table("lpp_z", "repetition", "method", sort=False)
            own = scores.pop(method)
            gaps = {
                # 0 where both are -inf.
                str(name): (own - other).where(own != other, 0.0).dropna()
                for name, other in scores.items()
                if name not in NO_RIVALS
            }
            gaps = {name: gap for name, gap in gaps.items() if len(gap)}
            if gaps:
                rows_of_own = there[there["method"] == method]
                compared.append(Comparison(task, int(size), rows_of_own, gaps))
    return compared


def half_width(values: np.ndarray) -> float:
    """Return how far an interval over repetitions reaches; inf of a single one."""
    if len(values) < 2 or not np.isfinite(values).all():
        return np.inf
    quantile = student.ppf(0.5 + CONFIDENCE / 2, len(values) - 1)
    return float(quantile * values.std(ddof=1) / len(values) ** 0.5)
