"""The mixture against brute force: its density, its samples, its normalisation."""

import copy
import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from sbi.utils import MultipleIndependent
from sbi.utils.metrics import c2st
from torch import Size, Tensor
from torch.distributions import Distribution, Gamma, Independent, Normal

from sbi_rope._sbi import embed, embedding_of, headless
from sbi_rope.coupling import SinkhornCoupler
from sbi_rope.errors import (
    InvalidInputError,
    RoPEWarning,
    SamplingError,
)
from sbi_rope.mixture import MixturePosterior, average, chunks
from sbi_rope.mixture import density as density_module
from sbi_rope.mixture import sampling as sampling_module
from sbi_rope.mixture import truncation as truncation_module
from tests import problems
from tests.problems import TableCoupling, brute_force_log_prob, gaussian_posterior

QUIET = {"show_progress_bars": False}


def flow_posterior(
    family: str = "maf", *, n_o: int = 6, tail_mass: float = 0.0, **coupler: Any
) -> MixturePosterior:
    """A mixture of trained flows, coupled by a sharp coupler."""
    npe = problems.npe_posterior(family)
    x_s = problems.simulate(npe.prior.sample((25,)))
    x_o = problems.simulate(npe.prior.sample((n_o,))) + 0.2
    h = embedding_of(npe.posterior_estimator)
    embeddings = embed(h, x_s)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RoPEWarning)
        coupling = SinkhornCoupler(gamma=0.1, tau=0.9, **coupler).couple(
            embed(h, x_o), embeddings
        )
    estimator = problems.coupled_mixture(
        headless(copy.deepcopy(npe.posterior_estimator)),
        embeddings,
        coupling,
        x_o,
        embedding_net=h,
        tail_mass=tail_mass,
    )
    return MixturePosterior(estimator, copy.deepcopy(npe.prior))


def log_prob_batched(posterior: MixturePosterior, theta: Tensor) -> Tensor:
    return posterior.log_prob_batched(theta, posterior.x_o, norm_posterior=False)


def inside_mass(posterior: MixturePosterior) -> Tensor:
    """Z_j of Gaussian components inside the box [-1, 1], in closed form."""
    mean, log_std = problems.simulated_of(posterior).double().chunk(2, dim=1)
    normal = Normal(mean, log_std.exp())
    one = torch.ones_like(mean)
    return (normal.cdf(one) - normal.cdf(-one)).prod(dim=1)


def count_draws(posterior: MixturePosterior, monkeypatch: pytest.MonkeyPatch) -> list:
    """Record the number of thetas of every call of the components' sample."""
    components: Any = posterior.posterior_estimator.parts[0].density
    original, calls = components.sample, []

    def sample(sample_shape: Size, condition: Tensor, **kwargs: Any) -> Tensor:
        calls.append(Size(sample_shape).numel() * len(condition))
        return original(sample_shape, condition, **kwargs)

    monkeypatch.setattr(components, "sample", sample)
    return calls


# --- density ---


def test_log_prob_is_the_log_sum_over_all_components() -> None:
    posterior = gaussian_posterior(n_o=5, n_s=40)
    theta = 2 * torch.rand(30, 5, 2) - 1
    expected = brute_force_log_prob(posterior, theta).float()
    batched = log_prob_batched(posterior, theta)
    assert batched.shape == (30, 5)
    assert torch.allclose(batched, expected, atol=1e-6, rtol=1e-6)
    assert torch.allclose(
        log_prob_batched(posterior, theta[0]), expected[:1], atol=1e-6, rtol=1e-6
    )
    for i, x in enumerate(posterior.x_o):
        single = posterior.log_prob(theta[:, i], x=x, norm_posterior=False)
        assert torch.allclose(single, expected[:, i], atol=1e-6, rtol=1e-6)


# One flow of each library; all families go through tests/contract.
@pytest.mark.medium
@pytest.mark.parametrize("family", ["mdn", "nsf", "zuko_unaf"])
def test_log_prob_of_trained_flows_is_the_log_sum_over_all_components(
    family: str,
) -> None:
    posterior = flow_posterior(family)
    theta = 2 * torch.rand(10, 6, 2) - 1
    with torch.no_grad():
        expected = brute_force_log_prob(posterior, theta).float()
    assert torch.allclose(
        log_prob_batched(posterior, theta), expected, atol=1e-4, rtol=1e-5
    )


