"""Make a stack from a RoPE with calibration pairs, in one call."""

import time
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timezone
from importlib.metadata import version
from typing import Annotated, Any

import torch
from torch import Tensor

from sbi_rope.data.parameters import probability_of_prior
from sbi_rope.density import Density
from sbi_rope.metrics.statistics import TwoSampleTest, compare_with_pairs
from sbi_rope.npe.sbi import check_density, embed, headless
from sbi_rope.npe.standardisation import warn_of_far_entries
from sbi_rope.rope.rope import RoPE
from sbi_rope.stacking.candidates import as_densities, chosen_candidates, left_out
from sbi_rope.stacking.data import NUM_FOLDS, StackData, draw_seeds
from sbi_rope.stacking.posterior import StackedPosterior, Versions
from sbi_rope.stacking.report import LearningCurve, StackingReport
from sbi_rope.stacking.scoring import score_folds
from sbi_rope.utils.errors import warn_user
from sbi_rope.utils.progress import is_shown
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import Range, check, default_names

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
    r"""Mix candidate posteriors with the weights that score best on hold-out pairs.

    The calibration pairs are divided into folds. Every candidate is trained without
    each fold and scored on that fold, and the posterior is the mixture of the
    candidates with the weights that score best
    (:func:`~sbi_rope.stacking.stacking_weights`). It answers any x.

    Each candidate is the average of its versions: those that were scored, one for each
    fold, and one trained on all pairs. By Jensen's inequality the average has a higher
    expected score than single versions, for observations like those of the pairs.

    Weights, scores and calibration in the report hold for such observations. If you
    pass ``x_o``, it is compared with the pairs by an energy test of the embeddings, and
    a p-value below 0.01 gives a warning. :func:`~sbi_rope.diagnose` makes the same
    comparison.

    Args:
        rope: A RoPE with calibration pairs. It need not be trained. Only its counts of
            calls of the simulator and of dropped simulations change.
        x_o: Real observations without labels, shape ``(n_o, *event)``, other than those
            of the pairs. A default candidate learns its discrepancy from them, too, if
            they are 30 vectors or more of at most ten entries.
        candidates: What to stack;
            :func:`default_candidates(rope, x_o)
            <sbi_rope.stacking.default_candidates>` if None: the prior, NPE, fine-tuned
            NPE, discrepancy models and regressions. A posterior, or a density of your
            own, that has not seen the pairs is taken as it is, see
            :class:`~sbi_rope.stacking.GivenCandidate`.
        num_folds: The number of folds, at most the number of groups. Pairs of
            one group are in the same fold. Groups are those that were appended, or else
            pairs with equal labels.
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
        InvalidInputError: If an argument is outside its range or has the wrong shape,
            or if a candidate with ``space="input"`` corrects x and some of its entries
            are missing (NaN).
        UnsupportedPosteriorError: If NPE or a candidate has no density.
        SamplingError: If the candidates have almost no mass inside the support of the
            prior at a hold-out observation.
        SimulationError: If the simulator fails.
    """
    check("rope", rope, RoPE)
    check("num_folds", num_folds, Annotated[int, Range(2)])
    check("learning_curve", learning_curve, bool)
    start, calls = time.perf_counter(), rope.source.num_calls
    if x_o is not None:
        x_o = rope.npe.as_x("x_o", x_o)
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
    # Versions are trained on all folds but one, and for the curve on fewer.
    num_folds = len(data.folds)
    smaller = {int(share * num_folds) for share in SMALLER if learning_curve}
    counts = {num_folds - 1, *(n for n in smaller if 0 < n < num_folds - 1)}
    points: list[StackingReport] = []
    seconds = dict.fromkeys((candidate.name for candidate in stacked), 0.0)
    fitted: list[list[Density]] = []
    for count in sorted(counts, reverse=True):
        versions = [data.without(k, count) for k in range(num_folds)]
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
    slowest = sorted(seconds, key=lambda one: -seconds[one])[:3]
    corrects = any("discrepancy" in candidate.family for candidate in stacked)
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
        discrepancy=data.discrepancy() if corrects and data.compares_entries else None,
        probability_of_prior=probability_of_prior(
            data.pairs, data.prior, seed=data.seed
        ),
        keep_prior=tuple(one.name for one in stacked if not one.learns_prior),
        provenance={
            "seed": "none, so that a repetition differs" if seed is None else str(seed),
            "seconds": f"{time.perf_counter() - start:.0f}",
            "longest": ", ".join(f"{name} {seconds[name]:.0f} s" for name in slowest),
            **({"left out": left_out(stacked, x_o)} if candidates is None else {}),
            "simulator calls": f"{rope.source.num_calls - calls:,}",
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
    npe = rope.npe
    posterior.parameter_names, posterior.x_names = npe.parameter_names, npe.x_names
    return posterior


def _compare_batch(data: StackData, x_o: Tensor) -> TwoSampleTest | None:
    """Compare observations with those of the pairs, and warn if they clearly differ.

    The energy test of their embeddings is None if there are too few of them.
    """
    real, batch = (embed(data.embedding_net, x) for x in (data.pairs.x, x_o))
    density = headless(data.estimator)
    test = compare_with_pairs(real, data.pairs.group.cpu(), batch, density)
    if test is not None and test.is_different:
        names = data.npe.parameter_names or default_names(data.pairs.theta.shape[-1])
        where = ", ".join(test.parameters(names)) or "no parameter alone"
        warn_user(
            f"`x_o` differs from the observations of the calibration pairs (p = "
            f"{test.p_value:.3f}; {where}), so that the report need not hold for it. "
            "Look at `diagnose(rope, x_o)`."
        )
    return test
