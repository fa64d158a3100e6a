"""Mixtures of several kinds of parts against brute force, and amortised ones."""

import copy
import math
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from sbi.inference import DirectPosterior
from torch import Size, Tensor, nn
from torch.distributions import Distribution, Normal

from sbi_rope import metrics
from sbi_rope._sbi import estimator_of, is_bounded
from sbi_rope.coupling import Coupling
from sbi_rope.errors import (
    InvalidInputError,
    RoPEWarning,
    SamplingError,
    UnsupportedPosteriorError,
)
from sbi_rope.mixture import (
    CoupledEmbeddings,
    MixtureEstimator,
    MixturePosterior,
    OwnEmbeddings,
    Part,
    chunks,
    part_of,
    part_of_prior,
    truncation,
)
from tests import gaussian, problems

QUIET: dict[str, Any] = {"show_progress_bars": False}
DIM, NUM_SIMULATED, NUM_BATCH = 2, 15, 8
WEIGHTS = (0.5, 0.3, 0.2)


def coupling(real: Tensor, simulated: Tensor, **options: Any) -> Coupling:
    """A coupling by a potential drawn at random."""
    options = {"gamma": 0.5, "direct": False, **options}
    return Coupling(
        potential=torch.randn(len(simulated), dtype=torch.double),
        real=real.detach().double(),
        simulated=simulated.double(),
        tau=1.0,
        marginal_error=0.0,
        num_iterations=0,
        converged=True,
        solver="none",
        **options,
    )


def gaussian_net() -> nn.Module:
    """From x to a mean and a logarithmic standard deviation in each dimension."""
    net = nn.Linear(3, 2 * DIM)
    with torch.no_grad():
        net.weight[DIM:] *= 0.2
        net.bias[DIM:] = -1.0
    return net


def coupled_part(**options: Any) -> Part:
    """A net, and a coupling of its embeddings."""
    simulated = problems.embeddings_of(DIM, NUM_SIMULATED)
    batch = torch.randn(NUM_BATCH, 3)
    net = nn.Linear(3, 2 * DIM)
    coupled = coupling(net(batch), simulated)
    mixing = CoupledEmbeddings(simulated, batch, net, coupled, **options)
    return Part(problems.Gaussians(DIM), mixing)


def own_part(num_nets: int = 2) -> Part:
    nets = [gaussian_net() for _ in range(num_nets)]
    return Part(problems.Gaussians(DIM), OwnEmbeddings(nets, (3,)))


def three_parts(
    weights: Any = WEIGHTS, *, tail_mass: float = 0.0, **options: Any
) -> MixturePosterior:
    """A coupled part, one given embeddings of x itself, and the prior."""
    prior = problems.box(DIM)
    parts = [coupled_part(**options), own_part(), part_of_prior(prior, (3,))]
    return MixturePosterior(
        MixtureEstimator(parts, weights, tail_mass=tail_mass), prior
    )


def amortised(**options: Any) -> MixturePosterior:
    """Two densities of x itself, neither of which knows a batch."""
    parts = [own_part(), own_part(1)]
    estimator = MixtureEstimator(parts, [0.25, 0.75], tail_mass=0.0)
    return MixturePosterior(estimator, problems.box(DIM), **options)


def rows_by_hand(posterior: MixturePosterior, x: Tensor) -> Tensor:
    """Of the coupling, by its definition."""
    (mixing,) = posterior.posterior_estimator.coupled
    one = mixing.coupling
    distances = (mixing.net(x).double()[:, None] - one.simulated).norm(dim=-1)
    return (one.potential - distances / one.gamma).softmax(dim=1).detach()


def gaussians(theta: Tensor, embeddings: Tensor) -> Tensor:
    """Densities at theta (..., d) given embeddings (..., 2 d)."""
    mean, log_std = embeddings.detach().double().chunk(2, dim=-1)
    return Normal(mean, log_std.exp()).log_prob(theta.double()).sum(-1).exp()


