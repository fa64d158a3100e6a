"""Properties that hold for any numbers, however large, small or many."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from sbi_rope import SinkhornCoupler
from sbi_rope._groups import split_groups, split_pairs
from sbi_rope._random import seeded
from sbi_rope.discrepancy import DiscrepancyModel, learn_parameters
from sbi_rope.errors import RoPEError
from sbi_rope.metrics import acauc_of, central_levels, mid_ranks
from sbi_rope.stacking import stacking_weights
from tests.faults.outcomes import state_of_process
from tests.faults.problem import THETA_O, THETA_S, X_O, posterior

# The same examples every time, and only as many as take a second or two.
brief = settings(derandomize=True, max_examples=60, deadline=None, database=None)


SOME_ROWS, SOME_COLUMNS = st.integers(1, 12), st.integers(1, 4)


@st.composite
def matrices(
    draw: st.DrawFn,
    *,
    rows: st.SearchStrategy[int] = SOME_ROWS,
    columns: st.SearchStrategy[int] = SOME_COLUMNS,
    largest: float = 1e8,
) -> Tensor:
    """A matrix whose columns have their own scale and centre, with ties in places."""
    n, width = draw(rows), draw(columns)
    numbers = st.floats(-3, 3, width=32)
    values = [draw(st.lists(numbers, min_size=width, max_size=width)) for _ in range(n)]
    matrix = torch.tensor(values, dtype=torch.double).reshape(n, width)
    exponent = math.log10(largest)
    scale = draw(
        st.lists(st.floats(-exponent, exponent), min_size=width, max_size=width)
    )
    matrix = matrix * 10.0 ** torch.tensor(scale, dtype=torch.double)
    return matrix + draw(st.sampled_from([0.0, 1.0, -1e4]))


@pytest.mark.filterwarnings("ignore:Coupling a batch")
@brief
@given(
    both=st.integers(1, 4).flatmap(
        lambda width: st.tuples(
            matrices(columns=st.just(width), largest=1e4),
            matrices(columns=st.just(width), largest=1e4),
        )
    ),
    gamma=st.floats(1e-3, 1e6),
    tau=st.floats(0, 1),
    solver=st.sampled_from(["own", "pot"]),
)
def test_rows_of_a_coupling_are_probabilities_whatever_the_embeddings(
    both: tuple[Tensor, Tensor], gamma: float, tau: float, solver: str
) -> None:
    coupler = SinkhornCoupler(gamma=gamma, tau=tau, solver=solver, max_iterations=50)
    try:
        coupling = coupler.couple(*both)
    except RoPEError:
        return
    assert (coupling.weights >= 0).all()
    assert torch.allclose(coupling.weights.sum(dim=1), torch.ones(()).double())
    assert coupling.converged == (coupling.marginal_error <= coupler.tolerance)
    sizes = coupling.effective_sample_size
    assert ((sizes > 1 - 1e-9) & (sizes < len(both[1]) + 1e-6)).all()


@brief
@given(scores=matrices(largest=1e3), pseudo_count=st.floats(0, 10))
def test_no_candidate_and_no_equal_weights_score_better_than_a_stack(
    scores: Tensor, pseudo_count: float
) -> None:
    found = stacking_weights(scores, pseudo_count=pseudo_count)
    num_candidates = scores.shape[1]
    assert torch.isclose(found.weights.sum(), torch.ones(()).double())

    def objective(weights: Tensor) -> float:
        penalty = pseudo_count / num_candidates * weights.log().sum()
        fit = torch.logsumexp(scores + weights.log(), dim=1).sum()
        return float(fit + (penalty if pseudo_count else 0.0))

    equal = torch.full_like(found.weights, 1 / num_candidates)
    best = objective(found.weights)
    # Sums of scores are rounded.
    slack = found.gap + 1e-9 * float(scores.abs().sum()) + 1e-9
    for other in (equal, *torch.eye(num_candidates).double()):
        assert not objective(other) > best + slack


@brief
@given(samples=matrices(rows=st.integers(2, 20)), repeats=st.integers(1, 3))
def test_ranks_and_levels_are_between_0_and_1(samples: Tensor, repeats: int) -> None:
    draws = samples[1:, None].repeat(repeats, 1, 1)
    ranks = mid_ranks(draws, samples[:1])
    levels = central_levels(ranks)
    for shares in (ranks, levels):
        assert ((shares >= 0) & (shares <= 1)).all()
    assert -0.5 <= acauc_of(levels).value <= 0.5


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
    folds = split_groups(numbers, num_folds)
    assert len(folds) == min(num_folds, len(set(groups)))
    for parts in (split_pairs(numbers, fraction), folds):
        assert sorted(torch.cat(list(parts)).tolist()) == list(range(len(groups)))
        seen = [set(numbers[rows].tolist()) for rows in parts]
        assert sum(map(len, seen)) == len(set(groups))


@pytest.mark.medium
@brief
@given(
    z=matrices(rows=st.just(8), columns=st.just(2), largest=1e3),
    noise=st.floats(0, 1e3),
)
def test_draws_of_a_discrepancy_are_finite_whatever_was_observed(
    z: Tensor, noise: float
) -> None:
    discrepancy = DiscrepancyModel().fit(z, THETA_O[:8], noise * torch.eye(2))
    assert 0 <= discrepancy.probability_of_none <= 1
    corrected = discrepancy.sample(20, seed=0).correct(THETA_O)
    assert torch.isfinite(corrected).all()


@brief
@given(theta=matrices(columns=st.just(2)))
def test_learned_probabilities_of_simulations_sum_to_one(theta: Tensor) -> None:
    learned = learn_parameters(theta, THETA_S)
    assert (learned.probabilities >= 0).all()
    assert abs(float(learned.probabilities.sum()) - 1) < 1e-6
    assert 0 <= learned.probability_of_prior <= 1


@brief
@given(theta=matrices(columns=st.just(2), largest=1e3))
def test_a_density_is_positive_inside_the_prior_and_zero_outside(
    theta: Tensor,
) -> None:
    log_prob = posterior().log_prob(theta, x=X_O[3])
    outside = (theta.float().abs() > 4).any(dim=1)
    assert torch.isneginf(log_prob[outside]).all()
    assert not log_prob.isnan().any()
    assert not torch.isposinf(log_prob).any()


@brief
@given(seed=st.integers(0, 2**70))
def test_a_seed_of_any_size_leaves_the_state_of_the_process_alone(seed: int) -> None:
    before = state_of_process(random_numbers=True)
    with seeded(seed):
        first = torch.rand(2)
    with seeded(seed):
        assert torch.equal(first, torch.rand(2))
    assert state_of_process(random_numbers=True) == before
