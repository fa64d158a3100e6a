"""Sentences of the docs that count, with the numbers that the tables have now.

    python -m benchmarks claims

prints those that a page does not hold, and ends with status 1 if there is one.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from benchmarks.evidence import CALIBRATED as AIMED_AT
from benchmarks.evidence import MAX_PAIRS, compare, finished_rows
from benchmarks.methods import COUPLED_STACK, GIVEN_PRIOR_STACK, STACK, STACKS
from benchmarks.published import Published
from benchmarks.stacks import CALIBRATED, NEAR, Comparison, comparisons

__all__ = ["Claim", "claims", "missing_claims"]

FOUND = "docs/background/benchmark.md"
STACKING = "docs/background/stacking.md"
START, WHICH = "docs/start/five_minutes.md", "docs/howto/which_method.md"
METHODS = "docs/background/methods.md"
AVERAGED = "fine-tuned NPE (averaged)"
CORRECTED = "discrepancy, fine-tuned"


class Claim(NamedTuple):
    """A part of a sentence, and the page that it is on."""

    page: str
    text: str


def claims(published: Published) -> list[Claim]:
    """Return all of them, with numbers from the tables.

    Raises:
        SystemExit: If there are no stacks of `main` and `stacking`.
    """
    for name in ("main", "stacking"):
        rows = published.rows[name]
        if not len(rows[(rows["method"] == STACK) & (rows["status"] == "finished")]):
            raise SystemExit(f"Expected results of stacks in the suite {name}.")
    makers = (
        *(_of_failures, _against_candidates, _against_others, _of_single_methods),
        _of_pairs_from_the_middle,
    )
    return [claim for maker in makers for claim in maker(published)]


def _of_failures(published: Published) -> Iterator[Claim]:
    """Ask for a sentence on stacks that failed, which no other sentence counts."""
    for name in ("main", "stacking"):
        rows = published.rows[name]
        failed = rows[rows["method"].isin(STACKS) & (rows["status"] == "failed")]
        if len(failed):
            yield Claim(FOUND, f"{len(failed)} stacks of `{name}` failed")


def missing_claims(found: Sequence[Claim], root: Path) -> list[Claim]:
    """Return those that their page does not hold, wherever its lines are broken."""
    pages = {
        page: _in_one_line((root / page).read_text(encoding="utf-8"))
        for page in {claim.page for claim in found}
    }
    return [claim for claim in found if claim.text not in pages[claim.page]]


def _in_one_line(text: str) -> str:
    return " ".join(text.split())


def _count(met: Iterable[bool]) -> str:
    """Return how many of some goals are met, as in "3 of 4"."""
    flags = [*met]
    return f"{sum(flags)} of {len(flags)}"


# The suite stacking ------------------------------------------------------------------


def _against_candidates(published: Published) -> Iterator[Claim]:
    found = comparisons(published.tables["stacking"])
    ten = [one for one in found if one.cell.n_calibration == 10]
    more = [one for one in found if one.cell.n_calibration > 10]
    near, near_with_ten = (_count(o.gap >= -NEAR for o in part) for part in (more, ten))
    losses = [max(one.test["prior"], one.test["NPE"]) - one.stacked for one in found]
    safe, worst = _count(loss <= NEAR for loss in losses), max(losses)
    yield Claim(
        FOUND,
        f"In {safe} stacks on six tasks it is not more than {NEAR} nats "
        f"below the prior or NPE ({worst:.2f} in the other).",
    )
    yield Claim(
        START, f"below the prior or NPE in {safe} cases, and {worst:.2f} in the other"
    )
    yield Claim(
        FOUND, f"in {near} with 50 and 200 pairs, and in {near_with_ten} with ten"
    )
    yield Claim(START, f"in {near} with 50 and 200 labels, and in {near_with_ten} with")
    yield Claim(
        WHICH,
        f"in {near} cells of the benchmark with 50 and 200 labels and in "
        f"{near_with_ten} with ten",
    )
    lost = [one for one in found if one.gap < -NEAR]
    lost_with_ten = sum(one.cell.n_calibration == 10 for one in lost)
    yield Claim(
        FOUND, f"it loses more than {NEAR} nats in {len(lost)} of [{len(found)} cells]"
    )
    yield Claim(FOUND, f"Of these, {lost_with_ten} have ten pairs, which cannot tell")
    most_lost = sorted(one.gap for one in found)
    yield Claim(
        FOUND,
        f"the stack loses {-most_lost[0]:.2f}. In the others it loses "
        f"{-most_lost[1]:.2f} at most",
    )
    held = [abs(o.held_out[STACK] - o.stacked) <= 2 * o.held_out_error for o in found]
    yield Claim(
        FOUND, f"In {sum(held)} cells the held-out score is within two standard"
    )
    calibrated = [abs(one.row["acauc"]) <= CALIBRATED for one in found]
    others = Counter(
        one.cell.task for one, met in zip(found, calibrated, strict=True) if not met
    )
    (first, most), (second, next_most) = others.most_common(2)
    yield Claim(
        FOUND,
        f"it is within {CALIBRATED} in {_count(calibrated)} cells. Of the "
        f"others {most} are the {first} and {next_most} {second}.",
    )
    shifted = [one for one in found if one.cell.variant == "prior_shift"]
    yield Claim(
        FOUND,
        f"its best candidate in [{_count(o.gap >= -NEAR for o in shifted)} cells]",
    )
    right = [one for one in found if one.cell.variant == "well_specified"]
    yield from _where_the_simulator_is_right(right)


def _where_the_simulator_is_right(right: list[Comparison]) -> Iterator[Claim]:
    above = np.array([one.stacked - one.test["NPE"] for one in right])
    count = _count(above >= 0.0)
    yield Claim(
        FOUND,
        f"in {count} cells, and loses {-above.min():.2f} nats at most in the others",
    )
    yield Claim(
        FOUND,
        f"In {count} cells the stack is as good as NPE or better, by up to "
        f"{above.max():.2f} nats",
    )
    yield Claim(WHICH, f"a stack has at most {-above.min():.2f} nats less")
    means = [
        np.mean(
            [
                one.row["acauc"]
                for one in right
                if (one.cell.task, one.cell.n_calibration) == ("pendulum", size)
            ]
        )
        for size in (10, 50, 200)
    ]
    yield Claim(
        FOUND,
        "their mean ACAUC is {:.2f}, {:.2f} and {:.2f} with 10, 50 and 200 "
        "pairs".format(*means),
    )


# The suite main ----------------------------------------------------------------------


def _against_others(published: Published) -> Iterator[Claim]:
    rows = finished_rows(published)
    few = [one for one in compare(rows) if one.size <= MAX_PAIRS]
    near = [one.is_near(one.best) for one in few]
    equal = [one.is_near(one.best_equal) for one in few if one.best_equal]
    yield Claim(
        FOUND,
        f"the best or within {NEAR} nats of the best method in "
        f"{_count(near)} cells, and in {sum(equal)} if methods that also see",
    )
    missed = [one for one, met in zip(few, near, strict=True) if not met]
    yield Claim(
        FOUND,
        f"Of the other {len(missed)}, "
        f"{sum(one.size == 10 for one in missed)} have ten pairs",
    )
    beyond = [one.is_above(one.best) for one in few]
    rivals = [one.is_above(one.best_rival) for one in few if one.best_rival]
    yield Claim(
        FOUND,
        f"it is in {_count(beyond)} cells better than the best other "
        "beyond the interval over repetitions",
    )
    yield Claim(
        FOUND,
        f"In {_count(rivals)} it is better, beyond the interval, than the "
        "best that is not of this package",
    )
    level = [one.gaps[CORRECTED].mean() < NEAR for one in few if CORRECTED in one.gaps]
    yield Claim(
        FOUND,
        f"mean LPP is above the stack's or less than {NEAR} below it in "
        f"{_count(level)} cells",
    )
    yield Claim(
        FOUND,
        f"Its mean |ACAUC| is {_mean_acauc(rows, STACK):.3f} (aimed at "
        f"{AIMED_AT}; SBI has {_mean_acauc(rows, 'SBI'):.3f}, and the fine-tuned "
        f"discrepancy model alone {_mean_acauc(rows, CORRECTED):.3f})",
    )
    batch = [one for one in compare(rows, COUPLED_STACK) if one.size <= MAX_PAIRS]
    count = _count(one.is_near(one.best) for one in batch)
    yield Claim(
        FOUND,
        f"**In {count} cells it is the best or within {NEAR} nats of the best method**",
    )
    yield Claim(STACKING, f"or within {NEAR} nats of the best, in {count} cells")


def _of_pairs_from_the_middle(published: Published) -> Iterator[Claim]:
    suites = {"light_tunnel_sensors": "noniid", "pendulum": "noniid"}
    suites["linear_gaussian"] = "failures"
    gains = [
        published.above(
            GIVEN_PRIOR_STACK,
            STACK,
            suite=suite,
            size=size,
            task=task,
            variant="biased_calibration",
        )
        for task, suite in suites.items()
        for size in (10, 50, 200)
    ]
    better = _count(gain > 0.0 for gain in gains if gain is not None)
    yield Claim(FOUND, f"**One that keeps the prior is better** in {better} cells")


def _mean_acauc(rows: pd.DataFrame, method: str) -> float:
    """Return the mean of |ACAUC| over repetitions, then over tasks and numbers."""
    some = rows[(rows["method"] == method) & (rows["n_calibration"] <= MAX_PAIRS)]
    by_cell = some["acauc"].abs().groupby([some["task"], some["n_calibration"]])
    return float(by_cell.mean().mean())


def _of_single_methods(published: Published) -> Iterator[Claim]:
    rows = finished_rows(published)
    few = rows[rows["n_calibration"].isin([10, 50, 200])]
    scores = few.pivot_table(
        index=["task", "n_calibration", "repetition"], columns="method", values="lpp_z"
    )
    over_one = (scores[AVERAGED] - scores["fine-tuned NPE"]).dropna()
    gains = over_one.groupby("n_calibration").mean()
    yield Claim(
        METHODS,
        "by {:.1f}, {:.1f} and {:.1f} nats with 10, 50 and 200 pairs, in ".format(
            *gains
        )
        + f"{_count(over_one > 0.0)} cells",
    )
    under_stack = (scores[STACK] - scores[AVERAGED]).dropna()
    by_task = under_stack.groupby(["task", "n_calibration"]).mean()
    yield Claim(
        FOUND,
        f"The stack is above it in {_count(under_stack > 0.0)} cells with up to "
        f"{MAX_PAIRS} pairs, by {by_task.min():.2f} to {by_task.max():.1f} nats in the "
        "mean of a task",
    )
    run = published.rows["main"]
    run = run[(run["method"] == AVERAGED) & (run["n_calibration"] <= MAX_PAIRS)]
    yield Claim(FOUND, f"In {_count(run['status'] == 'failed')} cells it failed")
    means = rows[rows["method"] == "RoPE"].pivot_table(
        index="task", columns="n_calibration", values="lpp_z"
    )
    learned = (means[1000] - means[50]).dropna().sort_values()
    yield Claim(
        FOUND,
        f"It gains {learned.iloc[-2]:.2f} nats or less from 50 to 1000 pairs on "
        f"{len(learned) - 1} of {len(learned)} tasks",
    )
