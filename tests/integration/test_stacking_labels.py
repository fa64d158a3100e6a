"""Stacks of pairs whose labels are noisy, partial, weighted, or draws."""

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from sbi_rope import RoPE, stack
from sbi_rope.metrics import Estimate, evaluate
from sbi_rope.npe.prior import PriorDistribution
from sbi_rope.report import write_html
from tests import gaussian
from tests.stacks import (
    CANDIDATES,
    NPE,
    NUM_PAIRS,
    PRIOR,
    QUIET,
    problem,
    rope_of,
    scores_of,
    validated,
)

THETA, X = problem(NUM_PAIRS, seed=1)
PARTIAL = THETA.clone()
PARTIAL[::2, 0] = math.nan


def labelled(theta: Any, **options: Any) -> RoPE:
    return rope_of((THETA[:0], X[:0])).append_calibration(theta, X, **options)


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
    partial = theta.where(torch.rand_like(theta) > 0.5, torch.nan)

    def score(theta: torch.Tensor, **options: Any) -> float:
        rope = RoPE(gaussian.posterior(), simulator=gaussian.simulator)
        rope.append_calibration(theta, x, **options)
        return evaluate(stack(rope, seed=0, **QUIET), *test, num_samples=20).lpp.mean

    exact = score(theta)
    assert score(noisy, theta_std=0.5) > exact - 0.1
    assert score(noisy) < exact - 0.1
    assert score(partial) > exact - 0.1
