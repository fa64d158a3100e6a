"""The coupling against a slow log-domain solver, its limits, failures and parts."""

import functools
import itertools
import math
import warnings
from typing import Any

import pytest
import torch
from torch import Tensor

from sbi_rope import SinkhornCoupler
from sbi_rope.coupling import Coupling, sinkhorn
from sbi_rope.coupling.sinkhorn import (
    Distances,
    Kernel,
    marginal_error,
    solve_fixed_point,
)
from sbi_rope.utils.errors import CouplingError, RoPEWarning
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
            patch.setattr("sbi_rope.coupling.coupling.MAX_STORED", 0)
        return raw_coupler(solver=solver, **settings).couple(real, simulated)


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
def test_rows_equal_those_of_the_oracle(mode: str) -> None:
    for ratio, tau in ((1.0, 1.0), (0.1, 0.9), (1e-2, 0.5), (1e-3, 0.9)):
        real, simulated, gamma, expected, change = solved_by_the_oracle(ratio, tau)
        settings = {"gamma": gamma, "tau": tau, "max_iterations": 600}
        coupling = coupled(mode, real, simulated, tolerance=1e-10, **settings)
        assert (coupling.weights.sum(dim=1) - 1).abs().max() < 1e-12
        assert coupling.converged, (ratio, tau)
        if ratio >= 0.1:
            assert coupling.solver == ("pot" if mode == "pot" else "own")
        assert change < 1e-10
        distance = worst_total_variation(coupling.weights, expected)
        assert distance < 1e-6, (ratio, tau)


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
    modes = itertools.product(MODES, ((1.0, 0.5), (0.9, 0.5), (0.5, 0.1)))
    for mode, (tau, gamma) in modes:
        settings = {"gamma": gamma, "tau": tau, "tolerance": 1e-12}
        rough = coupled(mode, real, simulated, max_iterations=2, **settings)
        fine = coupled(mode, real, simulated, **settings)
        assert (rough.converged, rough.num_iterations) == (False, 2), mode
        assert rough.marginal_error > 1e-5
        assert fine.converged, mode
        assert fine.solver == ("pot" if mode == "pot" else "own")
        # The errors are computed again from public fields alone.
        for coupling in (rough, fine):
            q = coupling.weights.double().mean(dim=0)
            target = torch.exp(-coupling.potential * (1 - tau) / tau) / q.numel()
            expected = (q - target / target.sum()).abs().sum()
            error = coupling.marginal_error
            assert error == pytest.approx(float(expected), abs=1e-14)


def test_tau_zero_is_the_row_softmax_of_the_cost() -> None:
    real, simulated = clouds(30, 40)
    coupling = raw_coupler(gamma=0.3, tau=0.0).couple(real, simulated)
    expected = torch.softmax(-cost_of(real, simulated) / 0.3, dim=1)
    assert torch.allclose(coupling.weights, expected, atol=1e-14)
    assert (coupling.num_iterations, coupling.solver) == (0, "none")
    nearly = raw_coupler(gamma=0.3, tau=1e-6).couple(real, simulated)
    assert torch.allclose(nearly.weights, expected, atol=1e-5)


def test_gamma_is_in_units_of_the_median_distance_between_simulations() -> None:
    real, simulated = clouds(30, 40)
    simulated = simulated**3  # the mean distance is no longer near the median
    coupling = SinkhornCoupler(gamma=0.1).couple(real, simulated)
    first, second = torch.triu_indices(40, 40, offset=1)
    median = (simulated[first] - simulated[second]).norm(dim=1).median()
    assert coupling.gamma == pytest.approx(0.1 * float(median))


def test_rows_of_the_batch_are_its_weights_and_new_rows_are_near_a_refit() -> None:
    real, simulated = clouds(200, 200)
    coupler = raw_coupler(gamma=1.0, tau=0.9, tolerance=1e-10)
    coupling = coupler.couple(real, simulated)
    assert torch.allclose(coupling.rows(real), coupling.weights, atol=1e-14)
    new = torch.randn(1, 3, dtype=torch.float64)
    refit = coupler.couple(torch.cat([real, new]), simulated).weights[-1:]
    assert worst_total_variation(coupling.rows(new), refit) < 0.01


