"""The density of a stack and its draws, against a stack in closed form."""

import copy
import math
import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from sbi.diagnostics import run_sbc
from torch import Tensor, nn
from torch.distributions import Normal

from sbi_rope.errors import (
    RoPEError,
    RoPEWarning,
    UnseenObservationError,
)
from sbi_rope.mixture import (
    CoupledContexts,
    CoupledNet,
    Part,
    chunks,
    part_of,
    part_of_prior,
)
from sbi_rope.stacking import (
    CouplingCandidate,
    StackedPosterior,
    default_candidates,
)
from sbi_rope.stacking.estimator import StackedEstimator
from tests import gaussian, problems

# Batches and calibration sets are small here on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning")

QUIET: dict[str, Any] = {"show_progress_bars": False}


@dataclass
class Analytic:
    """Two couplings of Gaussians, a Gaussian given x, and the box, stacked."""

    posterior: StackedPosterior
    tables: tuple[Tensor, Tensor]
    weights: Tensor

    def densities(
        self,
        theta: Tensor,
        *,
        x: Tensor | None = None,
        tables: Sequence[Tensor] | None = None,
    ) -> Tensor:
        """Of each candidate at theta ``(S, B, d)``, shape ``(S, B, 4)``, float64.

        Of the batch, or of other x with their rows of both couplings.
        """
        estimator = self.posterior.posterior_estimator
        x = self.posterior.x_o if x is None else x
        theta = theta.double()
        mean, log_std = estimator.coupled[0].simulated.double().chunk(2, dim=1)
        of_component = Normal(mean, log_std.exp()).log_prob(theta[:, :, None]).sum(-1)
        mixed = [
            torch.einsum("bj,sbj->sb", table.double(), of_component.exp())
            for table in tables or self.tables
        ]
        center = gaussian.GAIN * x.double()
        given_x = Normal(center, gaussian.POSTERIOR_STD).log_prob(theta).sum(-1).exp()
        inside = (theta.abs() <= 1).all(dim=-1).double()
        return torch.stack([*mixed, given_x, inside / 2 ** theta.shape[-1]], dim=-1)

    def density(self, theta: Tensor) -> Tensor:
        """Of the stack, without a bound, ``(S, B)``."""
        return self.densities(theta) @ self.weights

    def mass(self) -> Tensor:
        """Inside the box, ``(B,)``."""
        estimator = self.posterior.posterior_estimator
        mean, log_std = estimator.coupled[0].simulated.double().chunk(2, dim=1)
        of_component = _inside_box(mean, log_std.exp())
        center = gaussian.GAIN * self.posterior.x_o.double()
        given_x = _inside_box(center, torch.tensor(gaussian.POSTERIOR_STD).double())
        masses = [table.double() @ of_component for table in self.tables]
        return torch.stack([*masses, given_x, torch.ones_like(given_x)], -1) @ (
            self.weights
        )


def _inside_box(mean: Tensor, std: Tensor) -> Tensor:
    law, one = Normal(mean, std), torch.ones_like(mean)
    return (law.cdf(one) - law.cdf(-one)).prod(dim=-1)


def analytic(
    *,
    dim: int = 1,
    n_o: int = 5,
    n_s: int = 12,
    weights: Sequence[float] = (0.2, 0.1, 0.4, 0.3),
    spread: float = 1.5,
    unseen: Any = "raise",
) -> Analytic:
    """A stack whose couplings and Gaussian given x leak out of the box, differently."""
    contexts = problems.contexts_of(dim, n_s)
    x_o = spread * torch.randn(n_o, dim)
    tables = tuple((2 * torch.randn(n_o, n_s)).double().softmax(dim=1) for _ in "ab")
    couplings = tuple(problems.coupling_of(table, contexts) for table in tables)
    width = couplings[0].real.shape[1]
    nets = [CoupledNet(nn.Linear(dim, width), [c], [0.5]) for c in couplings]
    prior = problems.box(dim)
    estimator = StackedEstimator(
        Part(
            problems.Gaussians(dim),
            CoupledContexts(contexts, x_o, nets, unseen=unseen),
        ),
        [part_of(gaussian.GaussianEstimator(dim)), part_of_prior(prior, (dim,))],
        torch.full((4,), 0.25, dtype=torch.double),
        tail_mass=0.0,
    )
    of_all = torch.tensor(weights, dtype=torch.double)
    posterior = StackedPosterior(
        estimator.with_weights(of_all),
        prior,
        weights=dict(zip("abcd", weights, strict=True)),
    )
    return Analytic(posterior, (tables[0], tables[1]), of_all)


