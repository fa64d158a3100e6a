"""Stacking weights against searches that know nothing of EM."""

import itertools
import math
import warnings

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torch import Tensor

from sbi_rope.stacking import stacking_weights, weights
from sbi_rope.utils.errors import InvalidInputError, RoPEWarning


@pytest.fixture(autouse=True)
def exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Iterate long enough to compare weights, not only objectives."""
    monkeypatch.setattr(weights, "TOLERANCE", 1e-9)
    monkeypatch.setattr(weights, "MAX_STEPS", 200_000)


def random_scores(n: int, num_candidates: int, *, seed: int = 0) -> Tensor:
    """Log scores of which no candidate dominates: each is best at some pairs."""
    generator = torch.Generator().manual_seed(seed)
    scores = 1.5 * torch.randn(n, num_candidates, generator=generator)
    return scores.double() - 2.0


def objective(log_scores: Tensor, weights: Tensor) -> Tensor:
    """The penalised sum of log scores at weights ``(..., K)``, as it is defined."""
    mixed = torch.einsum("ik,...k->...i", log_scores.exp(), weights)
    return mixed.log().sum(dim=-1) + weights.log().mean(dim=-1)


def slsqp(log_scores: Tensor) -> Tensor:
    """The weights that SciPy's general solver finds."""
    density = log_scores.exp().numpy()
    count = density.shape[1]

    def negative(w: np.ndarray) -> float:
        return -float(np.log(density @ w).sum() + np.log(w).mean())

    def gradient(w: np.ndarray) -> np.ndarray:
        return -(density / (density @ w)[:, None]).sum(axis=0) - 1 / count / w

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


@pytest.mark.parametrize(("num_candidates", "steps"), [(2, 2000), (3, 150)])
def test_no_weights_on_a_grid_score_better(num_candidates: int, steps: int) -> None:
    scores = random_scores(12, num_candidates)
    parts = itertools.product(range(steps + 1), repeat=num_candidates - 1)
    rows = [(*part, steps - sum(part)) for part in parts if sum(part) <= steps]
    grid = torch.tensor(rows, dtype=torch.double) / steps
    values, found = objective(scores, grid), stacking_weights(scores)
    assert objective(scores, found) >= values.max() - 1e-9
    assert torch.allclose(found, grid[values.argmax()], atol=2 / steps)


@pytest.mark.parametrize(("n", "num_candidates"), [(3, 8), (40, 5), (200, 36)])
def test_a_general_solver_finds_the_same_weights(n: int, num_candidates: int) -> None:
    scores = random_scores(n, num_candidates, seed=n)
    found, expected = stacking_weights(scores), slsqp(scores)
    assert torch.allclose(found, expected, atol=1e-4)
    assert objective(scores, found) >= objective(scores, expected) - 1e-8


def test_neither_order_dtype_nor_a_constant_at_each_pair_changes_the_weights() -> None:
    scores = random_scores(25, 6).float().requires_grad_()
    found = stacking_weights(scores)
    assert found.dtype is torch.float64
    assert not found.requires_grad
    assert float(found.sum()) == pytest.approx(1.0, abs=1e-12)
    columns, rows = torch.randperm(6), torch.randperm(25)
    level = torch.linspace(-1e4, 1e4, 25, dtype=torch.double)[:, None]
    moved = scores.detach().double()[rows][:, columns] + level
    assert torch.allclose(stacking_weights(moved), found[columns], atol=1e-9)


def test_a_candidate_without_density_at_any_pair_has_only_its_pseudo_count() -> None:
    scores = random_scores(20, 3)
    scores[:, 1] = -torch.inf
    assert float(stacking_weights(scores)[1]) == pytest.approx((1 / 3) / 21)
    assert stacking_weights(scores[:, :1]).tolist() == [1.0]


def test_a_pair_without_density_anywhere_is_left_out_with_a_warning() -> None:
    scores = random_scores(20, 3)
    unknown = torch.full((2, 3), -torch.inf)
    with pytest.warns(RoPEWarning, match="2 of 22 held-out pairs"):
        found = stacking_weights(torch.cat([unknown, scores]))
    assert torch.equal(found, stacking_weights(scores))
    scores[0, 1:] = -torch.inf  # one candidate is enough
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert float(stacking_weights(scores)[0]) > 1 / 21


def test_weights_are_closer_to_equal_the_fewer_pairs_there_are() -> None:
    distances = []
    for n in (0, 2, 20, 200):
        # The same evidence again and again: only its amount changes.
        scores = random_scores(2, 4).repeat(n // 2, 1)
        distances.append(float((stacking_weights(scores) - 0.25).abs().sum()))
    assert distances[0] == 0.0
    assert distances == sorted(set(distances))


def test_weights_that_have_not_converged_give_a_warning(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scores = random_scores(50, 8)
    best = float(objective(scores, stacking_weights(scores)))
    monkeypatch.setattr(weights, "MAX_STEPS", 3)
    with pytest.warns(RoPEWarning, match="have not converged") as warned:
        early = stacking_weights(scores)
    # The gap bounds what is missing.
    [message] = [str(one.message) for one in warned]
    gap = float(message.split("up to ")[1].split(" nats")[0])
    assert 0 < (best - float(objective(scores, early))) / 51 <= gap + 1e-3


def test_nan_plus_infinity_and_other_shapes_are_refused() -> None:
    for bad in (math.nan, math.inf):
        scores = random_scores(10, 3)
        scores[4, 1] = bad
        with pytest.raises(InvalidInputError, match="got NaN or Inf"):
            stacking_weights(scores)
    with pytest.raises(InvalidInputError, match=r"shape \(n, K\)"):
        stacking_weights(torch.zeros(3))
