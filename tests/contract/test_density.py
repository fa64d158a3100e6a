"""What holds for every kind of density, and each kind against brute force."""

import copy
import math
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Size, Tensor, nn

from sbi_rope import MixturePosterior, load
from sbi_rope.density import (
    Coupled,
    Density,
    Flow,
    GaussianProcess,
    Mixture,
    Prior,
    base,
)
from sbi_rope.density import posterior as posterior_module
from sbi_rope.npe.sbi import embedding_of, estimator_of, headless
from sbi_rope.saving import save
from sbi_rope.utils.errors import InvalidInputError, RoPEWarning, SamplingError
from tests import problems

QUIET: dict[str, Any] = {"show_progress_bars": False}
FAMILIES = ["mdn", "maf", "nsf", "zuko_nsf"]


def npe(family: str = "nsf") -> Any:
    return estimator_of(problems.npe_posterior(family, dim=1))


def moved(network: Any, seed: int, scale: float = 0.05) -> Any:
    """A copy with other weights."""
    other = copy.deepcopy(network)
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(seed)
        for weight in other.parameters():
            weight.add_(scale * torch.randn_like(weight))
    return other


def several(family: str) -> Flow:
    return Flow.of([npe(family), moved(npe(family), 1), moved(npe(family), 2)])


def with_nets(family: str) -> Flow:
    h = embedding_of(npe(family))
    return Flow.of([npe(family)], nets=[h, moved(h, 1), moved(h, 2)])


def batch() -> Tensor:
    with torch.random.fork_rng():
        torch.manual_seed(3)
        return problems.simulate(problems.box(1).sample((4,))) + 0.2


def coupled(family: str | None = None, tail_mass: float = 1e-3) -> Coupled:
    """Four observations and nine simulations."""
    with torch.random.fork_rng():
        torch.manual_seed(4)
        weights = (2 * torch.randn(4, 9)).double().softmax(dim=1)
        if family is None:
            density: Any = problems.Gaussians(1)
            simulated = problems.embeddings_of(1, 9)
        else:
            density = headless(copy.deepcopy(npe(family)))
            h = embedding_of(npe(family))
            simulated = h(problems.simulate(problems.box(1).sample((9,)))).detach()
        coupling = problems.coupling_of(weights, simulated)
    found = Coupled(density, batch(), coupling)
    found.tail_mass = tail_mass
    return found


def process() -> GaussianProcess:
    with torch.random.fork_rng():
        torch.manual_seed(5)
        theta = problems.box(1).sample((20,))
        x, one = problems.simulate(theta) + 0.2, torch.ones(20)
        return GaussianProcess(theta, x, weights=one, groups=torch.arange(20))


def mixture(*weights: float) -> Mixture:
    parts = [Prior(problems.box(1), (3,)), several("nsf"), coupled(tail_mass=0.0)]
    return Mixture(parts, weights or (0.2, 0.5, 0.3))


CASES: dict[str, Callable[[], Density]] = {
    "prior": lambda: Prior(problems.box(1), (3,)),
    "process": process,
    **{f"one {name}": lambda name=name: Flow.of([npe(name)]) for name in FAMILIES},
    **{f"several {name}": lambda name=name: several(name) for name in FAMILIES},
    **{f"nets of {name}": lambda name=name: with_nets(name) for name in FAMILIES},
    "coupled": coupled,
    **{f"coupled {name}": lambda name=name: coupled(name) for name in FAMILIES},
    "mixture": mixture,
    "mixture of mixtures": lambda: Mixture([mixture(), several("maf")], [0.5, 0.5]),
}
every_kind = pytest.mark.parametrize("make", CASES.values(), ids=CASES)


def posterior_of(density: Density) -> MixturePosterior:
    return MixturePosterior(density, problems.box(1))


# --- every kind ---