def midpoints(count: int) -> Tensor:
    """The middles of equal cells of [-1, 1]."""
    return (torch.arange(count) + 0.5) * 2 / count - 1


def test_the_density_is_the_weighted_sum_of_the_candidates() -> None:
    known = analytic(dim=2)
    posterior = known.posterior
    theta = 2 * torch.rand(30, 5, 2) - 1
    expected = known.density(theta).log().float()
    options: dict[str, Any] = {"norm_posterior": False}
    batched = posterior.log_prob_batched(theta, posterior.x_o, **options)
    assert torch.allclose(batched, expected, atol=1e-5)
    first = posterior.log_prob_batched(theta[0], posterior.x_o, **options)
    assert torch.allclose(first, expected[:1], atol=1e-5)
    for i, x in enumerate(posterior.x_o):
        single = posterior.log_prob(theta[:, i], x=x, **options)
        assert torch.allclose(single, expected[:, i], atol=1e-5)


def test_the_log_probs_of_candidates_are_those_of_each_by_itself() -> None:
    known = analytic(dim=2)
    theta = 3 * torch.rand(5, 2) - 1.5
    estimator: Any = known.posterior.posterior_estimator
    found = estimator.candidate_log_probs(theta, known.posterior.x_o)
    expected = known.densities(theta[None])[0].log()
    assert found.dtype is torch.float64
    assert found.shape == (5, 4)
    assert torch.allclose(found, expected, atol=1e-5)
    # Rows in another order, and components that are known already.
    order = torch.tensor([3, 1, 4])
    log_q = estimator.component_log_probs(theta)
    some = estimator.candidate_log_probs(
        theta[order], known.posterior.x_o[order], log_q=log_q[order]
    )
    assert torch.allclose(some, expected[order], atol=1e-5)


@pytest.mark.parametrize("dim", [1, 2])
def test_the_normalised_density_integrates_to_one_although_candidates_leak(
    dim: int,
) -> None:
    known = analytic(dim=dim)
    posterior = known.posterior
    line = midpoints(2000 if dim == 1 else 100)
    theta = torch.cartesian_prod(*[line] * dim).reshape(-1, 1, dim).expand(-1, 5, -1)
    density = posterior.log_prob_batched(theta, posterior.x_o).double().exp()
    integral = density.mean(dim=0) * 2**dim
    leakage = posterior.leakage(posterior.x_o)
    error = leakage.standard_error / leakage.mass
    assert (leakage.mass < 0.9).any()
    assert (error < 0.03).all()
    assert ((integral - 1).abs() < 4 * error + 1e-3).all()


def test_the_mass_inside_the_prior_is_that_of_all_candidates() -> None:
    known = analytic(dim=2, n_o=8)
    leakage = known.posterior.leakage(known.posterior.x_o)
    wrong = (leakage.mass - known.mass()).abs()
    assert (wrong < 4 * leakage.standard_error).all()
    assert known.mass().max() - known.mass().min() > 0.1


def test_the_density_of_an_observation_does_not_depend_on_what_is_asked_beside() -> (
    None
):
    known = analytic(dim=2, n_o=8)
    posterior = known.posterior
    theta = 2 * torch.rand(6, 8, 2) - 1
    batched = posterior.log_prob_batched(theta, posterior.x_o)
    for i, x in enumerate(posterior.x_o):
        single = posterior.log_prob(theta[:, i], x=x)
        assert torch.allclose(single, batched[:, i], atol=1e-5)
    back = posterior.log_prob_batched(theta.flip(1), posterior.x_o.flip(0)).flip(1)
    assert torch.allclose(back, batched, atol=1e-5)


