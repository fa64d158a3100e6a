"""sbi's own diagnostics and plots run unchanged on a MixturePosterior.

True parameters that are drawn from the posteriors are calibrated by construction, so
that the diagnostics must find nothing. They must notice shifted parameters.
"""

import warnings
from typing import Any

import pytest
import torch
from sbi.diagnostics import check_sbc, check_tarp, run_sbc, run_tarp
from sbi.diagnostics.misspecification import calculate_p_misspecification
from sbi.diagnostics.sbc import check_uniformity_frequentist
from torch import Tensor

from sbi_rope import CalibrationFinetuner, MixturePosterior, RoPE
from sbi_rope.npe.sbi import embed
from tests import problems

NUM_OBSERVATIONS = 60
OPTIONS: Any = {"num_posterior_samples": 200, "show_progress_bar": False}


@pytest.fixture
def posterior() -> MixturePosterior:
    """Gaussian components leaking out of the prior, so that all of it is exercised."""
    return problems.gaussian_posterior(n_o=NUM_OBSERVATIONS, n_s=40, std=0.5)


@pytest.fixture
def theta(posterior: MixturePosterior) -> Tensor:
    return posterior.sample_batched((), posterior.x_o, show_progress_bars=False)


@pytest.mark.slow
def test_sbc_accepts_calibrated_posteriors_and_notices_shifted_ones(
    posterior: MixturePosterior, theta: Tensor
) -> None:
    with warnings.catch_warnings():
        # It would fall back to sampling one by one.
        warnings.filterwarnings("error", message=".*[Bb]atched sampling.*")
        ranks, dap = run_sbc(theta, posterior.x_o, posterior, **OPTIONS)
    checks = check_sbc(ranks, theta, dap, num_posterior_samples=200)
    assert checks["ks_pvals"].min() > 0.01
    shifted = (theta + 0.6).clamp(-1, 1)
    ranks, _ = run_sbc(shifted, posterior.x_o, posterior, **OPTIONS)
    # The first of the checks alone: the others train classifiers.
    assert check_uniformity_frequentist(ranks, 200).max() < 1e-3


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_sbc_works_without_batched_sampling_and_in_other_processes(
    posterior: MixturePosterior, theta: Tensor, workers: int
) -> None:
    options = {"num_workers": workers, "use_batched_sampling": False, **OPTIONS}
    ranks, _ = run_sbc(theta[:4], posterior.x_o[:4], posterior, **options)
    assert ranks.shape == (4, 2)
    assert ((ranks >= 0) & (ranks <= 200)).all()


def test_expected_coverage_is_nominal_for_calibrated_posteriors(
    posterior: MixturePosterior, theta: Tensor
) -> None:
    reduced = {"reduce_fns": posterior.log_prob, **OPTIONS}
    ranks, _ = run_sbc(theta, posterior.x_o, posterior, **reduced)
    assert ranks.shape == (NUM_OBSERVATIONS, 1)
    levels = ranks[:, 0].double() / 200
    # Uniform, with four standard errors on mean and spread.
    assert abs(float(levels.mean()) - 0.5) < 4 / (12 * NUM_OBSERVATIONS) ** 0.5
    assert 0.2 < float(levels.std()) < 0.38


def test_tarp_accepts_calibrated_posteriors(
    posterior: MixturePosterior, theta: Tensor
) -> None:
    ecp, alpha = run_tarp(theta, posterior.x_o, posterior, **OPTIONS)
    area, p_value = check_tarp(ecp, alpha)
    assert abs(area) < 2
    assert p_value > 0.05


@pytest.mark.medium
def test_misspecification_is_noticed_before_tuning_and_much_smaller_after() -> None:
    torch.manual_seed(7)
    npe = problems.npe_posterior("maf", "none", num_epochs=30)
    theta = npe.prior.sample((NUM_OBSERVATIONS + 30,))
    x = problems.simulate(theta) + 0.5
    finetuner = CalibrationFinetuner(max_num_epochs=200, learning_rate=1e-2)
    rope = RoPE(npe, simulator=problems.simulate, finetuner=finetuner)
    rope.append_calibration(theta[:30], x[:30]).train(seed=0, show_progress_bars=False)
    simulated = problems.simulate(problems.box(2).sample((300,)))
    h, g = rope.npe.h, rope.tuned_embedding_net
    before, after = (
        calculate_p_misspecification(
            embed(net, x[30:]), embed(h, simulated), n_shuffle=99
        )
        for net in (h, g)
    )
    assert before[0] < 0.02
    assert after[1][1] < 0.3 * before[1][1]
