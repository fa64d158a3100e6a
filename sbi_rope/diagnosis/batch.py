"""Diagnose a batch: run all tests and collect their findings."""

import copy
from collections.abc import Sequence
from typing import Annotated

import torch
from torch import Tensor

from sbi_rope._progress import is_shown
from sbi_rope._random import seeded
from sbi_rope._statistics import compare_with_pairs
from sbi_rope.density import MixturePosterior
from sbi_rope.diagnosis.misspecification import (
    far_findings,
    labelled_findings,
    misspecification_findings,
    support_of,
)
from sbi_rope.diagnosis.parameters import (
    prior_shift,
)
from sbi_rope.diagnosis.report import Diagnosis, read_for
from sbi_rope.diagnosis.residuals import (
    CrossFitted,
    cross_fit,
    residual_findings,
)
from sbi_rope.diagnosis.simulations import Simulations
from sbi_rope.errors import InvalidInputError
from sbi_rope.rope import RoPE
from sbi_rope.settings import Range, check, default_names, names_of
from sbi_rope.stacking import StackedPosterior

__all__ = ["diagnose"]

# With fewer simulations the thresholds cannot be estimated.
FEWEST_SIMULATIONS = 100
Folds = Annotated[int, Range(2)]
# So many draws of the prior make a smooth histogram.
NUM_DRAWN = 20_000
NO_STANDARDISATION = (
    "Whether an entry of x is far from all simulations was not tested, because NPE "
    "does not standardise x entry by entry (as for sets of trials)."
)