@pytest.mark.parametrize("alone", range(4))
def test_a_candidate_with_all_the_weight_is_the_stack(alone: int) -> None:
    weights = [float(k == alone) for k in range(4)]
    known = analytic(weights=weights, spread=0.5)
    posterior = known.posterior
    theta = midpoints(50)[:, None, None].expand(-1, 5, 1)
    expected = known.densities(theta)[..., alone] / known.mass()
    found = posterior.log_prob_batched(theta, posterior.x_o).double().exp()
    assert torch.allclose(found, expected, rtol=0.1)
    samples = posterior.sample_batched((2000,), posterior.x_o, **QUIET)
    grid = midpoints(500).double()[:, None]
    expected = known.densities(grid[..., None].expand(-1, 5, 1))[..., alone]
    mean = (grid * expected).sum(dim=0) / expected.sum(dim=0)
    assert torch.allclose(samples.mean(dim=0)[:, 0].double(), mean, atol=0.06)


@pytest.mark.parametrize(("entries", "draws"), [(2**19, 20_000), (30, 2000)])
def test_samples_follow_the_density_of_their_observation(
    entries: int, draws: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = analytic()
    posterior = known.posterior
    # At 30 entries two observations make a block.
    monkeypatch.setattr(chunks, "MAX_ENTRIES", entries)
    samples = posterior.sample_batched((draws,), posterior.x_o, **QUIET)[..., 0]
    assert (samples.abs() <= 1).all()
    theta = midpoints(1600)[:, None, None].expand(-1, 5, 1)
    expected = known.density(theta).reshape(16, 100, 5).sum(dim=1)
    expected = expected / expected.sum(dim=0)
    for i in range(5):
        counts = samples[:, i].histc(16, -1, 1).double() / draws
        error = (expected[:, i] * (1 - expected[:, i]) / draws).sqrt()
        assert ((counts - expected[:, i]).abs() < 4.5 * error + 1 / draws).all()


def test_samples_without_rejection_follow_the_density_without_a_bound() -> None:
    known = analytic()
    posterior = known.posterior
    draws = 5000
    samples = posterior.sample_batched(
        (draws,), posterior.x_o, reject_outside_prior=False, **QUIET
    )
    inside = (samples.abs() <= 1).all(dim=-1).double().mean(dim=0)
    mass = known.mass()
    error = (mass * (1 - mass) / draws).sqrt()
    assert ((inside - mass).abs() < 4.5 * error).all()


def test_chunking_changes_no_density(monkeypatch: pytest.MonkeyPatch) -> None:
    known = analytic(dim=2)
    posterior = known.posterior
    theta = 2 * torch.rand(6, 5, 2) - 1
    whole = posterior.log_prob_batched(theta, posterior.x_o, norm_posterior=False)
    estimator: Any = posterior.posterior_estimator
    scores = estimator.candidate_log_probs(theta[0], posterior.x_o)
    monkeypatch.setattr(chunks, "MAX_ENTRIES", 13)
    monkeypatch.setattr(chunks, "CPU_BATCH", 7)
    cut = posterior.log_prob_batched(theta, posterior.x_o, norm_posterior=False)
    assert torch.allclose(cut, whole, atol=1e-6)
    again = estimator.candidate_log_probs(theta[0], posterior.x_o)
    assert torch.allclose(again, scores, atol=1e-6)


def test_a_seed_reproduces_samples() -> None:
    posterior = analytic(dim=2).posterior
    draws = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        draws.append(posterior.sample_batched((20,), posterior.x_o, **QUIET))
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])


