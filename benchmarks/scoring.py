"""Scores of cells on the test set, and what they cost."""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from benchmarks.cases import Case, Pairs
from benchmarks.cells import Cell
from benchmarks.methods import (
    GIVEN_PRIOR_STACK,
    LOOK_UP,
    METHODS,
    OBSERVED_STACK,
    STACKS,
)
from benchmarks.store import Result
from sbi_rope import RoPE, SinkhornCoupler
from sbi_rope.baselines import ReferenceNPE
from sbi_rope.methods import Method
from sbi_rope.metrics import evaluate
from sbi_rope.stacking import StackedPosterior, default_candidates, stack


def score(case: Case, cells: Sequence[Cell]) -> Iterator[Result]:
    """Score cells that share a training, each when it is asked for.

    A coupling that fails is a failure of its cell alone.

    Raises:
        Exception: Whatever stops all cells, such as a failing training.
    """
    if METHODS[case.cell.method].couples:
        return _score_couplings(case, cells)
    score_one = _score_stack if case.cell.method in STACKS else _score_method
    return (score_one(case, cell) for cell in cells)


def failure(cell: Cell, error: Exception) -> Result:
    """Return the result of a cell that could not be scored."""
    text = f"{type(error).__name__}: {error}"
    return Result({**asdict(cell), "status": "failed", "error": text}, {})


def _score_method(case: Case, cell: Cell) -> Result:
    build = METHODS[cell.method].build
    assert build is not None
    method = build(case)
    start = time.process_time()
    _append_data(method, case)
    method.train(seed=case.seed, show_progress_bars=False)
    posterior = method.build_posterior()
    costs = {
        "seconds_npe": case.npe_seconds if method.starts_from_npe else 0.0,
        "seconds_train": time.process_time() - start,
        "num_simulations": case.num_simulated
        + ("simulations" in method.sees) * len(case.simulations[0]),
    }
    pairs = case.test_set
    if isinstance(method, ReferenceNPE):
        if case.simulator is None:
            pairs = case.held_out
        else:
            pairs = method.simulated_test_set(pairs[0], case.simulator, seed=case.seed)
    return _result(case, cell, posterior, pairs, **costs)


def _append_data(method: Method, case: Case) -> None:
    """Give a method all data that it can see."""
    if method.needs_simulations:
        stored = case.cell.method in LOOK_UP
        method.append_simulations(*(case.stored if stored else case.simulations))
    if "calibration" in method.sees:
        method.append_calibration(*case.calibration)
    if "observations" in method.sees:
        method.append_observations(case.test_set[1])


def _rope_of(case: Case) -> RoPE:
    """Return RoPE on a case, with the pairs that its method sees."""
    rope = RoPE(
        case.npe,
        simulator=case.simulator,
        simulations=case.stored if case.simulator is None else None,
        finetuner=case.settings.finetuner,
    )
    if METHODS[case.cell.method].pairs:
        # Who measured labels knows their error, and says so.
        noise = case.task.label_noise * case.task.prior_std.to(case.device)
        rope.append_calibration(
            *case.calibration, theta_std=noise if noise.any() else None
        )
    return rope


def _score_couplings(case: Case, cells: Sequence[Cell]) -> Iterator[Result]:
    rope = _rope_of(case)
    start = time.process_time()
    if METHODS[case.cell.method].pairs:
        rope.train(seed=case.seed, show_progress_bars=False)
    train_seconds = time.process_time() - start
    trained = case.num_simulated
    for cell in cells:
        before, start = case.num_simulated, time.process_time()
        assert cell.gamma is not None
        assert cell.tau is not None
        try:
            posterior = rope.build_posterior(
                case.test_set[1],
                coupler=SinkhornCoupler(
                    gamma=cell.gamma,
                    tau=cell.tau,
                    cost_scale=cell.cost_scale,  # type: ignore[arg-type]
                ),
                seed=case.seed,
                show_progress_bars=False,
            )
            made = trained + case.num_simulated - before
            yield _result(
                case,
                cell,
                posterior,
                case.test_set,
                converged=posterior.coupling.converged,
                seconds_npe=case.npe_seconds,
                seconds_train=train_seconds,
                seconds_couple=time.process_time() - start,
                num_simulations=len(case.simulations[0]) + made,
            )
        except Exception as error:  # such as no mass inside the prior's support
            yield failure(cell, error)


