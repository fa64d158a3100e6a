"""Stacking weights against searches that know nothing of EM."""

import itertools
import math
import warnings

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torch import Tensor

from sbi_rope.stacking import stacking_weights
from sbi_rope.utils.errors import InvalidInputError, RoPEWarning

# Tight enough to compare weights, not only objectives.
EXACT = {"tolerance": 1e-9, "max_iterations": 200_000}


def random_scores(n: int, num_candidates: int, *, seed: int = 0) -> Tensor:
    """Log scores of which no candidate dominates: each is best at some pairs."""
    generator = torch.Generator().manual_seed(seed)
    scores = 1.5 * torch.randn(n, num_candidates, generator=generator)
    return scores.double() - 2.0


def objective(log_scores: Tensor, weights: Tensor, pseudo_count: float) -> Tensor:
    """The penalised sum of log scores at weights ``(..., K)``, as it is defined."""
    mixed = torch.einsum("ik,...k->...i", log_scores.exp(), weights)
    penalty = pseudo_count / weights.shape[-1] * weights.log().sum(dim=-1)
    return mixed.log().sum(dim=-1) + (penalty if pseudo_count else 0.0)


def simplex_grid(num_candidates: int, steps: int) -> Tensor:
    """All weights that are multiples of 1 / steps."""
    parts = itertools.product(range(steps + 1), repeat=num_candidates - 1)
    rows = [(*part, steps - sum(part)) for part in parts if sum(part) <= steps]
    return torch.tensor(rows, dtype=torch.double) / steps


def slsqp(log_scores: Tensor, pseudo_count: float) -> Tensor:
    """The weights that SciPy's general solver finds."""
    density = log_scores.exp().numpy()
    share = pseudo_count / density.shape[1]

    def negative(w: np.ndarray) -> float:
        return -float(np.log(density @ w).sum() + share * np.log(w).sum())

    def gradient(w: np.ndarray) -> np.ndarray:
        return -(density / (density @ w)[:, None]).sum(axis=0) - share / w

    count = density.shape[1]
    found = minimize(
        negative,
        np.full(count, 1 / count),
        jac=gradient,
        method="SLSQP",
        bounds=[(1e-9, 1.0)] * count,
        constraints={"type": "eq", "fun": lambda w: w.sum() - 1.0},
        options={"ftol": 1e-14, "maxiter": 1000},
    )
    assert found.success
    return torch.as_tensor(found.x)


def test_no_weights_on_a_grid_score_better() -> None:
    for num_candidates, steps in ((2, 2000), (3, 150)):
        scores = random_scores(12, num_candidates)
        grid = simplex_grid(num_candidates, steps)
        for pseudo_count in (0.0, 1.0, 7.0):
            result = stacking_weights(scores, pseudo_count=pseudo_count, **EXACT)
            values = objective(scores, grid, pseudo_count)
            found = objective(scores, result.weights, pseudo_count)
            best = grid[values.argmax()]
            case = (num_candidates, pseudo_count)
            assert found >= values.max() - 1e-9, case
            assert torch.allclose(result.weights, best, atol=2 / steps), case


def test_a_general_solver_finds_the_same_weights() -> None:
    for n, num_candidates, pseudo_count in ((3, 8, 0.3), (40, 5, 1.0), (200, 36, 20.0)):
        scores = random_scores(n, num_candidates, seed=n)
        weights = stacking_weights(scores, pseudo_count=pseudo_count, **EXACT).weights
        expected = slsqp(scores, pseudo_count)
        assert torch.allclose(weights, expected, atol=1e-4), n
        ours, theirs = (objective(scores, w, pseudo_count) for w in (weights, expected))
        assert ours >= theirs - 1e-8, n


def test_weights_are_positive_and_sum_to_one_in_double_precision() -> None:
    weights = stacking_weights(random_scores(30, 6)).weights
    assert weights.dtype is torch.float64
    assert weights.shape == (6,)
    assert (weights > 0).all()
    assert float(weights.sum()) == pytest.approx(1.0, abs=1e-12)


def test_the_order_of_candidates_and_pairs_does_not_matter() -> None:
    scores = random_scores(25, 6)
    columns, rows = torch.randperm(6), torch.randperm(25)
    weights = stacking_weights(scores, **EXACT).weights
    permuted = stacking_weights(scores[rows][:, columns], **EXACT).weights
    assert torch.allclose(permuted, weights[columns], atol=1e-9)


def test_the_gap_bounds_the_distance_of_the_objective_from_its_maximum() -> None:
    scores = random_scores(50, 8)
    for pseudo_count in (0.0, 1.0):
        best = stacking_weights(scores, pseudo_count=pseudo_count, **EXACT)
        highest = objective(scores, best.weights, pseudo_count)
        for max_iterations in (1, 3, 10, 30):
            early = stacking_weights(
                scores,
                pseudo_count=pseudo_count,
                tolerance=1e-9,
                max_iterations=max_iterations,
            )
            missing = float(highest - objective(scores, early.weights, pseudo_count))
            assert 0 < missing <= early.gap + 1e-8, (pseudo_count, max_iterations)


