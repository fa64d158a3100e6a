"""A suite's tables in Markdown and its figures, from the committed results alone."""

import math
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import wilcoxon

from benchmarks import figures
from benchmarks.cells import Cell, Suite, data_in_words
from benchmarks.methods import METHODS
from benchmarks.schema import WHERE
from benchmarks.stacks import stacking_lines
from benchmarks.table import Table, markdown, number_text
from sbi_rope._files import write_atomically

__all__ = ["write_report"]

SETTING = ["cost_scale", "gamma", "tau"]
# Lines to compare with, not methods that compete.
REFERENCES = ("SBI",)
SIGNIFICANT = 0.05
MAX_LISTED = 30

EXPLANATION = """\
LPP: mean log-probability of the true parameters, in standard deviations of the prior
(higher is better); one observation with density zero makes it -inf. ± is the standard
deviation over repetitions. ACAUC: 0 is calibrated, above 0 over-confident, below 0
under-confident. ECE: expected coverage error, the mean distance of the coverage of
central intervals from their level. **Bold** is the best LPP of a column; an asterisk
marks those that are not significantly worse observation by observation (Wilcoxon's
signed-rank test over test observations, 5 %; it does not know how a method varies from
training to training, and a few observations can ruin a mean that it does not see: the
median is in the CSV). SBI is NPE on simulations instead of real observations, and does
not compete. Mixtures normalise over the support of the prior (RoPE, OT-only, the stack,
discrepancies that are tuned or fine-tuned); NPE and all other posteriors of sbi are
scored without leakage correction and without rejection. Methods that see no labels have
the same score in every column. gamma is in units of the median distance between
simulated embeddings (`simulated`), or in the units of the embedding as in the paper
(`none`).
"""


