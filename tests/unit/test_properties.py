"""Properties that hold for any numbers, however large, small or many."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from sbi_rope import SinkhornCoupler
from sbi_rope.data.pairs import Pairs, split_pairs
from sbi_rope.discrepancy import DiscrepancyModel, learn_parameters
from sbi_rope.metrics.evaluation import estimates_and_ranks
from sbi_rope.stacking import stacking_weights
from sbi_rope.utils.errors import RoPEError

# The same examples every time, and only as many as take a second or two.
brief = settings(derandomize=True, max_examples=60, deadline=None, database=None)


@st.composite
def matrices(
    draw: st.DrawFn, *, rows: tuple[int, int] = (1, 12), width: int = 2, largest: float
) -> Tensor:
    """A matrix whose columns have their own scale and centre, with ties in places."""
    n = draw(st.integers(*rows))
    numbers = st.lists(st.floats(-3, 3, width=32), min_size=width, max_size=width)
    values = torch.tensor([draw(numbers) for _ in range(n)], dtype=torch.double)
    exponents = st.floats(-math.log10(largest), math.log10(largest))
    scale = draw(st.lists(exponents, min_size=width, max_size=width))
    values = values * 10.0 ** torch.tensor(scale, dtype=torch.double)
    return values + draw(st.sampled_from([0.0, 1.0, -1e4]))


@pytest.mark.filterwarnings("ignore:Coupling a batch", "ignore:The coupling has not")
@brief
@given(
    real=matrices(largest=1e4),
    simulated=matrices(largest=1e4),
    gamma=st.floats(1e-3, 1e6),
    tau=st.floats(0, 1),
    solver=st.sampled_from(["own", "pot"]),
)
def test_rows_of_a_coupling_are_probabilities_whatever_the_embeddings(
    real: Tensor, simulated: Tensor, gamma: float, tau: float, solver: str
) -> None:
    coupler = SinkhornCoupler(gamma=gamma, tau=tau, solver=solver, max_iterations=50)
    try:
        coupling = coupler.couple(real, simulated)
    except RoPEError:
        return
    assert (coupling.weights >= 0).all()
    assert torch.allclose(coupling.weights.sum(dim=1), torch.ones(()).double())
    assert coupling.converged == (coupling.marginal_error <= coupler.tolerance)
    sizes = coupling.effective_sample_size
    assert ((sizes > 1 - 1e-9) & (sizes < len(simulated) + 1e-6)).all()


@brief
@given(scores=matrices(width=3, largest=1e3))
def test_weights_of_candidates_are_probabilities_whatever_the_scores(
    scores: Tensor,
) -> None:
    weights = stacking_weights(scores)
    assert (weights >= 0).all()
    assert torch.isclose(weights.sum(), torch.ones(()).double())


@brief
@given(samples=matrices(rows=(2, 20), largest=1e8), repeats=st.integers(1, 3))
def test_ranks_are_between_0_and_1(samples: Tensor, repeats: int) -> None:
    draws = samples[1:, None].repeat(2 * repeats, 1, 1)
    _, ranks = estimates_and_ranks(draws, samples[:1])
    assert ((ranks >= 0) & (ranks <= 1)).all()


@brief
@given(
    groups=st.lists(st.integers(0, 6), min_size=1, max_size=30),
    fraction=st.floats(0.01, 0.5),
    num_folds=st.integers(2, 6),
)
def test_no_group_of_pairs_is_on_both_sides_of_a_split(
    groups: list[int], fraction: float, num_folds: int
) -> None:
    numbers = torch.tensor(groups)
    folds = Pairs.exact(numbers[:, None].float(), numbers).folds(num_folds)
    assert len(folds) == min(num_folds, len(set(groups)))
    for parts in (split_pairs(numbers, fraction), folds):
        assert sorted(torch.cat(list(parts)).tolist()) == list(range(len(groups)))
        seen = [set(numbers[rows].tolist()) for rows in parts]
        assert sum(map(len, seen)) == len(set(groups))


@pytest.mark.medium
@brief
@given(z=matrices(rows=(8, 8), largest=1e3), noise=st.floats(0, 1e3))
def test_a_discrepancy_is_finite_whatever_was_observed(z: Tensor, noise: float) -> None:
    theta = torch.linspace(-2, 2, 16).reshape(8, 2)
    discrepancy = DiscrepancyModel().fit(z, theta, noise * torch.eye(2))
    assert 0 <= discrepancy.probability_of_none <= 1
    assert torch.isfinite(discrepancy.sample(20, seed=0).correct(theta)).all()


@brief
@given(theta=matrices(largest=1e8))
def test_learned_probabilities_of_simulations_sum_to_one(theta: Tensor) -> None:
    learned = learn_parameters(theta, torch.linspace(-2, 2, 60).reshape(30, 2).sin())
    assert (learned.probabilities >= 0).all()
    assert abs(float(learned.probabilities.sum()) - 1) < 1e-6
    assert 0 <= learned.probability_of_prior <= 1
