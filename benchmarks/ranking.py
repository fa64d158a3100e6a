"""Ranks of methods over tasks, and their picture."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from benchmarks.methods import METHODS

__all__ = ["rank_figure", "relative_ranks"]

CONFIDENCE, NUM_RESAMPLES = 0.95, 2000


def relative_ranks(rows: pd.DataFrame, *, beside: str, max_pairs: int) -> pd.DataFrame:
    """Return the rank of each method among those that were run on the same data.

    It is 0 for the best and 1 for the last. A method that failed is the last.

    Args:
        rows: Those of a suite, with one setting of each method.
        beside: A method. Data on which it was not run are left out.
        max_pairs: More calibration pairs are left out, too.

    Returns:
        A line for each method, a column for each task: the mean over numbers of pairs
        and repetitions. NaN where a method was not run.
    """
    scores = rows["lpp_z"].where(rows["status"] == "finished", -np.inf)
    rows = rows.assign(score=scores)
    of_each: dict[tuple[str, int, int], pd.Series] = {}
    for _, one in rows[rows["method"] == beside].iterrows():
        data = one["task"], int(one["n_calibration"]), int(one["repetition"])
        if data[1] > max_pairs:
            continue
        there = rows[
            (rows["task"] == data[0])
            & rows["n_calibration"].isin([0, data[1]])
            & (rows["repetition"] == data[2])
        ].set_index("method")["score"]
        if len(there) > 1:
            ranks = there.rank(ascending=False)
            of_each[data] = (ranks - 1) / (len(there) - 1)
    return pd.DataFrame(of_each).T.groupby(level=0).mean().T


def rank_figure(ranks: pd.DataFrame) -> Figure:
    """Draw means over tasks with bootstrap intervals; see `relative_ranks`."""
    mean = ranks.mean(axis=1).sort_values(ascending=False)
    values = ranks.loc[mean.index].to_numpy()
    num_tasks = values.shape[1]
    draws = np.random.default_rng(0).integers(
        num_tasks, size=(NUM_RESAMPLES, num_tasks)
    )
    resampled = values[:, draws]
    # A draw may have none of the tasks that a method was run on.
    known = np.isfinite(resampled)
    sums, counts = np.where(known, resampled, 0.0).sum(axis=2), known.sum(axis=2)
    means = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
    tail = (1 - CONFIDENCE) / 2
    low, high = np.nanquantile(means, [tail, 1 - tail], axis=1)
    figure = Figure(figsize=(7, 0.28 * len(mean) + 1), layout="constrained")
    axes = figure.subplots()
    names = []
    for height, (name, value) in enumerate(mean.items()):
        colour = METHODS[str(name)].style[0]
        axes.plot([low[height], high[height]], [height] * 2, c=colour)
        axes.plot(value, height, "o", color=colour)
        run = int(np.isfinite(values[height]).sum())
        names.append(f"{name}" if run == num_tasks else f"{name} [{run} tasks]")
    axes.set_yticks(range(len(mean)), names)
    axes.set_xlabel(f"mean rank over {num_tasks} tasks: 0 is best, 1 last or failed")
    axes.spines[["top", "right"]].set_visible(False)
    return figure