@pytest.mark.medium
def test_every_kind_of_coupling_gives_the_log_sum_of_its_own_weights(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for limit in (0, 10**9):
        monkeypatch.setattr("sbi_rope.coupling.coupler.MAX_STORED", limit)
        posterior = flow_posterior()
        rows = problems.rows_of(posterior, posterior.x_o)
        assert torch.equal(rows, posterior.weights)
        theta = 2 * torch.rand(10, 6, 2) - 1
        expected = brute_force_log_prob(posterior, theta).float()
        log_prob = log_prob_batched(posterior, theta)
        assert log_prob.dtype is torch.float32
        assert torch.allclose(log_prob, expected, atol=1e-4, rtol=1e-5)
        leakage, mass = posterior.leakage(posterior.x_o), posterior._cache[0]
        expected = posterior.weights.double() @ mass
        assert torch.allclose(leakage.mass, expected, atol=1e-12)
        normalised = posterior.log_prob_batched(theta, posterior.x_o)
        expected = log_prob - leakage.mass.log().float()
        assert torch.allclose(normalised, expected, atol=1e-4)


@pytest.mark.medium
@pytest.mark.parametrize("tail_mass", [0.0, 0.05])
def test_the_size_of_blocks_and_batches_changes_no_density(
    tail_mass: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    posterior = gaussian_posterior(n_o=7, n_s=20, tail_mass=tail_mass, std=0.8)
    theta = 2 * torch.rand(6, 7, 2) - 1
    whole = posterior.log_prob_batched(theta, posterior.x_o)
    one = posterior.log_prob(theta[:, 2], x=posterior.x_o[2])
    for entries, batch in ((1, 1), (13, 7), (50, 2**14), (2**19, 50)):
        monkeypatch.setattr(chunks, "MAX_ENTRIES", entries)
        monkeypatch.setattr(chunks, "CPU_BATCH", batch)
        cut = posterior.log_prob_batched(theta, posterior.x_o)
        assert torch.allclose(cut, whole, atol=1e-6), (entries, batch)
        cut = posterior.log_prob(theta[:, 2], x=posterior.x_o[2])
        assert torch.allclose(cut, one, atol=1e-6), (entries, batch)


@pytest.mark.filterwarnings("ignore:Extended")
def test_weights_and_proposals_stay_within_the_number_of_the_docstring(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    posterior = gaussian_posterior(n_o=30, n_s=12, std=2.0, unseen="extend")
    entries = []
    original, inside = TableCoupling.rows, posterior._inside
    log_q = density_module._log_q

    def rows(coupling: TableCoupling, real: Tensor, **options: Any) -> Tensor:
        entries.append(len(real) * len(coupling.simulated))
        return original(coupling, real, **options)

    def accept(theta: Tensor) -> Tensor:
        entries.append(len(theta))
        return inside(theta)

    def terms(*arguments: Any) -> Tensor:
        log_terms = log_q(*arguments)
        entries.append(log_terms.numel())
        return log_terms

    def refuse(coupling: TableCoupling) -> Tensor:
        raise AssertionError("the matrix of all weights was asked for")

    posterior.leakage(posterior.x_o)  # the draws behind it are cut by the flow's batch
    monkeypatch.setattr(TableCoupling, "rows", rows)
    monkeypatch.setattr(TableCoupling, "weights", property(refuse))
    monkeypatch.setattr(posterior, "_inside", accept)
    monkeypatch.setattr(density_module, "_log_q", terms)
    monkeypatch.setattr(chunks, "MAX_ENTRIES", 100)
    x_o = posterior.x_o
    calls: dict[str, Callable[[], Tensor]] = {
        "log_prob": lambda: posterior.log_prob_batched(torch.zeros(9, 30, 2), x_o),
        "sample": lambda: posterior.sample_batched((20,), x_o, **QUIET),
        "leakage": lambda: posterior.leakage(x_o).mass,
        "extend": lambda: posterior.sample_batched((20,), torch.randn(30, 3), **QUIET),
    }
    for name, call in calls.items():
        entries.clear()
        call()
        assert max(entries) <= 100, name
        # 30 rows of 12 weights, eight at a time.
        assert entries.count(8 * 12) >= 3, name


MEMORY = """
import torch

from sbi_rope.coupling import Coupling
from sbi_rope.mixture import MixturePosterior
from tests import problems
from benchmarks.machine import forget_peak, memory, peak_memory

n, dim = 6000, 2
simulated = problems.embeddings_of(dim, n)
coupling = Coupling(
    potential=torch.zeros(n, dtype=torch.float64), simulated=simulated.double(),
    real=simulated.double() + 0.01, gamma=0.05, tau=1.0, marginal_error=0.0,
    num_iterations=0, converged=True, solver="none",
    blocked=True,
)
estimator = problems.coupled_mixture(
    problems.Gaussians(dim), simulated, coupling, torch.randn(n, 3),
    embedding_net=torch.nn.Identity(),
)
posterior = MixturePosterior(estimator, problems.box(dim))
before = memory()
forget_peak()
posterior.log_prob_batched(torch.zeros(n, dim), posterior.x_o)
posterior.sample_batched((10,), posterior.x_o, show_progress_bars=False)
estimator.tail_mass = 0.0
posterior.log_prob_batched(torch.zeros(500, dim), posterior.x_o[:500])
posterior[0].log_prob(torch.zeros(500, dim))
print(peak_memory() - before)
"""


def test_components_with_a_density_of_nan_count_as_zero(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    broken = gaussian_posterior(n_o=6, n_s=20)
    estimator = broken.posterior_estimator
    theta = 2 * torch.rand(6, 2) - 1
    expected = brute_force_log_prob(broken, theta)
    components: Any = estimator.parts[0].density
    original, first = components.log_prob, problems.simulated_of(broken)[0]
    share = (
        broken.weights[:, 0]
        * original(theta[None], condition=first.expand(6, -1)).double().exp().flatten()
    )

    def log_prob(input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        log_q = original(input, condition)
        broken_here = (condition == first).all(dim=1)
        # NaN that reaches the gradients too.
        return log_q + input.sum(dim=-1) * torch.where(broken_here, math.nan, 0.0)

    monkeypatch.setattr(components, "log_prob", log_prob)
    with pytest.warns(RoPEWarning, match=r"6 of 120 component densities are NaN"):
        log_prob_now = log_prob_batched(broken, theta)[0]
    theta = theta.clone().requires_grad_()
    with pytest.warns(RoPEWarning):
        estimator.log_prob(theta, broken.x_o).sum().backward()
    assert torch.isfinite(theta.grad).all()
    assert (theta.grad != 0).all()
    assert torch.allclose(
        log_prob_now.double(), (expected.exp() - share).log().flatten(), atol=1e-5
    )


@pytest.mark.parametrize("tail_mass", [1e-3, 0.5, 1.0])
def test_the_tail_left_out_obeys_the_bound_of_the_docstring(tail_mass: float) -> None:
    torch.manual_seed(5)
    weights = torch.softmax(3 * torch.randn(8, 60), dim=1)
    posterior = gaussian_posterior(n_o=8, weights=weights, embeddings=embeddings(60))
    theta = 2 * torch.rand(50, 8, 2) - 1
    full = log_prob_batched(posterior, theta).double().exp()
    posterior.posterior_estimator.tail_mass = tail_mass
    truncated = log_prob_batched(posterior, theta).double().exp()

    # The largest density among the components left out, found independently.
    simulated = problems.simulated_of(posterior)
    components = posterior.posterior_estimator.parts[0].density
    bound = torch.zeros(50, 8, dtype=torch.float64)
    num_dropped = 0
    for i, row in enumerate(posterior.weights):
        smallest_first = row.argsort()
        dropped = smallest_first[row[smallest_first].cumsum(0) <= tail_mass][:59]
        num_dropped += len(dropped)
        for j in dropped:
            condition = simulated[j].expand(50, -1)
            density = components.log_prob(theta[None, :, i], condition)[0]
            bound[:, i] = torch.maximum(bound[:, i], density.double().exp())
    missing = full - truncated
    rounding = 1e-6 * full
    assert num_dropped > 8
    assert (missing >= -rounding).all()
    assert (missing <= tail_mass * bound + rounding).all()
    assert (missing > 10 * rounding).any(), "no component was left out"
    assert (truncated > 0).all(), "nothing was kept"


def embeddings(n_s: int, dim: int = 2) -> Tensor:
    return problems.embeddings_of(dim, n_s)


def test_the_tails_of_the_density_do_not_underflow() -> None:
    posterior = gaussian_posterior(dim=1, prior=problems.standard_normal(1), std=0.01)
    theta = torch.full((1, 5, 1), 50.0)
    expected = brute_force_log_prob(posterior, theta)
    assert expected.max() < -1e5
    assert torch.allclose(
        log_prob_batched(posterior, theta).double(), expected, rtol=1e-5
    )


def test_the_density_integrates_to_one() -> None:
    for prior, bound in ((problems.box(2), 1.0), (problems.standard_normal(2), 4.0)):
        posterior = gaussian_posterior(prior=prior, n_o=3, std=0.4)
        size = 161
        step = 2 * bound / size
        axis = torch.arange(size) * step - bound + step / 2
        grid = torch.cartesian_prod(axis, axis)[:, None].expand(-1, 3, -1)
        density = posterior.log_prob_batched(grid, posterior.x_o).exp()
        integral = density.sum(dim=0) * step**2
        error = posterior.leakage(posterior.x_o).standard_error
        assert ((integral - 1).abs() < 4 * error + 2e-3).all(), prior


def test_weights_of_zero_contribute_nothing() -> None:
    weights = torch.tensor([[0.0, 1.0, 0.0], [0.5, 0.0, 0.5]])
    for tail_mass in (0.0, 1e-3):
        posterior = gaussian_posterior(
            n_o=2, weights=weights, embeddings=embeddings(3), tail_mass=tail_mass
        )
        theta = 2 * torch.rand(4, 2, 2) - 1
        expected = brute_force_log_prob(posterior, theta).float()
        found = log_prob_batched(posterior, theta)
        assert torch.allclose(found, expected, atol=1e-6), tail_mass


def test_rows_of_theta_and_x_must_match() -> None:
    posterior = gaussian_posterior(n_o=5)
    for shape, num_x in (((3, 2), 5), ((4, 3, 2), 5), ((2, 2), 3), ((1, 4, 2), 5)):
        with pytest.raises(InvalidInputError, match=r"as many rows of `theta`"):
            posterior.log_prob_batched(torch.zeros(shape), posterior.x_o[:num_x])


def test_one_row_of_theta_or_one_x_serves_all_of_the_other() -> None:
    posterior = gaussian_posterior(n_o=5)
    theta = 2 * torch.rand(4, 5, 2) - 1
    many = posterior.log_prob_batched(theta[:, :1], posterior.x_o)
    same = posterior.log_prob_batched(theta[:, :1].expand(-1, 5, -1), posterior.x_o)
    assert torch.allclose(many, same, atol=1e-6)
    one_x = posterior.log_prob_batched(theta, posterior.x_o[:1])
    same = posterior.log_prob_batched(theta, posterior.x_o[:1].expand(5, -1))
    assert torch.allclose(one_x, same, atol=1e-6)


# --- samples ---


@pytest.mark.medium
def test_samples_follow_the_density() -> None:
    posterior = gaussian_posterior(n_o=1, n_s=6)
    size = 400
    step = 2 / size
    axis = torch.arange(size) * step - 1 + step / 2
    grid = torch.cartesian_prod(axis, axis)
    samples = posterior.sample((1500,), x=posterior.x_o, **QUIET)
    density = posterior.log_prob(grid, x=posterior.x_o).exp().double()
    chosen = torch.multinomial(density, 1500, replacement=True)
    drawn = grid[chosen] + step * (torch.rand(1500, 2) - 0.5)
    score = float(c2st(samples, drawn, n_folds=2))
    assert abs(score - 0.5) < 0.05


@pytest.mark.slow
def test_samples_have_the_cdf_of_the_truncated_mixture_in_blocks_of_any_size(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for entries, batch, n in (
        (2**19, 2**14, 2000),
        (1, 2**14, 500),  # one at a time takes its time
        (2**19, 50, 2000),
        (70, 33, 2000),
    ):
        posterior = gaussian_posterior(dim=1, n_o=3, n_s=5, std=0.6)
        monkeypatch.setattr(chunks, "MAX_ENTRIES", entries)
        monkeypatch.setattr(chunks, "CPU_BATCH", batch)
        samples = posterior.sample_batched((n,), posterior.x_o, **QUIET)[..., 0]
        one = posterior.sample((n,), x=posterior.x_o[1], **QUIET)[:, 0].double()
        mean, log_std = problems.simulated_of(posterior).double().T
        components = Normal(mean, log_std.exp())
        for i, draws in [*enumerate(samples.double().T), (1, one)]:
            points = torch.cat([torch.tensor([-1.0, 1.0]), draws.sort().values])
            cdf = components.cdf(points[:, None]) @ posterior.weights[i].double()
            u = (cdf[2:] - cdf[0]) / (cdf[1] - cdf[0])
            distance = (u - (torch.arange(n) + 0.5) / n).abs().max()
            # Kolmogorov-Smirnov, level 0.001.
            assert distance < 1.95 / math.sqrt(n), (entries, batch, i)


def test_components_are_drawn_with_their_weights_and_never_with_weight_zero() -> None:
    # Components that cannot be confused: a spike at each integer.
    spikes = torch.stack([torch.arange(6.0), torch.full((6,), -9.0)], dim=1)
    weights = torch.tensor(
        [[0.0, 0.5, 0.0, 0.3, 0.2, 0.0], [0.9, 0.0, 0.0, 0.0, 0.0, 0.1]]
    )
    posterior = gaussian_posterior(
        dim=1,
        n_o=2,
        weights=weights,
        embeddings=spikes,
        prior=problems.standard_normal(1),
    )
    n = 20_000
    samples = posterior.sample_batched((n,), posterior.x_o, **QUIET)
    for i in range(2):
        found = samples[:, i, 0].round().long().bincount(minlength=6) / n
        assert (found[weights[i] == 0] == 0).all()
        se = (weights[i] * (1 - weights[i]) / n).sqrt()
        assert ((found - weights[i]).abs() <= 4 * se).all()


def test_no_random_number_draws_a_component_of_weight_zero(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    spikes = torch.stack([torch.arange(4.0), torch.full((4,), -9.0)], dim=1)
    weights = torch.tensor([[0.0, 0.3, 0.7, 0.0]]).expand(200, -1)
    posterior = gaussian_posterior(
        dim=1,
        n_o=200,
        weights=weights,
        embeddings=spikes,
        prior=problems.standard_normal(1),
    )
    # The ends of what torch.rand returns in double precision.
    for uniform, expected in ((0.0, 1.0), (1 - 2**-53, 2.0)):
        monkeypatch.setattr(
            torch,
            "rand",
            lambda *size, value=uniform, **kwargs: torch.full(size, value, **kwargs),
        )
        samples = posterior.sample_batched((2,), posterior.x_o, **QUIET)
        assert torch.equal(samples.round(), torch.full((2, 200, 1), expected))


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_an_accepted_draw_is_kept_whole(device: str) -> None:
    # Equal coordinates in every draw: a mixture of two draws would show. Most of the
    # mass is outside the prior, so that each slot gets several proposals at a time.
    posterior = gaussian_posterior(dim=2, n_o=4, std=3.0)

    class Diagonal(problems.Gaussians):
        def sample(self, sample_shape: Size, condition: Tensor, **kw: Any) -> Tensor:
            return (
                super()
                .sample(sample_shape, condition)[..., :1]
                .expand(*sample_shape, len(condition), 2)
            )

    posterior.posterior_estimator.parts[0].density = Diagonal(2)
    posterior.to(device)
    samples = posterior.sample_batched((5000,), posterior.x_o, **QUIET)
    assert torch.equal(samples[..., 0], samples[..., 1])


def test_sampling_batches_are_no_larger_than_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    posterior = gaussian_posterior()
    calls = count_draws(posterior, monkeypatch)
    for batch_size in (1, 7, 100_000):
        calls.clear()
        samples = posterior.sample_batched(
            (10,), posterior.x_o, max_sampling_batch_size=batch_size, **QUIET
        )
        assert samples.shape == (10, 5, 2)
        assert max(calls) <= batch_size
        assert len(samples.flatten().unique()) == samples.numel()


def test_samples_stay_inside_the_prior_unless_asked_otherwise() -> None:
    posterior = gaussian_posterior(std=1.0)
    inside = posterior.sample_batched((500,), posterior.x_o, **QUIET)
    assert (inside.abs() <= 1).all()
    free = posterior.sample_batched(
        (500,), posterior.x_o, reject_outside_prior=False, **QUIET
    )
    share = (free.abs() <= 1).all(dim=-1).double().mean(dim=0)
    expected = posterior.weights @ inside_mass(posterior)
    assert ((share - expected).abs() < 4 * (0.25 / 500) ** 0.5).all()


def test_a_posterior_far_outside_the_prior_is_still_sampled() -> None:
    far = torch.tensor([[3.0, 0.0]])  # Z = P(N(3, 1) in [-1, 1]) = 0.023
    posterior = gaussian_posterior(
        dim=1, n_o=1, weights=torch.ones(1, 1), embeddings=far
    )
    samples = posterior.sample((2000,), x=posterior.x_o[0], **QUIET)[:, 0].double()
    normal = Normal(3.0, 1.0)
    low, high = normal.cdf(torch.tensor(-1.0)), normal.cdf(torch.tensor(1.0))
    u = (normal.cdf(samples) - low) / (high - low)
    assert abs(float(u.mean()) - 0.5) < 4 * (1 / 12 / 2000) ** 0.5
    assert abs(float(u.var()) - 1 / 12) < 0.01


def hopeless_posterior(n_o: int = 2) -> MixturePosterior:
    """All mass of the first observation lies far outside the prior."""
    spikes = torch.tensor([[100.0, -3.0], [0.0, -3.0]])
    weights = torch.eye(2)[[0] + [1] * (n_o - 1)]
    return gaussian_posterior(dim=1, n_o=n_o, weights=weights, embeddings=spikes)


def test_sampling_without_mass_inside_the_prior_names_the_observation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sampling_module, "MIN_PROPOSALS", 2000)
    posterior = hopeless_posterior()
    with pytest.raises(SamplingError, match=r"rows \[0\] of `x`.*reject_outside_prior"):
        posterior.sample_batched((3,), posterior.x_o, **QUIET)
    with pytest.raises(SamplingError):
        posterior.sample((1,), x=posterior.x_o[0], **QUIET)
    assert posterior.sample((3,), x=posterior.x_o[1], **QUIET).shape == (3, 1)
    free = posterior.sample(
        (3,), x=posterior.x_o[0], reject_outside_prior=False, **QUIET
    )
    assert (free > 90).all()


def test_little_mass_inside_the_prior_is_sampled_unless_it_takes_too_long() -> None:
    """As one in a stack in which the prior keeps a small share."""
    spikes = torch.tensor([[100.0, -3.0], [0.0, -3.0]])
    weights = torch.tensor([[1 - 4e-4, 4e-4], [0.0, 1.0]])
    posterior = gaussian_posterior(dim=1, n_o=2, weights=weights, embeddings=spikes)
    draws = posterior.sample_batched((300,), posterior.x_o, **QUIET)
    assert draws.abs().max() < 1
    for one in draws.unbind(dim=1):
        assert float(one.std()) == pytest.approx(math.exp(-3), rel=0.2)
    with pytest.raises(SamplingError, match=r"rows \[0\] of `x`.*Leave these"):
        posterior.sample_batched((10_000,), posterior.x_o, **QUIET)


def test_rejection_gives_up_after_a_bounded_number_of_draws(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    posterior = hopeless_posterior()
    components: Any = posterior.posterior_estimator.parts[0].density
    original, drawn = components.sample, [0]

    def sample(sample_shape: Size, condition: Tensor, **kwargs: Any) -> Tensor:
        drawn[0] += len(condition)
        # At a hundred thousand draws a second, which flows rarely reach, minutes.
        assert drawn[0] < 2e7, "more than 20 million draws for 1000 samples"
        return original(sample_shape, condition, **kwargs)

    monkeypatch.setattr(components, "sample", sample)
    with pytest.raises(SamplingError):
        posterior.sample((1000,), x=posterior.x_o[0], **QUIET)


def test_log_prob_without_mass_inside_the_prior_raises_unless_not_normalised() -> None:
    posterior = hopeless_posterior()
    theta = torch.zeros(1, 1)
    with pytest.raises(SamplingError, match="no mass inside"):
        posterior.log_prob(theta, x=posterior.x_o[0])
    value = posterior.log_prob(theta, x=posterior.x_o[0], norm_posterior=False)
    assert value < -1e5


# --- prior support and leakage ---


def test_the_mass_inside_the_prior_is_that_of_the_components() -> None:
    # With identity weights the mass of observation j is that of component j.
    n = 200
    posterior = gaussian_posterior(
        n_o=n, weights=torch.eye(n), embeddings=problems.embeddings_of(2, n, std=0.5)
    )
    leakage, truth = posterior.leakage(posterior.x_o), inside_mass(posterior)
    error = (truth * (1 - truth) / truncation_module.LEAKAGE_DRAWS).sqrt()
    z = (leakage.mass - truth) / error
    assert z.abs().max() < 4.5
    assert 0.8 < z.std() < 1.2
    assert abs(float(z.mean())) < 4 / n**0.5
    assert torch.allclose(leakage.standard_error, error, rtol=0.5)


def test_the_mass_of_a_mixture_and_its_error_follow_the_weights() -> None:
    posterior = gaussian_posterior(std=0.6, n_o=10, n_s=30)
    leakage, z_j = posterior.leakage(posterior.x_o), inside_mass(posterior)
    truth = posterior.weights @ z_j
    variance = posterior.weights.square() @ (z_j * (1 - z_j))
    error = (variance / truncation_module.LEAKAGE_DRAWS).sqrt()
    assert truth.min() < 0.9
    assert ((leakage.mass - truth).abs() < 4 * error).all()
    assert torch.allclose(leakage.standard_error, error, rtol=0.1)


def test_the_mass_inside_the_prior_of_flows_is_that_of_their_density() -> None:
    posterior = flow_posterior(n_o=4)
    axis = (torch.arange(60) + 0.5) / 30 - 1
    grid = torch.cartesian_prod(axis, axis)[:, None].expand(-1, 4, -1)
    integral = log_prob_batched(posterior, grid).exp().sum(dim=0) / 30**2
    leakage = posterior.leakage(posterior.x_o)
    assert ((leakage.mass - integral).abs() < 4 * leakage.standard_error + 5e-3).all()


def test_an_unbounded_prior_has_mass_one_without_draws(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    normal = Normal(torch.zeros(2), torch.ones(2))
    for prior in (problems.standard_normal(2), Independent(normal, 1)):
        posterior = gaussian_posterior(prior=prior)
        calls = count_draws(posterior, monkeypatch)
        leakage = posterior.leakage(posterior.x_o)
        assert torch.allclose(leakage.mass, torch.ones(5).double(), atol=1e-14)
        assert torch.equal(leakage.standard_error, torch.zeros(5).double())
        assert calls == []


def test_the_mass_of_an_observation_is_kept_until_another_is_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    posterior = average([problems.npe_posterior("maf")])
    first, second = problems.simulate(posterior.prior.sample((2,)))
    theta = posterior.sample((5,), x=first, show_progress_bars=False)
    expected = posterior.log_prob(theta, x=first)
    calls = count_draws(posterior, monkeypatch)
    assert torch.equal(posterior.log_prob(theta, x=first), expected)
    assert not calls
    posterior.leakage(first).mass.mul_(0.5)  # what is returned belongs to the caller
    assert torch.equal(posterior.log_prob(theta, x=first), expected)
    posterior.log_prob(theta, x=second)
    assert calls
    assert torch.equal(posterior.log_prob(theta, x=first), expected)


class WithoutSupport(Distribution):
    """A user's prior that says only through its density where it ends."""

    arg_constraints = {}  # noqa: RUF012

    def __init__(self) -> None:
        super().__init__(Size(), Size((2,)), validate_args=False)
        self.box = problems.box(2)

    def sample(self, sample_shape: Size = Size()) -> Tensor:  # noqa: B008
        return self.box.sample(sample_shape)

    def log_prob(self, value: Tensor) -> Tensor:
        inside = (value.abs() <= 1).all(dim=-1)
        return torch.where(inside, -math.log(4.0), -torch.inf)


@pytest.mark.parametrize(
    ("prior", "inside"),
    [
        pytest.param(
            MultipleIndependent(
                [problems.box(1), Normal(torch.zeros(1), torch.ones(1))]
            ),
            lambda theta: theta[..., 0].abs() <= 1,
            id="half bounded",
        ),
        pytest.param(
            Independent(Gamma(torch.ones(2), torch.ones(2)), 1),
            lambda theta: (theta >= 0).all(dim=-1),
            id="half line",
        ),
        pytest.param(
            WithoutSupport(),
            lambda theta: (theta.abs() <= 1).all(dim=-1),
            id="no support property",
        ),
    ],
)
def test_support_of_any_shape_bounds_samples_density_and_mass(
    prior: Distribution, inside: Callable[[Tensor], Tensor]
) -> None:
    posterior = gaussian_posterior(prior=prior, std=0.8)
    samples = posterior.sample_batched((200,), posterior.x_o, **QUIET)
    assert inside(samples).all()
    free = posterior.sample_batched(
        (8000,), posterior.x_o, reject_outside_prior=False, **QUIET
    )
    log_prob = posterior.log_prob_batched(free[:50], posterior.x_o)
    assert torch.equal(torch.isfinite(log_prob), inside(free[:50]))
    share = inside(free).double().mean(dim=0)
    leakage = posterior.leakage(posterior.x_o)
    error = (leakage.standard_error.square() + 0.25 / 8000).sqrt()
    assert ((leakage.mass - share).abs() < 4 * error).all()


def test_the_mass_of_components_is_estimated_once_for_all_views(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    posterior = gaussian_posterior()
    calls = count_draws(posterior, monkeypatch)
    view, theta = posterior[1], torch.zeros(1, 2)
    view.log_prob(theta)
    assert sum(calls) == 12 * truncation_module.LEAKAGE_DRAWS
    for _ in range(2):
        posterior.log_prob_batched(theta, posterior.x_o)
        posterior[3].log_prob(theta)
        posterior.leakage(posterior.x_o)
    assert sum(calls) == 12 * truncation_module.LEAKAGE_DRAWS


def test_log_prob_always_returns_the_same_and_keeps_the_random_state() -> None:
    posterior = gaussian_posterior(std=0.8)
    again = copy.deepcopy(posterior)
    theta = 2 * torch.rand(3, 5, 2) - 1
    torch_state, numpy_state = torch.get_rng_state(), np.random.get_state()  # noqa: NPY002
    first = posterior.log_prob_batched(theta, posterior.x_o)
    assert torch.equal(torch.get_rng_state(), torch_state)
    assert all(
        np.array_equal(a, b)
        for a, b in zip(np.random.get_state(), numpy_state, strict=True)  # noqa: NPY002
    )
    torch.rand(17)
    assert torch.equal(again.log_prob_batched(theta, posterior.x_o), first)


def test_samples_follow_the_seed_of_torch() -> None:
    posterior = gaussian_posterior(std=0.8)
    draws = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        draws.append(posterior.sample_batched((4,), posterior.x_o, **QUIET))
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])


# --- from x to its row ---


def test_an_observation_is_found_by_its_value() -> None:
    x_o = torch.randn(6, 3)
    x_o[4] = x_o[1]
    x_o[2, 0] = 0.0
    posterior = gaussian_posterior(x_o=x_o)
    rows = posterior.weights

    def found(x: Tensor) -> Tensor:
        return problems.rows_of(posterior, x)

    assert torch.equal(found(x_o)[[0, 1, 2, 3, 5]], rows[[0, 1, 2, 3, 5]])
    assert torch.equal(found(x_o[[5, 0, 0]]), rows[[5, 0, 0]])
    assert torch.equal(found(x_o[4:5]), found(x_o[1:2]))
    negative_zero = x_o[2:3].clone()
    negative_zero[0, 0] = -0.0
    assert torch.equal(found(negative_zero), rows[2:3])


def test_double_precision_and_numpy_observations_are_recognised() -> None:
    posterior = gaussian_posterior()
    theta, x = torch.zeros(2, 2), posterior.x_o[3]
    expected = posterior.log_prob(theta, x=x)
    for same in (x.double(), x.numpy(), x.double().numpy(), x[None], x.tolist()):
        assert torch.equal(posterior.log_prob(theta, x=same), expected)
        assert posterior.sample((2,), x=same, **QUIET).shape == (2, 2)
    batch = posterior.x_o.double()
    assert torch.equal(
        posterior.log_prob_batched(torch.zeros(5, 2), batch)[0, 3], expected[0]
    )
    assert posterior.sample_batched((2,), batch.numpy(), **QUIET).shape == (2, 5, 2)


def test_an_unseen_observation_is_an_error_that_says_what_to_do() -> None:
    posterior = gaussian_posterior()
    new = torch.randn(1, 3)
    for call in (
        lambda: posterior.sample((2,), x=new, **QUIET),
        lambda: posterior.log_prob(torch.zeros(1, 2), x=new),
        lambda: posterior.sample_batched(
            (2,), torch.cat([posterior.x_o, new]), **QUIET
        ),
        lambda: posterior.log_prob_batched(torch.zeros(1, 2), new),
        lambda: posterior.leakage(new),
        lambda: posterior.potential(torch.zeros(1, 2), x=new),
    ):
        with pytest.raises(InvalidInputError, match=r"rope.build_posterior\(x\)"):
            call()


def test_an_unseen_observation_may_extend_the_coupling_with_a_warning() -> None:
    posterior = gaussian_posterior(unseen="extend")
    net = posterior.posterior_estimator.coupled[0].net
    new = torch.randn(2, 3)
    expected = posterior.coupling.rows(embed(net, new))
    smallest = float((1 / expected.square().sum(dim=1)).min())
    mixed = torch.cat([new[:1], posterior.x_o[2:3], new[1:]])
    with pytest.warns(RoPEWarning, match=rf"2 unseen.*size is {smallest:.1f} of 12"):
        rows = problems.rows_of(posterior, mixed)
    assert torch.allclose(rows[[0, 2]], expected, atol=1e-12)
    assert torch.equal(rows[1], posterior.weights[2])

    with pytest.warns(RoPEWarning):
        log_prob = posterior.log_prob(torch.zeros(1, 2), x=new[0], norm_posterior=False)
    extended = gaussian_posterior(
        n_o=2, weights=expected, embeddings=problems.simulated_of(posterior), x_o=new
    )
    assert torch.allclose(
        log_prob,
        extended.log_prob(torch.zeros(1, 2), x=new[0], norm_posterior=False),
        atol=1e-6,
    )


def test_each_call_that_extends_warns_once_at_the_line_of_the_caller() -> None:
    posterior = gaussian_posterior(unseen="extend")
    for call in (
        lambda: posterior.sample_batched((2,), torch.randn(1, 3), **QUIET),
        lambda: posterior.log_prob(torch.zeros(1, 2), x=torch.randn(3)),
        lambda: posterior.log_prob_batched(
            torch.zeros(1, 2), torch.randn(1, 3), norm_posterior=False
        ),
    ):
        with pytest.warns(RoPEWarning) as caught:
            call()
        assert [warning.filename for warning in caught] == [__file__]


def test_normalising_subtracts_the_log_of_the_mass() -> None:
    posterior = gaussian_posterior(std=0.8)
    theta = 2 * torch.rand(3, 5, 2) - 1
    difference = log_prob_batched(posterior, theta) - posterior.log_prob_batched(
        theta, posterior.x_o
    )
    log_mass = posterior.leakage(posterior.x_o).mass.log().float()
    assert log_mass.max() < -0.05
    assert torch.allclose(difference, log_mass.expand(3, -1), atol=1e-5)
    one = posterior.log_prob(theta[:, 2], x=posterior.x_o[2])
    one_free = posterior.log_prob(theta[:, 2], posterior.x_o[2], norm_posterior=False)
    assert torch.allclose(one_free - one, log_mass[2].expand(3), atol=1e-5)


def test_log_prob_is_minus_infinity_only_outside_the_prior() -> None:
    posterior = gaussian_posterior(std=0.8)
    theta = 3 * torch.rand(50, 5, 2) - 1.5
    inside = (theta.abs() <= 1).all(dim=-1)
    for norm in (True, False):
        log_prob = posterior.log_prob_batched(theta, posterior.x_o, norm_posterior=norm)
        assert torch.equal(torch.isfinite(log_prob), inside)
        assert (log_prob[~inside] == -torch.inf).all()
