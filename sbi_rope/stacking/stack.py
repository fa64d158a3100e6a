"""Make a stack from a RoPE with calibration pairs, in one call."""

import time
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timezone
from importlib.metadata import version
from typing import Annotated, Any

import torch
from torch import Tensor

from sbi_rope._progress import is_shown
from sbi_rope._random import seeded
from sbi_rope._sbi import check_density, embed, headless
from sbi_rope._standardisation import warn_of_far_entries
from sbi_rope._statistics import TwoSampleTest, compare_with_pairs
from sbi_rope.density import Density
from sbi_rope.discrepancy import DiscrepancyReport
from sbi_rope.discrepancy.parameters import probability_of_prior
from sbi_rope.errors import warn_user
from sbi_rope.rope import RoPE
from sbi_rope.settings import Range, check, default_names
from sbi_rope.stacking.candidates import (
    Candidate,
    as_densities,
    chosen_candidates,
    left_out,
)
from sbi_rope.stacking.data import NUM_FOLDS, StackData, draw_seeds
from sbi_rope.stacking.posterior import StackedPosterior, Versions
from sbi_rope.stacking.report import LearningCurve, StackingReport
from sbi_rope.stacking.scoring import score_folds

__all__ = ["stack"]

# The learning curve trains on these shares of the folds, and on all folds but one.
SMALLER = (0.25, 0.5)
# The report says which versions of these made it.
PACKAGES = "sbi-rope", "sbi", "torch", "numpy", "scipy", "POT"


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
    r"""Mix candidate posteriors with the weights that score best on held-out pairs.

    The calibration pairs are divided into folds. Every candidate is trained without
    each fold and scored on that fold, and the posterior is the mixture of the
    candidates with the weights that score best
    (:func:`~sbi_rope.stacking.stacking_weights`). It answers any x.

    The stack is made of the models that were scored. Each candidate is the average of
    its versions: one for each fold, trained on the other folds, and one trained on all
    pairs. The held-out score is that of single versions. By Jensen's inequality their
    average has a higher expected score, for observations like those of the pairs. The
    version trained on all pairs is not scored.

    The weights, the scores and the calibration in the report hold for observations like
    those of the pairs. With ``x_o`` the two are compared by an energy test of their
    embeddings, and a p-value below 0.01 gives a warning. Without it,
    :func:`~sbi_rope.diagnose` makes the same comparison.

    Args:
        rope: A RoPE with calibration pairs. It need not be trained, and it is not
            changed, except that it counts calls of the simulator, and the simulations
            that are dropped.
        x_o: Real observations without labels, shape ``(n_o, *event)``, other than those
            of the pairs. If there are 30 vectors of at most ten entries, the default
            candidates have a discrepancy among them that is learned from them, too.
        candidates: What to stack;
            :func:`default_candidates(rope, x_o)
            <sbi_rope.stacking.default_candidates>` if None: the prior, NPE, fine-tuned
            NPE, discrepancy models and regressions. A posterior, or a density of your
            own, that has not seen the pairs is taken as it is, see
            :class:`~sbi_rope.stacking.GivenCandidate`.
        num_folds: The number of folds, at most the number of groups. Pairs with equal
            labels, or of the same of the ``groups`` that were appended, are in the same
            fold.
        learning_curve: Whether to train on fewer folds too, so that the report can
            estimate what more labels would add. It takes about twice the time.
        seed: Seed of everything random; None uses the states of torch, NumPy and
            Python.
        show_progress_bars: Whether to show the course of each training. None does so in
            a terminal or a notebook, but not in a file.

    Returns:
        The stack, an sbi posterior. Its ``report`` holds the held-out scores, and
        compares the stack with the prior and with NPE.

    Raises:
        NotReadyError: If there are fewer than two groups of pairs.
        InvalidInputError: If an argument is outside its range or has the wrong shape,
            or if entries of x are missing (NaN) that a candidate with
            ``space="input"`` corrects.
        UnsupportedPosteriorError: If NPE or a candidate has no density.
        SamplingError: If the candidates have almost no mass inside the support of the
            prior at a held-out observation.
        SimulationError: If the simulator fails.
    """
    check("rope", rope, RoPE)
    check("num_folds", num_folds, Annotated[int, Range(2)])
    check("learning_curve", learning_curve, bool)
    start, calls = time.perf_counter(), rope.num_simulator_calls
    if x_o is not None:
        x_o = rope.checked_observations(x_o)
        warn_of_far_entries("x_o", x_o, rope.embedding_net)
    of_data, of_scores = draw_seeds(seed, 2)
    data = StackData(
        rope,
        num_folds=num_folds,
        seed=of_data,
        show_progress_bars=is_shown(show_progress_bars),
    )
    check_density(
        data.estimator,
        what="a RoPE of a posterior",
        because="candidates are scored by the density of held-out parameters",
    )
    # These come first, so that nobody waits for the training to hear of it.
    stacked = chosen_candidates(candidates, data, x_o)
    batch = None if x_o is None else _compare_batch(data, x_o)
    numbers = range(len(data.folds))
    points: list[StackingReport] = []
    seconds = dict.fromkeys((candidate.name for candidate in stacked), 0.0)
    fitted: list[list[Density]] = []
    for count in _numbers_of_folds(len(numbers), curve=learning_curve):
        versions = [data.without(k, count) for k in numbers]
        if not fitted:
            versions.append(data.every)
        found = []
        for candidate in stacked:
            # With the same seed for all, nothing depends on the order of candidates.
            # The caller may have switched gradients off.
            began = time.perf_counter()
            with seeded(data.seed), torch.enable_grad():
                densities = candidate.fit(data, versions)
            seconds[candidate.name] += time.perf_counter() - began
            found.append(as_densities(densities, data, candidate.name))
        fitted = fitted or found
        points.append(
            score_folds(data, stacked, found, num_training_folds=count, seed=of_scores)
        )
    curve = None
    if learning_curve:
        curve = LearningCurve(
            num_pairs=tuple(point.num_trained_on for point in points[::-1]),
            evaluations=tuple(point.held_out for point in points[::-1]),
        )
    report = replace(
        points[0],
        learning_curve=curve,
        batch=batch,
        discrepancy=_discrepancy(stacked, data),
        probability_of_prior=probability_of_prior(
            data.pairs, data.prior, seed=data.seed
        ),
        keep_prior=tuple(one.name for one in stacked if not one.learns_prior),
        provenance={
            "seed": "none, so that a repetition differs" if seed is None else str(seed),
            "seconds": f"{time.perf_counter() - start:.0f}",
            "longest": ", ".join(
                f"{name} {seconds[name]:.0f} s"
                for name in sorted(seconds, key=lambda one: -seconds[one])[:3]
            ),
            **({"left out": left_out(stacked, x_o)} if candidates is None else {}),
            "simulator calls": f"{rope.num_simulator_calls - calls:,}",
            "finished": datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
            "versions": ", ".join(f"{name} {version(name)}" for name in PACKAGES),
        },
    )
    posterior = StackedPosterior(
        [Versions.of(one) for one in fitted],
        data.prior,
        report=report,
        enable_transform=data.npe.enable_transform,
    )
    posterior.parameter_names, posterior.x_names = rope.parameter_names, rope.x_names
    return posterior


