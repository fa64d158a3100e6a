"""Stacks of pairs whose labels are noisy, partial, weighted, or draws."""

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from sbi_rope import RoPE, load, stack
from sbi_rope.metrics import evaluate
from sbi_rope.npe.prior import PriorDistribution
from sbi_rope.report import write_html
from sbi_rope.saving import save
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


def labelled(theta: Any, **options: Any) -> RoPE:
    empty = problem(0, seed=1)
    return rope_of(empty).append_calibration(
        theta, problem(NUM_PAIRS, seed=1)[1], **options
    )


THETA = problem(NUM_PAIRS, seed=1)[0]
PARTIAL = THETA.clone()
PARTIAL[::2, 0] = math.nan


@pytest.mark.medium
def test_a_stack_is_scored_on_what_was_measured(tmp_path: Any) -> None:
    rope = labelled(PARTIAL, theta_std=0.1)
    posterior = stacked(rope, candidates=CANDIDATES[:4])
    scores = posterior.report
    assert torch.isfinite(scores.log_scores).all()
    assert torch.equal(torch.isnan(scores.held_out.levels), torch.isnan(PARTIAL))
    # In standard deviations of the prior, each parameter that was measured counts.
    units = PriorDistribution(rope.npe.prior).log_units()
    in_units = scores.held_out.log_prob + (~torch.isnan(PARTIAL)).to(units) @ units
    score = posterior.report.held_out.lpp_z
    assert score.mean == pytest.approx(float(in_units.mean()), rel=1e-6)
    error = float(in_units.std()) / 20**0.5
    assert score.high - score.mean == pytest.approx(2.093 * error, rel=1e-3)
    known = "Known were 20 labels, 20 with noise and 10 partial."
    assert known in str(posterior.report)
    assert math.isfinite(posterior.report.held_out.acauc.mean)
    with pytest.raises(InvalidInputError, match="some exact labels"):
        posterior.credible_set(0.8, x=observed()[:1], guaranteed=True)
    save(posterior, tmp_path / "stack")
    write_html(load(tmp_path / "stack").report, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert known in page
    assert ">nan<" not in page


@pytest.mark.medium
def test_exact_labels_among_others_give_sets_with_a_guarantee() -> None:
    """One of each specimen counts, and none whose label is noisy or partial."""
    std = torch.zeros(NUM_PAIRS, 2)
    std[1] = 0.1
    options = {"theta_std": std, "groups": [*range(16), 15, 15, 0, 2]}
    posterior = stacked(labelled(PARTIAL, **options), candidates=[PRIOR, NPE])
    is_exact = ~torch.isnan(PARTIAL).any(dim=1) & (std[:, 0] == 0)
    scores = posterior.report.set_scores
    assert scores is not None
    # Nine labels are exact, and two of these are of specimen 15.
    assert int(is_exact.sum()) == 9
    assert len(scores) == 8
    assert torch.isfinite(scores.joint).all()
    with pytest.raises(InvalidInputError, match="8 exact labels"):
        posterior.credible_set(0.9, observed()[:1], guaranteed=True)


def test_a_single_label_may_be_partial() -> None:
    """Folds without it have as many draws of each label as the fold with it."""
    theta = THETA.clone()
    theta[0, 0] = math.nan
    scores = validated(labelled(theta), candidates=[PRIOR, CANDIDATES[3]])
    assert torch.isfinite(scores.log_scores).all()


def test_labels_of_vanishing_noise_are_scored_like_exact_ones() -> None:
    exact = validated(labelled(THETA), candidates=[PRIOR, NPE])
    noisy = validated(labelled(THETA, theta_std=1e-5), candidates=[PRIOR, NPE])
    assert torch.allclose(noisy.log_scores, exact.log_scores, atol=0.05)
    assert torch.allclose(noisy.held_out.levels, exact.held_out.levels, atol=0.01)
    assert torch.allclose(noisy.held_out.log_prob, exact.held_out.log_prob, atol=0.1)


@pytest.mark.medium
def test_labels_given_as_draws_are_scored_relative_to_the_prior() -> None:
    draws = (THETA[:, None] + 0.05 * torch.randn(NUM_PAIRS, 30, 2)).clamp(-0.99, 0.99)
    posterior = stacked(labelled(draws), candidates=[PRIOR, NPE])
    scores = posterior.report
    assert torch.allclose(
        scores_of(scores, "prior"), torch.zeros(1).double(), atol=1e-5
    )
    assert torch.isnan(scores.held_out.levels).all()
    text = " ".join(str(posterior.report).split())
    assert "Coverage is not known" in text
    assert "relative to that of the prior" in text
    # Where draws are on a bound of the prior, too.
    draws[0, :5, 0] = 1.0
    scores = validated(labelled(draws), candidates=[PRIOR, NPE])
    assert torch.isfinite(scores.log_scores).all()


@pytest.mark.medium
def test_a_parameter_that_was_never_measured_is_named(tmp_path: Path) -> None:
    theta = THETA.clone()
    theta[:, 0] = math.nan
    report = stacked(labelled(theta), candidates=[PRIOR, NPE]).report
    assert torch.isfinite(report.held_out.coverage.nanmean(dim=1)).all()
    assert "theta_1 was not measured" in str(report)
    write_html(report, tmp_path / "never.html")
    assert "theta_1 was not measured" in (tmp_path / "never.html").read_text()


def test_labels_without_noise_take_the_path_of_exact_ones() -> None:
    exact, found = (
        validated(labelled(THETA, **some), candidates=[PRIOR, CANDIDATES[3]])
        for some in ({}, {"theta_std": 0.0, "weights": [1.0] * 20})
    )
    assert torch.equal(exact.log_scores, found.log_scores)
    assert torch.equal(exact.held_out.log_prob, found.held_out.log_prob)


def test_the_weights_of_pairs_decide_for_the_candidate_that_they_favour() -> None:
    # NPE is right about the first half, and the prior about the others.
    theta, x = problem(NUM_PAIRS, seed=1)
    x = x - 0.4
    x[10:] = x[10:].flip(0) + 0.5
    weights = torch.ones(NUM_PAIRS)
    found = []
    for factor in (20.0, 0.05):
        weights[:10] = factor
        conductor = rope_of(problem(0, seed=1))
        conductor.append_calibration(theta, x, weights=weights)
        scores = validated(conductor, candidates=[PRIOR, NPE])
        found.append(float(scores.weights[1]))
        of_npe = scores_of(scores, "NPE")
        mean = scores.held_out.mean(of_npe).mean
        expected = (weights * of_npe).sum() / weights.sum()
        assert math.isclose(mean, float(expected), rel_tol=1e-6)
    assert found[0] > found[1] + 0.2


@pytest.mark.slow
def test_noise_that_is_told_costs_little_and_less_than_noise_that_is_not() -> None:
    torch.manual_seed(0)
    theta, x = gaussian.labelled(50)
    test = gaussian.labelled(500)
    noisy = theta + 0.5 * torch.randn_like(theta)
    partial = theta.where(torch.rand_like(theta) > 0.5, torch.nan)

    def score(theta: torch.Tensor, **options: Any) -> float:
        rope = RoPE(gaussian.posterior(), simulator=gaussian.simulator)
        rope.append_calibration(theta, x, **options)
        return evaluate(stack(rope, seed=0, **QUIET), *test, num_samples=20).lpp.mean

    exact = score(theta)
    assert score(noisy, theta_std=0.5) > exact - 0.1
    assert score(noisy) < exact - 0.1
    assert score(partial) > exact - 0.1
