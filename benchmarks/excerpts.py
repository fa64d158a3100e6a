"""Tables of the pages of docs: what some methods have on some tasks of a suite."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from benchmarks.methods import COUPLED_STACK, GIVEN_PRIOR_STACK, RVNP_STACK, STACK
from benchmarks.published import Published, entry, mean, num_repetitions, table

__all__ = ["EXCERPTS", "Excerpt"]

# What `Published.select` is asked for.
Fields = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Excerpt:
    """A table of mean scores, each chosen by what its line and its column say.

    Attributes:
        lines: The name of each line, and what it chooses.
        columns: The name of each column, and what it chooses.
        chosen: What all of them choose.
        score: The LPP or the ACAUC.
        sizes: The numbers of pairs in an entry; the usual one if there are none.
        same_repetitions: Whether the columns of a line are compared in the repetitions
            that all of them finished.
    """

    lines: Mapping[str, Fields]
    columns: Mapping[str, Fields]
    chosen: Fields = field(default_factory=dict)
    score: str = "lpp_z"
    sizes: Sequence[int] = ()
    same_repetitions: bool = False

    def markdown(self, published: Published) -> list[str]:
        """Return the table in Markdown."""
        usual = num_repetitions([published.rows["main"]])
        lines = []
        for name, line in self.lines.items():
            by_size = [
                self._parts(published, line | size)
                for size in ([{"size": n} for n in self.sizes] or [{}])
            ]
            entries = [
                " / ".join(
                    entry(part, self._text, out_of=usual)
                    for part in _without_copies(parts)
                )
                for parts in zip(*by_size, strict=True)
            ]
            lines.append([name, *entries])
        return table(("", *self.columns), lines)

    def _parts(self, published: Published, line: Fields) -> list[pd.DataFrame]:
        """Return the rows of the entries of a line, with one number of pairs."""
        parts = [
            published.select(**(self.chosen | column | line))
            for column in self.columns.values()
        ]
        if self.same_repetitions:
            parts = [part[part["status"] == "finished"] for part in parts]
            common = set.intersection(*(set(part["repetition"]) for part in parts))
            parts = [part[part["repetition"].isin(common)] for part in parts]
        return parts

    def _text(self, rows: pd.DataFrame) -> str:
        # Without the sign of -0.00.
        return f"{round(mean(rows, self.score) or 0.0, 2) + 0.0:.2f}"


def _without_copies(parts: Sequence[pd.DataFrame]) -> Sequence[pd.DataFrame]:
    """Return one part of a method that needs no pairs, or was not run at all."""
    first = parts[0].index
    return parts[:1] if all(part.index.equals(first) for part in parts) else parts


def _methods(*names: str) -> dict[str, Fields]:
    return {name: {"method": name} for name in names}


FEW = (10, 50, 200)
OF_EACH_SIZE = {f"{size} pairs": {"size": size} for size in (*FEW, 1000)}
SENSORS = {"task": "light_tunnel_sensors"}
IN_THE_MIDDLE = {"variant": "biased_calibration"}
LINEAR = {"task": "linear_gaussian"}
TASKS = {
    "cs": {"task": "cs"},
    "sir": {"task": "sir"},
    "pendulum": {"task": "pendulum"},
    "hemodynamics": {"task": "hemodynamics"},
    "wind tunnel (stand-in)": {"task": "wind_tunnel"},
    "sensors (real)": SENSORS,
}
IMAGES = {"task": "light_tunnel"}
WHERE_RVNP_HELPS = {"sir": {"task": "sir"}, "cs": {"task": "cs"}}
WITH_RVNP = {
    "RVNP alone": {"method": "RVNP"},
    "`stack(rope)`": {"method": STACK},
    "with RVNP": {"method": RVNP_STACK, "suite": "couplings"},
}
# By the name that a page calls them with.
EXCERPTS = {
    "stack-and-others": Excerpt(
        lines=_methods("prior", "NPE", "OT-only", "NNPE", "RVNP", "RVNP (offset)")
        | {"RNPE": {"method": "RNPE", "suite": "extras"}}
        | _methods("fine-tuned NPE", "fine-tuned NPE (averaged)", "RoPE")
        | _methods("discrepancy", "discrepancy, fine-tuned", STACK),
        columns=TASKS,
    ),
    "labels": Excerpt(
        lines=_methods("RoPE", "J-NPE", "fine-tuned NPE", "fine-tuned NPE (averaged)")
        | _methods("discrepancy", "discrepancy, fine-tuned", STACK),
        columns=OF_EACH_SIZE,
        chosen=SENSORS,
    ),
    "labels-of-a-stack": Excerpt(
        lines={
            "light tunnel's sensors, real measurements": SENSORS,
            "spread of an epidemic (`sir`)": {"task": "sir"},
            "pendulum with friction": {"task": "pendulum"},
        },
        columns={"NPE": {"method": "NPE"}}
        | {f"{n} pairs": {"method": STACK, "size": n} for n in FEW},
    ),
    "batch": Excerpt(
        lines=TASKS,
        columns={
            "`stack(rope)`": {"method": STACK},
            "`stack(rope, x_o)`": {"method": COUPLED_STACK},
        },
        sizes=FEW,
        same_repetitions=True,
    ),
    "with-rvnp": Excerpt(
        lines=WHERE_RVNP_HELPS,
        columns=WITH_RVNP,
        sizes=(10, 50),
        same_repetitions=True,
    ),
    "with-rvnp-calibration": Excerpt(
        lines=WHERE_RVNP_HELPS,
        columns=WITH_RVNP,
        score="acauc",
        sizes=(10, 50),
        same_repetitions=True,
    ),
    "images": Excerpt(
        lines=_methods("RoPE", "FRISBI", "FRISBI (distilled)", "FMCPE (embedding)")
        | _methods("J-NPE", "fine-tuned NPE", "fine-tuned NPE (averaged)")
        | _methods("discrepancy", "discrepancy (tuned)", "discrepancy, fine-tuned")
        | _methods(STACK),
        columns=OF_EACH_SIZE,
        chosen=IMAGES,
    ),
    "calibration": Excerpt(
        lines=TASKS | {"images (stand-in)": IMAGES},
        columns=_methods("SBI", "NPE", "RoPE", "discrepancy, fine-tuned", STACK),
        score="acauc",
        sizes=FEW,
    ),
    "rivals": Excerpt(
        lines=_methods("FMCPE", "FMCPE (embedding)", "FRISBI", "FRISBI (distilled)")
        | _methods("RoPE", STACK),
        columns={name: task for name, task in TASKS.items() if name != "hemodynamics"},
        sizes=FEW,
    ),
    "failures": Excerpt(
        lines={
            "curved": {"variant": "curved"},
            "heavy tails": {"variant": "heavy_tails"},
        },
        columns=_methods("RoPE", "fine-tuned NPE", "discrepancy (input)", STACK),
        chosen=LINEAR | {"suite": "failures"},
        sizes=FEW,
    ),
    "shift": Excerpt(
        lines={"sensors (real)": SENSORS | {"variant": "sensor_settings"}},
        columns=_methods("prior", "NPE", "OT-only", "RoPE", "fine-tuned NPE")
        | _methods("discrepancy", STACK),
        chosen={"suite": "shift"},
        sizes=FEW,
    ),
    "pairs-from-the-middle": Excerpt(
        lines={
            "sensors (real)": SENSORS | {"suite": "noniid"},
            "pendulum": {"task": "pendulum", "suite": "noniid"},
            "linear_gaussian": LINEAR | {"suite": "failures"},
        },
        columns=_methods("prior", "RoPE", "fine-tuned NPE", STACK, GIVEN_PRIOR_STACK),
        chosen=IN_THE_MIDDLE,
        sizes=FEW,
    ),
    "dimension": Excerpt(
        lines=_methods("prior", "SBI", "RoPE", "tuning-only", "fine-tuned NPE")
        | _methods("discrepancy", STACK),
        columns={
            f"{dim} parameters": {"options": f'{{"dim": {dim}}}'}
            for dim in (2, 5, 10, 25)
        },
        chosen=LINEAR | {"suite": "dimension"},
    ),
}
