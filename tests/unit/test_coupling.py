"""The coupling against a slow log-domain solver, its limits and failures."""

import itertools
import warnings
from typing import Any

import pytest
import torch
from torch import Tensor

from sbi_rope import SinkhornCoupler
from sbi_rope.coupling import Coupling, sinkhorn
from sbi_rope.utils.errors import RoPEWarning
from tests import oracles

# The ways to solve a coupling that have to agree.
MODES = ("own", "blocked", "pot")


def raw_coupler(**settings: Any) -> SinkhornCoupler:
    """A coupler of distances as they are, with the paper's gamma unless it is given."""
    return SinkhornCoupler(**{"gamma": 0.5, "cost_scale": "none", **settings})


def coupled(mode: str, real: Tensor, simulated: Tensor, **settings: Any) -> Coupling:
    """Couple in one of the modes."""
    solver = "pot" if mode == "pot" else "own"
    with pytest.MonkeyPatch.context() as patch:
        if mode == "blocked":
            patch.setattr(sinkhorn, "MAX_STORED", 0)
            patch.setattr(sinkhorn, "BLOCK", 7 * len(simulated))
        return raw_coupler(solver=solver, **settings).couple(real, simulated)


def clouds(n_o: int = 60, n_s: int = 60, dim: int = 3) -> tuple[Tensor, Tensor]:
    simulated = torch.randn(n_s, dim, dtype=torch.float64)
    real = 1.3 * torch.randn(n_o, dim, dtype=torch.float64) + 0.5
    return real, simulated


def cost_of(real: Tensor, simulated: Tensor) -> Tensor:
    return (real[:, None].double() - simulated[None].double()).norm(dim=2)


def worst_total_variation(a: Tensor, b: Tensor) -> float:
    return float((a.double() - b.double()).abs().sum(dim=1).max() / 2)


@pytest.mark.medium
def test_rows_equal_those_of_the_oracle() -> None:
    real, simulated = clouds()
    cost = cost_of(real, simulated)
    for ratio, tau in ((1.0, 1.0), (0.1, 0.9), (1e-2, 0.5), (1e-3, 0.9)):
        settings = {"gamma": ratio * float(cost.max()), "tau": tau}
        # It converges within 1500, or not at all in time.
        expected, _ = oracles.semi_balanced_plan(cost, iterations=1500, **settings)
        settings |= {"max_iterations": 600, "tolerance": 1e-10}
        for mode in MODES:
            coupling = coupled(mode, real, simulated, **settings)
            assert coupling.converged, (mode, ratio, tau)
            distance = worst_total_variation(coupling.weights, expected)
            assert distance < 1e-6, (mode, ratio, tau)


def test_the_plan_minimises_the_objective_of_the_paper() -> None:
    real, simulated = clouds(20, 6)
    cost = cost_of(real, simulated)
    weights = raw_coupler(tau=0.7, tolerance=1e-12).couple(real, simulated).weights
    best = oracles.objective(weights / 20, cost, gamma=0.5, tau=0.7)
    for _ in range(50):
        other = weights * (1 + 0.01 * torch.randn_like(weights)).abs()
        other /= 20 * other.sum(dim=1, keepdim=True)
        assert oracles.objective(other, cost, gamma=0.5, tau=0.7) > best


def test_the_marginal_error_measures_the_optimality_conditions() -> None:
    real, simulated = clouds(30, 40)
    for mode, (tau, gamma) in itertools.product(MODES, ((1.0, 0.5), (0.5, 0.1))):
        settings = {"gamma": gamma, "tau": tau, "tolerance": 1e-12}
        with pytest.warns(RoPEWarning, match="has not converged"):
            rough = coupled(mode, real, simulated, max_iterations=2, **settings)
        fine = coupled(mode, real, simulated, **settings)
        assert (rough.converged, rough.num_iterations) == (False, 2), mode
        assert rough.marginal_error > 1e-5
        assert fine.converged, mode
        # The errors are computed again from public fields alone.
        for coupling in (rough, fine):
            q = coupling.weights.mean(dim=0)
            target = torch.exp(-coupling.potential * (1 - tau) / tau)
            expected = float((q - target / target.sum()).abs().sum())
            assert coupling.marginal_error == pytest.approx(expected, abs=1e-14)


def test_tau_zero_is_the_row_softmax_of_the_cost() -> None:
    real, simulated = clouds(30, 40)
    coupling = raw_coupler(gamma=0.3, tau=0.0).couple(real, simulated)
    expected = torch.softmax(-cost_of(real, simulated) / 0.3, dim=1)
    assert torch.allclose(coupling.weights, expected, atol=1e-14)
    nearly = raw_coupler(gamma=0.3, tau=1e-6).couple(real, simulated)
    assert torch.allclose(nearly.weights, expected, atol=1e-5)


