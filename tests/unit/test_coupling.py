"""The coupling against a slow log-domain solver, its limits and its failures."""

import copy
import functools
import itertools
import pickle
import warnings
from dataclasses import fields, replace
from typing import Any

import ot
import pytest
import torch
from torch import Tensor

from sbi_rope import SinkhornCoupler
from sbi_rope.coupling import Coupling
from sbi_rope.coupling.cost import Cost
from sbi_rope.coupling.kernel import Kernel
from sbi_rope.coupling.pot import solve_pot
from sbi_rope.errors import CouplingError, InvalidInputError, RoPEWarning
from tests import oracles
from tests.modes import MODES, digits, raw_coupler

# One setting for each way through the code.
FEW_MODES: tuple[dict[str, Any], ...] = (
    {"solver": "own", "dtype": torch.float64, "blocked": False},
    {"solver": "own", "dtype": torch.float32, "blocked": True},
    {"solver": "pot", "dtype": torch.float64, "blocked": False},
)


def through_pickle(coupling: Coupling) -> Coupling:
    return pickle.loads(pickle.dumps(coupling))


def clouds(n_o: int = 60, n_s: int = 60, dim: int = 3) -> tuple[Tensor, Tensor]:
    simulated = torch.randn(n_s, dim, dtype=torch.float64)
    real = 1.3 * torch.randn(n_o, dim, dtype=torch.float64) + 0.5
    return real, simulated


def cost_of(real: Tensor, simulated: Tensor) -> Tensor:
    return (real[:, None].double() - simulated[None].double()).norm(dim=2)


def worst_total_variation(a: Tensor, b: Tensor) -> float:
    return float((a.double() - b.double()).abs().sum(dim=1).max() / 2)


@functools.cache
def solved_by_the_oracle(
    ratio: float, tau: float
) -> tuple[Tensor, Tensor, float, Tensor, float]:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        real, simulated = clouds()
    cost = cost_of(real, simulated)
    gamma = ratio * float(cost.max())
    # It converges within 1500, or not at all in time.
    plan = oracles.semi_balanced_plan(cost, gamma=gamma, tau=tau, iterations=1500)
    return real, simulated, gamma, *plan


@pytest.mark.medium
@pytest.mark.parametrize("mode", MODES)
def test_rows_equal_those_of_the_oracle(mode: dict[str, Any]) -> None:
    for ratio, tau in ((1.0, 1.0), (0.1, 0.9), (1e-2, 0.5), (1e-3, 0.9)):
        real, simulated, gamma, expected, change = solved_by_the_oracle(ratio, tau)
        coupler = raw_coupler(
            gamma=gamma,
            tau=tau,
            tolerance=digits(mode, double=1e-10, single=1e-6),
            max_iterations=600,
            **mode,
        )
        coupling = coupler.couple(real, simulated)
        assert coupling.weights.dtype == mode["dtype"]
        row_error = (coupling.weights.double().sum(dim=1) - 1).abs().max()
        assert row_error < digits(mode, double=1e-12, single=1e-5)
        assert coupling.converged, (ratio, tau)
        if ratio >= 0.1:
            assert coupling.solver == mode["solver"]
        assert change < 1e-10
        distance = worst_total_variation(coupling.weights, expected)
        assert distance < digits(mode, double=1e-6, single=1e-5), (ratio, tau)


def test_the_default_tolerance_leaves_the_rows_near_the_oracle() -> None:
    real, simulated, gamma, expected, _ = solved_by_the_oracle(0.1, 0.9)
    coupling = raw_coupler(gamma=gamma, tau=0.9).couple(real, simulated)
    assert coupling.marginal_error <= 1e-6
    assert worst_total_variation(coupling.weights, expected) < 1e-4


def test_the_plan_minimises_the_objective_of_the_paper() -> None:
    real, simulated = clouds(8, 6)
    cost = cost_of(real, simulated)
    for solver in ("own", "pot"):
        coupler = raw_coupler(gamma=0.5, tau=0.7, tolerance=1e-12, solver=solver)
        weights = coupler.couple(real, simulated).weights
        best = oracles.objective(weights / 8, cost, gamma=0.5, tau=0.7)
        for _ in range(50):
            other = weights * (1 + 0.01 * torch.randn_like(weights)).abs()
            other /= 8 * other.sum(dim=1, keepdim=True)
            assert oracles.objective(other, cost, gamma=0.5, tau=0.7) > best, solver


