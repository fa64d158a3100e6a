"""Stacking weights against searches that know nothing of EM."""

import itertools
import math
import warnings
from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torch import Tensor

from sbi_rope.errors import InvalidInputError, InvalidTypeError, RoPEWarning
from sbi_rope.stacking import stacking_weights

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


@pytest.mark.parametrize("pseudo_count", [0.0, 1.0, 7.0])
@pytest.mark.parametrize(("num_candidates", "steps"), [(2, 2000), (3, 150)])
def test_no_weights_on_a_grid_score_better(
    num_candidates: int, steps: int, pseudo_count: float
) -> None:
    scores = random_scores(12, num_candidates)
    result = stacking_weights(scores, pseudo_count=pseudo_count, **EXACT)
    grid = simplex_grid(num_candidates, steps)
    values = objective(scores, grid, pseudo_count)
    best = grid[values.argmax()]
    found = objective(scores, result.weights, pseudo_count)
    assert found >= values.max() - 1e-9
    assert torch.allclose(result.weights, best, atol=2 / steps)


@pytest.mark.parametrize("pseudo_count", [0.3, 1.0, 20.0])
@pytest.mark.parametrize(("n", "num_candidates"), [(3, 8), (40, 5), (200, 36)])
def test_a_general_solver_finds_the_same_weights(
    n: int, num_candidates: int, pseudo_count: float
) -> None:
    scores = random_scores(n, num_candidates, seed=n)
    weights = stacking_weights(scores, pseudo_count=pseudo_count, **EXACT).weights
    expected = slsqp(scores, pseudo_count)
    assert torch.allclose(weights, expected, atol=1e-4)
    ours, theirs = (objective(scores, w, pseudo_count) for w in (weights, expected))
    assert ours >= theirs - 1e-8


def test_weights_are_a_point_of_the_simplex() -> None:
    for seed in range(5):
        weights = stacking_weights(random_scores(30, 6, seed=seed)).weights
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


@pytest.mark.parametrize("pseudo_count", [0.0, 1.0])
@pytest.mark.parametrize("max_iterations", [1, 3, 10, 30])
def test_the_gap_bounds_what_is_missing_to_the_maximum(
    max_iterations: int, pseudo_count: float
) -> None:
    scores = random_scores(50, 8)
    best = stacking_weights(scores, pseudo_count=pseudo_count, **EXACT)
    early = stacking_weights(
        scores,
        pseudo_count=pseudo_count,
        tolerance=1e-9,
        max_iterations=max_iterations,
    )
    highest = objective(scores, best.weights, pseudo_count)
    missing = float(highest - objective(scores, early.weights, pseudo_count))
    assert 0 < missing <= early.gap + 1e-8


def test_the_mean_approaches_its_maximum_as_fast_as_em_promises() -> None:
    scores = random_scores(50, 8)
    best = stacking_weights(scores, pseudo_count=0.0, **EXACT).weights
    for t in (1, 5, 25, 125):
        early = stacking_weights(
            scores, pseudo_count=0.0, tolerance=1e-9, max_iterations=t
        )
        missing = objective(scores, best, 0.0) - objective(scores, early.weights, 0.0)
        assert float(missing) / 50 <= math.log(8) / t


@pytest.mark.parametrize("pseudo_count", [0.5, 1.0, 4.0])
def test_weights_are_a_fixed_point_of_em(pseudo_count: float) -> None:
    scores = random_scores(30, 5)
    weights = stacking_weights(scores, pseudo_count=pseudo_count, **EXACT).weights
    joint = weights * scores.exp()
    responsibilities = joint / joint.sum(dim=1, keepdim=True)
    again = (responsibilities.sum(dim=0) + pseudo_count / 5) / (30 + pseudo_count)
    assert torch.allclose(again, weights, atol=1e-8)


def test_copies_of_a_candidate_share_its_weight_and_change_no_mixture() -> None:
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


@pytest.mark.parametrize("pseudo_count", [0.0, 1.0])
def test_a_single_candidate_has_all_the_weight(pseudo_count: float) -> None:
    scores = random_scores(10, 1)
    result = stacking_weights(scores, pseudo_count=pseudo_count)
    assert result.weights.tolist() == [1.0]
    assert result.score == pytest.approx(float(scores.mean()))
    assert result.converged


def test_a_candidate_without_density_anywhere_keeps_its_pseudo_count_alone() -> None:
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


def test_a_pair_that_no_candidate_knows_is_left_out_with_a_warning() -> None:
    scores = random_scores(20, 3)
    unknown = torch.full((2, 3), -torch.inf)
    with pytest.warns(RoPEWarning, match="2 of 22 held-out pairs"):
        result = stacking_weights(torch.cat([unknown, scores]), **EXACT)
    expected = stacking_weights(scores, **EXACT)
    assert torch.equal(result.weights, expected.weights)
    assert result.score == expected.score


def test_a_pair_that_only_one_candidate_knows_earns_no_warning() -> None:
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


