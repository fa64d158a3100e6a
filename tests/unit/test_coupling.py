"""The coupling against a slow log-domain solver, its limits and its failures."""

import copy
import functools
import itertools
import pickle
import warnings
from collections.abc import Callable
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
from sbi_rope.errors import (
    CouplingError,
    InvalidInputError,
    InvalidTypeError,
    RoPEWarning,
)
from tests import oracles
from tests.modes import MODES, digits, raw_coupler


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


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("tau", [1.0, 0.9, 0.5])
@pytest.mark.parametrize("ratio", [1.0, 1e-1, 1e-2, 1e-3])
def test_rows_equal_those_of_the_oracle(
    mode: dict[str, Any], ratio: float, tau: float
) -> None:
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
    assert torch.isfinite(coupling.weights).all()
    if mode["solver"] == "own" and (tau, ratio) != (1.0, 1e-3):
        assert coupling.converged
    if coupling.converged and change < 1e-10:
        distance = worst_total_variation(coupling.weights, expected)
        # At tau = 1 and the smallest gamma, a marginal error of 1e-6 leaves some room.
        single = 1e-3 if (tau, ratio) == (1.0, 1e-3) else 1e-5
        assert distance < digits(mode, double=1e-6, single=single)
    else:
        # Plain Sinkhorn has not converged at tau = 1 and a small gamma.
        assert tau == 1.0
        assert ratio < 0.1
        assert coupling.converged == (coupling.marginal_error <= coupler.tolerance)


@pytest.mark.parametrize("mode", MODES)
def test_the_plan_minimises_the_objective_of_the_paper(mode: dict[str, Any]) -> None:
    real, simulated = clouds(8, 6)
    coupling = raw_coupler(
        gamma=0.5, tau=0.7, tolerance=digits(mode, double=1e-12, single=1e-6), **mode
    ).couple(real, simulated)
    cost = cost_of(real, simulated)

    def objective(rows: Tensor) -> float:
        return oracles.objective(rows / len(rows), cost, gamma=0.5, tau=0.7)

    weights = coupling.weights.double()
    best = objective(weights / weights.sum(dim=1, keepdim=True))
    for _ in range(50):
        noise = 1 + 0.01 * torch.randn_like(weights)
        other = weights * noise.abs()
        assert objective(other / other.sum(dim=1, keepdim=True)) > best


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(("tau", "gamma"), [(1.0, 0.5), (0.9, 0.5), (0.5, 0.1)])
def test_marginal_error_measures_the_optimality_conditions(
    mode: dict[str, Any], tau: float, gamma: float
) -> None:
    real, simulated = clouds(30, 40)
    coupler = raw_coupler(
        gamma=gamma, tau=tau, tolerance=digits(mode, double=1e-12, single=1e-6), **mode
    )
    rough = replace(coupler, max_iterations=2).couple(real, simulated)
    fine = coupler.couple(real, simulated)
    assert not rough.converged
    assert rough.num_iterations == 2
    assert rough.marginal_error > 1e-5
    assert fine.converged
    # Recomputed from the public fields alone.
    for coupling in (rough, fine):
        q = coupling.weights.double().mean(dim=0)
        target = torch.exp(-coupling.potential * (1 - tau) / tau) / q.numel()
        expected = (q - target / target.sum()).abs().sum()
        assert coupling.marginal_error == pytest.approx(
            float(expected), abs=digits(mode, double=1e-14, single=1e-6)
        )
        assert coupling.batch_error == coupling.marginal_error
        assert coupling.num_fitted == 30


def test_large_gamma_gives_uniform_rows() -> None:
    coupling = raw_coupler(gamma=1e8).couple(*clouds(30, 40))
    assert (coupling.weights - 1 / 40).abs().max() < 1e-8


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


def test_simulated_cost_scale_makes_gamma_free_of_units() -> None:
    real, simulated = clouds(30, 40)
    coupler = SinkhornCoupler(gamma=0.1, cost_scale="simulated", tolerance=1e-12)
    coupling = coupler.couple(real, simulated)
    scaled = coupler.couple(1e4 * real, 1e4 * simulated)
    assert torch.allclose(coupling.weights, scaled.weights, atol=1e-9)
    distances = cost_of(simulated, simulated)
    off_diagonal = distances[~torch.eye(40, dtype=torch.bool)]
    assert coupling.gamma == pytest.approx(0.1 * float(off_diagonal.median()), rel=0.02)