def _score_stack(case: Case, cell: Cell) -> Result:
    rope = _rope_of(case)
    start = time.process_time()
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
    costs = {
        "seconds_npe": case.npe_seconds,
        "seconds_train": time.process_time() - start,
        "num_simulations": len(case.simulations[0]) + case.num_simulated,
    }
    beside = _beside_candidates(case, posterior)
    return _result(case, cell, posterior, case.test_set, **costs, **beside)


def _beside_candidates(case: Case, posterior: StackedPosterior) -> dict[str, float]:
    """Return what a stack is compared with, in standard deviations of the prior.

    These are its score on hold-out pairs, and on the test set the scores of the best of
    its candidates and of the better of prior and NPE.
    """
    unit = float(case.task.prior_std.log().sum())
    report = posterior.report
    held_out = report.held_out.log_prob
    device = posterior.posterior_estimator.device
    theta, x = (one.to(device) for one in case.test_set)
    of_each = {
        name: float(one.average.log_prob(theta[None], x).double().mean()) + unit
        for name, one in zip(report.names, posterior.versions, strict=True)
    }
    basics = [of_each[name] for name in ("prior", "NPE") if name in of_each]
    return {
        "held_out": float(held_out.mean()) + unit,
        "held_out_error": float(held_out.std()) / len(held_out) ** 0.5,
        "best_candidate": max(of_each.values()),
        "best_basic": max(basics, default=-math.inf),
    }


def _result(
    case: Case,
    cell: Cell,
    posterior: Any,
    pairs: Pairs,
    *,
    seconds_npe: float,
    seconds_train: float,
    seconds_couple: float = 0.0,
    converged: bool = True,
    **others: float,
) -> Result:
    """Score a posterior.

    Args:
        case: The data.
        cell: The cell.
        posterior: Its posterior.
        pairs: The pairs to score it on.
        seconds_npe: Training of the NPE that methods share; 0 for others.
        seconds_train: All other training; of RoPE the fine-tuning, which the couplings
            of a sweep share.
        seconds_couple: Simulating and coupling.
        converged: Whether the coupling has converged; True without one.
        others: More columns of the row.
    """
    start = time.process_time()
    evaluation = evaluate(
        posterior,
        *pairs,
        theta_std=case.task.prior_std.to(pairs[0]),
        num_samples=case.settings.num_samples,
        seed=case.seed,
    )
    log_prob, root = evaluation.log_prob, len(evaluation) ** 0.5
    acauc = zip(case.task.parameter_names, evaluation.acauc_of_parameters, strict=True)
    row = {
        **asdict(cell),
        "status": "finished",
        "lpp": evaluation.lpp.mean,
        "lpp_z": evaluation.lpp_z.mean,
        "acauc": evaluation.acauc.mean,
        "lpp_median": float(log_prob.quantile(0.5, interpolation="nearest")),
        "neg_inf_fraction": float(log_prob.isneginf().double().mean()),
        "lpp_standard_error": float(log_prob.std()) / root,
        "acauc_standard_error": float(evaluation.levels.mean(dim=1).std()) / root,
        "acauc_per_parameter": "; ".join(f"{k}={one.mean:.4f}" for k, one in acauc),
        "converged": converged,
        "n_test": len(pairs[0]),
        "stand_in": case.task.stand_in,
        "seconds_npe": round(seconds_npe, 1),
        "seconds_train": round(seconds_train, 2),
        "seconds_couple": round(seconds_couple, 2),
        "seconds_test": round(time.process_time() - start, 2),
        **others,
    }
    arrays = {
        "log_probs": log_prob.cpu().numpy(),
        "coverage": evaluation.coverage.mean(dim=1).cpu().numpy().astype(np.float32),
    }
    return Result(row, arrays)