def test_the_marginal_error_measures_the_optimality_conditions() -> None:
    real, simulated = clouds(30, 40)
    modes = itertools.product(FEW_MODES, ((1.0, 0.5), (0.9, 0.5), (0.5, 0.1)))
    for mode, (tau, gamma) in modes:
        tolerance = digits(mode, double=1e-12, single=1e-6)
        coupler = raw_coupler(gamma=gamma, tau=tau, tolerance=tolerance, **mode)
        rough = replace(coupler, max_iterations=2).couple(real, simulated)
        fine = coupler.couple(real, simulated)
        assert (rough.converged, rough.num_iterations) == (False, 2), mode
        assert rough.marginal_error > 1e-5
        assert fine.converged, mode
        assert fine.solver == mode["solver"]
        # The errors are computed again from public fields alone.
        for coupling in (rough, fine):
            q = coupling.weights.double().mean(dim=0)
            target = torch.exp(-coupling.potential * (1 - tau) / tau) / q.numel()
            expected = (q - target / target.sum()).abs().sum()
            assert coupling.marginal_error == pytest.approx(
                float(expected), abs=digits(mode, double=1e-14, single=1e-6)
            )
            assert coupling.batch_error == coupling.marginal_error
            assert coupling.num_fitted == 30


def test_a_large_gamma_and_equal_points_give_uniform_rows() -> None:
    coupling = raw_coupler(gamma=1e8).couple(*clouds(30, 40))
    assert (coupling.weights - 1 / 40).abs().max() < 1e-8
    ones = torch.ones(20, 2)
    assert (raw_coupler().couple(ones, ones).weights - 1 / 20).abs().max() < 1e-8


def test_tau_zero_is_the_row_softmax_of_the_cost() -> None:
    real, simulated = clouds(30, 40)
    coupling = raw_coupler(gamma=0.3, tau=0.0).couple(real, simulated)
    expected = torch.softmax(-cost_of(real, simulated) / 0.3, dim=1)
    assert torch.allclose(coupling.weights, expected, atol=1e-14)
    assert (coupling.num_iterations, coupling.solver) == (0, "none")
    nearly = raw_coupler(gamma=0.3, tau=1e-6).couple(real, simulated)
    assert torch.allclose(nearly.weights, expected, atol=1e-5)


def test_tau_one_has_uniform_column_marginals() -> None:
    coupling = raw_coupler(gamma=0.3, tau=1.0, tolerance=1e-10).couple(*clouds(30, 40))
    assert (coupling.weights.mean(dim=0) - 1 / 40).abs().sum() < 1e-10


def test_permuting_the_inputs_permutes_the_weights() -> None:
    real, simulated = clouds(30, 40)
    coupler = raw_coupler(gamma=0.3, tau=0.9, tolerance=1e-12)
    rows, columns = torch.randperm(30), torch.randperm(40)
    permuted = coupler.couple(real[rows], simulated[columns]).weights
    expected = coupler.couple(real, simulated).weights[rows][:, columns]
    assert torch.allclose(permuted, expected, atol=1e-9)


def test_scaling_cost_and_gamma_together_changes_nothing() -> None:
    real, simulated = clouds(30, 40)
    coupler = raw_coupler(gamma=0.3, tau=0.9, tolerance=1e-12)
    scaled = raw_coupler(gamma=30.0, tau=0.9, tolerance=1e-12)
    assert torch.allclose(
        coupler.couple(real, simulated).weights,
        scaled.couple(100 * real, 100 * simulated).weights,
        atol=1e-9,
    )


def test_with_the_simulated_cost_scale_gamma_has_no_unit() -> None:
    real, simulated = clouds(30, 40)
    simulated = simulated**3  # the mean distance is no longer near the median
    coupler = SinkhornCoupler(gamma=0.1, cost_scale="simulated", tolerance=1e-12)
    coupling = coupler.couple(real, simulated)
    scaled = coupler.couple(1e4 * real, 1e4 * simulated)
    assert torch.allclose(coupling.weights, scaled.weights, atol=1e-9)
    first, second = torch.triu_indices(40, 40, offset=1)
    median = (simulated[first] - simulated[second]).norm(dim=1).median()
    assert coupling.gamma == pytest.approx(0.1 * float(median))