@pytest.mark.parametrize(("n_o", "n_s"), [(25, 80), (80, 25), (30, 1)])
def test_numbers_of_observations_and_simulations_may_differ(n_o: int, n_s: int) -> None:
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


@pytest.mark.parametrize("direct", [False, True])
def test_rows_from_given_distances_are_the_same_rows(direct: bool) -> None:
    real, simulated = clouds()
    coupling = replace(raw_coupler().couple(real, simulated), direct=direct)
    other = replace(coupling, gamma=2 * coupling.gamma)
    distances = coupling.distances(real)
    assert torch.allclose(distances, cost_of(real, simulated))
    for one in (coupling, other):
        assert torch.equal(one.rows(real, distances=distances), one.rows(real))
    far = real.clone()
    far[0] = 1e30
    with pytest.raises(InvalidInputError, match="away from the simulations"):
        coupling.rows(far, distances=coupling.distances(far))


def test_a_coupling_of_some_observations_has_their_rows() -> None:
    coupling = raw_coupler().couple(*clouds())
    some = torch.tensor([5, 2])
    part = coupling.restricted_to(some)
    assert torch.allclose(part.weights, coupling.weights[some], atol=1e-12)
    assert part.marginal_error == coupling.marginal_error
    assert len(part.effective_sample_size) == 2


@pytest.mark.parametrize("copied", [copy.deepcopy, copy.copy, through_pickle])
def test_a_copy_of_a_coupling_leaves_what_was_kept(
    copied: Callable[[Coupling], Coupling],
) -> None:
    coupling = raw_coupler().couple(*clouds(300, 300))
    before = len(pickle.dumps(coupling))
    weights = coupling.weights
    assert coupling.weights is weights
    assert len(pickle.dumps(coupling)) == before < 30_000
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


@pytest.mark.parametrize("tau", [0.9, 0.5])
def test_underflow_in_pot_is_rescued_and_reported(tau: float) -> None:
    real, simulated, gamma = far_clouds()
    cost = cost_of(real, simulated)
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


@pytest.mark.parametrize("mode", MODES)
def test_columns_that_underflow_are_solved_in_the_log_domain(
    mode: dict[str, Any],
) -> None:
    # No observation is near the last five simulations: their columns of the kernel
    # vanish, in float64 too, and at a small tau nothing forces them to come back.
    real, simulated, _ = far_clouds()
    coupler = raw_coupler(
        gamma=0.05, tau=0.5, tolerance=digits(mode, double=1e-12, single=1e-6), **mode
    )
    coupling = coupler.couple(real, simulated)
    cost = cost_of(real, simulated)
    assert (cost[:, :5].amin(dim=0) - cost.amin(dim=1).max()).min() / 0.05 > 800
    expected, _ = oracles.semi_balanced_plan(cost, gamma=0.05, tau=0.5)
    assert coupling.converged
    assert worst_total_variation(coupling.weights, expected) < digits(
        mode, double=1e-9, single=2e-5
    )
    # w = tau (w + log b - log q) in the far columns, whatever their size.
    log_q = torch.logsumexp(
        torch.log_softmax(coupling.potential - cost / 0.05, dim=1), dim=0
    )
    fixed = 0.5 * (coupling.potential - log_q)
    difference = (fixed - fixed.mean()) - coupling.potential
    assert difference.abs().max() < digits(mode, double=1e-6, single=1e-3)


@pytest.mark.parametrize("mode", MODES)
def test_what_cannot_converge_says_so_and_stays_finite(mode: dict[str, Any]) -> None:
    real, simulated, gamma = far_clouds()
    gamma = gamma * digits(mode, double=1.0, single=10.0)
    coupling = raw_coupler(gamma=gamma, max_iterations=20, **mode).couple(
        real, simulated
    )
    assert not coupling.converged
    assert coupling.marginal_error > 1e-6
    assert coupling.num_iterations <= 20
    assert torch.isfinite(coupling.weights).all()
    row_error = (coupling.weights.double().sum(dim=1) - 1).abs().max()
    assert row_error < digits(mode, double=1e-12, single=1e-5)


