"""Distances, kernels, blocks, and the accelerated fixed point."""

import itertools
import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from sbi_rope.coupling import cost as cost_module
from sbi_rope.coupling import fixed_point
from sbi_rope.coupling.cost import Cost, Distances
from sbi_rope.coupling.fixed_point import solve_fixed_point
from sbi_rope.coupling.kernel import Kernel, marginal_error
from sbi_rope.errors import CouplingError, InvalidInputError
from tests.memory import run_alone
from tests.modes import MODES, coupled, raw_coupler


def clouds(n_o: int = 300, n_s: int = 200) -> tuple[Tensor, Tensor]:
    simulated = torch.randn(n_s, 5, dtype=torch.float64)
    real = 1.3 * torch.randn(n_o, 5, dtype=torch.float64) + 0.5
    return real, simulated


def total_variation(a: Tensor, b: Tensor) -> Tensor:
    return (a.double() - b.double()).abs().sum(dim=1) / 2


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


def test_distances_without_a_matrix_product_are_exact() -> None:
    fixed = torch.randn(50, 3, dtype=torch.float64) + 1e6
    points = torch.cat([fixed[:10], fixed[:10] + 1e-6])
    expected = (points[:, None] - fixed).norm(dim=2)
    assert torch.allclose(
        Distances(fixed, direct=True)(points), expected, rtol=1e-9, atol=0.0
    )


def test_the_unit_of_the_embeddings_does_not_matter() -> None:
    real, simulated = clouds(60, 50)
    coupler = raw_coupler(gamma=0.1, tau=0.9)
    expected = coupler.couple(real, simulated)
    by_median = replace(coupler, cost_scale="simulated")
    gamma = by_median.couple(real, simulated).gamma
    for scale in (1e-25, 1e15):
        embeddings = scale * real, scale * simulated
        scaled = replace(coupler, gamma=0.1 * scale).couple(*embeddings)
        assert scaled.converged, scale
        difference = total_variation(scaled.weights, expected.weights).max()
        assert difference < 1e-4, scale
        found = by_median.couple(*embeddings).gamma
        assert found == pytest.approx(gamma * scale, rel=1e-5)


def test_distances_that_overflow_are_refused() -> None:
    real, simulated = clouds(60, 50)
    with pytest.raises(CouplingError, match="overflow"):
        raw_coupler(gamma=1.5e154).couple(1.5e154 * real, 1.5e154 * simulated)


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
        assert total_variation(coupling.weights, rows).max() < 1e-6
        log_q = rows.mean(dim=0).log()
        assert marginal_error(log_q, coupling.potential, 0.5) < 2e-6


def test_rows_of_an_observation_too_far_away_are_refused() -> None:
    coupling = raw_coupler().couple(*clouds(60, 50))
    for value in (1e20, 1e300):
        far = torch.full((1, 5), value, dtype=torch.float64)
        with pytest.raises(InvalidInputError, match="`real` at most"):
            coupling.rows(far)


# --- kernels ---


def log_marginal(real: Tensor, simulated: Tensor, gamma: float, w: Tensor) -> Tensor:
    """The log of the mean of the rows, in the log domain throughout."""
    cost = (real[:, None].double() - simulated[None].double()).norm(dim=2)
    rows = torch.log_softmax(w - cost / gamma, dim=1)
    return torch.logsumexp(rows, dim=0) - math.log(len(real))


def kernel_of(mode: str, real: Tensor, simulated: Tensor, gamma: float) -> Any:
    cost = Cost(real, simulated, stored=mode == "stored cost")
    return Kernel(cost, gamma, stored=mode != "streamed")


KERNELS = ("stored", "stored cost", "streamed")


@pytest.mark.parametrize("mode", KERNELS)
def test_kernels_return_the_log_of_the_mean_row(mode: str) -> None:
    for gamma, spread in itertools.product((10.0, 0.5, 0.02), (0.0, 1.0, 300.0)):
        real, simulated = clouds(80, 60)
        simulated[:5] += 30.0  # columns that underflow at the smaller gammas
        kernel = kernel_of(mode, real, simulated, gamma)
        for _ in range(3):  # another potential may need another absorption
            w = spread * torch.randn(60, dtype=torch.float64)
            expected = log_marginal(real, simulated, gamma, w)
            error = ((kernel(w) - expected) / (1 + expected.abs())).abs().max()
            assert error < 1e-12, (gamma, spread)


