"""The experiments beside the benchmark: what they print and score."""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import norm
from torch import Tensor, nn

from benchmarks.cases import Case, CountingSimulator, Sources
from benchmarks.cells import Cell
from benchmarks.experiments import (
    choices,
    courses,
    data,
    finetuning,
    patience,
    ranks,
)
from benchmarks.experiments.choices import CHOICES, Choice, Run, comparison
from benchmarks.experiments.common import add_task, begin, show
from benchmarks.experiments.losses import Loss, as_row, losses, target_distances
from benchmarks.methods import METHODS
from benchmarks.scoring import Score, scores
from benchmarks.store import Cache
from sbi_rope._sbi import estimator_of
from sbi_rope.errors import RoPEWarning
from sbi_rope.mixture import part_of
from sbi_rope.stacking import default_candidates, stacking_weights
from sbi_rope.tasks import get_task
from tests.stacks import quick

NAMES = tuple(candidate.name for candidate in default_candidates())
NUM_FOLDS = 5
PAIRS = 20


def options(folder: Path, **chosen: object) -> argparse.Namespace:
    """Return options of the command line."""
    known = {"variant": "", "root": None, "hemodynamics": None, "preset": "smoke"}
    return argparse.Namespace(**known, out=folder, **chosen)


def test_rows_are_printed_as_a_table_when_they_are_there(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["a", "--task", "cs", "--n", "3"])
    threads = torch.get_num_threads()
    args = begin("What?", add_task({"--n": {"type": int}}), threads=threads)
    assert (args.task, args.n, args.preset) == ("cs", 3, "standard")
    capsys.readouterr()

    def rows() -> Iterator[dict[str, object]]:
        yield {"a": 1, "b": "x"}
        assert "| 1 | x |" in capsys.readouterr().out
        yield {"a": 2, "b": "y"}

    show(rows())
    assert capsys.readouterr().out == "| 2 | y |\n"


def test_the_factor_of_a_spread_that_is_too_wide_is_found_from_its_coverage() -> None:
    levels = np.arange(1, 100) / 100
    needed = norm.ppf((1.0 + levels) / 2.0)
    shares = ranks.shares_of(2.0 * norm.cdf(needed / 0.8) - 1.0)
    assert ranks.best_factor(shares) == pytest.approx(0.8, abs=1e-4)
    # Nothing is better than the right factor. Ten bins see a little less of it than
    # the closed form for normal densities.
    gain = ranks.gain_of_factor(shares, 0.8)
    assert gain == pytest.approx(ranks.gain_of_any_map(shares))
    assert gain == pytest.approx((0.8**2 - 1.0) / 2.0 - np.log(0.8), rel=0.1)
    assert ranks.gain_of_any_map(ranks.shares_of(levels)) == pytest.approx(0.0)


def test_runs_of_the_finetuning_experiment_are_kept_and_averaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[int] = []

    def run(task: object, npe: object, setting: str, n: int, seed: int) -> object:
        made.append(seed)
        return dict.fromkeys(finetuning.FORMATS, float(n + seed))

    monkeypatch.setattr(finetuning, "trained_npe", lambda *_, **__: None)
    monkeypatch.setattr(finetuning, "run", run)
    args = options(
        tmp_path,
        task="linear_gaussian",
        n_calibration=[5],
        seeds=[0, 1],
        settings=["lr 1e-3, bank of 1"],
    )
    (row,) = finetuning.rows(args)
    assert (row["pairs"], row["distance"], row["seeds"]) == (5, "5.500", 2)
    # What an older version kept is not read, and that is said.
    (tmp_path / "linear_gaussian.csv").touch()
    with pytest.warns(RoPEWarning, match="result of an older version and is not read"):
        assert [*finetuning.rows(args)] == [row]
    assert made == [0, 1]


def test_npe_of_an_experiment_is_read_back_as_it_was_trained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = (200, {"num_transforms": 1}, {"max_num_epochs": 1})
    monkeypatch.setitem(data.NPE_SETTINGS, "linear_gaussian", small)
    task = get_task("linear_gaussian")
    trained = data.trained_npe(task, seed=0, cache=Cache(tmp_path))
    monkeypatch.setattr(data, "NPE", None)
    again = data.trained_npe(task, seed=0, cache=Cache(tmp_path))
    theta, x = task.get_test_set(3)
    ours, theirs = (one.log_prob_batched(theta[None], x) for one in (again, trained))
    assert torch.equal(ours, theirs)


# The choices inside the stack ---------------------------------------------------------


def a_run(*, seed: int = 0, n: int = 6) -> Run:
    generator = torch.Generator().manual_seed(seed)
    shape = (NUM_FOLDS + 1, 9, len(NAMES))
    return Run(
        seconds=3.0,
        names=NAMES,
        fold=torch.arange(n) % NUM_FOLDS,
        held_out=torch.randn(n, len(NAMES), generator=generator).double(),
        others=torch.randn(shape, generator=generator).double(),
    )