def _numbers_of_folds(num_folds: int, *, curve: bool) -> list[int]:
    """Return on how many folds versions are trained, all but one first."""
    most = num_folds - 1
    smaller = {int(share * num_folds) for share in SMALLER} if curve else set()
    return [most, *sorted((n for n in smaller if 0 < n < most), reverse=True)]


def _discrepancy(
    candidates: Sequence[Candidate], data: StackData
) -> DiscrepancyReport | None:
    """Return what the pairs say about each entry of x, if a candidate uses it."""
    is_used = any("discrepancy" in candidate.family for candidate in candidates)
    return data.discrepancy() if is_used and data.compares_entries else None


def _compare_batch(data: StackData, x_o: Tensor) -> TwoSampleTest | None:
    """Compare observations with those of the pairs, and warn if they clearly differ.

    Returns:
        An energy test of the embeddings h(x), with the pairs as the first set, or None
        if there are too few observations or pairs.
    """
    net = data.embedding_net
    test = compare_with_pairs(
        embed(net, data.pairs.x),
        data.pairs.group.cpu(),
        embed(net, x_o),
        headless(data.estimator),
    )
    if test is not None and test.is_different:
        names = data.rope.parameter_names or default_names(data.pairs.theta.shape[-1])
        where = ", ".join(test.parameters(names)) or "no parameter alone"
        warn_user(
            f"`x_o` differs from the observations of the calibration pairs (p = "
            f"{test.p_value:.3f}; {where}), so that the report need not hold for it. "
            "Look at `diagnose(rope, x_o)`."
        )
    return test