@pytest.mark.parametrize("sample_shape", [(), (1,), (4,), (2, 3)])
def test_samples_have_the_shapes_of_sbi(sample_shape: tuple[int, ...]) -> None:
    posterior = analytic(dim=2).posterior
    batched = posterior.sample_batched(sample_shape, posterior.x_o, **QUIET)
    assert batched.shape == (*sample_shape, 5, 2)
    single = posterior.sample(sample_shape, x=posterior.x_o[1], **QUIET)
    assert single.shape == (*sample_shape, 2)
    assert batched.dtype is single.dtype is torch.float32


def test_it_is_a_sequence_of_the_posteriors_of_its_batch() -> None:
    posterior = analytic(dim=2).posterior
    assert len(posterior) == 5
    theta = 2 * torch.rand(7, 2) - 1
    for i, view in enumerate(posterior):
        expected = posterior.log_prob(theta, x=posterior.x_o[i])
        assert torch.allclose(view.log_prob(theta), expected)
        assert torch.allclose(posterior[i].log_prob(theta), expected)
    assert posterior[-1].sample((3,), **QUIET).shape == (3, 2)
    with pytest.raises(IndexError):
        posterior[5]


def test_rows_of_the_merged_coupling_sum_to_one() -> None:
    known = analytic()
    rows = known.posterior.weights
    expected = (2 * known.tables[0] + known.tables[1]) / 3
    assert torch.allclose(rows, expected)


@pytest.mark.parametrize(
    "copied",
    [
        pytest.param(lambda p: pickle.loads(pickle.dumps(p)), id="pickle"),
        pytest.param(copy.deepcopy, id="deepcopy"),
        pytest.param(copy.copy, id="copy"),
    ],
)
def test_a_copy_answers_the_same(copied: Callable[[Any], StackedPosterior]) -> None:
    posterior = analytic(dim=2).posterior
    theta = 2 * torch.rand(3, 5, 2) - 1
    expected = posterior.log_prob_batched(theta, posterior.x_o)
    other = copied(posterior)
    assert torch.equal(other.log_prob_batched(theta, posterior.x_o), expected)
    assert other.candidate_weights == posterior.candidate_weights
    assert str(other) == str(posterior)


@pytest.mark.gpu
def test_moving_to_a_gpu_and_back_changes_nothing() -> None:
    posterior = analytic(dim=2).posterior
    theta = 2 * torch.rand(3, 5, 2) - 1
    expected = posterior.log_prob_batched(theta, posterior.x_o, norm_posterior=False)
    posterior.to("cuda")
    x_o = posterior.x_o
    assert x_o.device.type == "cuda"
    moved = posterior.log_prob_batched(theta.cuda(), x_o, norm_posterior=False)
    assert torch.allclose(moved.cpu(), expected, atol=1e-4)
    assert posterior.sample_batched((4,), x_o, **QUIET).device.type == "cuda"
    posterior.to("cpu")
    back = posterior.log_prob_batched(theta, posterior.x_o, norm_posterior=False)
    assert torch.equal(back, expected)


def test_the_maximum_of_the_density_is_inside_the_prior() -> None:
    view = analytic(dim=2).posterior[0]
    best = view.map(num_iter=40, num_init_samples=50, **QUIET)
    assert best.shape == (1, 2)
    assert (best.abs() <= 1).all()
    samples = view.sample((200,), **QUIET)
    assert view.log_prob(best) >= view.log_prob(samples).max() - 0.01


def test_gradients_reach_theta() -> None:
    known = analytic(dim=2)
    theta = (0.5 * torch.rand(1, 5, 2)).requires_grad_()
    log_prob = known.posterior.log_prob_batched(
        theta, known.posterior.x_o, norm_posterior=False, track_gradients=True
    )
    (gradient,) = torch.autograd.grad(log_prob.sum(), theta)
    step = 1e-4
    for axis in range(2):
        away = torch.zeros(2).double()
        away[axis] = step
        up, down = (
            known.density(theta.detach().double() + sign * away).log().sum(dim=0)
            for sign in (1, -1)
        )
        expected = (up - down) / (2 * step)
        assert torch.allclose(gradient[0, :, axis].double(), expected, atol=1e-2)