@pytest.mark.parametrize("mode", MODES)
def test_no_nan_over_gamma_and_tau(mode: dict[str, Any]) -> None:
    real, simulated = clouds(25, 25)
    scale = float(cost_of(real, simulated).max())
    smallest = digits(mode, double=1e-6, single=1e-4)
    for ratio, tau in itertools.product(
        [1e3, 1.0, 1e-1, 1e-2, 1e-3, smallest], [1.0, 0.9, 0.5, 1e-3, 0.0]
    ):
        coupler = raw_coupler(gamma=ratio * scale, tau=tau, max_iterations=100, **mode)
        coupling = coupler.couple(real, simulated)
        assert torch.isfinite(coupling.weights).all(), (ratio, tau)
        assert torch.isfinite(coupling.potential).all(), (ratio, tau)
        assert 0 <= coupling.marginal_error <= 2, (ratio, tau)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_gamma_beyond_the_digits_of_the_distances_is_refused(
    dtype: torch.dtype,
) -> None:
    real, simulated = clouds(25, 25)
    for tau in (1.0, 0.0):
        coupler = raw_coupler(gamma=1e-13, tau=tau, dtype=dtype)
        with pytest.raises(CouplingError, match=r"gamma of at least .* larger gamma"):
            coupler.couple(real, simulated)


def test_embeddings_far_from_the_origin_need_no_larger_gamma() -> None:
    real, simulated = clouds(30, 40)
    coupler = raw_coupler(gamma=0.1, tolerance=1e-10)
    moved = coupler.couple(real + 1e7, simulated + 1e7)
    weights = coupler.couple(real, simulated).weights
    assert worst_total_variation(moved.weights, weights) < 1e-6


def test_equal_points_everywhere_give_uniform_rows() -> None:
    ones = torch.ones(20, 2)
    assert torch.allclose(
        raw_coupler().couple(ones, ones).weights, torch.tensor(1 / 20).double()
    )


def test_a_small_batch_is_warned_about_and_one_row_at_tau_one_is_uniform() -> None:
    real, simulated = clouds(1, 40)
    with pytest.warns(RoPEWarning, match=r"smaller tau.*unseen='extend'"):
        coupling = raw_coupler(gamma=0.1, tau=1.0).couple(real, simulated)
    assert torch.allclose(coupling.weights, torch.tensor(1 / 40).double(), atol=1e-6)
    with pytest.warns(RoPEWarning):
        sharp = raw_coupler(gamma=0.1, tau=0.1).couple(real, simulated)
    assert sharp.effective_sample_size < 30


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        pytest.param({"gamma": 0.0}, "`gamma` to be positive", id="gamma zero"),
        pytest.param({"gamma": -1.0}, "`gamma` to be positive", id="gamma negative"),
        pytest.param({"gamma": float("nan")}, "`gamma`", id="gamma nan"),
        pytest.param({"tau": 1.5}, r"`tau` in \[0, 1\]", id="tau above one"),
        pytest.param({"tau": -0.1}, r"`tau` in \[0, 1\]", id="tau negative"),
        pytest.param({"solver": "ott"}, "`solver` to be one of", id="solver"),
        pytest.param({"cost_scale": "max"}, "`cost_scale` to be one of", id="scale"),
        pytest.param({"tolerance": 0.0}, "`tolerance`", id="tolerance"),
        pytest.param({"max_iterations": 0}, "`max_iterations`", id="iterations"),
        pytest.param({"dtype": torch.float16}, "`dtype` to be one of", id="dtype"),
        pytest.param({"blocked": "yes"}, "`blocked` to be one of", id="blocked"),
        pytest.param({"num_fitted": 0}, "`num_fitted`.*at least 1", id="fitted"),
        pytest.param(
            {"anderson_memory": -1}, "`anderson_memory`.*at least 0", id="memory"
        ),
        pytest.param(
            {"solver": "pot", "blocked": True}, "solver='own'", id="blocked POT"
        ),
    ],
)
def test_settings_outside_their_range_are_refused(settings: dict, match: str) -> None:
    with pytest.raises(InvalidInputError, match=match):
        raw_coupler(**settings)