@every_kind
def test_it_integrates_to_one_and_samples_follow_it(
    make: Callable[[], Density],
) -> None:
    posterior, x = posterior_of(make()), batch()
    edges = torch.linspace(-1, 1, 401)
    theta = (edges[1:] + edges[:-1])[:, None, None] / 2
    density = posterior.log_prob_batched(theta.expand(-1, 4, -1), x).double().exp()
    shares = density.reshape(8, 50, 4).sum(dim=1) / 200
    error = problems.error_of_mass(posterior.leakage_correction(x))
    assert ((shares.sum(dim=0) - 1).abs() < 4.5 * error + 0.01).all()
    n = 3000
    draws = posterior.sample_batched((n,), x, **QUIET)[..., 0]
    bins = ((draws + 1) * 4).long().clamp(0, 7)
    found = nn.functional.one_hot(bins, 8).double().mean(dim=0).T
    shares = shares / shares.sum(dim=0)
    deviation = (shares * (1 - shares) / n).sqrt()
    assert ((found - shares).abs() < 4.5 * deviation + 0.005).all()


@every_kind
def test_a_row_does_not_depend_on_its_batch_or_on_how_it_is_cut(
    make: Callable[[], Density], monkeypatch: pytest.MonkeyPatch
) -> None:
    density, x = make(), batch()
    theta = 1.8 * torch.rand(5, 4, 1) - 0.9
    expected = density.log_prob(theta, x)
    assert expected.shape == (5, 4)
    for i in range(4):
        alone = density.log_prob(theta[:, i : i + 1], x[i : i + 1])
        assert torch.allclose(alone[:, 0], expected[:, i], atol=1e-4)
    # One observation serves all theta, and one theta all observations.
    many = density.log_prob(theta[:, :1].expand(-1, 4, -1), x[:1])
    assert torch.allclose(many, expected[:, :1].expand(-1, 4), atol=1e-4)
    for entries, pairs in ((1, 1), (20, 7)):
        for module in (base, posterior_module):
            monkeypatch.setattr(module, "MAX_ENTRIES", entries)
        monkeypatch.setattr(base, "CPU_BATCH", pairs)
        assert torch.allclose(density.log_prob(theta, x), expected, atol=1e-4)
        draws = posterior_of(density).sample_batched((3,), x, **QUIET)
        assert draws.shape == (3, 4, 1)
        assert len(draws.flatten().unique()) == draws.numel()


@every_kind
def test_copies_and_files_answer_the_same(
    make: Callable[[], Density], tmp_path: Path
) -> None:
    posterior, x = posterior_of(make()), batch()
    theta = 1.8 * torch.rand(5, 4, 1) - 0.9
    expected = posterior.log_prob_batched(theta, x)
    torch.manual_seed(1)
    draws = posterior.sample_batched((6,), x, **QUIET)
    save(posterior, tmp_path / "posterior.pt")
    trusted = (problems.Gaussians, problems.TableCoupling)
    there = copy.deepcopy(posterior)
    there.to("cpu")
    for other in (
        copy.deepcopy(posterior),
        pickle.loads(pickle.dumps(posterior)),
        load(tmp_path / "posterior.pt", trusted=trusted),
        there,
    ):
        assert torch.equal(other.log_prob_batched(theta, x), expected)
        torch.manual_seed(1)
        assert torch.equal(other.sample_batched((6,), x, **QUIET), draws)


@pytest.mark.gpu
@every_kind
def test_it_moves_to_a_gpu_and_back(make: Callable[[], Density]) -> None:
    posterior, x = posterior_of(make()), batch()
    theta = 1.8 * torch.rand(5, 4, 1) - 0.9
    expected = posterior.log_prob_batched(theta, x, norm_posterior=False)
    posterior.to("cuda")
    found = posterior.log_prob_batched(theta.cuda(), x.cuda(), norm_posterior=False)
    assert torch.allclose(found.cpu(), expected, atol=1e-3)
    assert posterior.sample_batched((3,), x.cuda(), **QUIET).is_cuda
    assert posterior.leakage_correction(x.cuda()).is_cuda
    posterior.to("cpu")
    again = posterior.log_prob_batched(theta, x, norm_posterior=False)
    assert torch.equal(again, expected)


