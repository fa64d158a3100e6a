"""The coupling against a slow log-domain solver, its limits and its failures."""

import itertools
import warnings

import ot
import pytest
import torch
from torch import Tensor

from sbi_rope import SinkhornCoupler
from sbi_rope.coupling import Coupling
from sbi_rope.errors import (
    CouplingError,
    InvalidInputError,
    InvalidTypeError,
    RoPEWarning,
)
from tests import oracles


def clouds(n_o: int = 60, n_s: int = 60, dim: int = 3) -> tuple[Tensor, Tensor]:
    simulated = torch.randn(n_s, dim, dtype=torch.float64)
    real = 1.3 * torch.randn(n_o, dim, dtype=torch.float64) + 0.5
    return real, simulated


def cost_of(real: Tensor, simulated: Tensor) -> Tensor:
    return (real[:, None].double() - simulated[None].double()).norm(dim=2)


def worst_total_variation(a: Tensor, b: Tensor) -> float:
    return float((a - b).abs().sum(dim=1).max() / 2)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("tau", [1.0, 0.9, 0.5])
@pytest.mark.parametrize("ratio", [1.0, 1e-1, 1e-2, 1e-3])
@pytest.mark.parametrize("solver", ["pot", "log"])
def test_rows_equal_those_of_the_oracle(
    solver: str, ratio: float, tau: float, dtype: torch.dtype
) -> None:
    real, simulated = (part.to(dtype) for part in clouds())
    cost = cost_of(real, simulated)
    gamma = ratio * float(cost.max())
    coupler = SinkhornCoupler(
        gamma=gamma, tau=tau, solver=solver, tolerance=1e-10, max_iterations=3000
    )
    coupling = coupler.couple(real, simulated)

    assert (coupling.weights.sum(dim=1) - 1).abs().max() < 1e-12
    assert torch.isfinite(coupling.weights).all()
    expected, change = oracles.semi_balanced_plan(
        cost, gamma=gamma, tau=tau, iterations=3000
    )
    if change < 1e-10:
        assert coupling.converged
        assert coupling.solver == solver  # POT needs no help here
        assert worst_total_variation(coupling.weights, expected) < 1e-6
    else:
        # Plain Sinkhorn has not converged at tau = 1 and a small gamma; neither has
        # the coupler, or if it has, it says by how much.
        assert (tau, ratio) in {(1.0, 1e-2), (1.0, 1e-3)}
        assert coupling.converged == (coupling.marginal_error <= 1e-10)


def test_the_plan_minimises_the_objective_of_the_paper() -> None:
    real, simulated = clouds(8, 6)
    coupling = SinkhornCoupler(gamma=0.5, tau=0.7, tolerance=1e-12).couple(
        real, simulated
    )
    cost = cost_of(real, simulated)

    def objective(rows: Tensor) -> float:
        return oracles.objective(rows / len(rows), cost, gamma=0.5, tau=0.7)

    best = objective(coupling.weights)
    for _ in range(50):
        noise = 1 + 0.01 * torch.randn_like(coupling.weights)
        other = coupling.weights * noise.abs()
        assert objective(other / other.sum(dim=1, keepdim=True)) > best


@pytest.mark.parametrize(("tau", "gamma"), [(1.0, 0.5), (0.9, 0.5), (0.5, 0.1)])
def test_marginal_error_measures_the_optimality_conditions(
    tau: float, gamma: float
) -> None:
    real, simulated = clouds(30, 40)
    rough = SinkhornCoupler(gamma=gamma, tau=tau, max_iterations=1).couple(
        real, simulated
    )
    fine = SinkhornCoupler(gamma=gamma, tau=tau, tolerance=1e-12).couple(
        real, simulated
    )
    assert not rough.converged
    assert rough.num_iterations == 1
    assert fine.converged
    # Recomputed from the public fields alone.
    for coupling in (rough, fine):
        q = coupling.weights.mean(dim=0)
        target = torch.exp(-coupling.potential * (1 - tau) / tau) / q.numel()
        expected = (q - target / target.sum()).abs().sum()
        assert coupling.marginal_error == pytest.approx(float(expected), abs=1e-14)


def test_large_gamma_gives_uniform_rows() -> None:
    coupling = SinkhornCoupler(gamma=1e8).couple(*clouds(30, 40))
    assert (coupling.weights - 1 / 40).abs().max() < 1e-8