def test_choices_are_those_that_the_stack_has() -> None:
    for choice in CHOICES.values():
        assert {*choice.without} < {*NAMES}
    name, choice = next(iter(CHOICES.items()))
    assert name.endswith("(default)")
    assert choice == Choice(without=(), pseudo_count=1.0, refit=None)


def test_weights_are_those_of_the_candidates_that_are_kept() -> None:
    one = a_run()
    weights = Choice(without=("NPE", "prior"), pseudo_count=2.0).weights(one)
    kept = [k for k, name in enumerate(NAMES) if name not in ("NPE", "prior")]
    expected = stacking_weights(one.held_out[:, kept], pseudo_count=2.0).weights
    assert torch.equal(weights[kept], expected)
    assert float(weights.sum()) == pytest.approx(1.0)


def test_a_stack_is_scored_as_a_mixture_of_candidates_and_versions() -> None:
    one = a_run()
    for refit, share in ((None, 1 / 6), (0.0, 0.0), (0.5, 0.5), (1.0, 1.0)):
        choice = Choice(refit=refit)
        shares = [(1 - share) / NUM_FOLDS] * NUM_FOLDS + [share]
        versions = torch.tensor(shares).double()
        density = torch.einsum("vmk,v->mk", one.others.exp(), versions)
        expected = float((density @ choice.weights(one)).log().mean())
        assert choice.score(one) == pytest.approx(expected, rel=1e-6)


def test_the_comparison_has_gains_over_the_first_choice() -> None:
    runs = [a_run(seed=1), a_run(seed=2), a_run(seed=3)]
    rows = {
        str(row["choice"]): [*row.values()][1:]
        for row in comparison({"pendulum": runs[:2], "sir": runs[2:]})
    }
    name, base = next(iter(CHOICES.items()))
    scores = [base.score(one) for one in runs]
    mean = (scores[0] + scores[1]) / 2
    lpps = [f"{mean:.2f} (2)", f"{scores[2]:.2f} (1)", f"{(mean + scores[2]) / 2:.2f}"]
    assert rows[f"{name}, LPP"] == lpps
    best = [float(one.candidate_scores(1 / 6).mean(dim=0).max()) for one in runs]
    gains = [(best[0] + best[1]) / 2 - mean, best[2] - scores[2]]
    shown = [f"{gain:+.2f}" for gain in (*gains, sum(gains) / 2)]
    assert rows["best single candidate"] == shown
    assert rows["seconds"] == ["3", "3", "3"]


def test_a_run_scores_pairs_that_the_stack_has_not_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    args = options(
        tmp_path, task=["linear_gaussian"], n_calibration=6, folds=2, seeds=[1]
    )
    kept: list[Run] = []
    monkeypatch.setattr(
        choices, "comparison", lambda runs: [kept.extend(*runs.values())]
    )
    with quick():
        [*choices.rows(args)]
    monkeypatch.setattr(choices, "run", None)  # as it is read back the second time
    [*choices.rows(args)]
    found, again = kept
    assert found.names == again.names
    for name in ("fold", "held_out", "others"):
        assert torch.equal(getattr(found, name), getattr(again, name))
    assert {*found.names} < {*NAMES}
    assert found.held_out.shape == (6, len(found.names))
    assert found.others.shape == (3, 300, len(found.names))
    task = get_task("linear_gaussian")
    theta, _ = task.get_calibration_set(306, seed=1)
    prior = task.get_prior().log_prob(theta).double()
    unit = task.prior_std.log().sum().double()
    k = found.names.index("prior")
    for version in found.others:
        assert torch.allclose(version[:, k], prior[6:] + unit, atol=1e-4)
    # Held-out scores only weigh candidates; they keep theta's own unit.
    assert torch.allclose(found.held_out[:, k], prior[:6], atol=1e-4)


@pytest.mark.medium
def test_courses_and_rates_are_those_that_the_rows_say(tmp_path: Path) -> None:
    shared = options(
        tmp_path, task="linear_gaussian", n_calibration=9, versions=2, seed=1
    )
    of_courses = argparse.Namespace(
        **vars(shared), spaces=["embedding"], gains=[-np.inf, np.inf], finetuned=True
    )
    of_rates = argparse.Namespace(
        **vars(shared),
        starts=["embedding"],
        rates=[1e-12, 1e-2],
        together=True,
        patiences=[5],
    )
    with quick():
        one, most, again = courses.rows(of_courses)
        nothing, fast, both = patience.rows(of_rates)
    corrected, tuned = "discrepancy", "discrepancy, fine-tuned"
    assert (one[corrected], one[tuned]) == (again[corrected], again[tuned])
    assert most[corrected] != one[corrected]
    # A rate of nearly nothing leaves what the training starts from.
    assert nothing["LPP"] == one[corrected]
    assert fast["LPP"] != nothing["LPP"]
    assert both["rate"] == "1e-12 or 0.01"