def test_numbers_of_observations_and_simulations_may_differ() -> None:
    for n_o, n_s in ((25, 80), (80, 25), (30, 1)):
        real, simulated = clouds(n_o, n_s)
        coupling = raw_coupler(gamma=0.5, tolerance=1e-10).couple(real, simulated)
        expected, _ = oracles.semi_balanced_plan(
            cost_of(real, simulated), gamma=0.5, tau=1.0
        )
        assert coupling.weights.shape == (n_o, n_s)
        assert worst_total_variation(coupling.weights, expected) < 1e-8


def test_rows_of_the_batch_are_its_weights_and_new_rows_are_near_a_refit() -> None:
    real, simulated = clouds(200, 200)
    coupler = raw_coupler(gamma=1.0, tau=0.9, tolerance=1e-10)
    coupling = coupler.couple(real, simulated)
    assert torch.allclose(coupling.rows(real), coupling.weights, atol=1e-14)
    new = torch.randn(1, 3, dtype=torch.float64)
    refit = coupler.couple(torch.cat([real, new]), simulated).weights[-1:]
    assert worst_total_variation(coupling.rows(new), refit) < 0.01


def test_rows_from_given_distances_are_the_same_rows() -> None:
    real, simulated = clouds()
    far = real.clone()
    far[0] = 1e30
    for direct in (False, True):
        coupling = replace(raw_coupler().couple(real, simulated), direct=direct)
        distances = coupling.distances(real)
        assert torch.allclose(distances, cost_of(real, simulated))
        for one in (coupling, replace(coupling, gamma=2 * coupling.gamma)):
            assert torch.equal(one.rows(real, distances=distances), one.rows(real))
        with pytest.raises(InvalidInputError, match="away from the simulations"):
            coupling.rows(far, distances=coupling.distances(far))


def test_a_coupling_of_some_observations_has_their_rows() -> None:
    coupling = raw_coupler().couple(*clouds())
    some = torch.tensor([5, 2])
    part = coupling.restricted_to(some)
    assert torch.allclose(part.weights, coupling.weights[some], atol=1e-12)
    assert part.marginal_error == coupling.marginal_error
    assert len(part.effective_sample_size) == 2


def test_a_copy_of_a_coupling_does_not_hold_its_weights() -> None:
    coupling = raw_coupler().couple(*clouds(300, 300))
    before = len(pickle.dumps(coupling))
    weights = coupling.weights
    assert coupling.weights is weights
    assert len(pickle.dumps(coupling)) == before < 30_000
    for copied in (copy.deepcopy, copy.copy, through_pickle):
        other = copied(coupling)
        assert set(vars(other)) == {entry.name for entry in fields(coupling)}
        assert torch.equal(other.weights, weights)


def test_effective_sample_size_counts_equal_weights() -> None:
    # The first observation is near two of four simulations, the second far from all.
    simulated = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 50.0], [0.0, -50.0]])
    coupling = Coupling(
        potential=torch.zeros(4),
        real=torch.tensor([[0.0, 0.0], [1e6, 0.0]]),
        simulated=simulated,
        gamma=1.0,
        tau=1.0,
        marginal_error=0.0,
        batch_error=0.0,
        num_fitted=2,
        num_iterations=0,
        converged=True,
        solver="none",
    )
    sizes = coupling.effective_sample_size
    assert sizes[0] == pytest.approx(2.0)
    expected = 1 / coupling.weights.square().sum(dim=1)
    assert torch.allclose(sizes, expected)


def far_clouds() -> tuple[Tensor, Tensor, float]:
    """Two clouds so far apart, for gamma, that POT's kernel underflows."""
    real, simulated = clouds(40, 40)
    simulated[:5] += 100.0
    return real, simulated, 1e-4 * float(cost_of(real, simulated).max())


def test_our_own_solver_goes_on_where_pot_underflows() -> None:
    real, simulated, gamma = far_clouds()
    cost, tau = cost_of(real, simulated), 0.5
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        a = torch.full((40,), 1 / 40, dtype=torch.float64)
        ot.unbalanced.sinkhorn_unbalanced(
            a, a, cost, gamma, (float("inf"), gamma * tau / (1 - tau))
        )
    assert any("Numerical errors" in str(w.message) for w in caught)

    coupler = raw_coupler(gamma=gamma, tau=tau, solver="pot", tolerance=1e-10)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        coupling = coupler.couple(real, simulated)
    assert coupling.solver == "own"
    assert coupling.converged
    expected, change = oracles.semi_balanced_plan(cost, gamma=gamma, tau=tau)
    assert change < 1e-9
    assert worst_total_variation(coupling.weights, expected) < 1e-6


