"""Small stacks that tests share, and their candidates and data."""

import functools
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from sbi_rope import CalibrationFinetuner, RoPE, StackedPosterior
from sbi_rope.density import Density, Prior
from sbi_rope.discrepancy import DiscrepancyModel
from sbi_rope.discrepancy.correction import TRAINING
from sbi_rope.rope.finetuning import FINETUNING
from sbi_rope.stacking import Candidate, StackData, StackingReport, stack
from sbi_rope.stacking.candidates import REHEARSED, default_candidates
from sbi_rope.training.fit import Training
from tests import problems

QUIET: dict[str, Any] = {"show_progress_bars": False}
NUM_PAIRS, NUM_OBSERVED = 20, 25
NUM_FOLDS = 3  # more would take longer, and are no different
DEFAULTS: dict[str, Any] = {"num_folds": NUM_FOLDS, "seed": 0, **QUIET}


@contextmanager
def quick() -> Iterator[None]:
    """Train everything in a stack for a few steps only."""
    model = DiscrepancyModel(
        gain_precisions=(1.0,), error_scales=(0.1,), degrees_of_freedom=(3.0,)
    )
    correcting = Training(training_batch_size=50, learning_rate=5e-3, max_num_epochs=4)
    constants = {
        "stacking.data.NUM_SIMULATIONS": 300,
        "stacking.data.SIMULATIONS_PER_PAIR": 5,
        "stacking.data.DiscrepancyModel": lambda: model,
        "stacking.scoring.NUM_SAMPLES": 40,
        "stacking.candidates.TUNING": CalibrationFinetuner(
            rehearsal=1.0, learning_rate=0.02, max_num_epochs=3
        ),
        "stacking.candidates.FINETUNING": replace(FINETUNING, max_num_epochs=2),
        "stacking.candidates.REHEARSED": replace(REHEARSED, max_num_epochs=1),
        "rope.finetuning.STEPS_IN_EPOCH": 3,
        "discrepancy.correction.TRAINING": dict.fromkeys(TRAINING, correcting),
        "discrepancy.correction.NUM_DRAWS": 50,
        "discrepancy.correction.NUM_COMPARED": 50,
        "discrepancy.unlabelled.SEARCH": Training(max_num_epochs=5),
        "discrepancy.unlabelled.NUM_HESSIANS": 1,
        "discrepancy.unlabelled.NUM_COMPONENTS": 5,
    }
    with ExitStack() as patches:
        for name, value in constants.items():
            patches.enter_context(patch(f"sbi_rope.{name}", value))
        yield


# Tuning moves the net far enough that g differs from h.
QUICK = CalibrationFinetuner(
    max_num_epochs=6, simulations_per_target=3, learning_rate=0.03
)
# All kinds of default candidates.
CANDIDATES = default_candidates()
PRIOR, NPE = CANDIDATES[:2]


class Box(Candidate):
    """A box around the parameters of the pairs: a candidate in ten lines."""

    name = "box"

    def fit(self, data: StackData, versions: Sequence[Tensor]) -> list[Density]:
        theta = data.pairs.mean
        widths = [theta[rows].abs().amax(dim=0) + 0.1 for rows in versions]
        boxes = [problems.BoxUniform(-width, width) for width in widths]
        return [Prior(box, data.pairs.x.shape[1:]) for box in boxes]


# This candidate depends on the pairs and is quick to train.
BOX = Box()


def uneven(theta: Tensor) -> Tensor:
    """Simulate noisy readings, which take more random numbers at some theta.

    The simulations of later rows then depend on theta of all rows before.
    """
    rate = 10 * (1.5 + theta.sum(dim=1, keepdim=True)).clamp_min(0.1)
    return problems.simulate(theta) + 0.02 * (torch.poisson(rate) - rate)


def problem(n: int, *, seed: int, dim: int = 2) -> tuple[Tensor, Tensor]:
    """Return parameters, and real observations with a shift against simulations."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        theta = problems.box(dim).sample((n,))
        return theta, problems.simulate(theta) + 0.4


def rope_of(
    pairs: tuple[Tensor, Tensor] | None = None,
    *,
    family: str = "mdn",
    embedding: str = "linear",
    **options: Any,
) -> RoPE:
    """Return a RoPE that is not trained, because a stack does not need that."""
    names = {"theta_std", "weights", "groups"} & {*options}
    of_labels = {name: options.pop(name) for name in names}
    if "simulations" not in options:
        options.setdefault("simulator", uneven)
    options.setdefault("finetuner", QUICK)
    rope = RoPE(problems.npe_posterior(family, embedding), **options)
    pairs = problem(NUM_PAIRS, seed=1) if pairs is None else pairs
    return rope.append_calibration(*pairs, **of_labels)


def trained() -> RoPE:
    return rope_of().train(seed=0, **QUIET)


def observed(n: int = NUM_OBSERVED) -> Tensor:
    return problem(n, seed=2)[1]


def data_of(rope: RoPE, *, num_folds: int = 4) -> StackData:
    return StackData(rope, num_folds=num_folds, seed=0, **QUIET)


def stacked(rope: RoPE, x_o: Tensor | None = None, **options: Any) -> StackedPosterior:
    with quick():
        return stack(rope, x_o, **{**DEFAULTS, **options})


def validated(rope: RoPE, x_o: Tensor | None = None, **options: Any) -> StackingReport:
    return stacked(rope, x_o, **options).report


@functools.cache
def the_stack() -> StackedPosterior:
    """Return a stack for any observation. Tests share it and must not change it."""
    with torch.random.fork_rng():
        return stacked(rope_of())


@functools.cache
def small_stack() -> StackedPosterior:
    """Return a stack of three candidates, as shared; the last depends on the pairs."""
    with torch.random.fork_rng():
        return stacked(rope_of(), candidates=[PRIOR, NPE, BOX], num_folds=5)


def scores_of(report: StackingReport, name: str) -> Tensor:
    return report.log_scores[:, report.names.index(name)]


def unnormalised(posterior: Any, theta: Tensor, x: Tensor) -> Tensor:
    return posterior.log_prob_batched(theta, x, norm_posterior=False).detach()