X = torch.zeros(20, 2)


@pytest.mark.parametrize(
    ("real", "simulated", "error", "match"),
    [
        pytest.param(X[:0], X, InvalidInputError, "`real`.*empty", id="no real"),
        pytest.param(X, X[:0], InvalidInputError, "`simulated`.*empty", id="no sim"),
        pytest.param(X, X[:, :1], InvalidInputError, "`real` of shape", id="widths"),
        pytest.param(X, X[0], InvalidInputError, "`simulated` of shape", id="1-d"),
        pytest.param(X / 0, X, InvalidInputError, "`real` to be finite", id="nan"),
        pytest.param(X.tolist(), X, InvalidTypeError, "torch.as_tensor", id="list"),
        pytest.param(X, X.to("meta"), InvalidInputError, "same device", id="device"),
    ],
)
def test_unusable_embeddings_are_refused(
    real: Tensor, simulated: Tensor, error: type, match: str
) -> None:
    with pytest.raises(error, match=match):
        raw_coupler().couple(real, simulated)


def test_simulations_without_spread_cannot_set_the_scale() -> None:
    with pytest.raises(CouplingError, match="median distance"):
        SinkhornCoupler(cost_scale="simulated").couple(X, X)


def test_distances_that_overflow_are_refused() -> None:
    with pytest.raises(CouplingError, match="overflow"):
        raw_coupler().couple(X.double() + 1e200, X.double())


def balanced_overflow() -> tuple[Tensor, Tensor, float]:
    """gamma / max(C) = 1e-3 at tau = 1, where POT's scalings overflow."""
    real, simulated = clouds(250, 250, dim=10)
    return real, simulated, 1e-3 * float(cost_of(real, simulated).max())


def test_where_pots_scalings_overflow_the_rows_stay_exact_and_finite() -> None:
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


def test_where_plain_iterations_do_not_get_there_accelerated_ones_do() -> None:
    real, simulated, gamma = balanced_overflow()
    coupler = raw_coupler(gamma=gamma, max_iterations=3000)
    plain = replace(coupler, anderson_memory=0).couple(real, simulated)
    accelerated = coupler.couple(real, simulated)
    assert (plain.num_iterations, plain.converged) == (3000, False)
    assert accelerated.converged
    assert plain.marginal_error > 10 * accelerated.marginal_error


def test_iterations_of_all_solvers_count_together() -> None:
    real, simulated, gamma = far_clouds()
    coupler = raw_coupler(gamma=gamma, solver="pot", max_iterations=37)
    coupling = coupler.couple(real, simulated)
    assert coupling.solver == "own"
    assert coupling.num_iterations == 37


def test_pot_goes_on_from_where_it_was() -> None:
    # Starting each burst anew would never get past the longest burst.
    real, simulated = clouds(250, 250, dim=10)
    gamma = 1e-2 * float(cost_of(real, simulated).max())
    coupler = raw_coupler(gamma=gamma, solver="pot", tolerance=1e-8)
    coupling = coupler.couple(real, simulated)
    assert coupling.solver == "pot"
    assert coupling.num_iterations > 1000
    assert coupling.converged


@pytest.mark.parametrize("solver", ["own", "pot"])
def test_a_tolerance_below_the_digits_ends_early_and_says_so(solver: str) -> None:
    real, simulated = clouds()
    coupler = raw_coupler(solver=solver, dtype=torch.float32, tolerance=1e-14)
    coupling = coupler.couple(real, simulated)
    assert not coupling.converged
    assert coupling.num_iterations < 2000
    assert 1e-14 < coupling.marginal_error < 1e-6


@pytest.mark.parametrize("mode", MODES)
def test_the_default_tolerance_reports_its_distance_from_the_oracle(
    mode: dict[str, Any],
) -> None:
    real, simulated, gamma, expected, _ = solved_by_the_oracle(0.1, 0.9)
    coupling = raw_coupler(gamma=gamma, tau=0.9, **mode).couple(real, simulated)
    assert coupling.solver == mode["solver"]  # POT needs no help here
    assert coupling.marginal_error <= 1e-6
    assert worst_total_variation(coupling.weights, expected) < 1e-4


def test_a_rescue_in_the_middle_keeps_to_the_budget() -> None:
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
