"""Blocks and subsets: large couplings equal small ones done the long way."""

import functools
import itertools
import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from sbi_rope import SinkhornCoupler
from sbi_rope.coupling import cost as cost_module
from sbi_rope.coupling import fixed_point
from sbi_rope.coupling.cost import Cost, Distances
from sbi_rope.coupling.fixed_point import solve_fixed_point
from sbi_rope.coupling.kernel import Kernel, marginal_error
from sbi_rope.errors import CouplingError, InvalidInputError, RoPEWarning
from tests.memory import run_alone
from tests.modes import MODES, digits, raw_coupler


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


def test_float32_distances_are_rounded_float64_ones() -> None:
    fixed = torch.randn(50, 3) + 100.0
    points = torch.cat([fixed[:10], torch.randn(10, 3)])
    expected = (points[:, None].double() - fixed.double()).norm(dim=2)
    distances = Distances(fixed)(points)
    assert distances.dtype == torch.float32
    assert torch.allclose(distances.double(), expected, rtol=1e-7, atol=1e-7)


def test_distances_without_a_matrix_product_are_exact() -> None:
    fixed = torch.randn(50, 3, dtype=torch.float64) + 1e6
    points = torch.cat([fixed[:10], fixed[:10] + 1e-6])
    expected = (points[:, None] - fixed).norm(dim=2)
    assert torch.allclose(
        Distances(fixed, direct=True)(points), expected, rtol=1e-9, atol=0.0
    )


def test_the_unit_of_the_embeddings_does_not_matter() -> None:
    real, simulated = clouds(60, 50)
    for dtype in (torch.float32, torch.float64):
        coupler = raw_coupler(gamma=0.1, tau=0.9, dtype=dtype)
        expected = coupler.couple(real, simulated)
        by_median = replace(coupler, cost_scale="simulated")
        gamma = by_median.couple(real, simulated).gamma
        for scale in (1e-25, 1e15):
            embeddings = scale * real, scale * simulated
            scaled = replace(coupler, gamma=0.1 * scale).couple(*embeddings)
            assert scaled.converged, (dtype, scale)
            difference = total_variation(scaled.weights, expected.weights).max()
            assert difference < 1e-4, (dtype, scale)
            found = by_median.couple(*embeddings).gamma
            assert found == pytest.approx(gamma * scale, rel=1e-5)


def test_distances_beyond_the_dtype_are_refused() -> None:
    real, simulated = clouds(60, 50)
    for dtype, scale in ((torch.float32, 1e20), (torch.float64, 1.5e154)):
        coupler = raw_coupler(gamma=scale, dtype=dtype)
        with pytest.raises(CouplingError, match="overflow"):
            coupler.couple(scale * real, scale * simulated)


def test_distances_are_exact_if_gamma_is_small_compared_to_them() -> None:
    # Two clusters a million apart, each a thousandth wide, and gamma as their width.
    simulated = 1e-3 * torch.randn(60, 2, dtype=torch.float64)
    simulated[:20] += 1e6
    real = 1e-3 * torch.randn(60, 2, dtype=torch.float64)
    real[:20] += 1e6
    cost = (real[:, None] - simulated).norm(dim=2)
    for blocked in (False, True):
        coupler = raw_coupler(gamma=1e-3, tau=0.5, blocked=blocked)
        coupling = coupler.couple(real, simulated)
        rows = torch.softmax(coupling.potential - cost / 1e-3, dim=1)
        assert coupling.direct
        assert total_variation(coupling.weights, rows).max() < 1e-6
        log_q = rows.mean(dim=0).log()
        assert marginal_error(log_q, coupling.potential, 0.5) < 2e-6


def test_rows_of_an_observation_too_far_away_are_refused() -> None:
    for dtype in (torch.float32, torch.float64):
        coupling = raw_coupler(dtype=dtype).couple(*clouds(60, 50))
        for value in (1e20, 1e200, 1e300):
            far = torch.full((1, 5), value, dtype=torch.float64)
            with pytest.raises(InvalidInputError, match="`real` at most"):
                coupling.rows(far)


def test_a_far_simulation_leaves_the_other_distances_exact() -> None:
    fixed = torch.randn(50, 3, dtype=torch.float64)
    fixed[0] = 1e8
    points = fixed[1:] + 1e-2
    expected = (points[:, None] - fixed).norm(dim=2)
    assert ((Distances(fixed)(points) - expected) / expected).abs().max() < 1e-9


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
DTYPES = (torch.float64, torch.float32)


