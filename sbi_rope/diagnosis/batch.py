"""Diagnose a batch: run all tests and collect their findings."""

import copy
from collections.abc import Sequence
from typing import Annotated

import torch
from torch import Tensor

from sbi_rope.data.parameters import is_improbable
from sbi_rope.density import MixturePosterior
from sbi_rope.diagnosis.misspecification import (
    after_tuning,
    before_tuning,
    distances,
    far_entries,
    mmd_test,
    unlike_pairs,
    unmatched,
)
from sbi_rope.diagnosis.prior_shift import averaged, cross_fit, prior_shift, shifts
from sbi_rope.diagnosis.report import Diagnosis, Finding
from sbi_rope.metrics.statistics import TwoSampleTest, compare_with_pairs
from sbi_rope.rope.rope import RoPE
from sbi_rope.utils.errors import InvalidInputError
from sbi_rope.utils.progress import is_shown
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import Range, check, default_names

# With fewer simulations the thresholds cannot be estimated.
FEWEST_SIMULATIONS = 100
# Above this p-value there is no sign of a difference.
NO_SIGN = 0.05
Folds = Annotated[int, Range(2)]


def diagnose(
    rope: RoPE,
    x_o: Tensor,
    *,
    num_simulations: int | None = None,
    num_folds: int | None = 5,
    posterior: MixturePosterior | None = None,
    seed: int | None = None,
    show_progress_bars: bool | None = None,
) -> Diagnosis:
    r"""Test whether a batch fulfils the assumptions of RoPE and of a stack.

    1. Is the batch like the observations of the calibration pairs? This is an energy
       test of :math:`h(x_o)`, and of NPE's estimate of each parameter.
    2. Is an entry of x many standard deviations away from simulations?
    3. Do the parameters of the batch follow the prior? The parameters of
       simulations, weighted by the coupling at tau = 0, are compared with the prior.
    4. Does :math:`h(x_o)` differ from :math:`h(x_s)`? This is an MMD test.
    5. Does :math:`g(x_o)` still differ from simulations, after tuning?
    6. Which observations have no simulation near them?

    The last two are about RoPE only. Without calibration pairs g is h, and 1 and 5 are
    left out. Each of 1 and 3 to 6 raises an alarm by chance in one batch of a hundred.

    Args:
        rope: A RoPE, which is not changed. If calibration pairs were appended but not
            trained on, a copy is trained first, with ``seed``.
        x_o: The batch, shape ``(n_o, *event)``.
        num_simulations: n_s, at least 100. If None, ``max(n_o, 1000)``, or all stored
            simulations if there are fewer.
        num_folds: The number of folds of the pairs for the allowance for errors of g in
            3, each of which takes as long as ``rope.train``. None does without it.
        posterior: The posterior that you use, made with the same pairs. For a stack 5
            and 6 are left out; 6 takes the place of 2 if x is not standardised. A shift
            of 3 is no alarm if the stack has learned it from the pairs, and 1 shows no
            sign of a difference.
        seed: Seed of everything random; None uses the states of torch, NumPy and
            Python. The simulations are those of ``rope.build_posterior`` with the same
            seed and number.
        show_progress_bars: Whether to show the progress of slow simulations and of the
            folds. None does so in a terminal or a notebook.

    Returns:
        The findings. Print them, or pass them to
        :func:`sbi_rope.plots.implied_parameters`.

    Raises:
        InvalidInputError: If there are fewer than 100 simulations.
    """
    check("rope", rope, RoPE)
    check("posterior", posterior, MixturePosterior | None)
    check("num_folds", num_folds, Folds | None)
    x_o = rope.npe.as_x("x_o", x_o)  # before anybody waits for a training
    pairs, tuned = rope.pairs, len(rope.pairs) > 0
    if tuned and not rope.is_trained:
        rope = copy.copy(rope)  # which shares all data
        rope.train(seed=seed, show_progress_bars=show_progress_bars)
    with seeded(seed):
        # First, so that a posterior with the same seed has these simulations.
        x_o, real, theta, simulated = rope.embed(
            x_o, num_simulations=num_simulations, show_progress_bars=show_progress_bars
        )
        n_s, dim = theta.shape
        if n_s < FEWEST_SIMULATIONS:
            raise InvalidInputError(
                f"Expected at least {FEWEST_SIMULATIONS} simulations, to estimate the "
                f"thresholds; got {n_s}."
            )
        npe, names = rope.npe, rope.npe.parameter_names or default_names(dim)
        real, theta, simulated = (_moved(some) for some in (real, theta, simulated))
        embedded = npe.embed("x_o", x_o, npe.h)
        before = mmd_test(_moved(embedded), simulated, simulated)
        ends, like_pairs, after, held_out = [simulated], None, None, None
        if tuned:
            of_pairs, groups = npe.embed("x", pairs.x, npe.h), pairs.group.cpu()
            like_pairs = compare_with_pairs(of_pairs, groups, embedded, npe.density())
            ends = [averaged(simulated, theta, simulated), simulated]
            after = mmd_test(real, simulated, ends[0])
        distance = distances(real, simulated, ends)
        if num_folds is not None and pairs.num_groups > 1:
            show = is_shown(show_progress_bars)
            points, targets = cross_fit(rope, num_folds, show=show)
            held_out = points, averaged(targets, theta, simulated), pairs.group.cpu()
        shift = prior_shift(real, theta, ends, held_out)
        learned = _learned(posterior, like_pairs, names)
        far, near = far_entries(npe.h, x_o), unmatched(distance, n_s)
        findings = [
            unlike_pairs(like_pairs, names),
            far,
            *shifts(shift, theta, names, learned, tuned=tuned),
            before_tuning(before, tuned=tuned),
        ]
        is_stack = hasattr(posterior, "report")
        if after is not None and not is_stack:
            findings.append(after_tuning(after))
        if far.value is None or not is_stack:  # a broken one must be found in a stack
            findings.append(near)
        # So many that a histogram is smooth.
        prior = _moved(npe.prior.sample(torch.Size((20_000,))))
    if tuned and posterior is None:
        sentence = "Not known. Pass `posterior=` to count only the alarms about it."
        findings.append(Finding("posterior in use", sentence))
    return Diagnosis(
        findings=tuple(sorted(findings, key=lambda one: not one.alarming)),
        distance=distance,
        theta=theta,
        implied=shift.implied,
        unshifted=shift.unshifted,
        prior=prior,
        parameter_names=names,
    )


def _learned(
    posterior: MixturePosterior | None, test: TwoSampleTest | None, names: Sequence[str]
) -> list[str]:
    """Return parameters of a batch like the pairs, whose values the stack learned."""
    report = getattr(posterior, "report", None)
    if report is None or test is None or test.is_different:
        return []
    if report.keeps_prior or not is_improbable(report.probability_of_prior):
        return []
    each = zip(names, test.p_values, strict=True)
    return [name for name, p_value in each if p_value > NO_SIGN]


def _moved(values: Tensor) -> Tensor:
    return values.detach().cpu().double()