def test_effective_sample_size_counts_equal_weights() -> None:
    # The first observation is near two of four simulations, the second far from all.
    simulated = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 50.0], [0.0, -50.0]])
    real = torch.tensor([[0.0, 0.0], [1e6, 0.0]])
    coupling = raw_coupler(gamma=1.0, tau=0.0).couple(real, simulated)
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
    for mode in MODES:
        settings = {"gamma": 0.05, "tau": 0.5, "tolerance": 1e-12}
        coupling = coupled(mode, real, simulated, **settings)
        assert coupling.converged, mode
        assert worst_total_variation(coupling.weights, expected) < 1e-9, mode
        # w = tau (w + log b - log q) in the far columns, whatever their size.
        log_q = torch.logsumexp(
            torch.log_softmax(coupling.potential - cost / 0.05, dim=1), dim=0
        )
        fixed = 0.5 * (coupling.potential - log_q)
        difference = (fixed - fixed.mean()) - coupling.potential
        assert difference.abs().max() < 1e-6, mode


def test_a_gamma_too_small_for_the_digits_is_refused() -> None:
    real, simulated = clouds(25, 25)
    for tau in (1.0, 0.0):
        coupler = raw_coupler(gamma=1e-13, tau=tau)
        with pytest.raises(CouplingError, match="gamma of at least"):
            coupler.couple(real, simulated)


def test_a_small_batch_is_warned_about_and_one_row_at_tau_one_is_uniform() -> None:
    real, simulated = clouds(1, 40)
    with pytest.warns(RoPEWarning, match=r"smaller tau.*unseen='extend'"):
        coupling = raw_coupler(gamma=0.1, tau=1.0).couple(real, simulated)
    assert torch.allclose(coupling.weights, torch.tensor(1 / 40).double(), atol=1e-6)
    with pytest.warns(RoPEWarning):
        sharp = raw_coupler(gamma=0.1, tau=0.1).couple(real, simulated)
    assert sharp.effective_sample_size < 30
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        raw_coupler(gamma=0.1, tau=0.0).couple(real, simulated)


# --- distances ---


def test_distances_are_exact_to_the_stated_accuracy() -> None:
    for width, offset in itertools.product((1, 3, 64), (0.0, 1e6)):
        fixed = torch.randn(50, width, dtype=torch.float64) + offset
        others = 3 * fixed[10:20] - 2 * offset
        points = torch.cat([fixed[:10], fixed[:10] + 1e-3, others])
        expected = (points[:, None] - fixed).norm(dim=2)
        centred = fixed - fixed.median(dim=0).values
        radius = float(centred.norm(dim=1).max())
        error = (Distances(fixed)(points) - expected).abs()
        assert error.max() < 5e-8 * radius, (width, offset)
        apart = expected > 0.1 * radius
        assert (error / expected)[apart].max() < 1e-12, (width, offset)


def test_distances_are_exact_if_gamma_is_small_compared_to_them() -> None:
    # Two clusters a million apart, each a thousandth wide, and gamma as their width.
    simulated = 1e-3 * torch.randn(60, 2, dtype=torch.float64)
    simulated[:20] += 1e6
    real = 1e-3 * torch.randn(60, 2, dtype=torch.float64)
    real[:20] += 1e6
    cost = (real[:, None] - simulated).norm(dim=2)
    for mode in ("own", "blocked"):
        coupling = coupled(mode, real, simulated, gamma=1e-3, tau=0.5)
        rows = torch.softmax(coupling.potential - cost / 1e-3, dim=1)
        assert coupling.direct
        assert worst_total_variation(coupling.weights, rows) < 1e-6
        log_q = rows.mean(dim=0).log()
        assert marginal_error(log_q, coupling.potential, 0.5) < 2e-6


# --- kernels ---


def log_marginal(real: Tensor, simulated: Tensor, gamma: float, w: Tensor) -> Tensor:
    """The log of the mean of the rows, in the log domain throughout."""
    cost = (real[:, None].double() - simulated[None].double()).norm(dim=2)
    rows = torch.log_softmax(w - cost / gamma, dim=1)
    return torch.logsumexp(rows, dim=0) - math.log(len(real))