@pytest.mark.parametrize("mode", KERNELS)
def test_kernels_return_the_log_of_the_mean_row(mode: str) -> None:
    cases = itertools.product(DTYPES, (10.0, 0.5, 0.02), (0.0, 1.0, 300.0))
    for dtype, gamma, spread in cases:
        real, simulated = (part.to(dtype) for part in clouds(80, 60))
        simulated[:5] += 30.0  # columns that underflow at the smaller gammas
        kernel = kernel_of(mode, real, simulated, gamma)
        for _ in range(3):  # another potential may need another absorption
            w = spread * torch.randn(60, dtype=torch.float64)
            expected = log_marginal(real, simulated, gamma, w)
            # Exponents of up to 3000 are rounded to 6e-8 of themselves.
            error = ((kernel(w) - expected) / (1 + expected.abs())).abs().max()
            limit = 1e-12 if dtype == torch.float64 else 3e-6
            assert error < limit, (dtype, gamma, spread)


def test_potentials_are_absorbed_only_if_the_factors_leave_the_range() -> None:
    for dtype in DTYPES:
        real, simulated = (part.to(dtype) for part in clouds(80, 60))
        kernel = kernel_of("stored", real, simulated, 0.5)
        w = torch.randn(60, dtype=torch.float64)
        for scale in (0.0, 1.0, 2.0, -1.0):
            kernel(scale * w)
        assert kernel.num_absorptions == 1, dtype
        kernel(1000.0 * w)
        assert kernel.num_absorptions == 2, dtype


