"""A stack that was interrupted goes on where it was, and only with its own results."""

import copy
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import torch
from torch import Tensor

from sbi_rope import RoPE, StackedPosterior
from sbi_rope._sbi import headless
from sbi_rope.errors import (
    InvalidInputError,
    NotWritableError,
    RoPEWarning,
)
from sbi_rope.mixture import Part, part_of_prior
from sbi_rope.stacking import (
    AmortisedCandidate,
    DiscrepancyCandidate,
    FinetunedCandidate,
    RVNPCandidate,
)
from sbi_rope.stacking.folds import Fold
from tests import problems
from tests.stacks import (
    FINETUNED,
    NPE,
    NUM_FOLDS,
    OT_ONLY,
    PRIOR,
    QUICK,
    in_this_process,
    observed,
    problem,
    rope_of,
    stacked,
    uneven,
    validated,
)

ROOT = Path(__file__).parents[2]

# Whatever else warns here, because there are few pairs and simulations.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")

CANDIDATES = (PRIOR, NPE, FinetunedCandidate(), DiscrepancyCandidate(space="tuned"))
# Trainings of CANDIDATES that are kept, and their number before an interruption.
NUM_KEPT, NUM_BEFORE = 2 * (NUM_FOLDS + 1), 3


@contextmanager
def trainings(*, stop: Any = None) -> Iterator[list[str]]:
    """List the trainings in a ``with`` block, and stop after some."""
    names: list[str] = []

    def listed(original: Any) -> Any:
        def parts(self: AmortisedCandidate, fold: Fold) -> list[Part]:
            if stop is not None and len(names) == NUM_BEFORE:
                stop()
            names.append(self.name)
            return original(self, fold)

        return parts

    kinds = (FinetunedCandidate, DiscrepancyCandidate)
    patches = [patch.object(kind, "parts", listed(kind.parts)) for kind in kinds]
    with patches[0], patches[1]:
        yield names


def interrupt() -> None:
    raise KeyboardInterrupt


def num_trained(folder: Path, rope: RoPE | None = None, **options: Any) -> int:
    """Return how many trainings a stack with checkpoints takes."""
    options = {"candidates": CANDIDATES, **options}
    with trainings() as names:
        stacked(rope_of() if rope is None else rope, checkpoints=folder, **options)
    return len(names)


def numbers(posterior: StackedPosterior) -> list[Tensor]:
    theta, x = problem(4, seed=3)
    torch.manual_seed(0)
    samples = posterior.sample_batched((3,), x, show_progress_bars=False)
    log_prob = posterior.log_prob_batched(theta[None], x)
    return [posterior.report.cross_validation.log_scores, samples, log_prob.detach()]


def assert_same(a: StackedPosterior, b: StackedPosterior) -> None:
    assert all(torch.equal(*pair) for pair in zip(numbers(a), numbers(b), strict=True))


ELSEWHERE = """
import os, sys
from tests.integration.test_stacking_checkpoints import CANDIDATES, rope_of
from tests.integration.test_stacking_checkpoints import stacked, trainings
with trainings(stop=lambda: os._exit(7)):
    stacked(rope_of(), candidates=CANDIDATES, checkpoints=sys.argv[1])
"""


