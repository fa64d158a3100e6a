"""From a trained RoPE to a stack, in one call."""

import copy
from collections.abc import Sequence
from typing import Any, Literal

from torch import Tensor

from sbi_rope._validation import check_choice, check_unit_interval
from sbi_rope.errors import warn_user
from sbi_rope.rope import RoPE
from sbi_rope.stacking.candidates import Candidate
from sbi_rope.stacking.cross_validation import check_setup, score_folds
from sbi_rope.stacking.estimator import StackedEstimator
from sbi_rope.stacking.fitting import Components, fit_candidates
from sbi_rope.stacking.posterior import StackedPosterior
from sbi_rope.stacking.report import LearningCurve, StackingReport

__all__ = ["stack"]

# Shares of the folds to train on for the learning curve, beside all but one.
SMALLER = (0.25, 0.5)


def stack(
    rope: RoPE,
    x_o: Tensor,
    *,
    candidates: Sequence[Candidate] | None = None,
    num_folds: int | None = None,
    num_simulations: int | None = None,
    pseudo_count: float = 1.0,
    learning_curve: bool = False,
    unseen: Literal["raise", "extend"] = "raise",
    tail_mass: float = 1e-3,
    seed: int | None = None,
    show_progress_bars: bool = True,
) -> StackedPosterior:
    r"""Weigh RoPE at many settings and its rivals by their scores on held-out pairs.

    No gamma or tau is chosen: candidates are scored on calibration pairs that they were
    not trained on (:func:`cross_validate`), and the posterior is their mixture with the
    weights that score best (:func:`stacking_weights`).

    Args:
        rope: A trained RoPE; it is left as it is, but counts the simulations
            that were dropped.
        x_o: The batch of real observations, shape ``(n_o, *event)``.
        candidates: What to stack; ``default_candidates()`` if None: RoPE, RoPE tuned
            with rehearsal, and OT-only at four gammas and three taus, the prior, NPE,
            tuning-only and fine-tuned NPE.
        num_folds: Folds of the calibration pairs, at most as many as there are pairs; 5
            if None, or leave-one-out of up to 10 pairs.
        num_simulations: As in :meth:`~sbi_rope.RoPE.build_posterior`.
        pseudo_count: Strength of the Dirichlet prior of the weights, in pairs.
        learning_curve: Whether to train on fewer folds too, so that the report can say
            what more labels might add; takes about twice the time.
        unseen: What the posterior does with an x outside the batch: ``"raise"``, or
            ``"extend"`` each coupling by one row.
        tail_mass: As in :meth:`~sbi_rope.RoPE.build_posterior`.
        seed: Seed of everything random; None uses the states of torch, NumPy and
            Python.
        show_progress_bars: Whether to show the folds done.

    Returns:
        The stack, an sbi posterior of the batch; ``posterior.report`` says what the
        pairs say about it.

    Raises:
        NotReadyError: If RoPE is not trained or has fewer than two pairs.
        InvalidInputError: If an argument is outside its range or has the wrong shape.
        UnsupportedPosteriorError: If a candidate has no density.
        SimulationError: If the simulator fails.
    """
    check_choice("unseen", unseen, ("raise", "extend"))
    check_unit_interval("tail_mass", tail_mass)
    chosen, seeds = check_setup(rope, candidates, num_folds, pseudo_count, seed)
    _ = rope.tuned_embedding_net  # says so if it is not trained
    components = Components.of(
        rope,
        x_o,
        chosen,
        num_simulations=num_simulations,
        seed=seeds[0],
        show_progress_bars=show_progress_bars,
    )
    options: dict[str, Any] = {
        "num_folds": num_folds,
        "pseudo_count": pseudo_count,
        "seed": seeds[1],
        "show_progress_bars": show_progress_bars,
    }
    scores = score_folds(rope, components, chosen, **options)
    curve = None
    if learning_curve:
        fewer = [int(share * scores.num_folds) for share in SMALLER]
        smaller = [
            score_folds(rope, components, chosen, num_training_folds=folds, **options)
            for folds in fewer
            if 1 <= folds < scores.num_folds - 1
        ]
        curve = LearningCurve.of([*smaller, scores])
    estimator = fit_candidates(
        chosen,
        rope,
        components.x_o,
        components,
        seed=seeds[2],
        unseen=unseen,
        tail_mass=tail_mass,
    )
    _warn_unless_converged(estimator)
    weights = scores.weights.weights
    return StackedPosterior(
        estimator.with_weights(weights),
        copy.deepcopy(components.prior),  # moving the stack leaves the report
        enable_transform=components.enable_transform,
        weights=dict(zip(scores.names, weights.tolist(), strict=True)),
        report=StackingReport(cross_validation=scores, learning_curve=curve),
        shared=scores.shared,
    )


def _warn_unless_converged(estimator: StackedEstimator) -> None:
    couplings = estimator.coupled[0].couplings
    open_ones = [c for c in couplings if not c.converged]
    if open_ones:
        worst = max(coupling.marginal_error for coupling in open_ones)
        warn_user(
            f"{len(open_ones)} of {len(couplings)} couplings have not converged "
            f"(marginal error up to {worst:.1e}). They are weighed by their scores as "
            "they are. Give RoPE a coupler with more `max_iterations`, or leave the "
            "smallest gammas out."
        )
