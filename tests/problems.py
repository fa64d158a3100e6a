"""Small problems shared by the tests: trained estimators, and mixtures of Gaussians."""

import functools
import logging
import math
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from sbi.inference import FMPE, MNPE, NPE, NPSE
from sbi.neural_nets import posterior_flow_nn, posterior_nn, posterior_score_nn
from sbi.neural_nets.embedding_nets import PermutationInvariantEmbedding
from sbi.neural_nets.estimators import ConditionalDensityEstimator
from sbi.utils import BoxUniform, MultipleIndependent
from torch import Size, Tensor, nn
from torch.distributions import Bernoulli, Binomial, Distribution, MultivariateNormal

from sbi_rope.coupling import Coupling
from sbi_rope.density import Coupled, MixturePosterior

# Names of `posterior_nn` for continuous parameters, and for mixed ones.
FAMILIES = [
    *("mdn", "made", "maf", "maf_rqs", "nsf", "zuko_nice", "zuko_maf", "zuko_nsf"),
    *("zuko_ncsf", "zuko_sospf", "zuko_naf", "zuko_unaf", "zuko_gf", "zuko_bpf"),
]
MIXED_FAMILIES = ["mnpe", "mnle"]


class SmallCNN(nn.Sequential):
    """An embedding of (1, 8, 8) images."""

    def __init__(self) -> None:
        super().__init__(nn.Conv2d(1, 3, 3), nn.ReLU(), nn.Flatten(), nn.Linear(108, 4))


def box(dim: int, low: float = -1.0, high: float = 1.0) -> BoxUniform:
    return BoxUniform(torch.full((dim,), low), torch.full((dim,), high))


def mixed_prior(dim: int) -> MultipleIndependent:
    """A box, a parameter with the values 0, 1, 2 and one with the values 0, 1."""
    discrete = [Binomial(2, torch.tensor([0.5])), Bernoulli(torch.tensor([0.3]))]
    return MultipleIndependent([box(dim), *discrete], validate_args=False)


def simulate(theta: Tensor) -> Tensor:
    """Three noisy readings of theta, whatever its dimension up to four."""
    mixing = [[1.0, 0.5, -0.5], [0.2, -1.0, 0.7], [-0.6, 0.3, 0.9], [0.4, 0.8, 0.1]]
    signal = theta @ torch.tensor(mixing[: theta.shape[1]])
    return signal + 0.1 * torch.randn(len(theta), 3)


def simulate_image(theta: Tensor) -> Tensor:
    """An (1, 8, 8) image whose brightness and slope are theta."""
    slope = torch.linspace(-1, 1, 8)
    image = theta[:, 0, None, None] + theta[:, 1, None, None] * slope
    return (image + 0.1 * torch.randn(len(theta), 8, 8))[:, None]


