"""Make a stack from a RoPE with calibration pairs, in one call."""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any

import torch
from torch import Tensor

from sbi_rope.data.parameters import probability_of_prior
from sbi_rope.density import Density
from sbi_rope.metrics.statistics import TwoSampleTest, compare_with_pairs
from sbi_rope.npe.sbi import check_density, embed, headless
from sbi_rope.npe.standardisation import warn_of_far_entries
from sbi_rope.rope.rope import RoPE
from sbi_rope.stacking.candidates import (
    Candidate,
    GivenCandidate,
    as_density,
    default_candidates,
)
from sbi_rope.stacking.data import NUM_FOLDS, StackData, draw_seeds
from sbi_rope.stacking.posterior import StackedPosterior, Versions
from sbi_rope.stacking.report import LearningCurve, StackingReport
from sbi_rope.stacking.scoring import score_folds
from sbi_rope.utils.errors import InvalidInputError, warn_user
from sbi_rope.utils.progress import is_shown
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import Range, check


def stack(
    rope: RoPE,
    x_o: Tensor | None = None,
    *,
    candidates: Sequence[Any] | None = None,
    num_folds: int = NUM_FOLDS,
    learning_curve: bool = False,
    seed: int | None = None,
    show_progress_bars: bool | None = None,
) -> StackedPosterior:
    r"""Mix candidate posteriors with the weights that score best on hold-out pairs.

    The calibration pairs are divided into folds. Every candidate is trained without
    each fold and scored on that fold, and the posterior is the mixture of the
    candidates with the weights that score best
    (:func:`~sbi_rope.stacking.stacking_weights`). It answers any x.

    Each candidate is the average of its versions: those that were scored, one for each
    fold, and one trained on all pairs. By Jensen's inequality the average has a higher
    expected score than single versions, for observations like those of the pairs.

    Weights, scores and calibration in the report hold for such observations.

    Args:
        rope: A RoPE with calibration pairs. It need not be trained. Only its counts of
            calls of the simulator and of dropped simulations change.
        x_o: Real observations without labels, shape ``(n_o, *event)``, other than those
            of the pairs. They are compared with the pairs by an energy test of the
            embeddings, and a p-value below 0.01 gives a warning. A default candidate
            learns its discrepancy from them, too, if they are 30 vectors or more of at
            most ten entries.
        candidates: What to stack;
            :func:`default_candidates(rope, x_o)
            <sbi_rope.stacking.default_candidates>` if None. A posterior, or a density
            of your own, that has not seen the pairs is taken as it is, see
            :class:`~sbi_rope.stacking.GivenCandidate`.
        num_folds: The number of folds, at most the number of groups. Pairs of one group
            are in the same fold.
        learning_curve: Whether to train on fewer folds too, so that the report can
            estimate what more labels would add. It takes about twice the time.
        seed: Seed of everything random; None uses the states of torch, NumPy and
            Python.
        show_progress_bars: Whether to show the course of each training. None does so in
            a terminal or a notebook, but not in a file.

    Returns:
        The stack, an sbi posterior with a ``report``.

    Raises:
        NotReadyError: If there are fewer than two groups of pairs.
        InvalidInputError: If an argument is outside its range or has the wrong shape.
        UnsupportedPosteriorError: If NPE or a candidate has no density.
        SamplingError: If the candidates have almost no mass inside the support of the
            prior at a hold-out observation.
    """
    check("rope", rope, RoPE)
    check("num_folds", num_folds, Annotated[int, Range(2)])
    check("learning_curve", learning_curve, bool)
    start, calls = time.perf_counter(), rope.source.num_calls
    if x_o is not None:
        x_o = rope.npe.as_x("x_o", x_o)
        warn_of_far_entries("x_o", x_o, rope.npe.h)
    of_data, of_scores = draw_seeds(seed, 2)
    data = StackData(
        rope,
        num_folds=num_folds,
        seed=of_data,
        show_progress_bars=is_shown(show_progress_bars),
    )
    check_density(data.estimator, what="a RoPE of a posterior")
    if candidates is None:
        chosen = [one for one in default_candidates(x_o=x_o) if one.suits(data)]
    else:
        chosen = _checked(candidates, data)
    batch = None if x_o is None else _compare_batch(data, x_o)
    # Each version sees all folds but one, and for the curve half and a quarter of them.
    num_folds = len(data.folds)
    counts = [num_folds - 1]
    if learning_curve:
        counts += [n for n in (num_folds // 2, num_folds // 4) if 0 < n < counts[0]]
    points: list[StackingReport] = []
    fitted: list[list[Density]] = []
    for count in counts:
        versions = [data.without(k, count) for k in range(num_folds)]
        if not fitted:
            versions.append(data.every)
        found = [_fitted(candidate, data, versions) for candidate in chosen]
        fitted = fitted or found
        points.append(score_folds(data, chosen, found, seed=of_scores))
    curve = LearningCurve(
        num_pairs=tuple(len(data) * count // num_folds for count in counts[::-1]),
        evaluations=tuple(point.held_out for point in points[::-1]),
    )
    corrects = any("discrepancy" in candidate.name for candidate in chosen)
    report = replace(
        points[0],
        learning_curve=curve if learning_curve else None,
        batch=batch,
        discrepancy=data.discrepancy() if corrects and data.compares_entries else None,
        probability_of_prior=probability_of_prior(
            data.pairs, data.prior, seed=data.seed
        ),
        keeps_prior=not any(candidate.learns_prior for candidate in chosen),
        provenance={
            "seed": str(seed),
            "seconds": f"{time.perf_counter() - start:.0f}",
            "simulator calls": f"{rope.source.num_calls - calls:,}",
        },
    )
    posterior = StackedPosterior(
        [Versions.of(one) for one in fitted],
        data.prior,
        report=report,
        enable_transform=data.npe.enable_transform,
    )
    npe = rope.npe
    posterior.parameter_names, posterior.x_names = npe.parameter_names, npe.x_names
    return posterior


def _checked(candidates: Sequence[Any], data: StackData) -> list[Candidate]:
    """Return the candidates of a user, densities among them as candidates."""
    check("candidates", candidates, Sequence)
    chosen = [
        one if isinstance(one, Candidate) else GivenCandidate(one) for one in candidates
    ]
    names = [candidate.name for candidate in chosen]
    if not names or len(set(names)) < len(names):
        raise InvalidInputError(
            f"Expected `candidates` with different names; got {names}. Name a density "
            "with `GivenCandidate(density, name)`."
        )
    for one in chosen:  # so that nobody waits for the training to hear of it
        if isinstance(one, GivenCandidate):
            as_density(one.density, data, one.name)
    return chosen


def _fitted(
    candidate: Candidate, data: StackData, versions: Sequence[Tensor]
) -> list[Density]:
    """Return the density of each version of a candidate; equal ones are one object."""
    # With the same seed for all, nothing depends on the order of candidates. The caller
    # may have switched gradients off.
    with seeded(data.seed), torch.enable_grad():
        found = candidate.fit(data, versions)
    known = {id(one): as_density(one, data, candidate.name) for one in found}
    return [known[id(one)] for one in found]


def _compare_batch(data: StackData, x_o: Tensor) -> TwoSampleTest | None:
    """Compare observations with those of the pairs, and warn if they clearly differ.

    The energy test of their embeddings is None if there are too few of them.
    """
    real, batch = (embed(data.embedding_net, x) for x in (data.pairs.x, x_o))
    density = headless(data.estimator)
    test = compare_with_pairs(real, data.pairs.group.cpu(), batch, density)
    if test is not None and test.is_different:
        warn_user(
            "`x_o` differs from the observations of the calibration pairs (p = "
            f"{test.p_value:.3f}), so that the report need not hold for it. Look at "
            "`diagnose(rope, x_o)`."
        )
    return test