def diagnose(
    rope: RoPE,
    x_o: Tensor,
    *,
    num_simulations: int | None = None,
    num_folds: int | None = 5,
    posterior: MixturePosterior | None = None,
    parameter_names: Sequence[str] | None = None,
    seed: int | None = None,
    show_progress_bars: bool | None = None,
) -> Diagnosis:
    r"""Test whether a batch fulfils the assumptions of RoPE.

    1. Does the batch differ from simulations, before tuning and after? This is sbi's
       MMD test of :math:`h(x_o)` and of :math:`g(x_o)` against :math:`h(x_s)`.
    2. Which observations have no simulation near them, and how many simulations are
       behind each posterior?
    3. Do the parameters of the batch follow the prior? The parameters of the
       simulations, weighted by the coupling at tau = 0, are compared with the prior.
    4. Do the residuals :math:`g(x) - E[h(S(\theta))]` of calibration pairs depend on
       :math:`\theta`? They are computed on pairs that g was not trained on.
    5. Is an entry of x many standard deviations away from simulations? This is tested
       if NPE standardises x.
    6. Is the batch like the observations of the calibration pairs? This is an energy
       test of :math:`h(x_o)`, and of NPE's estimate of each parameter, against those of
       the pairs. The held-out scores of a stack, and what they say about calibration,
       hold for observations like those of the pairs.

    Without calibration pairs g is h, and the second test of 1 and all of 4 and 6 are
    left out. One batch of simulations in a hundred exceeds the thresholds of 1, of 3
    and of the distances in 2. One batch in a hundred that is drawn like the pairs has a
    p-value below the threshold of 6, which is 0.01. The thresholds of effective sample
    sizes are rules of thumb about the setting of the coupler.

    Args:
        rope: A RoPE, which is not changed. If calibration pairs were appended but not
            trained on, a copy is trained first, with ``seed``.
        x_o: The batch, shape ``(n_o, *event)``.
        num_simulations: n_s, at least 100. If None, ``max(n_o, 1000)``, or all stored
            simulations if there are fewer.
        num_folds: The number of trainings for the residuals of 4, each of which takes
            as long as ``rope.train``. None leaves out 4, and the allowance for errors
            of g in 3.
        posterior: The posterior that you use, such as that of :func:`sbi_rope.stack`,
            made with the same pairs. Alarms are then counted for it, and what concerns
            other posteriors only comes last. A shift against the prior is no alarm, but
            expected, if the posterior is a stack that has learned from the pairs how
            parameters are distributed, and 6 shows no sign of a difference. None counts
            all alarms.
        parameter_names: One name for each parameter. If None, those of ``rope``, or
            "theta_1" and so on.
        seed: Seed of everything random; None uses the states of torch, NumPy and
            Python. The simulations are those of ``rope.build_posterior`` with the same
            seed and number.
        show_progress_bars: Whether to show the progress of slow simulations, and how
            many folds are done. None does so in a terminal or a notebook, but not in a
            file.

    Returns:
        The findings. Print them, or pass them to
        :func:`sbi_rope.plots.implied_parameters`.

    Raises:
        InvalidInputError: If there are fewer than 100 simulations.
    """
    check("rope", rope, RoPE)
    check("posterior", posterior, MixturePosterior | None)
    check("num_folds", num_folds, Folds | None)
    tuned = len(rope.pairs) > 0
    if tuned and not rope.is_trained:
        rope = copy.copy(rope)  # which shares all data
        rope.train(seed=seed, show_progress_bars=show_progress_bars)
    with seeded(seed):
        # This comes first, so that a posterior with the same seed has these
        # simulations.
        batch = rope.embed(
            x_o, num_simulations=num_simulations, show_progress_bars=show_progress_bars
        )
        dim = batch.theta.shape[1]
        names = rope.parameter_names or default_names(dim)
        if parameter_names is not None:
            names = names_of(parameter_names, dim)
        if len(batch.theta) < FEWEST_SIMULATIONS:
            raise InvalidInputError(
                f"Expected at least {FEWEST_SIMULATIONS} simulations, to estimate the "
                f"thresholds; got {len(batch.theta)}."
            )
        coupling = batch.couple(rope.coupler)
        before = batch.npe.embed("x_o", batch.x_o, batch.npe.h)
        simulations = Simulations(
            theta=_moved(batch.theta), embedded=_moved(batch.simulated), tuned=tuned
        )
        real, sizes = _moved(batch.real), _moved(coupling.effective_sample_size)
        findings = misspecification_findings(
            _moved(before), real if tuned else None, simulations
        )
        support = support_of(real, simulations)
        findings += support.findings(sizes, len(simulations))
        held_out, notes = _held_out(
            rope, num_folds, show_progress_bars=is_shown(show_progress_bars)
        )
        shift = prior_shift(real, simulations, held_out=held_out)
        findings += shift.findings(simulations, names, notes)
        residual = []
        if held_out is not None:
            residual = residual_findings(rope, held_out, simulations, notes)
        findings += residual
        far = far_findings(batch.npe.h, batch.x_o)
        if not far:
            notes.append(NO_STANDARDISATION)
        findings += far
        # It decides whether anything that was found on the pairs holds for the batch.
        alike: tuple[str, ...] = ()
        if tuned:
            of_pairs = batch.npe.embed("x", rope.pairs.x, batch.npe.h)
            test = compare_with_pairs(
                of_pairs,
                rope.pairs.group.cpu(),
                before,
                batch.npe.density(),
            )
            findings = labelled_findings(test, names, notes) + findings
            alike = () if test is None else test.alike(names)
        prior = _moved(batch.npe.prior.sample(torch.Size((NUM_DRAWN,))))
    if not coupling.converged:
        notes.append(
            "The coupling has not converged, so that its effective sample sizes are "
            "approximate."
        )
    diagnosis = Diagnosis(
        findings=tuple(findings),
        notes=tuple(notes),
        flags=support.flags,
        effective_sample_size=sizes,
        distance=support.distance,
        theta=simulations.theta,
        implied=shift.batch.weights,
        unshifted=shift.expected[0].weights,
        residuals=None if held_out is None else held_out.residuals,
        parameter_names=names,
        prior=prior,
        like_pairs=alike,
    )
    if posterior is None:
        return diagnosis
    is_stack = isinstance(posterior, StackedPosterior)
    return read_for(diagnosis, posterior.report if is_stack else None)


def _held_out(
    rope: RoPE, num_folds: int | None, *, show_progress_bars: bool
) -> tuple[CrossFitted | None, list[str]]:
    """Return the embeddings of held-out calibration pairs, or why there are none."""
    if not len(rope.pairs):
        note = (
            "There are no calibration pairs, so that nothing was tuned. The tests that "
            "need labels were left out (misspecification after tuning, residuals, "
            "comparison with the pairs)."
        )
    elif num_folds is None:
        note = (
            "Residuals of calibration pairs were left out, as asked. Errors of the "
            "tuned embedding net can therefore look like a prior shift."
        )
    elif rope.pairs.num_groups < 2:
        note = (
            "Residuals were left out, because all calibration pairs have the same "
            "parameters (or group), or there is only one."
        )
    else:
        return cross_fit(
            rope, num_folds=num_folds, show_progress_bars=show_progress_bars
        ), []
    return None, [note]


def _moved(values: Tensor) -> Tensor:
    return values.detach().cpu().double()