@contextmanager
def reproducible() -> Iterator[None]:
    """Give whoever asks first the same network as all others, without warnings."""
    with torch.random.fork_rng(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.manual_seed(1)
        yield


def trained(trainer: Any, prior: Any, simulator: Any, builder: Any, epochs: int) -> Any:
    """Train an estimator of sbi on 200 simulations."""
    theta = prior.sample((200,))
    x = simulator(theta)
    inference = trainer(prior, builder, show_progress_bars=False)
    # sbi warns by its logger if NaN is kept.
    logging.disable()
    inference.append_simulations(theta, x, exclude_invalid_x=False)
    logging.disable(logging.NOTSET)
    inference.train(max_num_epochs=epochs, training_batch_size=50)
    return inference.build_posterior()


@functools.cache
def npe_posterior(
    family: str = "maf",
    embedding: str = "linear",
    z_score_x: str = "independent",
    dim: int = 2,
    num_epochs: int = 2,
) -> Any:
    """Train a small NPE once a session; for reading only.

    ``embedding`` is "none", "linear" (with dropout, so that evaluation mode matters),
    or "cnn" for image-shaped x. ``dim`` is the number of continuous parameters, which a
    mixed family has two discrete ones beside.
    """
    make_net: Callable[[], nn.Module] = {
        "none": nn.Identity,
        "linear": lambda: nn.Sequential(nn.Linear(3, 4), nn.Tanh(), nn.Dropout(0.5)),
        "cnn": SmallCNN,
    }[embedding]
    with reproducible():
        builder = posterior_nn(
            family,
            z_score_x=z_score_x,
            embedding_net=make_net(),
            hidden_features=16,
            num_transforms=1 if family == "zuko_unaf" else 2,
        )
        prior = mixed_prior(dim) if family in MIXED_FAMILIES else box(dim)
        trainer = MNPE if family == "mnpe" else NPE
        simulator = simulate_image if embedding == "cnn" else simulate
        return trained(trainer, prior, simulator, builder, num_epochs)


def simulate_trials(theta: Tensor) -> Tensor:
    """Up to four noisy readings of theta, (n, 4, 2); those that are missing are NaN."""
    trials = theta[:, None] + 0.3 * torch.randn(len(theta), 4, 2)
    number = torch.randint(1, 5, (len(theta), 1))
    return trials.where((torch.arange(4) < number)[..., None], torch.nan)


class TrialsNet(nn.Module):
    """An embedding of sets of trials, which leaves out those that are missing."""

    def __init__(self) -> None:
        super().__init__()
        self.of_trial, self.of_set = nn.Linear(2, 4), nn.Linear(5, 3)

    def forward(self, x: Tensor) -> Tensor:
        known = ~x.isnan().any(dim=-1, keepdim=True)
        features = self.of_trial(x.nan_to_num()).tanh() * known
        count = known.sum(dim=1)
        return self.of_set(torch.cat([features.sum(dim=1) / count, count], dim=1))


def trials_net_of_sbi() -> nn.Module:
    """Sbi's net, which mixes up the numbers of trials if they have several columns."""
    return PermutationInvariantEmbedding(
        nn.Linear(2, 4), 4, num_hiddens=8, output_dim=3, aggregation_fn="mean"
    )


@functools.cache
def trials_posterior(make_net: Callable[[], nn.Module] = TrialsNet) -> Any:
    """Train a small NPE on trials some of which are missing; for reading only."""
    with reproducible():
        builder = posterior_nn(
            "mdn", embedding_net=make_net(), z_score_x="none", hidden_features=10
        )
        return trained(NPE, box(2), simulate_trials, builder, 5)


@functools.cache
def vector_field_posterior(method: str) -> Any:
    """Train a small FMPE or NPSE once a session; for reading only."""
    trainer, builder = {
        "fmpe": (FMPE, posterior_flow_nn),
        "npse": (NPSE, posterior_score_nn),
    }[method]
    with reproducible():
        estimator = builder("mlp", embedding_net=nn.Linear(3, 4), hidden_features=16)
        return trained(trainer, box(2), simulate, estimator, 2)


class Gaussians(ConditionalDensityEstimator):
    """The analytic q(theta | s) = N(mean, diag(std^2)) with s = (mean, log std)."""

    def __init__(self, dim: int) -> None:
        super().__init__(nn.Identity(), Size((dim,)), Size((2 * dim,)))

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        mean, log_std = condition.chunk(2, dim=-1)
        z = (input - mean) / log_std.exp()
        return (-0.5 * z.square() - log_std - 0.5 * math.log(2 * math.pi)).sum(-1)

    def sample(self, sample_shape: Size, condition: Tensor, **kwargs: Any) -> Tensor:
        mean, log_std = condition.chunk(2, dim=-1)
        noise = torch.randn(*sample_shape, *mean.shape).to(mean)
        return mean + log_std.exp() * noise

    def loss(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        return -self.log_prob(input[None], condition)[0]


@dataclass(frozen=True, eq=False, kw_only=True)
class TableCoupling(Coupling):
    """A coupling with weights chosen by hand; the embedding of x_o is its number."""

    table: Tensor = field(repr=False)

    def rows(self, real: Tensor) -> Tensor:
        return self.table[real[:, 0].long()]

    def to(self, device: str | torch.device) -> "TableCoupling":
        return replace(super().to(device), table=self.table.to(device))


def coupling_of(weights: Tensor, simulated: Tensor) -> TableCoupling:
    numbers = torch.arange(len(weights), dtype=torch.double, device=weights.device)
    return TableCoupling(
        table=weights.double(),
        potential=torch.linspace(-1, 1, len(simulated), dtype=torch.float64),
        real=numbers[:, None].repeat(1, simulated.shape[1]),
        simulated=simulated.double(),
        gamma=0.5,
        tau=1.0,
        marginal_error=0.0,
        num_iterations=0,
        converged=True,
    )


def embeddings_of(dim: int, n_s: int, *, std: float = 0.3) -> Tensor:
    """Means over [-1, 1], standard deviations around ``std``."""
    mean = 2 * torch.rand(n_s, dim) - 1
    return torch.cat([mean, math.log(std) + 0.3 * torch.randn(n_s, dim)], dim=1)


def gaussian_posterior(
    *,
    dim: int = 2,
    n_o: int = 5,
    n_s: int = 12,
    prior: Distribution | None = None,
    std: float = 0.3,
    weights: Tensor | None = None,
    embeddings: Tensor | None = None,
    x_o: Tensor | None = None,
    tail_mass: float = 0.0,
) -> MixturePosterior:
    """A mixture of analytic Gaussians with three readings in x_o."""
    if embeddings is None:
        embeddings = embeddings_of(dim, n_s, std=std)
    if x_o is None:
        x_o = torch.randn(n_o, 3)
    if weights is None:
        weights = (2 * torch.randn(len(x_o), len(embeddings))).double().softmax(dim=1)
    if prior is None:
        prior = box(dim)
    coupling = coupling_of(weights, embeddings)
    density = Coupled(Gaussians(dim), x_o, coupling)
    density.tail_mass = tail_mass
    return MixturePosterior(density, prior)


def rows_of(posterior: Any, x: Tensor) -> Tensor:
    """The weights of the simulations for some observations, (n, n_s)."""
    density = posterior.posterior_estimator
    return density.rows(density.embed(x))


def error_of_mass(mass: Tensor, draws: int = 1024) -> Tensor:
    """The relative standard error of a mass that is the share of so many draws."""
    smoothed = (draws * mass + 0.5) / (draws + 1)
    return (smoothed * (1 - smoothed) / draws).sqrt() / mass


def standard_normal(dim: int) -> MultivariateNormal:
    return MultivariateNormal(torch.zeros(dim), torch.eye(dim))


def brute_force_log_prob(posterior: Any, theta: Tensor) -> Tensor:
    """log sum_j alpha_ij q(theta | s_j) over all i and j, (S, n_o) from (S, n_o, d).

    One component at a time, in float64; no support, no tail.
    """
    coupled, flat = posterior.posterior_estimator, theta.flatten(0, -2)
    columns = []
    for embedding in coupled.simulated:
        condition = embedding[None].expand(len(flat), -1)
        log_q = coupled.density.log_prob(flat[None], condition)[0]
        columns.append(log_q.double().reshape(theta.shape[:-1]))
    return torch.logsumexp(torch.stack(columns, -1) + posterior.weights.log(), dim=-1)