def test_tau_zero_is_the_row_softmax_of_the_cost() -> None:
    real, simulated = clouds(30, 40)
    coupling = SinkhornCoupler(gamma=0.3, tau=0.0).couple(real, simulated)
    expected = torch.softmax(-cost_of(real, simulated) / 0.3, dim=1)
    assert torch.allclose(coupling.weights, expected, atol=1e-14)
    assert (coupling.num_iterations, coupling.solver) == (0, "none")
    nearly = SinkhornCoupler(gamma=0.3, tau=1e-6).couple(real, simulated)
    assert torch.allclose(nearly.weights, expected, atol=1e-5)


def test_tau_one_has_uniform_column_marginals() -> None:
    coupling = SinkhornCoupler(gamma=0.3, tau=1.0, tolerance=1e-10).couple(
        *clouds(30, 40)
    )
    assert (coupling.weights.mean(dim=0) - 1 / 40).abs().sum() < 1e-10


def test_permuting_the_inputs_permutes_the_weights() -> None:
    real, simulated = clouds(30, 40)
    coupler = SinkhornCoupler(gamma=0.3, tau=0.9, tolerance=1e-12)
    rows, columns = torch.randperm(30), torch.randperm(40)
    permuted = coupler.couple(real[rows], simulated[columns]).weights
    expected = coupler.couple(real, simulated).weights[rows][:, columns]
    assert torch.allclose(permuted, expected, atol=1e-9)


def test_scaling_cost_and_gamma_together_changes_nothing() -> None:
    real, simulated = clouds(30, 40)
    coupler = SinkhornCoupler(gamma=0.3, tau=0.9, tolerance=1e-12)
    scaled = SinkhornCoupler(gamma=30.0, tau=0.9, tolerance=1e-12)
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
    coupling = SinkhornCoupler(gamma=0.5, tolerance=1e-10).couple(real, simulated)
    expected, _ = oracles.semi_balanced_plan(
        cost_of(real, simulated), gamma=0.5, tau=1.0
    )
    assert coupling.weights.shape == (n_o, n_s)
    assert worst_total_variation(coupling.weights, expected) < 1e-8


def test_rows_of_the_batch_are_its_weights_and_new_rows_are_near_a_refit() -> None:
    real, simulated = clouds(200, 200)
    coupler = SinkhornCoupler(gamma=1.0, tau=0.9, tolerance=1e-10)
    coupling = coupler.couple(real, simulated)
    assert torch.allclose(coupling.rows(real), coupling.weights, atol=1e-14)
    new = torch.randn(1, 3, dtype=torch.float64)
    refit = coupler.couple(torch.cat([real, new]), simulated).weights[-1:]
    assert worst_total_variation(coupling.rows(new), refit) < 0.01


def test_effective_sample_size_counts_equal_weights() -> None:
    weights = torch.tensor([[0.5, 0.5, 0.0, 0.0], [0.25] * 4], dtype=torch.float64)
    coupling = Coupling(
        weights=weights,
        potential=torch.zeros(4),
        marginal_error=0.0,
        num_iterations=0,
        converged=True,
        solver="none",
        gamma=1.0,
        tau=1.0,
        simulated=torch.zeros(4, 1),
    )
    assert coupling.effective_sample_size.tolist() == [2.0, 4.0]


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

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        coupling = SinkhornCoupler(gamma=gamma, tau=tau, tolerance=1e-10).couple(
            real, simulated
        )
    assert coupling.solver == "log"
    assert coupling.converged
    expected, change = oracles.semi_balanced_plan(cost, gamma=gamma, tau=tau)
    assert change < 1e-9
    assert worst_total_variation(coupling.weights, expected) < 1e-6


def test_what_cannot_converge_says_so_and_stays_finite() -> None:
    real, simulated, gamma = far_clouds()
    coupling = SinkhornCoupler(gamma=gamma, tau=1.0, max_iterations=50).couple(
        real, simulated
    )
    assert not coupling.converged
    assert coupling.marginal_error > 1e-6
    assert coupling.num_iterations <= 50
    assert torch.isfinite(coupling.weights).all()
    assert (coupling.weights.sum(dim=1) - 1).abs().max() < 1e-12


def test_no_nan_over_gamma_tau_and_dtype() -> None:
    real, simulated = clouds(25, 25)
    scale = float(cost_of(real, simulated).max())
    for ratio, tau, dtype in itertools.product(
        [1e3, 1.0, 1e-3, 1e-6], [1.0, 0.5, 1e-3, 0.0], [torch.float32, torch.float64]
    ):
        coupling = SinkhornCoupler(
            gamma=ratio * scale, tau=tau, max_iterations=100
        ).couple(real.to(dtype), simulated.to(dtype))
        assert torch.isfinite(coupling.weights).all(), (ratio, tau, dtype)