def test_no_entry_of_the_kernel_is_a_denormal_number(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    real, simulated = (part.float() for part in clouds(80, 60))
    smallest = []
    exponentiate = torch.Tensor.exp_

    def spy(self: Tensor) -> Tensor:
        result = exponentiate(self)
        smallest.append(float(result.min()))
        return result

    monkeypatch.setattr(torch.Tensor, "exp_", spy)
    for mode in KERNELS:
        smallest.clear()
        kernel_of(mode, real, simulated, 0.01)(torch.zeros(60, dtype=torch.float64))
        assert smallest
        assert min(smallest) > 1e-31, mode


@pytest.mark.medium
@pytest.mark.parametrize("mode", MODES)
def test_the_size_of_blocks_and_portions_changes_no_row(
    mode: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    real, simulated = clouds(60, 50)
    tolerance = digits(mode, double=1e-10, single=1e-6)
    coupler = raw_coupler(gamma=0.3, tau=0.9, tolerance=tolerance, **mode)
    expected = coupler.couple(real, simulated)
    portions = expected.real.split([1, 20, 39])
    rows = torch.cat([expected.rows(portion) for portion in portions])
    limit = digits(mode, double=1e-13, single=1e-6)
    assert (rows - expected.weights).abs().max() < limit
    for block in (1, 100, 10**9):
        monkeypatch.setattr(cost_module, "CPU_BLOCK", block)
        coupling = coupler.couple(real, simulated)
        limit = digits(mode, double=1e-9, single=1e-4)
        assert (coupling.weights - expected.weights).abs().max() < limit, block
        sizes = coupling.effective_sample_size
        assert torch.allclose(sizes, expected.effective_sample_size, rtol=1e-4), block


def test_blocked_weights_are_computed_but_not_kept() -> None:
    real, simulated = clouds(60, 50)
    blocked = raw_coupler(blocked=True).couple(real, simulated)
    assert blocked.weights is not blocked.weights
    assert torch.equal(blocked.weights, blocked.weights)
    kept = raw_coupler(blocked=False).couple(real, simulated)
    assert kept.weights is kept.weights


def test_blocks_are_used_where_there_are_too_many_distances_to_store(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    real, simulated = clouds(60, 50)
    monkeypatch.setattr("sbi_rope.coupling.coupler.MAX_STORED", 60 * 50)
    assert not raw_coupler().couple(real, simulated).blocked
    monkeypatch.setattr("sbi_rope.coupling.coupler.MAX_STORED", 60 * 50 - 1)
    assert raw_coupler().couple(real, simulated).blocked

    def is_blocked(coupler: SinkhornCoupler, *, reused: bool) -> bool:
        set_up = coupler._set_up(real, simulated, 0, gamma=1.0, tau=1.0, reused=reused)
        return set_up[0].blocked

    stored = raw_coupler(blocked=False)
    assert not is_blocked(stored, reused=False)
    pot = raw_coupler(solver="pot")
    assert not is_blocked(pot, reused=True)
    # A part may be stored where the whole may not, and its weights not kept.
    part = raw_coupler(num_fitted=59)
    assert not is_blocked(part, reused=False)
    assert part.couple(real, simulated).blocked


MEASURE = """
import torch
from benchmarks.machine import forget_peak, memory, peak_memory
from sbi_rope import SinkhornCoupler
torch.manual_seed(0)
real, simulated = torch.randn(4000, 4), torch.randn(4000, 4)
SinkhornCoupler(gamma=0.5, blocked=True).couple(real[:200], simulated[:200])
for blocked in (True, False):
    before = memory()
    forget_peak()
    coupling = SinkhornCoupler(gamma=0.5, blocked=blocked).couple(real, simulated)
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
    for blocked in (True, False):
        with LargestTensor() as largest:
            coupling = raw_coupler(gamma=0.3, blocked=blocked).couple(real, simulated)
            assert coupling.effective_sample_size.shape == (100,)
            coupling.rows(real[:10])
        sizes[blocked] = largest.size
    assert sizes[True] <= 2000
    assert sizes[False] >= 100 * 200


@pytest.mark.slow
def test_blocked_couplings_take_less_memory_than_a_matrix() -> None:
    # 4000 x 4000 numbers are 122 MB in float64.
    blocked, stored = map(float, run_alone(MEASURE).split())
    assert 0.0 <= blocked <= 40.0
    assert 110.0 <= stored <= 180.0


# --- the accelerated fixed point ---


def solve(kernel: Any, n_s: int, **options: Any) -> Any:
    settings = {
        "tau": 1.0,
        "tolerance": 1e-8,
        "max_iterations": 3000,
        "memory": 5,
        "eps": 2e-16,
    }
    start = torch.zeros(n_s, dtype=torch.float64)
    return solve_fixed_point(kernel, start, **(settings | options))


def test_acceleration_needs_fewer_iterations_for_the_same_plan() -> None:
    real, simulated = clouds()
    kernel = kernel_of("stored", real, simulated, 0.15)
    plain, accelerated = solve(kernel, 200, memory=0), solve(kernel, 200)
    assert accelerated.num_iterations < 0.4 * plain.num_iterations
    assert max(plain.marginal_error, accelerated.marginal_error) <= 1e-8
    assert (plain.potential - accelerated.potential).abs().max() < 1e-4


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
    plain = solve(kernel, 300, memory=0, tolerance=1e-6)
    assert plain.marginal_error <= 1e-6
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
    real, simulated = (part.float() for part in clouds())
    kernel = kernel_of("stored", real, simulated, 0.5)
    eps = torch.finfo(torch.float32).eps
    solution = solve(kernel, 200, tolerance=1e-14, max_iterations=10_000, eps=eps)
    assert fixed_point.STALLED < solution.num_iterations < 2000
    assert 1e-14 < solution.marginal_error < 1e-5


# --- potentials fitted to some of the observations ---


@functools.cache
def fits_to_parts() -> tuple[Any, list[Any]]:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        real, simulated = clouds(3000, 200)
    coupler = raw_coupler(gamma=0.5, tau=0.9, tolerance=1e-9)
    parts = [
        replace(coupler, num_fitted=count).couple(real, simulated, seed=1)
        for count in (100, 500, 2000)
    ]
    return coupler.couple(real, simulated), parts


def test_potentials_fitted_to_more_observations_approach_the_full_fit() -> None:
    full, parts = fits_to_parts()
    errors = [
        float(total_variation(part.weights, full.weights).mean()) for part in parts
    ]
    assert errors[0] > 1.5 * errors[1] > 1.5**2 * errors[2] > 0
    assert errors[2] < 0.02
    assert [part.num_fitted for part in parts] == [100, 500, 2000]


def test_the_error_of_a_partial_fit_over_the_whole_batch_is_reported() -> None:
    full, parts = fits_to_parts()
    for part in parts:
        assert part.converged
        assert part.marginal_error <= 1e-9
        q = part.weights.mean(dim=0)
        target = torch.softmax(-part.potential * (1 - 0.9) / 0.9, dim=0)
        assert part.batch_error == pytest.approx(float((q - target).abs().sum()))
    errors = [part.batch_error for part in [*parts, full]]
    assert errors == sorted(errors, reverse=True)


def test_fitting_to_all_observations_is_the_full_fit() -> None:
    real, simulated = clouds()
    full = raw_coupler().couple(real, simulated)
    for count in (300, 301):
        coupling = raw_coupler(num_fitted=count).couple(real, simulated)
        assert torch.equal(coupling.potential, full.potential)
        assert (coupling.num_fitted, coupling.batch_error) == (300, full.marginal_error)


def test_the_choice_of_observations_has_a_seed_of_its_own() -> None:
    real, simulated = clouds()
    coupler = raw_coupler(num_fitted=50)
    state = torch.get_rng_state()
    first, again, other = (
        coupler.couple(real, simulated, seed=seed).potential for seed in (1, 1, 2)
    )
    assert torch.equal(first, again)
    assert not torch.allclose(first, other)
    assert torch.equal(torch.get_rng_state(), state)


def test_few_fitted_observations_are_warned_about_like_a_small_batch() -> None:
    with pytest.warns(RoPEWarning, match="num_fitted=10 of "):
        raw_coupler(num_fitted=10).couple(*clouds())


# --- on a GPU ---


@pytest.mark.gpu
@pytest.mark.parametrize("mode", MODES)
def test_a_gpu_gives_the_rows_of_the_cpu(mode: dict[str, Any]) -> None:
    real, simulated = clouds()
    tolerance = digits(mode, double=1e-9, single=1e-6)
    for gamma, tau in ((0.5, 0.9), (0.1, 1.0), (0.02, 0.5)):
        coupler = raw_coupler(gamma=gamma, tau=tau, tolerance=tolerance, **mode)
        expected = coupler.couple(real, simulated)
        coupling = coupler.couple(real.cuda(), simulated.cuda())
        assert coupling.potential.is_cuda
        assert coupling.converged
        difference = total_variation(coupling.weights.cpu(), expected.weights).max()
        assert difference < digits(mode, double=1e-6, single=1e-3), (gamma, tau)


# --- on a device without float64 ---


class NoFloat64(TorchDispatchMode):
    """Raise where a device without float64 would."""

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        for value in result if isinstance(result, tuple | list) else (result,):
            if isinstance(value, Tensor) and value.dtype == torch.float64:
                raise TypeError(f"{func} made a tensor in float64")
        return result


@pytest.fixture
def _no_float64(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cost_module, "has_float64", lambda device: False)


@pytest.mark.parametrize(("blocked", "tau"), [(False, 1.0), (True, 0.9)])
def test_a_device_without_float64_couples_in_float32(
    blocked: bool, tau: float, request: pytest.FixtureRequest
) -> None:
    real, simulated = (values.float() + 10 for values in clouds())
    coupler = raw_coupler(
        gamma=0.1,
        tau=tau,
        dtype=torch.float32,
        blocked=blocked,
        tolerance=1e-5,
        num_fitted=200,
    )
    expected = replace(coupler, dtype=torch.float64).couple(real, simulated, seed=0)
    request.getfixturevalue("_no_float64")
    with NoFloat64():
        coupling = coupler.couple(real, simulated, seed=0)
        weights, rows = coupling.weights, coupling.rows(real[:10])
        assert coupling.effective_sample_size.isfinite().all()
    assert coupling.converged
    assert coupling.potential.dtype == weights.dtype == torch.float32
    assert total_variation(weights, expected.weights).max() < 1e-3
    assert torch.equal(rows, weights[:10])


@pytest.mark.usefixtures("_no_float64")
def test_pot_is_given_float32_on_a_device_without_float64() -> None:
    real, simulated = (values.float() for values in clouds(80, 60))
    coupler = raw_coupler(dtype=torch.float32, solver="pot", tolerance=1e-5)
    coupler.couple(real, simulated)  # POT tries all dtypes when it is first used
    with NoFloat64():
        coupling = coupler.couple(real, simulated)
    assert coupling.converged


@pytest.mark.usefixtures("_no_float64")
def test_columns_that_underflow_are_solved_in_the_log_domain_without_float64() -> None:
    real, simulated = (values.float() for values in clouds(80, 60))
    simulated[0] += 1000.0
    coupler = raw_coupler(gamma=1.0, dtype=torch.float32, tolerance=1e-4)
    with NoFloat64():
        coupling = coupler.couple(real, simulated)
    assert coupling.converged
    assert float(coupling.weights[:, 0].mean()) == pytest.approx(1 / 60, rel=1e-2)


@pytest.mark.usefixtures("_no_float64")
def test_distances_on_a_device_without_float64_tell_near_points_apart() -> None:
    """By a matrix product in float32, they would be wrong by 3e-4 of the radius."""
    real = 100 * torch.randn(40, 5)
    coupler = SinkhornCoupler(
        gamma=1.0, tau=0.5, dtype=torch.float32, cost_scale="simulated", tolerance=1e-5
    )
    coupling = coupler.couple(real, real)
    assert coupling.direct
    exact = torch.cdist(real.double(), real.double())
    scale = torch.nn.functional.pdist(real.double()).median()
    assert coupling.gamma == pytest.approx(float(scale), rel=1e-6)
    expected = torch.softmax(coupling.potential - exact / coupling.gamma, dim=1)
    assert torch.allclose(coupling.weights.double(), expected, rtol=1e-4)


@pytest.mark.usefixtures("_no_float64")
def test_float64_on_a_device_without_it_is_refused() -> None:
    real, simulated = (values.float() for values in clouds(30, 30))
    with pytest.raises(
        InvalidInputError,
        match=r"float64 is not available on cpu; pass SinkhornCoupler\("
        r"dtype=torch.float32\) or move the posterior to the CPU",
    ):
        raw_coupler().couple(real, simulated)


def test_only_apples_gpus_are_without_float64() -> None:
    known = {kind: torch.device(kind) for kind in ("cpu", "cuda", "mps")}
    answers = {kind: cost_module.has_float64(device) for kind, device in known.items()}
    assert answers == {"cpu": True, "cuda": True, "mps": False}
