"""The weights of a stack against the objective that they maximise."""

import math
import warnings

import pytest
import torch
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
    """The penalised sum of log scores as it is defined."""
    return (log_scores.exp() @ weights).log().sum() + weights.log().mean()


@pytest.mark.parametrize(("n", "num_candidates"), [(3, 8), (40, 5), (200, 36)])
def test_no_other_weights_are_better(n: int, num_candidates: int) -> None:
    """A concave objective has its maximum where all its derivatives are equal."""
    scores = random_scores(n, num_candidates, seed=n)
    found = stacking_weights(scores).requires_grad_()
    objective(scores, found).backward()
    assert float(found.detach().sum()) == pytest.approx(1.0, abs=1e-12)
    assert found.grad is not None
    assert torch.allclose(found.grad, found.grad.mean(), rtol=1e-4)


def test_a_candidate_without_density_at_any_pair_has_only_its_pseudo_count() -> None:
    scores = random_scores(20, 3)
    scores[:, 1] = -torch.inf
    assert float(stacking_weights(scores)[1]) == pytest.approx((1 / 3) / 21)
    assert stacking_weights(scores[:, :1]).tolist() == [1.0]
    assert stacking_weights(scores[:0]).tolist() == [1 / 3] * 3


def test_neither_order_dtype_nor_a_constant_at_each_pair_changes_the_weights() -> None:
    scores = random_scores(25, 6).float().requires_grad_()
    found = stacking_weights(scores)
    assert found.dtype is torch.float64
    assert not found.requires_grad
    columns, rows = torch.randperm(6), torch.randperm(25)
    level = torch.linspace(-1e4, 1e4, 25, dtype=torch.double)[:, None]
    moved = scores.detach().double()[rows][:, columns] + level
    assert torch.allclose(stacking_weights(moved), found[columns], atol=1e-9)


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


def test_nan_plus_infinity_and_other_shapes_are_refused() -> None:
    for bad in (math.nan, math.inf):
        scores = random_scores(10, 3)
        scores[4, 1] = bad
        with pytest.raises(InvalidInputError, match="got NaN or Inf"):
            stacking_weights(scores)
    with pytest.raises(InvalidInputError, match=r"shape \(n, K\)"):
        stacking_weights(torch.zeros(3))