def test_equal_points_everywhere_give_uniform_rows() -> None:
    ones = torch.ones(20, 2)
    assert torch.allclose(
        SinkhornCoupler().couple(ones, ones).weights, torch.tensor(1 / 20).double()
    )


def test_a_small_batch_is_warned_about_and_one_row_at_tau_one_is_uniform() -> None:
    real, simulated = clouds(1, 40)
    with pytest.warns(RoPEWarning, match=r"smaller tau.*unseen='extend'"):
        coupling = SinkhornCoupler(gamma=0.1, tau=1.0).couple(real, simulated)
    assert torch.allclose(coupling.weights, torch.tensor(1 / 40).double(), atol=1e-6)
    with pytest.warns(RoPEWarning):
        sharp = SinkhornCoupler(gamma=0.1, tau=0.1).couple(real, simulated)
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
    ],
)
def test_settings_outside_their_range_are_refused(settings: dict, match: str) -> None:
    with pytest.raises(InvalidInputError, match=match):
        SinkhornCoupler(**settings)


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
        SinkhornCoupler().couple(real, simulated)


def test_simulations_without_spread_cannot_set_the_scale() -> None:
    with pytest.raises(CouplingError, match="median distance"):
        SinkhornCoupler(cost_scale="simulated").couple(X, X)


def test_distances_that_overflow_are_refused() -> None:
    with pytest.raises(CouplingError, match="overflow"):
        SinkhornCoupler().couple(X.double() + 1e200, X.double())


def balanced_overflow() -> tuple[Tensor, Tensor, float]:
    """gamma / max(C) = 1e-3 at tau = 1, where POT's scalings overflow."""
    real, simulated = clouds(250, 250, dim=10)
    return real, simulated, 1e-3 * float(cost_of(real, simulated).max())


def test_where_pots_scalings_overflow_the_rows_stay_exact_and_finite() -> None:
    real, simulated, gamma = balanced_overflow()
    coupling = SinkhornCoupler(gamma=gamma, tau=1.0, max_iterations=600).couple(
        real, simulated
    )
    assert not coupling.converged  # and says so: 600 iterations are not enough
    assert (coupling.weights.sum(dim=1) - 1).abs().max() < 1e-12
    # A potential of the oracle after as many iterations is no better.
    expected, _ = oracles.semi_balanced_plan(
        cost_of(real, simulated), gamma=gamma, tau=1.0, iterations=600
    )
    assert coupling.marginal_error < 1.5 * float(
        (expected.mean(dim=0) - 1 / 250).abs().sum()
    )


def test_iterations_of_all_solvers_count_together() -> None:
    real, simulated, gamma = far_clouds()
    coupling = SinkhornCoupler(gamma=gamma, tau=1.0, max_iterations=37).couple(
        real, simulated
    )
    assert coupling.solver == "log"
    assert coupling.num_iterations == 37


def test_pot_goes_on_from_where_it_was() -> None:
    # Starting each burst anew would never get past the longest burst.
    real, simulated = clouds(250, 250, dim=10)
    gamma = 1e-2 * float(cost_of(real, simulated).max())
    coupling = SinkhornCoupler(gamma=gamma, tau=1.0, tolerance=1e-8).couple(
        real, simulated
    )
    assert coupling.solver == "pot"
    assert coupling.num_iterations > 1000
    assert coupling.converged


def test_the_default_tolerance_reports_its_distance_from_the_oracle() -> None:
    real, simulated = clouds()
    cost = cost_of(real, simulated)
    gamma = 0.1 * float(cost.max())
    coupling = SinkhornCoupler(gamma=gamma, tau=0.9).couple(real, simulated)
    expected, _ = oracles.semi_balanced_plan(cost, gamma=gamma, tau=0.9)
    assert coupling.marginal_error <= 1e-6
    assert worst_total_variation(coupling.weights, expected) < 1e-4


def test_a_rescue_in_the_middle_keeps_to_the_budget() -> None:
    torch.manual_seed(4)  # clouds whose scalings overflow after some iterations
    real, simulated = clouds()
    gamma = 1.7e-4 * float(cost_of(real, simulated).max())
    coupler = SinkhornCoupler(gamma=gamma, tau=1.0, max_iterations=300)
    coupling = coupler.couple(real, simulated)
    _, made_by_pot, healthy = coupler._solve_pot(
        _in_units_of_gamma(cost_of(real, simulated), gamma)
    )
    assert not healthy
    assert 0 < made_by_pot < 300
    assert (coupling.solver, coupling.num_iterations) == ("log", 300)


def _in_units_of_gamma(cost: Tensor, gamma: float) -> Tensor:
    return (cost - cost.min(dim=1, keepdim=True).values) / gamma