def test_mixed_parameters_have_a_mass_of_one_over_all_categories() -> None:
    density = Mixture([Flow.of([npe("mnpe")]), several("mnpe")], [0.5, 0.5])
    posterior, x = MixturePosterior(density, problems.mixed_prior(1)), batch()
    assert not posterior.enable_transform  # for `map`
    line = torch.linspace(-0.9975, 0.9975, 400)
    theta = torch.cartesian_prod(line, torch.arange(3.0), torch.arange(2.0))
    density = posterior.log_prob_batched(theta[:, None].expand(-1, 4, -1), x).exp()
    total = density.sum(dim=0) * 2 / 400
    error = problems.error_of_mass(posterior.leakage_correction(x))
    assert ((total - 1).abs() < 5 * error + 0.01).all()
    draws = posterior.sample_batched((50,), x, **QUIET)
    assert torch.isfinite(posterior.log_prob_batched(draws, x)).all()


# --- against brute force ---


@pytest.mark.parametrize("family", [None, *FAMILIES])
def test_a_coupled_density_is_the_sum_over_all_simulations(family: str | None) -> None:
    posterior = posterior_of(coupled(family, tail_mass=0.0))
    theta = 1.8 * torch.rand(6, 4, 1) - 0.9
    with torch.no_grad():
        expected = problems.brute_force_log_prob(posterior, theta)
    found = posterior.log_prob_batched(theta, posterior.x_o, norm_posterior=False)
    assert torch.allclose(found.double(), expected, atol=1e-4, rtol=1e-5)


@pytest.mark.parametrize("family", FAMILIES)
def test_a_flow_is_the_average_of_its_networks(family: str) -> None:
    theta, x = 1.8 * torch.rand(6, 4, 1) - 0.9, batch()
    estimators = [npe(family), moved(npe(family), 1), moved(npe(family), 2)]
    h = embedding_of(npe(family))
    bare = headless(npe(family))
    with torch.no_grad():
        alone = torch.stack([one.log_prob(theta, x) for one in estimators])
        of_nets = torch.stack(
            [bare.log_prob(theta, net(x)) for net in (h, moved(h, 1), moved(h, 2))]
        )
    for flow, each in ((several(family), alone), (with_nets(family), of_nets)):
        assert torch.allclose(
            flow.log_probs(theta, flow.embed(x)).float(), each, atol=1e-4
        )
        expected = each.logsumexp(dim=0) - math.log(3)
        assert torch.allclose(flow.log_prob(theta, x), expected, atol=1e-4)
        some = flow[[2, 0]].log_prob(theta, x)
        expected = each[[2, 0]].logsumexp(dim=0) - math.log(2)
        assert torch.allclose(some, expected, atol=1e-4)


def test_a_mixture_is_the_weighted_sum_of_its_parts_and_their_draws() -> None:
    density, x = mixture(), batch()
    theta = 1.8 * torch.rand(6, 4, 1) - 0.9
    log_probs = torch.stack([part.log_prob(theta, x) for part in density.parts])
    weights = torch.tensor([0.2, 0.5, 0.3])
    expected = torch.einsum("k,ksb->sb", weights, log_probs.exp()).log()
    assert torch.allclose(density.log_prob(theta, x), expected, atol=1e-4)
    assert len(mixture(0.5, 0.0, 0.5).parts) == 2
    # Spikes at integers tell where draws come from.
    spikes = torch.tensor([[0.0, -9.0], [1.0, -9.0]])
    parts = [
        problems.gaussian_posterior(
            dim=1, embeddings=spikes, weights=torch.eye(2)[[k] * 4], x_o=x
        ).posterior_estimator
        for k in range(2)
    ]
    draws = Mixture(parts, [0.3, 0.7]).sample(Size((5000,)), x).round()
    assert torch.allclose(draws.mean(dim=(0, 2)), torch.full((4,), 0.7), atol=0.03)