def test_gamma_is_in_units_of_the_median_distance_between_simulations() -> None:
    real, simulated = clouds(30, 40)
    simulated = simulated**3  # the mean distance is no longer near the median
    coupling = SinkhornCoupler(gamma=0.1).couple(real, simulated)
    median = torch.nn.functional.pdist(simulated).median()
    assert coupling.gamma == pytest.approx(0.1 * float(median))


def test_rows_of_any_portion_are_the_weights_and_new_rows_are_near_a_refit() -> None:
    real, simulated = clouds(200, 200)
    coupler = raw_coupler(gamma=1.0, tau=0.9, tolerance=1e-10)
    coupling = coupler.couple(real, simulated)
    rows = torch.cat([coupling.rows(part) for part in real.split([1, 20, 179])])
    assert torch.allclose(rows, coupling.weights, atol=1e-13)
    sizes = 1 / coupling.weights.square().sum(dim=1)
    assert torch.allclose(coupling.effective_sample_size, sizes)
    new = torch.randn(1, 3, dtype=torch.float64)
    refit = coupler.couple(torch.cat([real, new]), simulated).weights[-1:]
    assert worst_total_variation(coupling.rows(new), refit) < 0.01


def test_columns_that_underflow_are_as_in_the_log_domain() -> None:
    # No observation is near the last five simulations: their columns of the kernel
    # vanish, in float64 too, and at a small tau nothing forces them to come back.
    real, simulated = clouds(40, 40)
    simulated[:5] += 100.0
    cost = cost_of(real, simulated)
    assert (cost[:, :5].amin(dim=0) - cost.amin(dim=1).max()).min() / 0.05 > 800
    expected, _ = oracles.semi_balanced_plan(cost, gamma=0.05, tau=0.5)
    for mode in ("own", "blocked"):
        settings = {"gamma": 0.05, "tau": 0.5, "tolerance": 1e-12}
        coupling = coupled(mode, real, simulated, **settings)
        assert coupling.converged, mode
        assert worst_total_variation(coupling.weights, expected) < 1e-9, mode
    with pytest.warns(RoPEWarning, match="has not converged.* solver='own'"):
        assert coupled("pot", real, simulated, **settings).weights.isfinite().all()


def test_a_small_batch_is_warned_about_and_one_row_at_tau_one_is_uniform() -> None:
    real, simulated = clouds(1, 40)
    with pytest.warns(RoPEWarning, match=r"smaller tau, or `stack`"):
        coupling = raw_coupler(gamma=0.1, tau=1.0).couple(real, simulated)
    assert torch.allclose(coupling.weights, torch.tensor(1 / 40).double(), atol=1e-6)
    with pytest.warns(RoPEWarning):
        sharp = raw_coupler(gamma=0.1, tau=0.1).couple(real, simulated)
    assert sharp.effective_sample_size < 30
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        raw_coupler(gamma=0.1, tau=0.0).couple(real, simulated)


def test_an_offset_of_the_embeddings_changes_no_row() -> None:
    real, simulated = clouds()
    expected = raw_coupler(tau=0.9).couple(real, simulated).weights
    weights = raw_coupler(tau=0.9).couple(real + 1e6, simulated + 1e6).weights
    assert worst_total_variation(weights, expected) < 1e-6


@pytest.mark.medium
def test_it_converges_where_acceleration_alone_gets_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Clusters with other shares of observations than of simulations.

    At tau = 1 whole clusters have to exchange mass across gaps of a hundred gammas.
    """
    coupler = SinkhornCoupler(gamma=0.05, max_iterations=1000)

    def converged(seed: int) -> bool:
        torch.manual_seed(seed)
        real, simulated = (
            0.1 * torch.randn(n, 3) + 5.0 * torch.randint(0, 4, (n, 1))
            for n in (150, 300)
        )
        return coupler.couple(real, simulated).converged

    assert all(map(converged, (1, 2)))
    monkeypatch.setattr(sinkhorn, "ENOUGH", -torch.inf)
    with pytest.warns(RoPEWarning, match="has not converged"):
        assert not all(map(converged, (1, 2)))


@pytest.mark.gpu
@pytest.mark.parametrize("mode", MODES)
def test_a_gpu_gives_the_rows_of_the_cpu(mode: str) -> None:
    real, simulated = clouds(300, 200, 5)
    settings = {"gamma": 0.1, "tau": 0.9, "tolerance": 1e-9}
    expected = coupled(mode, real, simulated, **settings)
    coupling = coupled(mode, real.cuda(), simulated.cuda(), **settings)
    assert coupling.potential.is_cuda
    assert coupling.converged
    difference = worst_total_variation(coupling.weights.cpu(), expected.weights)
    assert difference < 1e-6
