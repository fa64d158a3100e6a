"""Scores of cells on the test set, and what they cost."""

import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.cases import Case
from benchmarks.cells import NEEDS_COUPLING, Cell
from benchmarks.methods import COUPLED_STACK, METHODS, STACK
from sbi_rope import RoPE, SinkhornCoupler
from sbi_rope.baselines import ReferenceNPE
from sbi_rope.metrics import Evaluation, evaluate
from sbi_rope.stacking import StackedPosterior, stack
from sbi_rope.sweep import sweep

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
    test_set: tuple[Tensor, Tensor]
    evaluation: Evaluation
    train_seconds: float
    couple_seconds: float
    test_seconds: float
    num_simulations: int
    shares_npe: bool
    converged: bool = True
    arrays: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A cell that could not be scored, and why."""

    cell: Cell
    error: Exception


def scores(
    case: Case, cells: Sequence[Cell], group: Sequence[Cell]
) -> Iterator[Score | Failure]:
    """Score cells that differ in gamma and tau only, each when it is asked for.

    The sweep over gamma and tau passes by all of ``group``, of which ``cells`` are a
    part.

    A posterior that cannot be scored is a failure of its cell alone.

    Raises:
        Exception: Whatever stops all cells, such as a failing training.
    """
    if case.cell.method in NEEDS_COUPLING:
        yield from _coupled_scores(case, cells, group)
    elif case.cell.method in (STACK, COUPLED_STACK):
        for cell in cells:
            yield _stack_score(case, cell)
    else:
        for cell in cells:
            yield _score(case, cell)


def _score(case: Case, cell: Cell) -> Score:
    theta, x_o = case.test_set
    pairs = (theta, x_o)
    count = _Count(case)
    method = METHODS[cell.method](case)
    start = time.perf_counter()
    if method.needs_simulations:
        # Without a simulator, tuning-only looks targets up among stored simulations.
        stored = cell.method == "tuning-only"
        method.append_simulations(*(case.stored if stored else case.simulations))
    if "calibration" in method.sees:
        method.append_calibration(*case.calibration)
    if "observations" in method.sees:
        method.append_observations(x_o)
    method.train(seed=case.seed, show_progress_bars=False)
    posterior = method.build_posterior()
    seconds = time.perf_counter() - start
    used = len(case.simulations[0]) if "simulations" in method.sees else 0
    used += count.new
    if isinstance(method, ReferenceNPE):
        if case.simulator is None:
            assert case.held_out is not None
            pairs = case.held_out
        else:
            pairs = method.simulated_test_set(theta, case.simulator, seed=case.seed)
    evaluation, test_seconds = _evaluate(case, posterior, pairs)
    return Score(
        cell=cell,
        posterior=posterior,
        test_set=pairs,
        evaluation=evaluation,
        train_seconds=seconds,
        couple_seconds=0.0,
        test_seconds=test_seconds,
        num_simulations=used,
        shares_npe=method.starts_from_npe,
    )


def _coupled_scores(
    case: Case, cells: Sequence[Cell], group: Sequence[Cell]
) -> Iterator[Score | Failure]:
    count = _Count(case)
    rope = _rope(case)
    start = time.perf_counter()
    if case.cell.method == "RoPE":
        rope.append_calibration(*case.calibration)
        rope.train(seed=case.seed, show_progress_bars=False)
    train_seconds = time.perf_counter() - start
    wanted = {(cell.gamma, cell.tau): cell for cell in cells}
    # One sweep over all, from large gammas to small: it simulates and normalises once.
    gammas = sorted({cell.gamma for cell in group if cell.gamma}, reverse=True)
    taus = sorted({cell.tau for cell in group if cell.tau is not None}, reverse=True)
    start = time.perf_counter()
    posteriors = sweep(
        rope,
        case.test_set[1],
        gammas=gammas,
        taus=taus,
        coupler=SinkhornCoupler(cost_scale=case.cell.cost_scale),  # type: ignore[arg-type]
        seed=case.seed,
        require_convergence=False,
        show_progress_bars=False,
    )
    used = len(case.simulations[0]) + count.new
    settings = itertools.product(gammas, taus)
    for setting, posterior in zip(settings, posteriors, strict=True):
        couple_seconds = time.perf_counter() - start
        cell = wanted.get(setting)
        if cell is not None:
            try:
                evaluation, test_seconds = _evaluate(case, posterior, case.test_set)
            except Exception as error:  # such as no mass inside the prior's support
                yield Failure(cell=cell, error=error)
            else:
                yield Score(
                    cell=cell,
                    posterior=posterior,
                    test_set=case.test_set,
                    evaluation=evaluation,
                    train_seconds=train_seconds,
                    couple_seconds=couple_seconds,
                    test_seconds=test_seconds,
                    num_simulations=used,
                    converged=posterior.coupling.converged,
                    shares_npe=True,
                )
        start = time.perf_counter()


def _rope(case: Case) -> RoPE:
    return RoPE(
        case.npe,
        simulator=case.simulator,
        simulations=case.stored if case.simulator is None else None,
        finetuner=case.settings.finetuner,
    )


def _stack_score(case: Case, cell: Cell) -> Score:
    batch = case.test_set[1] if cell.method == COUPLED_STACK else None
    count = _Count(case)
    start = time.perf_counter()
    rope = _rope(case).append_calibration(*case.calibration)
    posterior = stack(rope, batch, seed=case.seed, show_progress_bars=False)
    train_seconds = time.perf_counter() - start
    evaluation, test_seconds = _evaluate(case, posterior, case.test_set)
    return Score(
        cell=cell,
        posterior=posterior,
        test_set=case.test_set,
        evaluation=evaluation,
        train_seconds=train_seconds,
        couple_seconds=0.0,
        test_seconds=test_seconds,
        num_simulations=len(case.simulations[0]) + count.new,
        shares_npe=True,
        arrays=_candidates(case, posterior),
    )


def _candidates(case: Case, posterior: StackedPosterior) -> dict[str, np.ndarray]:
    """Return how each candidate of a stack did, on held-out pairs and on the test set.

    The stack itself comes last. In standard deviations of the prior.
    """
    held_out = posterior.report.cross_validation
    unit = float(case.task.prior_std.log().sum())
    test = posterior.candidate_log_probs(*case.test_set)
    scores = torch.cat([held_out.log_scores, held_out.stack_scores[:, None]], dim=1)
    return {
        "candidates": np.array([*held_out.names, STACK]),
        "weights": np.array([*held_out.weights.weights.tolist(), np.nan]),
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


def _evaluate(
    case: Case, posterior: Any, pairs: tuple[Tensor, Tensor]
) -> tuple[Evaluation, float]:
    start = time.perf_counter()
    evaluation = evaluate(
        posterior,
        *pairs,
        theta_std=case.task.prior_std.to(pairs[0]),
        num_samples=case.settings.num_samples,
        seed=case.seed,
    )
    return evaluation, time.perf_counter() - start
