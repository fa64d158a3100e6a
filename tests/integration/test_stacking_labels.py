"""Stacks of noisy, partial, weighted and drawn labels, and of x without labels."""

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.distributions import Independent, Normal

from sbi_rope import RoPE, stack
from sbi_rope.data.simulate import Moments
from sbi_rope.discrepancy.unlabelled import Marginal, fit_unlabelled
from sbi_rope.metrics import Estimate, evaluate
from sbi_rope.npe.prior import PriorDistribution
from sbi_rope.report import write_html
from sbi_rope.stacking import default_candidates
from sbi_rope.stacking.candidates import UnlabelledCandidate
from sbi_rope.utils.errors import InvalidInputError
from tests import gaussian
from tests.stacks import (
    CANDIDATES,
    NPE,
    NUM_PAIRS,
    PRIOR,
    QUIET,
    observed,
    problem,
    rope_of,
    scores_of,
    stacked,
    validated,
)

pytestmark = pytest.mark.filterwarnings(
    "ignore::sbi_rope.utils.errors.RoPEWarning", "ignore:Maximum number of epochs"
)
THETA, X = problem(NUM_PAIRS, seed=1)
PARTIAL = THETA.clone()
PARTIAL[::2, 0] = math.nan


def labelled(theta: Tensor, **options: Any) -> RoPE:
    return rope_of((theta, X), **options)


