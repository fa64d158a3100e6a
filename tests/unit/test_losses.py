"""The benchmark's command that takes RoPE apart, on a task of seconds."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from benchmarks.cases import Case, CountingSimulator, Sources
from benchmarks.cells import NEEDS_COUPLING, Cell
from benchmarks.losses import Loss, as_line, losses, target_distances
from benchmarks.scoring import Score, scores
from benchmarks.store import Cache

PAIRS = 20


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
    coupled = method in NEEDS_COUPLING
    cell = replace(case.cell, method=method, gamma=0.1 if coupled else None)
    (score,) = scores(replace(case, cell=cell), [cell], [cell])
    assert isinstance(score, Score)
    return score.evaluation.lpp.mean


@pytest.mark.parametrize(
    ("method", "line"),
    [
        ("SBI", ("SBI", None)),
        ("RoPE", (f"RoPE, {PAIRS} pairs", 0.1)),
        ("OT-only", ("OT-only", 0.1)),
    ],
)
def test_lines_that_are_methods_score_as_in_the_benchmark(
    case: Case,
    lines: dict[tuple[str, float | None], Loss],
    method: str,
    line: tuple[str, float | None],
) -> None:
    expected = lpp_in_the_benchmark(case, method)
    assert lines[line].evaluation.lpp.mean == pytest.approx(expected, abs=1e-4)


def test_tuning_brings_the_pairs_nearer_than_they_were(
    lines: dict[tuple[str, float | None], Loss],
) -> None:
    tuned = lines[f"RoPE, {PAIRS} pairs", 0.1].calibration
    before = lines["OT-only", 0.1].calibration
    assert tuned is not None
    assert before is not None
    assert tuned.shape == before.shape == (PAIRS,)
    assert tuned.mean() < before.mean()


def test_simulations_of_the_test_parameters_are_where_they_should_be(
    lines: dict[tuple[str, float | None], Loss],
) -> None:
    nearest = lines["transport alone (sees test labels)", 0.1].test
    untuned = lines["OT-only", 0.1].test
    assert nearest is not None
    assert untuned is not None
    assert nearest.mean() < untuned.mean()


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


def test_a_line_shows_what_there_is(
    lines: dict[tuple[str, float | None], Loss],
) -> None:
    columns = as_line(lines["SBI", None]).count("|")
    for loss in lines.values():
        assert as_line(loss).count("|") == columns
    assert "- | - |" in as_line(lines["SBI", None])
    bad = replace(lines["OT-only", 0.1], converged=False)
    assert "not converged" in as_line(bad)