def test_the_tail_that_is_left_out_is_that_of_the_smallest_weights() -> None:
    posterior: Any = problems.gaussian_posterior(n_o=8, n_s=60)
    density, x = posterior.posterior_estimator, posterior.x_o
    theta = 2 * torch.rand(50, 8, 2) - 1
    each = theta[:, :, None].expand(-1, -1, 60, -1)
    terms = density.density.log_prob(each, density.simulated).double().exp()
    ascending, order = posterior.weights.sort(dim=1)
    for tail_mass in (1e-3, 0.3, 1.0):
        kept = ascending.cumsum(dim=1) > tail_mass
        kept[:, -1] = True
        weights = posterior.weights * torch.zeros(8, 60).scatter(1, order, kept.float())
        density.tail_mass = tail_mass
        found = density.log_prob(theta, x).double().exp()
        assert torch.allclose(found, (terms * weights).sum(dim=-1), atol=1e-6)
        assert not kept.all()


# --- coupled densities ---


def test_simulations_are_drawn_with_their_weights_and_never_with_weight_zero() -> None:
    spikes = torch.stack([torch.arange(6.0), torch.full((6,), -9.0)], dim=1)
    weights = torch.tensor([[0, 0.5, 0, 0.3, 0.2, 0], [0.9, 0, 0, 0, 0, 0.1]])
    posterior = problems.gaussian_posterior(
        dim=1, n_o=2, weights=weights, embeddings=spikes, prior=problems.box(1, -9, 9)
    )
    n = 20_000
    samples = posterior.sample_batched((n,), posterior.x_o, **QUIET).round().long()
    found = nn.functional.one_hot(samples[..., 0], 6).double().mean(dim=0)
    error = (weights * (1 - weights) / n).sqrt()  # zero at weights of zero
    assert ((found - weights).abs() <= 4.5 * error).all()


def test_an_observation_is_found_by_its_value() -> None:
    x_o = torch.randn(6, 3)
    x_o[4], x_o[2, 0] = x_o[1], 0.0
    posterior = problems.gaussian_posterior(x_o=x_o)
    rows = posterior.weights
    assert torch.equal(problems.rows_of(posterior, x_o[[5, 0, 4]]), rows[[5, 0, 1]])
    x = x_o[2:3].clone()
    x[0, 0] = -0.0
    assert torch.equal(problems.rows_of(posterior, x), rows[2:3])
    theta = torch.zeros(2, 2)
    expected = posterior.log_prob(theta, x=x_o[3])
    others: Any = (x_o[3].double(), x_o[3].numpy(), x_o[3].tolist(), x_o[3:4])
    for same in others:
        assert torch.equal(posterior.log_prob(theta, x=same), expected)


def test_an_observation_outside_the_batch_is_refused() -> None:
    new, posterior = torch.randn(2, 3), problems.gaussian_posterior()
    for call in (
        lambda: posterior.sample((2,), x=new[:1], **QUIET),
        lambda: posterior.log_prob_batched(torch.zeros(1, 2), new),
        lambda: posterior.potential(torch.zeros(1, 2), x=new[:1]),
    ):
        with pytest.raises(InvalidInputError, match=r"rope.build_posterior\(x\)"):
            call()