def write_report(suite: Suite, table: Table, folder: Path) -> Path:
    """Write `report.md` and its figures into a folder.

    The same table gives the same bytes.
    """
    finished = table.finished
    cells = pd.DataFrame([vars(cell) for cell in suite.cells])
    lines = [f"# {suite.title}", "", suite.question, "", EXPLANATION]
    lines += [f"Settings: `{preset}`." for preset in cells["preset"].unique()]
    for where in cells[WHERE].drop_duplicates().itertuples(index=False, name=None):
        rows = finished[(finished[WHERE] == [*where]).all(axis=1)]
        lines += ["", f"## {_title(where, rows)}", ""]
        lines += _section(rows, table) if len(rows) else ["Not run."]
    for name, what in figures.draw_all(suite, table, folder):
        lines += ["", f"![{what}]({name})"]
    if stacked := stacking_lines(table):
        lines += ["", *stacked]
    if "RoPE" in set(cells["method"]):
        lines += ["", "## Where RoPE loses", "", *_losses(finished, table)]
    lines += ["", "## What was not run", "", *_missing(suite, table)]
    path = folder / "report.md"
    with write_atomically(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n")
    return path


def _title(where: tuple[str, str, str], rows: pd.DataFrame) -> str:
    title = ", ".join(data_in_words(*where))
    stands_in = rows["stand_in"].any()
    return title + (" (a model stands in for the recorded data)" if stands_in else "")


def _section(rows: pd.DataFrame, table: Table) -> list[str]:
    rows = rows.assign(label=_labels(rows))
    sizes = sorted({*rows["n_calibration"]} - {0}) or [0]
    order = [*METHODS]
    ranked = rows.assign(rank=rows["method"].map(order.index))
    names = ranked.sort_values(["rank", *SETTING])["label"].unique()
    marks = {size: _marks(_with_pairs(rows, size), table) for size in sizes}

    def lpp(part: pd.DataFrame, size: int) -> str:
        entry = number_text(part["lpp_z"], ".2f")
        if not part["converged"].all():
            entry += " (not converged)"
        return marks[size].get(part["label"].iloc[0], "{}").format(entry)

    def calibration(part: pd.DataFrame, size: int) -> str:
        acauc, error = part[["acauc", "expected_coverage_error"]].mean()
        return f"{acauc:+.3f} ({error:.3f})"

    def entries(name: str, text: Callable[[pd.DataFrame, int], str]) -> Iterable[str]:
        for size in sizes:
            part = _with_pairs(rows[rows["label"] == name], size)
            yield text(part, size) if len(part) else ""

    heads = ["-" if size == 0 else str(size) for size in sizes]
    lines = [
        f"{rows['n_test'].iloc[0]} test observations, "
        f"{rows['repetition'].nunique()} repetition(s).{_setting(rows)}",
    ]
    for score, text in (("LPP", lpp), ("ACAUC (ECE)", calibration)):
        parts = [[name, *entries(name, text)] for name in names]
        lines += ["", *markdown((f"{score}, calibration pairs", *heads), parts)]
    return lines


def _with_pairs(rows: pd.DataFrame, size: int) -> pd.DataFrame:
    """Return the rows of methods that see so many pairs, or none."""
    return rows[rows["n_calibration"].isin([0, size])]


def _labels(rows: pd.DataFrame) -> list[str]:
    """Name the method of each row as briefly as they can be told apart."""
    settings = rows.groupby("method")[SETTING].apply(lambda g: len(g.drop_duplicates()))
    labels = []
    for cell in rows.index:
        label = cell.method
        if cell.gamma is not None and settings[label] > 1:
            scale = " of the embedding" if cell.cost_scale == "none" else ""
            label += f" (gamma {cell.gamma:g}{scale}, tau {cell.tau:g})"
        labels.append(label)
    return labels


def _setting(rows: pd.DataFrame) -> str:
    """Return the setting of the couplings, where there is a single one."""
    settings = rows[SETTING].dropna().drop_duplicates()
    if len(settings) != 1:
        return ""
    scale, gamma, tau = settings.iloc[0]
    return f" Couplings: gamma = {gamma:g} ({scale}), tau = {tau:g}."


# Comparisons ------------------------------------------------------------------------


def _marks(rows: pd.DataFrame, table: Table) -> dict[str, str]:
    """Return formats for the entries of the methods that are best, or nearly."""
    scores: dict[str, dict[int, np.ndarray]] = {}
    for cell, label in rows["label"].items():
        log_probs = table.arrays[cell].get("log_probs")
        if cell.method not in REFERENCES and log_probs is not None:
            scores.setdefault(label, {})[cell.repetition] = log_probs
    means = {
        name: float(np.mean([part.astype(float).mean() for part in parts.values()]))
        for name, parts in scores.items()
    }
    if not means or max(means.values()) == -math.inf:
        return {}
    best = max(means, key=means.__getitem__)
    marks = {best: "**{}**"}
    for name, parts in scores.items():
        # Of repetitions that both have: only these are the same observations.
        common = sorted(parts.keys() & scores[best].keys())
        if name == best or not common:
            continue
        ours, others = (
            np.concatenate([scores[which][repetition] for repetition in common])
            for which in (name, best)
        )
        if len(ours) == len(others) and not worse(ours, others):
            marks[name] = "{}*"
    return marks


def worse(values: np.ndarray, best: np.ndarray) -> bool:
    """Whether log-probabilities are significantly below another method's.

    By ranks of the differences: one observation that is far off would hide all others
    from a t-test.
    """
    lost, theirs = np.isneginf(values), np.isneginf(best)
    if lost.sum() != theirs.sum():
        return bool(lost.sum() > theirs.sum())
    finite = ~lost & ~theirs
    difference = values[finite].astype(float) - best[finite].astype(float)
    if not np.any(difference):
        return False
    test = wilcoxon(difference, alternative="less", method="asymptotic")
    return bool(test.pvalue < SIGNIFICANT)


def _losses(finished: pd.DataFrame, table: Table) -> list[str]:
    """List the cells of RoPE that another method beats with as many pairs, or none."""
    lines = []
    others = finished[~finished["method"].isin([*REFERENCES, "RoPE"])]
    for cell, row in finished[finished["method"] == "RoPE"].iterrows():
        rivals = others[
            (
                others[[*WHERE, "repetition", "preset"]]
                == row[[*WHERE, "repetition", "preset"]]
            ).all(axis=1)
            & others["n_calibration"].isin([0, cell.n_calibration])
            & (others["gamma"].isna() | (others[SETTING] == row[SETTING]).all(axis=1))
            & (others["lpp_z"] > row["lpp_z"])
        ]
        if len(rivals):
            listed = [
                f"{other.method} {lpp:.2f}"
                f"{'' if _surely_worse(table, cell, other) else ' (not significant)'}"
                for other, lpp in rivals["lpp_z"].items()
            ]
            lines.append(f"- {cell}: {row['lpp_z']:.2f}; {', '.join(listed)}")
    return lines or ["In no cell that was run."]


def _surely_worse(table: Table, cell: Cell, other: Cell) -> bool:
    ours = table.arrays[cell].get("log_probs")
    theirs = table.arrays[other].get("log_probs")
    if ours is None or theirs is None or len(ours) != len(theirs):
        return False
    return worse(ours, theirs)


def _missing(suite: Suite, table: Table) -> list[str]:
    lines = []
    missing = pd.DataFrame([vars(cell) for cell in table.not_run(suite)])
    failed = table.rows[table.rows["status"] == "failed"]
    if len(missing):
        lines += [f"{len(missing)} of {len(suite.cells)} cells were not run:", ""]
        groups = missing.groupby([*WHERE, "repetition"], sort=False)["method"]
        for (task, variant, options, repetition), methods in groups:
            names = ", ".join(data_in_words(task, variant, options))
            listed = ", ".join(methods.unique())
            lines.append(f"- {names} #{repetition}: {len(methods)} cells ({listed})")
    if len(failed):
        lines += ["", f"{len(failed)} cells failed:", ""]
        lines += [
            f"- {cell}: {error.splitlines()[0][:200]}"
            for cell, error in failed["error"].head(MAX_LISTED).items()
        ]
    return lines or ["Everything was run."]
