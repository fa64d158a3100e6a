"""Scores of cells on the test set, and what they cost."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from benchmarks.cases import Case, Pairs
from benchmarks.cells import Cell
from benchmarks.methods import (
    GIVEN_PRIOR_STACK,
    METHODS,
    OBSERVED_STACK,
    STACK,
    STACKS,
    append_data,
)
from sbi_rope import RoPE, SinkhornCoupler
from sbi_rope.baselines import ReferenceNPE
from sbi_rope.metrics import Evaluation, evaluate
from sbi_rope.stacking import StackedPosterior, default_candidates, stack

__all__ = ["Failure", "Score", "scores"]


@dataclass(frozen=True, kw_only=True)
class Score:
    """The scores of a cell on the test set, and what it cost.

    Attributes:
        cell: The cell.
        posterior: The posterior that was scored.
        test_set: The pairs it was scored on.
        evaluation: Its scores.
        train_seconds: Training, without that of the NPE that methods share; of RoPE the
            fine-tuning, which the couplings of a sweep share.
        couple_seconds: Simulating and coupling.
        test_seconds: Sampling and evaluating the posteriors of the test set.
        num_simulations: Simulations behind the posterior, those of the shared NPE
            included.
        shares_npe: Whether it starts from the NPE that methods share.
        converged: Whether the coupling has converged; True without one.
        arrays: What else is kept of it, by name.
    """

    cell: Cell
    posterior: Any
    test_set: Pairs
    evaluation: Evaluation
    train_seconds: float
    test_seconds: float
    num_simulations: int
    couple_seconds: float = 0.0
    shares_npe: bool = True
    converged: bool = True
    arrays: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A cell that could not be scored, and why."""

    cell: Cell
    error: Exception


def scores(case: Case, cells: Sequence[Cell]) -> Iterator[Score | Failure]:
    """Score cells that differ in gamma and tau only, each when it is asked for.

    A posterior that cannot be scored is a failure of its cell alone.

    Raises:
        Exception: Whatever stops all cells, such as a failing training.
    """
    method = case.cell.method
    if METHODS[method].couples:
        yield from _coupled_scores(case, cells)
    else:
        score = _stack_score if method in STACKS else _score
        for cell in cells:
            yield score(case, cell)


def _score(case: Case, cell: Cell) -> Score:
    pairs = case.test_set
    count = _Count(case)
    build = METHODS[cell.method].build
    assert build is not None
    method = build(case)
    start = time.perf_counter()
    used, shares_npe = append_data(method, cell.method, case)
    method.train(seed=case.seed, show_progress_bars=False)
    posterior = method.build_posterior()
    seconds = time.perf_counter() - start
    used += count.new
    if isinstance(method, ReferenceNPE):
        if case.simulator is None:
            assert case.held_out is not None
            pairs = case.held_out
        else:
            pairs = method.simulated_test_set(pairs[0], case.simulator, seed=case.seed)
    return _scored(
        case,
        cell,
        posterior,
        pairs,
        train_seconds=seconds,
        num_simulations=used,
        shares_npe=shares_npe,
    )


def _coupled_scores(case: Case, cells: Sequence[Cell]) -> Iterator[Score | Failure]:
    count = _Count(case)
    start = time.perf_counter()
    rope = _trained_rope(case)
    train_seconds = time.perf_counter() - start
    trained = count.new
    for cell in cells:
        before, start = count.new, time.perf_counter()
        try:
            posterior = _coupled(rope, case, cell)
            couple_seconds = time.perf_counter() - start
            used = len(case.simulations[0]) + trained + count.new - before
            yield _scored(
                case,
                cell,
                posterior,
                case.test_set,
                train_seconds=train_seconds,
                couple_seconds=couple_seconds,
                num_simulations=used,
                converged=posterior.coupling.converged,
            )
        except Exception as error:  # such as no mass inside the prior's support
            yield Failure(cell=cell, error=error)


def _coupled(rope: RoPE, case: Case, cell: Cell) -> Any:
    assert cell.gamma is not None
    assert cell.tau is not None
    coupler = SinkhornCoupler(
        gamma=cell.gamma,
        tau=cell.tau,
        cost_scale=cell.cost_scale,  # type: ignore[arg-type]
    )
    return rope.build_posterior(
        case.test_set[1],
        coupler=coupler,
        seed=case.seed,
        show_progress_bars=False,
    )


def _trained_rope(case: Case) -> RoPE:
    """Return what couples in RoPE and OT-only, trained as far as it is."""
    if not METHODS[case.cell.method].pairs:
        return _rope_of(case)
    rope = _rope_of(case).append_calibration(*case.calibration)
    return rope.train(seed=case.seed, show_progress_bars=False)


def _rope_of(case: Case) -> RoPE:
    """Return RoPE on a case, without calibration pairs."""
    return RoPE(
        case.npe,
        simulator=case.simulator,
        simulations=case.stored if case.simulator is None else None,
        finetuner=case.settings.finetuner,
    )


def _stack_score(case: Case, cell: Cell) -> Score:
    count = _Count(case)
    start = time.perf_counter()
    rope = _rope_of(case).append_calibration(*case.calibration)
    candidates = None
    if cell.method == GIVEN_PRIOR_STACK:
        candidates = default_candidates(rope, learn_prior=False)
    elif cell.method == OBSERVED_STACK:
        candidates = default_candidates(rope, case.test_set[1])
    posterior = stack(
        rope,
        candidates=candidates,
        num_folds=case.settings.num_folds,
        seed=case.seed,
        show_progress_bars=False,
    )
    train_seconds = time.perf_counter() - start
    score = _scored(
        case,
        cell,
        posterior,
        case.test_set,
        train_seconds=train_seconds,
        num_simulations=len(case.simulations[0]) + count.new,
    )
    return replace(score, arrays=_candidates(case, posterior))


def _candidates(case: Case, posterior: StackedPosterior) -> dict[str, np.ndarray]:
    """Return how each candidate of a stack did, on held-out pairs and on the test set.

    The stack itself comes last. In standard deviations of the prior.
    """
    report = posterior.report
    unit = float(case.task.prior_std.log().sum())
    test = posterior.candidate_log_probs(*case.test_set)
    stack = report.held_out.log_prob[:, None]
    scores = torch.cat([report.log_scores, stack], dim=1)
    return {
        "candidates": np.array([*report.names, STACK]),
        "weights": np.array([*report.weights.weights.tolist(), np.nan]),
        "held_out": (scores.mean(dim=0) + unit).cpu().numpy(),
        "held_out_error": (scores.std(dim=0) / len(scores) ** 0.5).cpu().numpy(),
        "test": (test.mean(dim=0) + unit).cpu().numpy(),
    }


class _Count:
    """How many simulations were made since."""

    def __init__(self, case: Case) -> None:
        self.simulator = case.simulator
        self.before = 0 if self.simulator is None else self.simulator.count

    @property
    def new(self) -> int:
        return 0 if self.simulator is None else self.simulator.count - self.before


def _scored(
    case: Case, cell: Cell, posterior: Any, pairs: Pairs, **costs: Any
) -> Score:
    start = time.perf_counter()
    evaluation = evaluate(
        posterior,
        *pairs,
        theta_std=case.task.prior_std.to(pairs[0]),
        num_samples=case.settings.num_samples,
        seed=case.seed,
    )
    return Score(
        cell=cell,
        posterior=posterior,
        test_set=pairs,
        evaluation=evaluation,
        test_seconds=time.perf_counter() - start,
        **costs,
    )