def test_pairs_that_all_candidates_dislike_count_as_much_as_others() -> None:
    scores = random_scores(20, 4)
    weights = stacking_weights(scores, **EXACT).weights
    level = torch.linspace(-1e4, 1e4, 20, dtype=torch.double)[:, None]
    shifted = stacking_weights(scores + level, **EXACT)
    assert torch.allclose(shifted.weights, weights, atol=1e-9)
    assert math.isfinite(shifted.score)


def test_scores_far_apart_do_not_underflow() -> None:
    far = -1e4
    scores = torch.tensor([[0.0, far], [0.0, far], [far, 0.0]], dtype=torch.double)
    result = stacking_weights(scores, pseudo_count=0.0)
    expected = torch.tensor([2 / 3, 1 / 3], dtype=torch.double)
    assert torch.allclose(result.weights, expected, atol=1e-6)
    best = math.log(2 / 3) * 2 / 3 + math.log(1 / 3) / 3
    assert result.score == pytest.approx(best)


def test_the_score_is_the_mean_log_score_of_the_mixture() -> None:
    scores = random_scores(20, 4)
    result = stacking_weights(scores)
    expected = (scores.exp() @ result.weights).log().mean()
    assert result.score == pytest.approx(float(expected))


def test_stopping_early_is_said() -> None:
    scores = random_scores(50, 8)
    result = stacking_weights(scores, max_iterations=2, tolerance=1e-9)
    assert not result.converged
    assert result.num_iterations == 2
    assert result.gap > 1e-9
    enough = stacking_weights(scores)
    assert enough.converged
    assert enough.gap <= 1e-3


def test_the_fewer_the_pairs_the_closer_are_the_weights_to_equal() -> None:
    distances = []
    for n in (0, 2, 20, 200):
        # The same evidence again and again: only its amount changes.
        scores = random_scores(2, 4).repeat(n // 2, 1)
        weights = stacking_weights(scores, pseudo_count=5.0, **EXACT).weights
        distances.append(float((weights - 0.25).abs().sum()))
    assert distances[0] == 0.0
    assert distances == sorted(set(distances))


def test_many_pairs_forget_the_pseudo_count() -> None:
    scores = random_scores(4, 3)
    free = stacking_weights(scores, pseudo_count=0.0, **EXACT).weights
    errors = []
    for n in (10, 100, 1000):
        weights = stacking_weights(scores.repeat(n, 1), pseudo_count=1.0, **EXACT)
        errors.append(float((weights.weights - free).abs().max()))
    # As 1 / n.
    assert errors[0] > 5 * errors[1] > 25 * errors[2]
    assert errors[2] < 1e-3


def test_a_large_pseudo_count_makes_weights_equal() -> None:
    result = stacking_weights(random_scores(20, 4), pseudo_count=1e9)
    assert torch.allclose(result.weights, torch.full((4,), 0.25).double(), atol=1e-6)


def test_pairs_that_all_candidates_score_the_same_say_nothing() -> None:
    scores = random_scores(10, 3)
    ties = torch.linspace(-5, 5, 30)[:, None].expand(-1, 3)
    alone = stacking_weights(scores, pseudo_count=0.0, **EXACT).weights
    among = stacking_weights(torch.cat([scores, ties]), pseudo_count=0.0, **EXACT)
    assert torch.allclose(among.weights, alone, atol=1e-6)


def test_the_scores_are_left_as_they_are() -> None:
    scores = random_scores(20, 4).float().requires_grad_()
    before = scores.detach().clone()
    weights = stacking_weights(scores).weights
    assert not weights.requires_grad
    assert torch.equal(scores.detach(), before)
    assert torch.allclose(weights, stacking_weights(before.double()).weights)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_nan_and_plus_infinity_are_refused(bad: float) -> None:
    scores = random_scores(10, 3)
    scores[4, 1] = bad
    with pytest.raises(InvalidInputError, match="without NaN and plus infinity"):
        stacking_weights(scores)


@pytest.mark.parametrize("shape", [(), (3,), (3, 0), (0, 0), (2, 3, 4)])
def test_other_shapes_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(InvalidInputError, match=r"shape \(pairs, candidates\)"):
        stacking_weights(torch.zeros(shape))


@pytest.mark.parametrize("bad", [None, [[0.0, 1.0]], np.zeros((2, 2))])
def test_what_is_no_tensor_is_refused(bad: Any) -> None:
    with pytest.raises(InvalidTypeError, match="log_scores"):
        stacking_weights(bad)


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        ("pseudo_count", -1.0),
        ("pseudo_count", math.nan),
        ("pseudo_count", math.inf),
        ("pseudo_count", "1"),
        ("pseudo_count", None),
        ("tolerance", 0.0),
        ("tolerance", math.nan),
        ("max_iterations", 0),
        ("max_iterations", 2.5),
    ],
)
def test_arguments_outside_their_range_are_refused(name: str, bad: Any) -> None:
    with pytest.raises(InvalidInputError, match=name):
        stacking_weights(random_scores(5, 2), **{name: bad})