def densities(posterior: MixturePosterior, theta: Tensor, x: Tensor) -> Tensor:
    """Of each part at theta (S, n, d), shape (S, n, 3)."""
    _, own, _ = posterior.posterior_estimator.parts
    mixing: Any = own.mixing
    rows = rows_by_hand(posterior, x)
    simulated = problems.simulated_of(posterior)
    return torch.stack(
        [
            (rows * gaussians(theta[..., None, :], simulated)).sum(dim=-1),
            torch.stack([gaussians(theta, net(x)) for net in mixing.nets]).mean(0),
            (theta.abs() <= 1).all(dim=-1).double() / 2**DIM,
        ],
        dim=-1,
    )


def masses(posterior: MixturePosterior, x: Tensor) -> Tensor:
    """Of each part inside the box, shape (n, 3), in closed form."""
    own: Any = posterior.posterior_estimator.parts[1].mixing

    def inside(embeddings: Tensor) -> Tensor:
        mean, log_std = embeddings.detach().double().chunk(2, dim=-1)
        law, one = Normal(mean, log_std.exp()), torch.ones_like(mean)
        return (law.cdf(one) - law.cdf(-one)).prod(dim=-1)

    rows = rows_by_hand(posterior, x)
    return torch.stack(
        [
            rows @ inside(problems.simulated_of(posterior)),
            torch.stack([inside(net(x)) for net in own.nets]).mean(dim=0),
            torch.ones(len(x), dtype=torch.double),
        ],
        dim=-1,
    )