def test_columns_that_underflow_are_solved_in_the_log_domain() -> None:
    # No observation is near the last five simulations: their columns of the kernel
    # vanish, in float64 too, and at a small tau nothing forces them to come back.
    real, simulated, _ = far_clouds()
    cost = cost_of(real, simulated)
    assert (cost[:, :5].amin(dim=0) - cost.amin(dim=1).max()).min() / 0.05 > 800
    expected, _ = oracles.semi_balanced_plan(cost, gamma=0.05, tau=0.5)
    for mode in FEW_MODES:
        tolerance = digits(mode, double=1e-12, single=1e-6)
        coupler = raw_coupler(gamma=0.05, tau=0.5, tolerance=tolerance, **mode)
        coupling = coupler.couple(real, simulated)
        assert coupling.converged, mode
        assert worst_total_variation(coupling.weights, expected) < digits(
            mode, double=1e-9, single=2e-5
        )
        # w = tau (w + log b - log q) in the far columns, whatever their size.
        log_q = torch.logsumexp(
            torch.log_softmax(coupling.potential - cost / 0.05, dim=1), dim=0
        )
        fixed = 0.5 * (coupling.potential - log_q)
        difference = (fixed - fixed.mean()) - coupling.potential
        assert difference.abs().max() < digits(mode, double=1e-6, single=1e-3), mode


def test_couplings_are_finite_at_all_gammas_and_taus_converged_or_not() -> None:
    real, simulated = clouds(25, 25)
    scale = float(cost_of(real, simulated).max())
    for mode in (parameters.values[0] for parameters in MODES):
        smallest = digits(mode, double=1e-6, single=1e-4)
        for ratio, tau in itertools.product((1e3, 1e-2, smallest), (1.0, 0.5, 1e-3)):
            case = (mode, ratio, tau)
            settings = {"gamma": ratio * scale, "tau": tau, "max_iterations": 20}
            coupler = raw_coupler(**settings, **mode)
            coupling = coupler.couple(real, simulated)
            assert torch.isfinite(coupling.weights).all(), case
            assert torch.isfinite(coupling.potential).all(), case
            assert 0 <= coupling.marginal_error <= 2, case
            assert coupling.num_iterations <= 20, case
            assert coupling.converged == (coupling.marginal_error <= 1e-6), case
            row_error = (coupling.weights.double().sum(dim=1) - 1).abs().max()
            assert row_error < digits(mode, double=1e-12, single=1e-5), case


def test_a_gamma_too_small_for_the_digits_of_the_dtype_is_refused() -> None:
    real, simulated = clouds(25, 25)
    ones = torch.ones(30, 2)
    for dtype, tau in itertools.product((torch.float32, torch.float64), (1.0, 0.0)):
        coupler = raw_coupler(gamma=1e-13, tau=tau, dtype=dtype)
        with pytest.raises(CouplingError, match=r"gamma of at least .* larger gamma"):
            coupler.couple(real, simulated)
        # Distances of zero do not help.
        with pytest.raises(CouplingError, match="gamma of at least"):
            replace(coupler, gamma=1e-310).couple(ones, ones)


def test_embeddings_far_from_the_origin_need_no_larger_gamma() -> None:
    real, simulated = clouds(30, 40)
    coupler = raw_coupler(gamma=0.1, tolerance=1e-10)
    moved = coupler.couple(real + 1e7, simulated + 1e7)
    weights = coupler.couple(real, simulated).weights
    assert worst_total_variation(moved.weights, weights) < 1e-6


def test_a_small_batch_is_warned_about_and_one_row_at_tau_one_is_uniform() -> None:
    real, simulated = clouds(1, 40)
    with pytest.warns(RoPEWarning, match=r"smaller tau.*unseen='extend'"):
        coupling = raw_coupler(gamma=0.1, tau=1.0).couple(real, simulated)
    assert torch.allclose(coupling.weights, torch.tensor(1 / 40).double(), atol=1e-6)
    with pytest.warns(RoPEWarning):
        sharp = raw_coupler(gamma=0.1, tau=0.1).couple(real, simulated)
    assert sharp.effective_sample_size < 30
    # There is no warning at a tau where rows are apart.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        raw_coupler(gamma=0.1, tau=0.0).couple(real, simulated)


