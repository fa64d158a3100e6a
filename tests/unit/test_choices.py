"""The choices inside the stack: what a run says of each."""

from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.cases import Case, Sources
from benchmarks.cells import Cell
from benchmarks.choices import CHOICES, Choice, Run, candidates, report, run
from benchmarks.store import Cache
from sbi_rope.stacking import CouplingCandidate, default_candidates, stacking_weights

NAMES = tuple(candidate.name for candidate in candidates())


def a_run(*, task: str = "pendulum", seed: int = 0, n: int = 6) -> Run:
    generator = torch.Generator().manual_seed(seed)
    return Run(
        task=task,
        seed=seed,
        num_folds=5,
        names=NAMES,
        held_out=torch.randn(n, len(NAMES), generator=generator).double(),
        others=torch.randn(9, len(NAMES), generator=generator).double(),
        mass=torch.rand(9, len(NAMES), generator=generator).double(),
    )


def test_the_wide_grid_contains_the_candidates_of_all_choices() -> None:
    for choice in CHOICES.values():
        kept = [c for c in candidates() if choice.keeps(c)]
        couplings = [c for c in kept if isinstance(c, CouplingCandidate)]
        nets = 1 + choice.untuned + choice.rehearsal
        assert len(couplings) == nets * len(choice.gammas) * len(choice.taus)
        assert len(kept) == len(couplings) + 4


def test_the_choice_called_default_is_that_of_the_stack() -> None:
    (choice,) = (c for name, c in CHOICES.items() if name.endswith("(default)"))
    kept = {c.name for c in candidates() if choice.keeps(c)}
    assert kept == {c.name for c in default_candidates()}
    assert choice.pseudo_count == 1.0


def test_weights_are_those_of_the_candidates_that_are_kept() -> None:
    one, choice = a_run(), Choice(gammas=(0.1,), taus=(1.0,), pseudo_count=2.0)
    weights = choice.weights(one)
    kept = [k for k, c in enumerate(candidates()) if choice.keeps(c)]
    assert len(kept) == 2 + 4
    expected = stacking_weights(one.held_out[:, kept], pseudo_count=2.0).weights
    assert torch.equal(weights[kept], expected)
    assert float(weights.sum()) == pytest.approx(1.0)


def test_a_stack_is_scored_as_a_mixture_that_is_normalised() -> None:
    one = a_run()
    weights = torch.rand(len(NAMES)).double()
    weights /= weights.sum()
    density = (one.others.exp() * weights).sum(dim=1)
    mass = (one.mass * weights).sum(dim=1)
    expected = float((density / mass).log().mean())
    assert one.score(weights) == pytest.approx(expected, rel=1e-6)


def test_one_candidate_alone_is_scored_as_itself() -> None:
    one = a_run()
    weights = torch.zeros(len(NAMES)).double()
    weights[3] = 1.0
    assert one.score(weights) == pytest.approx(float(one.scores()[3]), rel=1e-6)


def test_the_report_has_gains_over_the_first_choice() -> None:
    runs = [a_run(seed=1), a_run(seed=2), a_run(task="sir")]
    first, alone = report([*runs, a_run(n=8)]).split("8 pairs, 5 folds:")
    assert "| pendulum (1) | mean" in alone
    assert "| pendulum (2) | sir (1) | mean | worst |" in first
    rows = {line.split(" | ")[0]: line.split(" | ")[1:] for line in first.splitlines()}
    base = next(iter(CHOICES.values()))
    scores = [one.score(base.weights(one)) for one in runs]
    shown = rows[f"| {next(iter(CHOICES))}"]
    assert shown[0] == f"{(scores[0] + scores[1]) / 2:.2f}"
    best = [float(one.scores().max()) for one in runs]
    gains = [(sum(best[:2]) - sum(scores[:2])) / 2, best[2] - scores[2]]
    shown = rows["| best single candidate for these pairs"]
    assert shown[:3] == [f"{g:+.2f}" for g in (*gains, sum(gains) / 2)]
    assert shown[3] == f"{min(gains):+.2f} |"


def test_a_run_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    one = a_run()
    arrays = {name: np.asarray(value) for name, value in vars(one).items()}
    np.savez(tmp_path / "run.npz", **arrays)
    found = Run.load(tmp_path / "run.npz")
    assert (found.task, found.seed, found.num_folds) == ("pendulum", 0, 5)
    assert found.names == one.names
    assert torch.equal(found.held_out, one.held_out)
    assert torch.equal(found.mass, one.mass)


@pytest.mark.slow
def test_a_run_scores_pairs_that_the_stack_has_not_seen(tmp_path: Path) -> None:
    cell = Cell(task="linear_gaussian", preset="smoke", method="stack")
    case = Case.of(cell, Sources(), Cache(tmp_path), "cpu")
    found = run(case, n_calibration=6, num_folds=2, seed=1)
    assert set(found.names) == set(NAMES)
    assert found.held_out.shape == (6, len(NAMES))
    assert found.others.shape == found.mass.shape == (300, len(NAMES))
    assert (found.mass <= 1.0 + 1e-6).all()
    theta, _ = case.task.get_calibration_set(306, seed=1)
    prior = case.task.get_prior().log_prob(theta).double()
    unit = case.task.prior_std.log().sum().double()
    k = found.names.index("prior")
    assert torch.allclose(found.others[:, k], prior[6:] + unit, atol=1e-4)
    # In random order, as the folds are.
    held_out = found.held_out[:, k].sort().values
    assert torch.allclose(held_out, prior[:6].sort().values, atol=1e-4)