def counted(target: Any, name: str, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Record the arguments of every call of a method."""
    original, calls = getattr(target, name), []

    def record(*arguments: Any, **options: Any) -> Any:
        calls.append(arguments)
        return original(*arguments, **options)

    monkeypatch.setattr(target, name, record)
    return calls


# --- density ---


@pytest.mark.medium
def test_log_prob_is_the_log_sum_over_parts_and_embeddings(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    posterior = three_parts()
    theta = 3 * torch.rand(6, NUM_BATCH, DIM) - 1.5
    expected = densities(posterior, theta, posterior.x_o) @ torch.tensor(
        WEIGHTS, dtype=torch.double
    )
    estimator = posterior.posterior_estimator
    for entries, batch in ((2**19, 2**14), (40, 7), (1, 1)):
        monkeypatch.setattr(chunks, "MAX_ENTRIES", entries)
        monkeypatch.setattr(chunks, "CPU_BATCH", batch)
        found = estimator.log_prob(theta, posterior.x_o)
        assert torch.allclose(found, expected.log().float(), atol=1e-5), entries
        one = estimator.log_prob(theta[:, 2:3], posterior.x_o[2:3])
        assert torch.allclose(one, expected[:, 2:3].log().float(), atol=1e-5), entries


def test_part_log_probs_are_the_log_densities_of_each_part_by_itself() -> None:
    posterior = three_parts(tail_mass=0.5, weights=(1.0, 0.0, 0.0))
    theta = 2 * torch.rand(NUM_BATCH, DIM) - 1
    theta[0] = 1.5  # where the prior has no density
    estimator = posterior.posterior_estimator
    expected = densities(posterior, theta[None], posterior.x_o)[0].log()
    found = estimator.part_log_probs(theta, posterior.x_o)
    assert found.dtype is torch.float64
    assert torch.allclose(found, expected, atol=1e-5)
    order = torch.tensor([3, 0, 5])
    some = estimator.part_log_probs(theta[order], posterior.x_o[order])
    assert torch.allclose(some, expected[order], atol=1e-5)


def test_the_tail_is_left_out_of_all_parts_together() -> None:
    posterior = three_parts(tail_mass=0.0)
    estimator, x = posterior.posterior_estimator, posterior.x_o
    theta = 2 * torch.rand(40, NUM_BATCH, DIM) - 1
    whole = estimator.log_prob(theta, x).double().exp()
    estimator.tail_mass = 0.25
    cut = estimator.log_prob(theta, x).double().exp()
    # All but the prior, whose single weight is 0.2, goes by its weights.
    rows = 0.5 * rows_by_hand(posterior, x)
    rows = torch.cat([rows, torch.tensor([[0.15, 0.15, 0.2]]).expand(len(x), 3)], 1)
    mixing: Any = estimator.parts[1].mixing
    terms = torch.cat(
        [
            gaussians(theta[..., None, :], problems.simulated_of(posterior)),
            torch.stack([gaussians(theta, net(x)) for net in mixing.nets], dim=-1),
            torch.full((*theta.shape[:2], 1), 0.25, dtype=torch.double),
        ],
        dim=-1,
    )
    ascending, order = rows.sort(dim=1)
    dropped = torch.zeros_like(rows, dtype=torch.bool)
    dropped.scatter_(1, order, ascending.cumsum(dim=1) <= 0.25)
    assert dropped[:, :NUM_SIMULATED].any(dim=1).all()
    assert torch.allclose(whole, (terms * rows).sum(-1), rtol=1e-5)
    assert torch.allclose(cut, (terms * rows * ~dropped).sum(-1), rtol=1e-5)


def test_parts_of_weight_zero_are_not_evaluated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for alone in range(3):
        posterior = three_parts([float(k == alone) for k in range(3)])
        calls = [
            [
                counted(target, name, monkeypatch)
                for target, name in (
                    (part.density, "log_prob"),
                    (part.density, "sample"),
                    (part.mixing, "embed"),
                    (part.mixing, "rows"),
                )
            ]
            for part in posterior.posterior_estimator.parts
        ]
        theta = 2 * torch.rand(NUM_BATCH, DIM) - 1
        posterior.log_prob_batched(theta, posterior.x_o)
        posterior.sample_batched((3,), posterior.x_o, **QUIET)
        for k, of_part in enumerate(calls):
            assert all(of_part) == any(of_part) == (k == alone), (k, alone)


def test_gradients_are_those_of_the_sum_of_all_parts() -> None:
    posterior = three_parts()
    theta = (0.8 * torch.rand(1, NUM_BATCH, DIM)).requires_grad_()
    posterior.posterior_estimator.log_prob(theta, posterior.x_o).sum().backward()
    assert theta.grad is not None
    exact = theta.detach().double().requires_grad_()
    weights = torch.tensor(WEIGHTS, dtype=torch.double)
    (densities(posterior, exact, posterior.x_o) @ weights).log().sum().backward()
    assert exact.grad is not None
    assert torch.allclose(theta.grad.double(), exact.grad, atol=1e-4)


# --- samples and mass ---


def test_samples_follow_the_density_of_all_parts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    posterior = three_parts()
    x = posterior.x_o[:3]
    line = (torch.arange(40) + 0.5) / 20 - 1
    grid = torch.cartesian_prod(line, line)[:, None].expand(-1, 3, -1)
    density = densities(posterior, grid, x) @ torch.tensor(WEIGHTS).double()
    density = density / density.sum(dim=0)
    for entries, draws in ((2**19, 10_000), (60, 1000)):
        monkeypatch.setattr(chunks, "MAX_ENTRIES", entries)
        samples = posterior.sample_batched((draws,), x, **QUIET)
        for i in range(3):
            share = density[:, i].reshape(4, 10, 4, 10).sum(dim=(1, 3))
            edges = [torch.linspace(-1, 1, 5)] * 2
            counts = torch.histogramdd(samples[:, i], edges).hist / draws
            error = (share * (1 - share) / draws).sqrt()
            assert ((counts - share).abs() < 4.5 * error + 2e-3).all(), entries


def test_samples_come_from_each_part_in_proportion_to_its_weight() -> None:
    # Spikes at different integers: embeddings cannot be confused with each other.
    weights = (0.5, 0.3, 0.2)
    parts = []
    for number in range(3):
        net = nn.Linear(3, 2)
        with torch.no_grad():
            net.weight.zero_()
            net.bias.copy_(torch.tensor([float(number), -9.0]))
        parts.append(Part(problems.Gaussians(1), OwnEmbeddings([net], (3,))))
    estimator = MixtureEstimator(parts, weights)
    n = 20_000
    samples = estimator.sample(Size((n,)), torch.randn(2, 3))
    for column in samples[..., 0].round().long().T:
        found = column.bincount(minlength=3) / n
        for share, weight in zip(found.tolist(), weights, strict=True):
            assert abs(share - weight) < 4 * (weight * (1 - weight) / n) ** 0.5


def test_the_mass_and_its_error_are_those_of_all_parts_together() -> None:
    wrong = []
    for _ in range(10):
        posterior = three_parts()
        leakage = posterior.leakage(posterior.x_o)
        weights = torch.tensor(WEIGHTS, dtype=torch.double)
        exact = masses(posterior, posterior.x_o) @ weights
        wrong.append((leakage.mass - exact) / leakage.standard_error)
        assert exact.min() < 0.9
        assert (leakage.standard_error < 0.02).all()
    scores = torch.cat(wrong)
    assert scores.abs().max() < 4.5
    assert 0.5 < float(scores.square().mean().sqrt()) < 1.3


def test_the_mass_of_a_part_is_estimated_from_draws_in_proportion_to_its_weight(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    weights = [0.9995 - 0.25, 0.25, 0.0005]
    posterior = three_parts(weights)
    calls = [
        counted(part.density, "sample", monkeypatch)
        for part in posterior.posterior_estimator.parts
    ]
    posterior.leakage(posterior.x_o)
    posterior.leakage(posterior.x_o)

    def draws(of_part: list[Any]) -> int:
        return sum(Size(shape).numel() for shape, *_ in of_part)

    # Given each simulation once; of the own embeddings a quarter each time, over two
    # nets; the prior weighs less than a draw.
    assert draws(calls[0]) == truncation.LEAKAGE_DRAWS
    assert draws(calls[1]) == 2 * 128
    assert draws(calls[2]) == 0


def test_small_parts_with_a_noticeable_sum_do_not_count_as_inside() -> None:
    # Each of a hundred weighs less than a draw; a tenth of them does in sum, too.
    far = part_of_prior(problems.box(DIM, 3.0, 4.0), (3,))
    weights = torch.cat([torch.tensor([0.95]), torch.full((100,), 0.0005)])
    parts = [part_of_prior(problems.box(DIM), (3,)), *[far] * 100]
    posterior = MixturePosterior(MixtureEstimator(parts, weights), problems.box(DIM))
    leakage = posterior.leakage(torch.zeros(1, 3))
    assert 0.95 <= float(leakage.mass) < 0.952


def test_the_prior_is_never_left_out_of_a_density_whatever_it_weighs() -> None:
    net = nn.Linear(3, 2 * DIM)
    with torch.no_grad():
        net.weight.zero_()
        net.bias.copy_(torch.tensor([-0.9, -0.9, -3.0, -3.0]))
    parts = [
        Part(problems.Gaussians(DIM), OwnEmbeddings([net], (3,))),
        part_of_prior(problems.box(DIM), (3,)),
    ]
    estimator = MixtureEstimator(parts, [0.9999, 0.0001], tail_mass=1e-3)
    found = estimator.log_prob(torch.full((1, 1, DIM), 0.9), torch.zeros(1, 3))
    assert float(found) == pytest.approx(math.log(0.0001 / 2**DIM), abs=1e-5)


def test_the_mass_of_an_observation_is_the_same_beside_others_within_its_error() -> (
    None
):
    posterior = three_parts()
    together = posterior.leakage(posterior.x_o)
    assert torch.equal(posterior.leakage(posterior.x_o).mass, together.mass)
    for i, x in enumerate(posterior.x_o):
        alone = posterior.leakage(x)
        error = alone.standard_error.hypot(together.standard_error[i])
        assert ((alone.mass - together.mass[i]).abs() < 4 * error).all()


# --- couplings ---


def test_weights_are_those_of_the_coupling() -> None:
    posterior = three_parts()
    expected = rows_by_hand(posterior, posterior.x_o)
    assert torch.allclose(posterior.weights, expected, atol=1e-6)
    mixing = posterior.posterior_estimator.coupled[0]
    found = mixing.rows(mixing.embed(posterior.x_o)).weights
    assert torch.allclose(found, expected, atol=1e-6)


def test_unseen_observations_are_embedded_by_the_net() -> None:
    posterior = three_parts(unseen="extend")
    x, theta = torch.randn(4, 3), 2 * torch.rand(4, DIM) - 1
    with pytest.warns(RoPEWarning, match="4 unseen"):
        found = posterior.log_prob_batched(theta, x, norm_posterior=False)[0]
    weights = torch.tensor(WEIGHTS, dtype=torch.double)
    expected = (densities(posterior, theta[None], x)[0] @ weights).log()
    assert torch.allclose(found.double(), expected, atol=1e-5)


# --- the posterior of one observation ---


@pytest.mark.parametrize("unseen", ["raise", "extend"])
def test_the_posterior_of_one_observation_answers_as_the_whole(unseen: str) -> None:
    posterior = three_parts(unseen=unseen)
    theta = 2 * torch.rand(6, DIM) - 1
    for i in (0, 3):
        view = pickle.loads(pickle.dumps(posterior[i]))
        x = posterior.x_o[i]
        assert torch.equal(view.log_prob(theta), posterior.log_prob(theta, x=x))
        torch.manual_seed(i)
        samples = view.sample((20,), **QUIET)
        torch.manual_seed(i)
        assert torch.equal(samples, posterior.sample((20,), x=x, **QUIET))
        assert torch.equal(view.weights, posterior[i].weights)
        assert len(view) == 1
        assert torch.equal(view[0].log_prob(theta), view.log_prob(theta))
    other = posterior.x_o[1]
    if unseen == "raise":
        with pytest.raises(InvalidInputError, match="batch"):
            view.log_prob(theta, x=other)
    else:
        with pytest.warns(RoPEWarning, match="1 unseen"):
            found = view.log_prob(theta, x=other)
        assert torch.allclose(found, posterior.log_prob(theta, x=other), atol=1e-5)


def test_the_posterior_of_one_observation_forgets_who_was_asked_for_before() -> None:
    posterior = three_parts(unseen="extend")
    posterior.potential(torch.zeros(1, DIM), posterior.x_o[0])
    with pytest.warns(RoPEWarning, match="Extended"):
        posterior.log_prob(torch.zeros(1, DIM), x=torch.ones(1, 3))
    one = posterior[2]
    assert one.potential_fn.return_x_o() is None
    (coupled,) = one.posterior_estimator.coupled
    assert torch.equal(coupled.x_o, posterior.x_o[2:3])
    copied = pickle.loads(pickle.dumps(posterior))
    with pytest.warns(RoPEWarning, match="Extended"):  # its answer was not kept
        copied.log_prob(torch.zeros(1, DIM), x=torch.ones(1, 3))


def test_the_pickle_of_one_observation_does_not_grow_with_the_batch() -> None:
    def size(n_o: int) -> tuple[int, int]:
        posterior = problems.gaussian_posterior(x_o=torch.randn(n_o, 1, 16, 16))
        posterior.log_prob_batched(torch.zeros(n_o, 2), posterior.x_o)
        return len(pickle.dumps(posterior)), len(pickle.dumps(posterior[1]))

    (small, view), (large, other) = size(10), size(500)
    assert large > 10 * small
    assert other < view + 1000
    assert other < 60_000


# --- amortised posteriors ---


def test_an_amortised_posterior_answers_any_x() -> None:
    posterior = amortised()
    assert posterior.is_amortised
    assert not three_parts().is_amortised
    assert "for any x" in str(posterior)
    theta, x = 2 * torch.rand(7, 4, DIM) - 1, torch.randn(4, 3)
    weights = torch.tensor([0.25, 0.75], dtype=torch.double)
    of_each = []
    for part in posterior.posterior_estimator.parts:
        mixing: Any = part.mixing
        of_net = [gaussians(theta, net(x)) for net in mixing.nets]
        of_each.append(torch.stack(of_net).mean(dim=0))
    expected = (torch.stack(of_each, dim=-1) @ weights).log()
    found = posterior.log_prob_batched(theta, x, norm_posterior=False)
    assert torch.allclose(found.double(), expected, atol=1e-5)
    normalised = posterior.log_prob_batched(theta, x)
    mass = posterior.leakage(x).mass.log()
    assert torch.allclose(normalised.double(), expected - mass, atol=1e-5)
    for i in range(4):
        single = posterior.log_prob(theta[:, i], x=x[i])
        own = posterior.leakage(x[i]).mass.log()
        assert torch.allclose(single.double(), expected[:, i] - own, atol=1e-5)
    samples = posterior.sample_batched((5,), x, **QUIET)
    assert samples.shape == (5, 4, DIM)
    assert (samples.abs() <= 1).all()
    default = posterior.set_default_x(x[0])
    assert default.sample((6,), **QUIET).shape == (6, DIM)
    assert default.map(num_iter=3, num_init_samples=20).shape == (1, DIM)
    assert metrics.lpp(posterior, theta[0], x).log_probs.shape == (4,)


def test_a_part_made_of_an_npe_has_its_density_and_its_mass() -> None:
    npe = problems.npe_posterior("nsf")
    estimator = copy.deepcopy(estimator_of(npe)).train()
    part = part_of(estimator)
    assert not any(module.training for module in part.modules())
    posterior = MixturePosterior(MixtureEstimator([part], [1.0]), npe.prior)
    theta, x = 2 * torch.rand(5, 4, DIM) - 1, torch.randn(4, 3)
    with torch.no_grad():
        expected = npe.posterior_estimator.log_prob(theta, x)
    found = posterior.log_prob_batched(theta, x, norm_posterior=False)
    assert torch.allclose(found, expected, atol=1e-4)
    mass = posterior.leakage(x)
    free = npe.posterior_estimator.sample((5000,), x)
    share = (free.abs() <= 1).all(dim=-1).double().mean(dim=0)
    error = (mass.standard_error.square() + share * (1 - share) / 5000).sqrt()
    assert ((mass.mass - share).abs() < 4.5 * error + 1e-3).all()
    # A copy, in evaluation mode, whatever becomes of the user's own.
    ours = {id(parameter) for parameter in posterior.posterior_estimator.parameters()}
    assert not ours & {id(parameter) for parameter in estimator.parameters()}
    assert not any(parameter.requires_grad for parameter in part.parameters())
    assert all(parameter.requires_grad for parameter in estimator.parameters())


def test_an_amortised_posterior_has_no_batch() -> None:
    posterior = amortised()
    calls: list[tuple[Callable[[Any], Any], str]] = [
        (lambda p: p.x_o, "x_o"),
        (lambda p: p.coupling, "coupling"),
        (lambda p: p.couplings, "couplings"),
        (lambda p: p.weights, "weights"),
        (len, r"len\(\)"),
        (lambda p: p[0], r"\[i\]"),
        (list, "len"),
    ]
    for call, name in calls:
        with pytest.raises(InvalidInputError, match=rf"`{name}.*amortised"):
            call(posterior)
    assert posterior  # although it has no length


def test_a_copy_answers_the_same() -> None:
    for posterior in (amortised(), three_parts()):
        x = torch.randn(3, 3) if posterior.is_amortised else posterior.x_o[:3]
        theta = 2 * torch.rand(4, 3, DIM) - 1
        expected = posterior.log_prob_batched(theta, x)
        pickled = pickle.loads(pickle.dumps(posterior))
        for copied in (copy.deepcopy(posterior), pickled):
            assert torch.equal(copied.log_prob_batched(theta, x), expected)


def test_moving_a_mixture_moves_couplings_and_prior() -> None:
    posterior = three_parts()
    estimator = posterior.posterior_estimator
    prior: Any = estimator.parts[2].density
    estimator.to("meta")
    assert posterior.couplings[0].real.is_meta
    assert posterior.coupling.potential.is_meta
    assert prior.prior.sample((1,)).is_meta
    assert not posterior.prior.sample((1,)).is_meta


# --- the prior ---


class Untransformable(Distribution):
    """A prior that says nothing of itself but draws and densities."""

    arg_constraints = {}  # noqa: RUF012

    def __init__(self) -> None:
        super().__init__(Size(), Size((2,)), validate_args=False)

    @property
    def support(self) -> Any:
        raise NotImplementedError

    def sample(self, sample_shape: Size = Size()) -> Tensor:  # noqa: B008
        return torch.rand(*sample_shape, 2)

    def log_prob(self, value: Tensor) -> Tensor:
        inside = ((value >= 0) & (value <= 1)).all(dim=-1)
        return torch.where(inside, 0.0, -torch.inf)


def test_a_prior_that_sbi_cannot_transform_can_be_a_part() -> None:
    part = part_of_prior(Untransformable(), (3,))
    estimator = MixtureEstimator([part], [1.0])
    theta = torch.tensor([[0.5, 0.5], [1.5, 0.5]])
    found = estimator.log_prob(theta, torch.zeros(1, 3))[0]
    assert found.tolist() == [0.0, -torch.inf]
    samples = estimator.sample(Size((50,)), torch.zeros(2, 3))
    assert ((samples >= 0) & (samples <= 1)).all()


# --- what other modules see, and errors ---


def test_a_mixture_in_any_posterior_of_sbi_cannot_be_repaired() -> None:
    posterior = amortised()
    plain = DirectPosterior(posterior.posterior_estimator, posterior.prior)
    for one in (posterior, plain):
        with pytest.raises(UnsupportedPosteriorError, match="`posterior`"):
            estimator_of(one)


def test_only_our_posterior_is_known_to_be_bounded() -> None:
    posterior = amortised()
    assert is_bounded(posterior)
    assert not is_bounded(
        DirectPosterior(posterior.posterior_estimator, posterior.prior)
    )


def test_parts_that_do_not_fit_are_refused_by_name() -> None:
    own, coupled, other = own_part(), coupled_part(), coupled_part()
    one_parameter = part_of(gaussian.GaussianEstimator(1))
    calls: list[tuple[Callable[[], Any], str]] = [
        (lambda: MixtureEstimator([own, one_parameter], [0.5, 0.5]), "as the first"),
        (lambda: MixtureEstimator([coupled, other], [0.5, 0.5]), "same `x_o`"),
    ]
    for call, match in calls:
        with pytest.raises(InvalidInputError, match=match):
            call()


def test_an_estimator_without_a_density_cannot_be_a_part() -> None:
    field = problems.vector_field_posterior("fmpe").vector_field_estimator
    with pytest.raises(UnsupportedPosteriorError, match="Train NPE"):
        part_of(field)


def test_an_observation_at_which_a_density_fails_gives_a_named_error() -> None:
    part = part_of(problems.npe_posterior("mdn").posterior_estimator)
    with torch.no_grad():
        for weight in part.density.parameters():
            weight.mul_(1e8)  # its numbers overflow, as those of others far away
    mixture = MixtureEstimator([part], [1.0])
    x = torch.zeros(3, 3)
    x[1] = 1e20
    with pytest.raises(SamplingError, match="far from all simulations"):
        mixture.sample(torch.Size((4,)), x)
