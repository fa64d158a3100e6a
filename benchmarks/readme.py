"""The table that README shows: a few methods on real measurements."""

import numpy as np
import pandas as pd

from benchmarks.evidence import half_width, rows_of_main
from benchmarks.methods import STACK
from benchmarks.published import MISSING, Published, table
from benchmarks.table import with_numbers

__all__ = ["readme_lines"]

TASK, SIZES, OF_ACAUC = "light_tunnel_sensors", (10, 50, 200), 50
# Where a user starts, what is tuned on the labels, the rivals of 2025 and 2026 in the
# form that does better over all numbers of labels, the paper's method, and the default
# of this package.
METHODS = {
    "prior": "prior",
    "NPE": "NPE as it was",
    "fine-tuned NPE (averaged)": "fine-tuned NPE, averaged",
    "FMCPE (embedding)": "FMCPE (embedding)",
    "FRISBI (distilled)": "FRISBI (distilled)",
    "RoPE": "RoPE",
    STACK: "**`stack`**",
}


def readme_lines(published: Published, link: str) -> list[str]:
    """Return the block of README in Markdown.

    Args:
        published: All tables.
        link: From README to the page of all results.
    """
    rows = with_numbers(rows_of_main(published))
    rows = rows[(rows["task"] == TASK) & rows["method"].isin(METHODS)]
    lines = [
        [
            name,
            *(_lpp(_of(rows, method, size)) for size in SIZES),
            _acauc(_of(rows, method, OF_ACAUC)),
        ]
        for method, name in METHODS.items()
    ]
    head = ("", *(f"{size} labels" for size in SIZES), f"ACAUC, {OF_ACAUC} labels")
    return [
        "LPP is the mean log density of the true parameters, in standard deviations of",
        "the prior: higher is better. ± is its 95 % interval over repetitions, whose",
        "number is in brackets (of one, over observations). ACAUC is 0 for calibrated",
        "posteriors, positive for over-confident and negative for too wide.",
        *("", *table(head, lines), ""),
        f"[All tasks, all methods]({link}), also where another is better.",
    ]


def _of(rows: pd.DataFrame, method: str, size: int) -> pd.DataFrame:
    return rows[(rows["method"] == method) & rows["n_calibration"].isin([0, size])]


def _lpp(rows: pd.DataFrame) -> str:
    finished = rows[rows["status"] == "finished"]
    failed = len(rows) - len(finished)
    if not len(finished):
        return "failed" if failed else MISSING
    scores = finished["lpp_z"].to_numpy(dtype=float)
    width = half_width(scores)
    if np.isinf(width):
        width = 1.96 * float(finished["lpp_standard_error"].mean())
    count = f"{len(finished)}; {failed} failed" if failed else f"{len(finished)}"
    return f"{scores.mean():.2f} ± {width:.2f} ({count})"


def _acauc(rows: pd.DataFrame) -> str:
    known = rows["acauc"][rows["status"] == "finished"]
    return f"{known.mean():+.3f}" if len(known) else MISSING