def test_no_entry_of_the_kernel_is_a_denormal_number(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    real, simulated = clouds(80, 60)
    smallest = []
    exponentiate = torch.Tensor.exp_

    def spy(self: Tensor) -> Tensor:
        result = exponentiate(self)
        smallest.append(float(result.min()))
        return result

    monkeypatch.setattr(torch.Tensor, "exp_", spy)
    for mode in KERNELS:
        smallest.clear()
        kernel_of(mode, real, simulated, 1e-3)(torch.zeros(60, dtype=torch.float64))
        assert 1e-290 < min(smallest) < 1e-200, mode


@pytest.mark.medium
@pytest.mark.parametrize("mode", MODES)
def test_the_size_of_blocks_and_portions_changes_no_row(
    mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, simulated = clouds(60, 50)
    settings = {"gamma": 0.3, "tau": 0.9, "tolerance": 1e-10}
    expected = coupled(mode, real, simulated, **settings)
    portions = expected.real.split([1, 20, 39])
    rows = torch.cat([expected.rows(portion) for portion in portions])
    assert (rows - expected.weights).abs().max() < 1e-13
    for block in (1, 100, 10**9):
        monkeypatch.setattr(cost_module, "CPU_BLOCK", block)
        coupling = coupled(mode, real, simulated, **settings)
        assert (coupling.weights - expected.weights).abs().max() < 1e-9, block
        sizes = coupling.effective_sample_size
        assert torch.allclose(sizes, expected.effective_sample_size, rtol=1e-4), block


def test_blocked_weights_are_computed_but_not_kept() -> None:
    real, simulated = clouds(60, 50)
    blocked = coupled("blocked", real, simulated)
    assert blocked.blocked
    assert blocked.weights is not blocked.weights
    assert torch.equal(blocked.weights, blocked.weights)
    kept = coupled("own", real, simulated)
    assert not kept.blocked
    assert kept.weights is kept.weights


MEASURE = """
import torch
from benchmarks.machine import forget_peak, memory, peak_memory
from sbi_rope import SinkhornCoupler
from sbi_rope.coupling import coupler
torch.manual_seed(0)
real, simulated = torch.randn(4000, 4), torch.randn(4000, 4)
SinkhornCoupler(gamma=0.5).couple(real[:200], simulated[:200])
for coupler.MAX_STORED in (0, 10**9):
    before = memory()
    forget_peak()
    coupling = SinkhornCoupler(gamma=0.5).couple(real, simulated)
    coupling.effective_sample_size
    coupling.rows(real[:100])
    print(peak_memory() - before)
"""


class LargestTensor(TorchDispatchMode):
    """Note the number of entries of the largest tensor that torch makes."""

    def __init__(self) -> None:
        super().__init__()
        self.size = 0

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        if isinstance(result, Tensor):
            # Views of less than they show hold only that.
            entries = result.untyped_storage().nbytes() // result.element_size()
            self.size = max(self.size, entries)
        return result


def test_blocked_couplings_make_no_matrix(monkeypatch: pytest.MonkeyPatch) -> None:
    real, simulated = clouds(100, 200)
    monkeypatch.setattr(cost_module, "CPU_BLOCK", 2000)
    sizes = {}
    for mode in ("own", "blocked"):
        with LargestTensor() as largest:
            coupling = coupled(mode, real, simulated, gamma=0.3)
            assert coupling.effective_sample_size.shape == (100,)
            coupling.rows(real[:10])
        sizes[mode] = largest.size
    assert sizes["blocked"] <= 2000
    assert sizes["own"] >= 100 * 200


@pytest.mark.slow
def test_blocked_couplings_take_less_memory_than_a_matrix() -> None:
    # 4000 x 4000 numbers are 122 MB in float64.
    blocked, stored = map(float, run_alone(MEASURE).split())
    assert 0.0 <= blocked <= 40.0
    assert 110.0 <= stored <= 180.0


# --- the accelerated fixed point ---


def solve(kernel: Any, n_s: int, **options: Any) -> Any:
    settings = {"tau": 1.0, "tolerance": 1e-8, "max_iterations": 3000}
    start = torch.zeros(n_s, dtype=torch.float64)
    return solve_fixed_point(kernel, start, **(settings | options))


def plain_iterations(kernel: Any, potential: Tensor, tolerance: float) -> Any:
    """Iterate without acceleration; return the number of iterations and the result."""
    for iteration in range(1, 20_000):
        log_q = kernel(potential)
        if marginal_error(log_q, potential, 1.0) <= tolerance:
            return iteration, potential
        potential = potential - log_q
        potential = potential - potential.mean()
    raise AssertionError("not converged")


def test_acceleration_needs_fewer_iterations_for_the_same_plan() -> None:
    real, simulated = clouds()
    kernel = kernel_of("stored", real, simulated, 0.15)
    accelerated = solve(kernel, 200)
    count, plain = plain_iterations(kernel, torch.zeros(200).double(), 1e-8)
    assert accelerated.num_iterations < 0.4 * count
    assert accelerated.marginal_error <= 1e-8
    assert (plain - accelerated.potential).abs().max() < 1e-4


def test_the_solution_is_the_best_potential_seen() -> None:
    real, simulated = clouds()
    kernel = kernel_of("stored", real, simulated, 0.15)
    last = math.inf
    for budget in range(1, 30):
        solution = solve(kernel, 200, max_iterations=budget)
        assert solution.num_iterations == budget
        error = marginal_error(kernel(solution.potential), solution.potential, 1.0)
        assert error == pytest.approx(solution.marginal_error, rel=1e-6)
        assert abs(float(solution.potential.mean())) < 1e-12
        assert solution.marginal_error <= last
        last = solution.marginal_error


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
    monkeypatch.setattr(fixed_point, "PATIENCE", 10**9)
    lost = solve(kernel, 300, tolerance=1e-6, max_iterations=1500)
    assert lost.marginal_error > 1e-4


def test_a_step_that_makes_the_error_grow_is_taken_back() -> None:
    real, simulated, gamma = unbalanced_clusters()
    kernel = kernel_of("stored", real, simulated, gamma)
    seen: list[tuple[Tensor, float]] = []

    def watched(potential: Tensor) -> Tensor:
        log_q = kernel(potential)
        seen.append((potential, marginal_error(log_q, potential, 1.0)))
        return log_q

    solve(watched, 300, max_iterations=200)
    grown = next(
        i
        for i in range(1, 199)
        if seen[i][1] > fixed_point.LARGEST_GROWTH * seen[i - 1][1]
    )
    before = seen[grown - 1][0]
    image = before - math.log(300) - kernel(before)
    assert torch.allclose(seen[grown + 1][0], image - image.mean(), atol=1e-9)


def test_exhausted_digits_end_the_iteration() -> None:
    kernel = kernel_of("stored", *clouds(), 0.5)
    solution = solve(kernel, 200, tolerance=1e-18, max_iterations=10_000)
    assert fixed_point.STALLED < solution.num_iterations < 2000
    assert 1e-18 < solution.marginal_error < 1e-13


# --- on a GPU ---


@pytest.mark.gpu
@pytest.mark.parametrize("mode", MODES)
def test_a_gpu_gives_the_rows_of_the_cpu(mode: str) -> None:
    real, simulated = clouds()
    for gamma, tau in ((0.5, 0.9), (0.1, 1.0), (0.02, 0.5)):
        settings = {"gamma": gamma, "tau": tau, "tolerance": 1e-9}
        expected = coupled(mode, real, simulated, **settings)
        coupling = coupled(mode, real.cuda(), simulated.cuda(), **settings)
        assert coupling.potential.is_cuda
        assert coupling.converged
        difference = total_variation(coupling.weights.cpu(), expected.weights).max()
        assert difference < 1e-6, (gamma, tau)