@pytest.mark.medium
def test_a_stack_is_scored_on_what_was_measured(tmp_path: Path) -> None:
    rope = labelled(PARTIAL, theta_std=0.1)
    report = validated(rope, candidates=CANDIDATES[:4])
    is_known, held_out = ~torch.isnan(PARTIAL), report.held_out
    assert torch.isfinite(report.log_scores).all()
    assert torch.equal(~torch.isnan(held_out.levels), is_known)
    # In standard deviations of the prior, each parameter that was measured counts.
    units = PriorDistribution(rope.npe.prior).log_units()
    expected = Estimate.of(held_out.log_prob + is_known.to(units) @ units)
    assert vars(held_out.lpp_z) == pytest.approx(vars(expected))
    assert report.set_scores is None
    known = "Known were 20 labels, 20 with noise and 10 partial."
    assert known in str(report)
    write_html(report, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert known in page
    assert ">nan<" not in page


@pytest.mark.medium
def test_exact_labels_among_others_give_sets_with_a_guarantee() -> None:
    """One of each specimen counts, and none whose label is noisy or partial."""
    std = torch.zeros(NUM_PAIRS, 2)
    std[1] = 0.1
    groups = [*range(16), 15, 15, 0, 2]
    rope = labelled(PARTIAL, theta_std=std, groups=groups)
    scores = validated(rope, candidates=[PRIOR, NPE]).set_scores
    # Nine labels are exact, and two of these are of specimen 15.
    assert scores is not None
    assert len(scores) == 8
    assert torch.isfinite(scores.joint).all()


def test_labels_of_no_or_little_noise_are_scored_like_exact_ones() -> None:
    exact, none, little = (
        validated(labelled(THETA, theta_std=std), candidates=[PRIOR, NPE])
        for std in (None, 0.0, 1e-5)
    )
    assert torch.equal(none.log_scores, exact.log_scores)
    assert torch.equal(none.held_out.log_prob, exact.held_out.log_prob)
    assert torch.allclose(little.log_scores, exact.log_scores, atol=0.05)
    assert torch.allclose(little.held_out.levels, exact.held_out.levels, atol=0.01)


@pytest.mark.medium
def test_labels_given_as_draws_are_scored_relative_to_the_prior() -> None:
    draws = (THETA[:, None] + 0.05 * torch.randn(NUM_PAIRS, 30, 2)).clamp(-0.99, 0.99)
    draws[0, :5, 0] = 1.0  # on a bound of the prior
    report = validated(labelled(draws), candidates=[PRIOR, NPE])
    assert report.log_scores.isfinite().all()
    of_prior = scores_of(report, "prior")
    assert torch.allclose(of_prior, torch.zeros_like(of_prior), atol=1e-5)
    assert torch.isnan(report.held_out.levels).all()
    text = " ".join(str(report).split())
    assert "Coverage is not known" in text
    assert "relative to that of the prior" in text


@pytest.mark.medium
def test_a_parameter_that_was_never_measured_is_named() -> None:
    theta = torch.stack([torch.full((NUM_PAIRS,), math.nan), THETA[:, 1]], dim=1)
    report = validated(labelled(theta), candidates=[PRIOR, NPE])
    assert torch.isfinite(report.held_out.coverage.nanmean(dim=1)).all()
    assert "theta_1 was not measured" in str(report)


def test_the_weights_of_pairs_decide_for_the_candidate_that_they_favour() -> None:
    # NPE is right about the first half, and the prior about the others.
    x = X - 0.4
    x[10:] = x[10:].flip(0) + 0.5
    weights = torch.ones(NUM_PAIRS)
    found = []
    for factor in (20.0, 0.05):
        weights[:10] = factor
        rope = rope_of((THETA, x), weights=weights)
        scores = validated(rope, candidates=[PRIOR, NPE])
        found.append(float(scores.weights[1]))
        of_npe = scores_of(scores, "NPE")
        expected = (weights * of_npe).sum() / weights.sum()
        assert scores.held_out.mean(of_npe).mean == pytest.approx(float(expected))
    assert found[0] > found[1] + 0.2


@pytest.mark.slow
def test_noise_that_is_told_costs_little_and_less_than_noise_that_is_not() -> None:
    torch.manual_seed(0)
    theta, x = gaussian.labelled(50)
    test = gaussian.labelled(500)
    noisy = theta + 0.5 * torch.randn_like(theta)
    hidden = torch.rand(50) > 0.5
    hidden = torch.stack([hidden, ~hidden & (torch.rand(50) > 0.5)], dim=1)
    partial = theta.masked_fill(hidden, torch.nan)

    def score(theta: Tensor, **options: Any) -> float:
        rope = RoPE(gaussian.posterior(), simulator=gaussian.simulator)
        rope.append_calibration(theta, x, **options)
        return evaluate(stack(rope, seed=0, **QUIET), *test, num_samples=20).lpp.mean

    exact = score(theta)
    assert score(noisy, theta_std=0.5) > exact - 0.1
    assert score(noisy) < exact - 0.1
    assert score(partial) > exact - 0.1


# --- observations without labels ---


GAIN = torch.tensor([[0.8, 0.1], [0.0, 1.1]]).double()
OFFSET, ERROR_STD, NOISE_STD = torch.tensor([0.3, -0.2]).double(), 0.2, 0.1


def world(n: int) -> tuple[Tensor, Tensor]:
    """Means of simulations that are not normal, and real observations of them."""
    mean = torch.randn(n, 2).double()
    mean = torch.stack([mean[:, 0], 0.5 * mean[:, 1] + mean[:, 0].square() - 1], dim=1)
    simulated = mean + NOISE_STD * torch.randn(n, 2)
    return mean, simulated @ GAIN.T + OFFSET + ERROR_STD * torch.randn(n, 2)


def fit(z: Tensor, mean: Tensor, z_o: Tensor, weights: Tensor | None = None) -> list:
    noise = NOISE_STD**2 * torch.eye(2).double().expand(len(z), -1, -1)
    moments = Moments(means=mean[:, None], covariance=noise)
    weights = torch.ones(1, len(z)).double() if weights is None else weights
    simulated = world(3000)[0] + NOISE_STD * torch.randn(3000, 2)
    return fit_unlabelled(z, moments, weights, z_o, Marginal.of(simulated))


@pytest.mark.medium
def test_observations_without_labels_sharpen_what_six_labels_say() -> None:
    mean, z = world(6)
    _, z_o = world(200)
    truth = torch.cat([GAIN.flatten(), OFFSET])
    stds = []
    for some in (z_o[:0], z_o):
        [found] = fit(z, mean, some)
        draws = found.sample(2000, smallest_error=0.0, seed=0)
        drawn = torch.cat([draws.gain.flatten(1), draws.offset], dim=1)
        assert ((drawn.mean(dim=0) - truth).abs() < 3.5 * drawn.std(dim=0)).all()
        stds.append(drawn.std(dim=0))
        error = (draws.error_factor @ draws.error_factor.mT).mean(dim=0)
    assert (stds[1] < stds[0]).all()
    assert stds[1].mean() < 0.75 * stds[0].mean()
    assert error.diagonal().sqrt().numpy() == pytest.approx(ERROR_STD, rel=0.3)


@pytest.mark.medium
def test_versions_see_their_own_pairs_only_and_a_weight_is_as_many_pairs() -> None:
    mean, z = world(8)
    _, z_o = world(40)
    weights = torch.ones(2, 8).double()
    weights[0, 5:], weights[1, :2] = 0.0, 2.0
    state = torch.get_rng_state()
    both = fit(z, mean, z_o, weights)
    for version, rows in enumerate((list(range(5)), [0, 0, 1, 1, *range(2, 8)])):
        torch.set_rng_state(state)
        [alone] = fit(z[rows], mean[rows], z_o)
        assert torch.allclose(alone.mode, both[version].mode, atol=1e-3)


@pytest.mark.medium
def test_thirty_observations_bring_it_into_the_default_stack() -> None:
    rope, x_o = rope_of(), observed(30)
    plain = [candidate.name for candidate in default_candidates(rope)]
    made = stacked(rope, x_o)
    assert [c.name for c in default_candidates(rope, x_o)] == [*made.candidate_weights]
    assert [*made.candidate_weights] == [*plain, UnlabelledCandidate(x_o).name]
    # It answers any x.
    assert made.log_prob(torch.zeros(1, 2), x=observed(5)[4] + 0.1).isfinite()
    assert [c.name for c in default_candidates(rope, x_o[:29])] == plain
    with pytest.raises(InvalidInputError, match="NaN"):
        default_candidates(rope_of(), torch.full((120, 3), float("nan")))


@pytest.mark.slow
def test_with_the_prior_of_the_observations_it_is_almost_the_exact_posterior() -> None:
    torch.manual_seed(0)
    theta = gaussian.prior().sample((1020,))
    x = gaussian.simulator(theta) + 0.7 * torch.randn(1020, 2)
    rope = RoPE(gaussian.posterior(), simulator=gaussian.simulator)
    rope.append_calibration(theta[:20], x[:20])
    candidate = UnlabelledCandidate(x[20:])
    posterior = stack(
        rope, candidates=[PRIOR, NPE, candidate], seed=0, show_progress_bars=False
    )
    assert posterior.candidate_weights[candidate.name] > 0.6
    variance = gaussian.NOISE_STD**2 + 0.7**2
    std = torch.tensor((variance / (1 + variance)) ** 0.5)
    exact = Independent(Normal(x / (1 + variance), std), 1).log_prob(theta)
    found = posterior.versions[2].average.log_prob(theta[None], x)[0]
    assert float(found.mean()) > float(exact.mean()) - 0.1