def test_pot_cannot_be_asked_to_work_in_blocks() -> None:
    with pytest.raises(InvalidInputError, match="solver='own'"):
        raw_coupler(solver="pot", blocked=True)


def test_simulations_without_spread_cannot_set_the_scale() -> None:
    zeros = torch.zeros(20, 2)
    for simulated in (zeros, zeros[:1]):
        with pytest.raises(CouplingError, match="median distance"):
            SinkhornCoupler(cost_scale="simulated").couple(zeros, simulated)


def balanced_overflow() -> tuple[Tensor, Tensor, float]:
    """gamma / max(C) = 1e-3 at tau = 1, where POT's scalings overflow."""
    real, simulated = clouds(250, 250, dim=10)
    return real, simulated, 1e-3 * float(cost_of(real, simulated).max())


@pytest.mark.medium
def test_where_scalings_of_pot_overflow_the_rows_stay_exact_and_finite() -> None:
    real, simulated, gamma = balanced_overflow()
    coupler = raw_coupler(
        gamma=gamma, solver="pot", max_iterations=600, anderson_memory=0
    )
    coupling = coupler.couple(real, simulated)
    assert not coupling.converged  # and says so: 600 iterations are not enough
    assert (coupling.weights.sum(dim=1) - 1).abs().max() < 1e-12
    # A potential of the oracle after as many iterations is no better.
    expected, _ = oracles.semi_balanced_plan(
        cost_of(real, simulated), gamma=gamma, tau=1.0, iterations=600
    )
    assert coupling.marginal_error < 1.5 * float(
        (expected.mean(dim=0) - 1 / 250).abs().sum()
    )


@pytest.mark.medium
def test_accelerated_iterations_converge_where_plain_ones_do_not() -> None:
    real, simulated, gamma = balanced_overflow()
    coupler = raw_coupler(gamma=gamma, max_iterations=3000)
    plain = replace(coupler, anderson_memory=0).couple(real, simulated)
    accelerated = coupler.couple(real, simulated)
    assert (plain.num_iterations, plain.converged) == (3000, False)
    assert accelerated.converged
    assert plain.marginal_error > 10 * accelerated.marginal_error


def test_iterations_of_both_solvers_count_together() -> None:
    real, simulated, gamma = far_clouds()
    coupler = raw_coupler(gamma=gamma, solver="pot", max_iterations=37)
    coupling = coupler.couple(real, simulated)
    assert coupling.solver == "own"
    assert coupling.num_iterations == 37


@pytest.mark.medium
def test_each_call_of_pot_starts_where_the_last_one_ended() -> None:
    # If each call started from zero, none would get past its last iteration.
    real, simulated = clouds(250, 250, dim=10)
    gamma = 1e-2 * float(cost_of(real, simulated).max())
    coupler = raw_coupler(gamma=gamma, solver="pot", tolerance=1e-8)
    coupling = coupler.couple(real, simulated)
    assert coupling.solver == "pot"
    assert coupling.num_iterations > 1000
    assert coupling.converged


@pytest.mark.medium
def test_a_tolerance_below_the_digits_ends_early_and_says_so() -> None:
    real, simulated = clouds()
    for solver in ("own", "pot"):
        coupler = raw_coupler(solver=solver, dtype=torch.float32, tolerance=1e-14)
        coupling = coupler.couple(real, simulated)
        assert not coupling.converged
        assert coupling.num_iterations < 2000
        assert 1e-14 < coupling.marginal_error < 1e-6


def test_iterations_are_limited_when_the_solver_changes_on_the_way() -> None:
    torch.manual_seed(4)  # clouds whose scalings overflow after some iterations
    real, simulated = clouds()
    gamma = 1.7e-4 * float(cost_of(real, simulated).max())
    cost = Cost(real, simulated, stored=True)
    solution, healthy = solve_pot(
        cost,
        gamma,
        Kernel(cost, gamma, stored=True),
        torch.zeros(60, dtype=torch.float64),
        tau=1.0,
        tolerance=1e-6,
        max_iterations=300,
    )
    assert not healthy
    assert 0 < solution.num_iterations < 300
    coupler = raw_coupler(
        gamma=gamma, solver="pot", max_iterations=300, anderson_memory=0
    )
    coupling = coupler.couple(real, simulated)
    assert (coupling.solver, coupling.num_iterations) == ("own", 300)