def test_sbc_and_expected_coverage_find_its_own_draws_calibrated() -> None:
    posterior = analytic(n_o=80, n_s=30).posterior
    theta = posterior.sample_batched((), posterior.x_o, **QUIET)
    for reduce_fns in ("marginals", posterior.log_prob):
        ranks, _ = run_sbc(
            theta,
            posterior.x_o,
            posterior,
            reduce_fns=reduce_fns,
            num_posterior_samples=100,
            show_progress_bar=False,
        )
        levels = ranks[:, 0].double() / 100
        # Uniform, with four standard errors on mean and spread.
        assert abs(float(levels.mean()) - 0.5) < 4 / (12 * 80) ** 0.5
        assert 0.2 < float(levels.std()) < 0.38


def test_an_observation_outside_the_batch_is_refused_or_extended_to() -> None:
    x = torch.randn(3, 2)
    theta = 2 * torch.rand(3, 2) - 1
    closed = analytic(dim=2).posterior
    for call in (
        lambda: closed.log_prob_batched(theta, x),
        lambda: closed.sample_batched((2,), x, **QUIET),
        lambda: closed.leakage(x),
    ):
        with pytest.raises(UnseenObservationError, match="not in the batch"):
            call()
    known = analytic(dim=2, unseen="extend")
    posterior = known.posterior
    with pytest.warns(RoPEWarning, match="Extended the coupling"):
        found = posterior.log_prob_batched(theta, x, norm_posterior=False)
    estimator: Any = posterior.posterior_estimator
    tables = [
        net.couplings[0].rows(net.net(x).detach().double())
        for net in estimator.coupled[0].nets
    ]
    densities = known.densities(theta[None], x=x, tables=tables)
    expected = (densities @ known.weights).log().float()
    assert torch.allclose(found, expected, atol=1e-4)
    samples = posterior.sample_batched((50,), x, **QUIET)
    assert samples.shape == (50, 3, 2)
    assert (samples.abs() <= 1).all()


# --- candidates ---


def test_the_default_is_three_grids_the_prior_and_three_kinds_of_npe() -> None:
    candidates = default_candidates()
    couplings = [c for c in candidates if isinstance(c, CouplingCandidate)]
    assert len(couplings) == 36
    assert {c.name for c in candidates} - {c.name for c in couplings} == {
        "prior",
        "NPE",
        "tuning-only",
        "fine-tuned NPE",
    }
    small = default_candidates(gammas=(0.1,), taus=(1.0, 0.5))
    assert [c.name for c in small[:6]] == [
        "RoPE (gamma 0.1, tau 1)",
        "RoPE (gamma 0.1, tau 0.5)",
        "RoPE (gamma 0.1, tau 1, rehearsal 1)",
        "RoPE (gamma 0.1, tau 0.5, rehearsal 1)",
        "OT-only (gamma 0.1, tau 1)",
        "OT-only (gamma 0.1, tau 0.5)",
    ]
    without = default_candidates(gammas=(0.1,), taus=(1.0, 0.5), rehearsal=None)
    assert [c.name for c in without] == [c.name for c in (*small[:2], *small[4:])]


@pytest.mark.parametrize(
    "options",
    [
        {"gamma": 0.0, "tau": 1.0},
        {"gamma": math.nan, "tau": 1.0},
        {"gamma": 0.1, "tau": 1.1},
        {"gamma": 0.1, "tau": -0.1},
        {"gamma": 0.1, "tau": 1.0, "rehearsal": -1.0},
        {"gamma": 0.1, "tau": 1.0, "rehearsal": 1.0, "tuned": False},
        {"gamma": 0.1, "tau": 1.0, "tuned": "yes"},
        {"gamma": 0.1, "tau": 1.0, "cost_scale": "real"},
    ],
)
def test_settings_outside_their_range_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(RoPEError):
        CouplingCandidate(**options)