def test_copies_of_a_candidate_share_its_weight_and_do_not_change_the_mixture() -> None:
    scores = random_scores(30, 3)
    alone = stacking_weights(scores, pseudo_count=0.0, **EXACT)
    copied = torch.cat([scores, scores[:, :1], scores[:, :1]], dim=1)
    result = stacking_weights(copied, pseudo_count=0.0, **EXACT)
    mixed = copied.exp() @ result.weights
    assert torch.allclose(mixed, scores.exp() @ alone.weights, rtol=1e-6)
    assert float(result.weights[[0, 3, 4]].sum()) == pytest.approx(
        float(alone.weights[0]), abs=1e-6
    )
    assert torch.allclose(result.weights[1:3], alone.weights[1:], atol=1e-6)
    assert result.score == pytest.approx(alone.score, abs=1e-8)


def test_a_single_candidate_has_all_the_weight() -> None:
    scores = random_scores(10, 1)
    result = stacking_weights(scores)
    assert result.weights.tolist() == [1.0]
    assert result.score == pytest.approx(float(scores.mean()))
    assert result.converged


def test_a_candidate_without_density_at_any_pair_has_only_its_pseudo_count() -> None:
    scores = random_scores(20, 3)
    scores[:, 1] = -torch.inf
    others = scores[:, [0, 2]]
    result = stacking_weights(scores, pseudo_count=0.0, **EXACT)
    assert float(result.weights[1]) == 0.0
    expected = stacking_weights(others, pseudo_count=0.0, **EXACT)
    assert torch.allclose(result.weights[[0, 2]], expected.weights, atol=1e-6)
    assert result.score == pytest.approx(expected.score)

    result = stacking_weights(scores, pseudo_count=1.0, **EXACT)
    assert float(result.weights[1]) == pytest.approx((1 / 3) / 21)
    assert math.isfinite(result.score)


def test_a_pair_without_density_anywhere_is_left_out_with_a_warning() -> None:
    scores = random_scores(20, 3)
    unknown = torch.full((2, 3), -torch.inf)
    with pytest.warns(RoPEWarning, match="2 of 22 held-out pairs"):
        result = stacking_weights(torch.cat([unknown, scores]), **EXACT)
    expected = stacking_weights(scores, **EXACT)
    assert torch.equal(result.weights, expected.weights)
    assert result.score == expected.score


def test_a_pair_with_density_under_one_candidate_counts_without_a_warning() -> None:
    scores = random_scores(20, 3)
    scores[0, 1:] = -torch.inf
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = stacking_weights(scores, **EXACT)
    assert float(result.weights[0]) > 1 / 21
    expected = torch.logsumexp(scores + result.weights.log(), dim=1).mean()
    assert result.score == pytest.approx(float(expected))


def test_without_pairs_weights_are_equal() -> None:
    result = stacking_weights(torch.empty(0, 4))
    assert torch.allclose(result.weights, torch.full((4,), 0.25).double())
    assert result.converged
    with pytest.warns(RoPEWarning, match="3 of 3"):
        result = stacking_weights(torch.full((3, 4), -torch.inf))
    assert torch.allclose(result.weights, torch.full((4,), 0.25).double())


def test_a_constant_added_to_the_scores_of_a_pair_changes_no_weight() -> None:
    scores = random_scores(20, 4)
    weights = stacking_weights(scores, **EXACT).weights
    level = torch.linspace(-1e4, 1e4, 20, dtype=torch.double)[:, None]
    shifted = stacking_weights(scores + level, **EXACT)
    assert torch.allclose(shifted.weights, weights, atol=1e-9)
    assert math.isfinite(shifted.score)


def test_a_result_tells_whether_it_has_converged() -> None:
    scores = random_scores(50, 8)
    result = stacking_weights(scores, max_iterations=2, tolerance=1e-9)
    assert not result.converged
    assert result.num_iterations == 2
    assert result.gap > 1e-9
    enough = stacking_weights(scores)
    assert enough.converged
    assert enough.gap <= 1e-3


def test_weights_are_closer_to_equal_the_fewer_pairs_there_are() -> None:
    distances = []
    for n in (0, 2, 20, 200):
        # The same evidence again and again: only its amount changes.
        scores = random_scores(2, 4).repeat(n // 2, 1)
        weights = stacking_weights(scores, pseudo_count=5.0, **EXACT).weights
        distances.append(float((weights - 0.25).abs().sum()))
    assert distances[0] == 0.0
    assert distances == sorted(set(distances))


def test_scores_with_gradients_are_accepted_and_not_changed() -> None:
    scores = random_scores(20, 4).float().requires_grad_()
    before = scores.detach().clone()
    weights = stacking_weights(scores).weights
    assert not weights.requires_grad
    assert torch.equal(scores.detach(), before)
    assert torch.allclose(weights, stacking_weights(before.double()).weights)


def test_nan_plus_infinity_and_other_shapes_are_refused() -> None:
    for bad in (math.nan, math.inf):
        scores = random_scores(10, 3)
        scores[4, 1] = bad
        with pytest.raises(InvalidInputError, match="got NaN or Inf"):
            stacking_weights(scores)
    for shape in ((3,), (3, 0), (2, 3, 4)):
        with pytest.raises(InvalidInputError, match=r"shape \(n, K\)"):
            stacking_weights(torch.zeros(shape))