def test_the_posterior_of_one_observation_answers_as_the_whole() -> None:
    posterior = posterior_of(coupled())
    theta = 2 * torch.rand(6, 1) - 1
    views = [*posterior]
    assert len(views) == len(posterior) == 4
    for i in (0, 3):
        view, x = pickle.loads(pickle.dumps(views[i])), posterior.x_o[i]
        assert torch.equal(view.log_prob(theta), posterior.log_prob(theta, x=x))
        torch.manual_seed(i)
        samples = view.sample((20,), **QUIET)
        torch.manual_seed(i)
        assert torch.equal(samples, posterior.sample((20,), x=x, **QUIET))
        assert torch.equal(view.x_o, posterior.x_o[i : i + 1])
        assert torch.equal(view.weights, posterior.weights[i : i + 1])
        with pytest.raises(IndexError):
            view[1]


# --- rejection ---


def with_mass_inside(share: float) -> Any:
    """The first of two observations has all other mass far outside the prior."""
    spikes = torch.tensor([[100.0, -3.0], [0.0, -3.0]])
    weights = torch.tensor([[1 - share, share], [0.0, 1.0]])
    return problems.gaussian_posterior(dim=1, n_o=2, weights=weights, embeddings=spikes)


def test_sampling_without_mass_inside_the_prior_names_the_observation() -> None:
    posterior, proposed = with_mass_inside(0.0), []
    density = posterior.posterior_estimator

    def draw(z: Tensor, row: Tensor) -> Tensor:
        proposed.append(len(row))
        return Coupled.draw(density, z, row)

    density.draw = draw
    for count in (3, 1000):
        with pytest.raises(SamplingError, match=r"rows \[0\] of `x`.*reject_outside_p"):
            posterior.sample_batched((count,), posterior.x_o, **QUIET)
    assert sum(proposed) < 2e7
    assert posterior.sample((3,), x=posterior.x_o[1], **QUIET).shape == (3, 1)
    options = {"reject_outside_prior": False} | QUIET
    assert (posterior.sample((3,), x=posterior.x_o[0], **options) > 90).all()
    with pytest.raises(SamplingError, match="no mass inside"):
        posterior.log_prob(torch.zeros(1, 1), x=posterior.x_o[0])


def test_little_mass_inside_the_prior_is_sampled_unless_it_takes_too_long() -> None:
    posterior = with_mass_inside(4e-4)
    draws = posterior.sample_batched((300,), posterior.x_o, **QUIET)
    assert (draws.std(dim=0) / math.exp(-3) - 1).abs().max() < 0.2
    with pytest.raises(SamplingError, match=r"rows \[0\] of `x`.*Leave these"):
        posterior.sample_batched((10_000,), posterior.x_o, **QUIET)


# --- the prior, densities that fail, and what is refused ---


def test_an_unbounded_prior_has_mass_one_without_draws() -> None:
    posterior: Any = problems.gaussian_posterior(prior=problems.standard_normal(2))
    posterior.posterior_estimator.mass = None
    assert posterior.leakage_correction(posterior.x_o).tolist() == [1.0] * 5


def test_densities_of_nan_count_as_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    density: Any = coupled(tail_mass=0.0)
    theta, x = 1.8 * torch.rand(1, 4, 1) - 0.9, batch()
    total = density.log_prob(theta, x).double().exp()
    first, inside = density.simulated[0], density.density
    share = inside.log_prob(theta, first.expand(4, -1)).double().exp()
    share = share * density.coupling.table[:, 0]
    original = inside.log_prob

    def log_prob(input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        broken = (condition == first).all(dim=1)
        return original(input, condition).masked_fill(broken, math.nan)

    monkeypatch.setattr(inside, "log_prob", log_prob)
    with pytest.warns(RoPEWarning, match=r"4 of 36 component densities are NaN"):
        found = density.log_prob(theta, x)
    assert torch.allclose(found.double().exp(), total - share, rtol=1e-4)


def test_an_observation_at_which_a_density_fails_gives_a_named_error() -> None:
    estimator = moved(npe("mdn"), 1, scale=1e8)  # overflows, as others do far away
    with pytest.raises(SamplingError, match="far from all simulations"):
        Flow.of([estimator]).sample(Size((4,)), torch.tensor([[0.0] * 3, [1e20] * 3]))