def kernel_of(mode: str, real: Tensor, simulated: Tensor, gamma: float) -> Any:
    return Kernel(real, Distances(simulated), gamma, stored=mode == "stored")


KERNELS = ("stored", "streamed")


@pytest.mark.parametrize("mode", KERNELS)
def test_kernels_return_the_log_of_the_mean_row(mode: str) -> None:
    for gamma, spread in itertools.product((10.0, 0.5, 0.02), (0.0, 1.0, 300.0)):
        real, simulated = clouds(80, 60, 5)
        simulated[:5] += 30.0  # columns that underflow at the smaller gammas
        kernel = kernel_of(mode, real, simulated, gamma)
        for _ in range(3):  # another potential may need another absorption
            w = spread * torch.randn(60, dtype=torch.float64)
            expected = log_marginal(real, simulated, gamma, w)
            error = ((kernel(w) - expected) / (1 + expected.abs())).abs().max()
            assert error < 1e-12, (gamma, spread)


@pytest.mark.medium
@pytest.mark.parametrize("mode", MODES)
def test_the_size_of_blocks_and_portions_changes_no_row(
    mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, simulated = clouds(60, 50, 5)
    settings = {"gamma": 0.3, "tau": 0.9, "tolerance": 1e-10}
    expected = coupled(mode, real, simulated, **settings)
    portions = expected.real.split([1, 20, 39])
    rows = torch.cat([expected.rows(portion) for portion in portions])
    assert (rows - expected.weights).abs().max() < 1e-13
    for block in (1, 100, 10**9):
        monkeypatch.setattr(sinkhorn, "CPU_BLOCK", block)
        coupling = coupled(mode, real, simulated, **settings)
        assert (coupling.weights - expected.weights).abs().max() < 1e-9, block
        sizes = coupling.effective_sample_size
        assert torch.allclose(sizes, expected.effective_sample_size, rtol=1e-4), block


# --- the accelerated fixed point ---


def solve(kernel: Any, n_s: int, **options: Any) -> Any:
    settings = {"tau": 1.0, "tolerance": 1e-8, "max_iterations": 3000}
    start = torch.zeros(n_s, dtype=torch.float64)
    return solve_fixed_point(kernel, start, **(settings | options))


def unbalanced_clusters() -> tuple[Tensor, Tensor, float]:
    """Clusters with other shares of observations than of simulations.

    At tau = 1 whole clusters have to exchange mass across gaps of a hundred gammas: the
    potential must move far before the error falls, which misleads acceleration.
    """
    torch.manual_seed(0)
    simulated = 0.1 * torch.randn(300, 5) + 5.0 * torch.randint(0, 4, (300, 1))
    real = 0.1 * torch.randn(300, 5) + 5.0 * torch.randint(0, 4, (300, 1)) + 0.5
    gamma = 0.01 * float(torch.cdist(real, simulated).max())
    return real.double(), simulated.double(), gamma


@pytest.mark.medium
def test_plain_iterations_take_over_where_acceleration_gets_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    real, simulated, gamma = unbalanced_clusters()
    kernel = kernel_of("stored", real, simulated, gamma)
    accelerated = solve(kernel, 300, tolerance=1e-6, max_iterations=1500)
    assert accelerated.marginal_error <= 1e-6
    # Without the takeover the same budget is not enough.
    monkeypatch.setattr(sinkhorn, "PATIENCE", 10**9)
    lost = solve(kernel, 300, tolerance=1e-6, max_iterations=1500)
    assert lost.marginal_error > 1e-4


# --- on a GPU ---


@pytest.mark.gpu
@pytest.mark.parametrize("mode", MODES)
def test_a_gpu_gives_the_rows_of_the_cpu(mode: str) -> None:
    real, simulated = clouds(300, 200, 5)
    for gamma, tau in ((0.5, 0.9), (0.1, 1.0), (0.02, 0.5)):
        settings = {"gamma": gamma, "tau": tau, "tolerance": 1e-9}
        expected = coupled(mode, real, simulated, **settings)
        coupling = coupled(mode, real.cuda(), simulated.cuda(), **settings)
        assert coupling.potential.is_cuda
        assert coupling.converged
        difference = worst_total_variation(coupling.weights.cpu(), expected.weights)
        assert difference < 1e-6, (gamma, tau)