@pytest.mark.medium
def test_a_stack_goes_on_where_another_process_was_killed(tmp_path: Path) -> None:
    killed = subprocess.run(
        [sys.executable, "-c", ELSEWHERE, str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, "PYTHONHASHSEED": "3"},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert killed.returncode == 7, killed.stderr
    rope = rope_of()
    with trainings() as names:
        resumed = stacked(rope, candidates=CANDIDATES, checkpoints=tmp_path)
    assert len(names) == NUM_KEPT - NUM_BEFORE
    assert_same(resumed, stacked(rope_of(), candidates=CANDIDATES))


def test_what_was_trained_before_an_interruption_is_not_trained_again(
    tmp_path: Path,
) -> None:
    with trainings(stop=interrupt), pytest.raises(KeyboardInterrupt):
        num_trained(tmp_path)
    assert num_trained(tmp_path) == NUM_KEPT - NUM_BEFORE
    assert num_trained(tmp_path) == 0
    # A candidate more, or less, is no reason to train the others again.
    assert num_trained(tmp_path, candidates=CANDIDATES[1:3]) == 0
    more = (*CANDIDATES, FinetunedCandidate(space="embedding"))
    assert num_trained(tmp_path, candidates=more) == NUM_FOLDS + 1
    with trainings() as names:
        validated(rope_of(), candidates=CANDIDATES, checkpoints=tmp_path)
        stacked(
            rope_of(),
            observed(),
            candidates=[*CANDIDATES, OT_ONLY],
            checkpoints=tmp_path,
        )
    assert not names


def other_simulator(theta: Tensor) -> Tensor:
    return problems.simulate(theta) * 1.001


def other_pairs() -> tuple[Tensor, Tensor]:
    theta, x = problem(20, seed=1)
    return theta, x.index_fill(0, torch.tensor([3]), 0.1)


def of_other_density() -> RoPE:
    """Return a RoPE whose NPE has the same embedding net, and another density."""
    npe = copy.deepcopy(problems.npe_posterior("mdn"))
    with torch.no_grad():
        next(headless(npe.posterior_estimator).parameters()).add_(0.01)
    rope = RoPE(npe, simulator=uneven, finetuner=QUICK)
    return rope.append_calibration(*problem(20, seed=1))


OTHERS: dict[str, Callable[[], RoPE]] = {
    "pairs": lambda: rope_of(other_pairs()),
    "weights": lambda: rope_of(weights=torch.linspace(0.5, 1.5, 20)),
    "groups": lambda: rope_of(groups=[n // 2 for n in range(20)]),
    "embedding net": lambda: rope_of(family="maf"),
    "density": of_other_density,
    "simulator": lambda: rope_of(simulator=other_simulator),
}
# Fine-tuned NPE depends on no simulation.
CORRECTED = CANDIDATES[3:]
OPTIONS: dict[str, dict[str, Any]] = {"seed": {"seed": 1}, "folds": {"num_folds": 4}}


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all that a stack has trained."""
    folder = tmp_path_factory.mktemp("full")
    assert num_trained(folder, candidates=CORRECTED) == NUM_FOLDS + 1
    return folder


@pytest.mark.parametrize("other", [*OTHERS, *OPTIONS])
def test_a_stack_takes_nothing_of_a_stack_of_others(full: Path, other: str) -> None:
    rope, options = OTHERS.get(other, rope_of)(), OPTIONS.get(other, {})
    with pytest.warns(RoPEWarning, match=r"trained candidates of other stacks"):
        found = num_trained(full, rope, candidates=CORRECTED, **options)
    assert found == 1 + options.get("num_folds", NUM_FOLDS)


def test_the_observations_that_a_candidate_learns_from_are_part_of_it(
    tmp_path: Path,
) -> None:
    # NumPy does not print the middle of so many.
    x_o: Any = problem(1000, seed=2)[1].numpy()
    box = part_of_prior(problems.box(2), torch.Size(x_o.shape[1:]))

    def trained() -> bool:
        # It takes minutes to train this one.
        with patch.object(RVNPCandidate, "parts", return_value=[box]) as parts:
            stacked(rope_of(), candidates=[RVNPCandidate(x_o)], checkpoints=tmp_path)
        return parts.called

    assert trained()
    assert not trained()
    x_o[500] += 1.0
    assert trained()


class Mine(FinetunedCandidate):
    """A candidate of the user, whose code may change."""

    def parts(self, fold: Fold) -> list[Part]:
        MINE.append(self.name)
        return [part_of_prior(problems.box(2), fold.bench.x.shape[1:])]


MINE: list[str] = []


def test_candidates_of_the_user_are_trained_again(tmp_path: Path) -> None:
    MINE.clear()
    for _ in range(2):
        stacked(rope_of(), candidates=[Mine(), FINETUNED], checkpoints=tmp_path)
    assert len(MINE) == 2 * (NUM_FOLDS + 1)
    assert not list(tmp_path.iterdir())


def test_a_simulator_with_a_generator_of_its_own_is_seen_to_differ(
    tmp_path: Path,
) -> None:
    generator = np.random.default_rng(0)

    def simulator(theta: Tensor) -> Tensor:
        noise = torch.as_tensor(generator.normal(size=(len(theta), 1)))
        return problems.simulate(theta) + noise.to(theta)

    rope = rope_of(simulator=simulator)
    assert num_trained(tmp_path, rope) == NUM_KEPT
    # It keeps the simulations from the prior, and simulates at the labels again.
    with pytest.warns(RoPEWarning, match="of other stacks"):
        again = num_trained(tmp_path, rope, candidates=CORRECTED)
    assert again == NUM_FOLDS + 1


def test_a_prior_that_was_asked_something_is_the_same_prior(tmp_path: Path) -> None:
    npe = copy.deepcopy(problems.npe_posterior("mdn"))
    npe.prior = problems.standard_normal(2)
    rope = RoPE(npe, simulator=uneven, finetuner=QUICK)
    rope.append_calibration(*problem(20, seed=1))
    assert num_trained(tmp_path, rope) == NUM_KEPT
    before = len(vars(npe.prior))
    assert npe.prior.precision_matrix.shape == (2, 2)
    assert len(vars(npe.prior)) > before
    assert num_trained(tmp_path, rope) == 0


def test_a_damaged_checkpoint_is_put_aside_and_trained_again(tmp_path: Path) -> None:
    expected = stacked(rope_of(), candidates=CANDIDATES, checkpoints=tmp_path)
    damaged = sorted(tmp_path.glob("*.pt"))[0]
    content = damaged.read_bytes()[:-100]
    damaged.write_bytes(content)
    with (
        trainings() as names,
        pytest.warns(RoPEWarning, match=r"'discrepancy.*is damaged"),
    ):
        found = stacked(rope_of(), candidates=CANDIDATES, checkpoints=tmp_path)
    assert names == ["discrepancy (tuned)"]
    assert_same(found, expected)
    assert damaged.with_name(f"{damaged.name}.damaged-1").read_bytes() == content


def test_a_stack_goes_on_if_its_checkpoints_cannot_be_written(tmp_path: Path) -> None:
    folder = tmp_path / "checkpoints"

    def replace() -> None:
        shutil.rmtree(folder)
        folder.touch()  # a file, so that nothing can be written there

    with trainings(stop=replace) as names, pytest.warns(RoPEWarning) as warned:
        stacked(rope_of(), candidates=CANDIDATES, checkpoints=folder)
    assert len(names) == NUM_KEPT
    written = [one for one in warned if "was not written" in str(one.message)]
    assert len(written) == 1


def test_copies_of_folds_in_other_processes_keep_what_they_train(
    tmp_path: Path,
) -> None:
    with patch("sbi_rope.stacking.workers.in_workers", in_this_process):
        assert num_trained(tmp_path, num_workers=2) == NUM_KEPT
    assert num_trained(tmp_path) == 0


def test_checkpoints_that_cannot_be_kept_are_refused_before_training(
    tmp_path: Path,
) -> None:
    file = tmp_path / "file"
    file.touch()
    npe = copy.deepcopy(problems.npe_posterior("mdn"))
    npe.posterior_estimator.function = lambda: 0
    rope = RoPE(npe, simulator=uneven).append_calibration(*problem(20, seed=1))
    refused: list[tuple[type[Exception], str, dict[str, Any]]] = [
        (InvalidInputError, r"a `seed` together with", {"seed": None}),
        (InvalidInputError, r"`checkpoints` to be a path", {"checkpoints": 3}),
        (NotWritableError, r"where one can be made", {"checkpoints": file}),
        (InvalidInputError, r"NPE that can be described.*function", {"rope": rope}),
    ]
    for error, match, options in refused:
        given = {"rope": rope_of(), "checkpoints": tmp_path, **options}
        with trainings() as names, pytest.raises(error, match=match):
            stacked(candidates=CANDIDATES, **given)
        assert not names