def test_an_average_is_scored_by_its_mean_density(case: Case) -> None:
    rope, others = data.calibration_data(case, PAIRS, seed=1)
    parts = [part_of(estimator_of(rope.npe))]
    log_prob = estimator_of(rope.npe).log_prob(others[0][None], others[1])[0]
    expected = float(log_prob.mean() + case.task.prior_std.log().sum())
    for several in (parts, 3 * parts):
        found = data.average_lpp(several, others, case.task)
        assert found == pytest.approx(expected, abs=1e-4)


# Where RoPE loses ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    cell = Cell(
        task="linear_gaussian",
        preset="smoke",
        method="RoPE",
        n_calibration=PAIRS,
        gamma=0.1,
        tau=1.0,
        cost_scale="simulated",
    )
    return Case.of(cell, Sources(), Cache(tmp_path_factory.mktemp("cache")), "cpu")


@pytest.fixture(scope="module")
def lines(case: Case) -> dict[tuple[str, float | None], Loss]:
    return {(loss.name, loss.gamma): loss for loss in losses(case, gammas=[0.5, 0.1])}


def lpp_in_the_benchmark(case: Case, method: str) -> float:
    coupled = METHODS[method].couples
    cell = replace(case.cell, method=method, gamma=0.1 if coupled else None)
    (score,) = scores(replace(case, cell=cell), [cell], [cell])
    assert isinstance(score, Score)
    return score.evaluation.lpp.mean


@pytest.mark.slow
def test_lines_that_are_methods_score_as_in_the_benchmark(
    case: Case, lines: dict[tuple[str, float | None], Loss]
) -> None:
    for method, name, gamma in (
        ("SBI", "SBI", None),
        ("RoPE", f"RoPE, {PAIRS} pairs", 0.1),
        ("OT-only", "OT-only", 0.1),
    ):
        expected = lpp_in_the_benchmark(case, method)
        found = lines[name, gamma].evaluation.lpp.mean
        assert found == pytest.approx(expected, abs=1e-4)


@pytest.mark.medium
def test_embeddings_are_nearer_to_their_targets_where_less_is_wrong(
    lines: dict[tuple[str, float | None], Loss],
) -> None:
    tuned, untuned = (lines[f"RoPE, {PAIRS} pairs", 0.1], lines["OT-only", 0.1])
    nearest = lines["transport alone (sees test labels)", 0.1]
    assert tuned.calibration is not None
    assert untuned.calibration is not None
    assert nearest.test is not None
    assert untuned.test is not None
    assert tuned.calibration.shape == untuned.calibration.shape == (PAIRS,)
    assert tuned.calibration.mean() < untuned.calibration.mean()
    assert nearest.test.mean() < untuned.test.mean()


def test_distances_are_from_the_mean_of_simulations_that_succeeded() -> None:
    def simulator(theta: Tensor) -> Tensor:
        x = theta + torch.tensor([1.0, 0.0]).repeat(len(theta) // 2)[:, None]
        failed = (torch.arange(len(theta)) % 10 == 0)[:, None]
        return x.where(~failed, torch.nan)

    theta = torch.randn(150, 1)
    # Of ten simulations, one was lost of the five with 1: the mean is 4 / 9.
    distances = target_distances(
        nn.Identity(),
        nn.Identity(),
        CountingSimulator(simulator),
        (theta, theta + 4 / 9 + 3.0),
        seed=0,
    )
    torch.testing.assert_close(distances, torch.full((150,), 3.0), rtol=0, atol=1e-5)


def test_a_task_without_a_simulator_is_refused(tmp_path: Path) -> None:
    cell = Cell(task="hemodynamics", preset="smoke", method="RoPE", n_calibration=10)
    case = Case.of(cell, Sources(), Cache(tmp_path), "cpu")
    with pytest.raises(SystemExit, match="stored simulations only"):
        next(losses(case, gammas=[0.1]))


@pytest.mark.medium
def test_a_line_shows_what_there_is(
    lines: dict[tuple[str, float | None], Loss],
) -> None:
    rows = {key: as_row(loss) for key, loss in lines.items()}
    assert len({tuple(row) for row in rows.values()}) == 1
    sbi = rows["SBI", None]
    assert (sbi["gamma"], sbi["ESS"], sbi["distance, test"]) == ("-", "-", "-")
    bad = as_row(replace(lines["OT-only", 0.1], converged=False))
    assert bad["gamma"] == "0.1 (not converged)"
