"""The choices inside the stack: what a run says of each."""

from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.cases import Case, Sources
from benchmarks.cells import Cell
from benchmarks.choices import CHOICES, Choice, Run, report, run
from benchmarks.store import Cache
from sbi_rope.errors import InvalidInputError
from sbi_rope.stacking import default_candidates, stacking_weights
from tests.stacks import quick

NAMES = tuple(candidate.name for candidate in default_candidates())
NUM_FOLDS = 5


def a_run(*, task: str = "pendulum", seed: int = 0, n: int = 6) -> Run:
    generator = torch.Generator().manual_seed(seed)
    shape = (NUM_FOLDS + 1, 9, len(NAMES))
    return Run(
        task=task,
        seed=seed,
        seconds=3.0,
        names=NAMES,
        fold=torch.arange(n) % NUM_FOLDS,
        held_out=torch.randn(n, len(NAMES), generator=generator).double(),
        others=torch.randn(shape, generator=generator).double(),
    )


def test_choices_leave_out_candidates_that_there_are() -> None:
    for choice in CHOICES.values():
        assert {*choice.without} < {*NAMES}


def test_the_choice_called_default_is_that_of_the_stack() -> None:
    (choice,) = (c for name, c in CHOICES.items() if name.endswith("(default)"))
    assert choice == Choice(without=(), pseudo_count=1.0, refit=None)
    assert choice is next(iter(CHOICES.values()))


def test_weights_are_those_of_the_candidates_that_are_kept() -> None:
    one = a_run()
    weights = Choice(without=("NPE", "prior"), pseudo_count=2.0).weights(one)
    kept = [k for k, name in enumerate(NAMES) if name not in ("NPE", "prior")]
    expected = stacking_weights(one.held_out[:, kept], pseudo_count=2.0).weights
    assert torch.equal(weights[kept], expected)
    assert float(weights.sum()) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("refit", "share"), [(None, 1 / 6), (0.0, 0.0), (0.5, 0.5), (1.0, 1.0)]
)
def test_a_stack_is_scored_as_a_mixture_of_candidates_and_versions(
    refit: float | None, share: float
) -> None:
    one = a_run()
    choice = Choice(refit=refit)
    versions = torch.tensor([(1 - share) / NUM_FOLDS] * NUM_FOLDS + [share]).double()
    density = torch.einsum("vmk,v->mk", one.others.exp(), versions)
    expected = float((density @ choice.weights(one)).log().mean())
    assert choice.score(one) == pytest.approx(expected, rel=1e-6)


def test_the_report_has_gains_over_the_first_choice() -> None:
    runs = [a_run(seed=1), a_run(seed=2), a_run(task="sir")]
    first, alone = report([*runs, a_run(n=8)]).split("8 pairs, 5 folds")
    assert "| choice | pendulum | mean |" in alone
    assert "| choice | pendulum | sir | mean |" in first
    rows = {line.split(" | ")[0]: line.split(" | ")[1:] for line in first.splitlines()}
    name, base = next(iter(CHOICES.items()))
    scores = [base.score(one) for one in runs]
    mean = (scores[0] + scores[1]) / 2
    assert rows[f"| {name}, LPP"][:2] == [f"{mean:.2f} (2)", f"{scores[2]:.2f} (1)"]
    best = [float(one.candidate_scores(1 / 6).mean(dim=0).max()) for one in runs]
    gains = [(best[0] + best[1]) / 2 - mean, best[2] - scores[2]]
    shown = [f"{gain:+.2f}" for gain in (*gains, sum(gains) / 2)]
    assert rows["| best single candidate"] == [*shown[:2], f"{shown[2]} |"]
    assert rows["| seconds"] == ["3", "3", "3 |"]


def test_a_run_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    one = a_run()
    arrays = {name: np.asarray(value) for name, value in vars(one).items()}
    np.savez(tmp_path / "run.npz", **arrays)
    found = Run.load(tmp_path / "run.npz")
    assert (found.task, found.seed, found.seconds) == ("pendulum", 0, 3.0)
    assert (found.names, found.num_folds) == (one.names, NUM_FOLDS)
    for name in ("fold", "held_out", "others"):
        assert torch.equal(getattr(found, name), getattr(one, name))


def test_a_damaged_run_is_refused_by_the_name_of_its_file(tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    for content in (b"", b"garbage", b"PK\x03\x04garbage"):
        path.write_bytes(content)
        with pytest.raises(InvalidInputError, match=r"run\.npz to hold a run"):
            Run.load(path)


def test_a_run_scores_pairs_that_the_stack_has_not_seen(tmp_path: Path) -> None:
    cell = Cell(task="linear_gaussian", preset="smoke", method="stack")
    case = Case.of(cell, Sources(), Cache(tmp_path), "cpu")
    with quick():
        found = run(case, n_calibration=6, num_folds=2, seed=1)
    assert {*found.names} < {*NAMES}
    assert found.held_out.shape == (6, len(found.names))
    assert found.others.shape == (3, 300, len(found.names))
    theta, _ = case.task.get_calibration_set(306, seed=1)
    prior = case.task.get_prior().log_prob(theta).double()
    unit = case.task.prior_std.log().sum().double()
    k = found.names.index("prior")
    for version in found.others:
        assert torch.allclose(version[:, k], prior[6:] + unit, atol=1e-4)
    # Held-out scores only weigh candidates; they keep theta's own unit.
    assert torch.allclose(found.held_out[:, k], prior[:6], atol=1e-4)
