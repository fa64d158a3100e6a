"""sbi's own diagnostics and plots run unchanged on a MixturePosterior.

True parameters that are drawn from the posteriors are calibrated by construction, so
that the diagnostics must find nothing. They must notice shifted parameters.
"""

import warnings
from typing import Any

import pytest
from sbi.diagnostics import check_sbc, run_sbc
from sbi.diagnostics.sbc import check_uniformity_frequentist
from torch import Tensor

from sbi_rope import MixturePosterior
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
