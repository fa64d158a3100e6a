"""A linear-Gaussian problem whose posterior is known, in the shape of an sbi posterior.

theta ~ N(0, I), x_s = theta + 0.5 eps, so theta | x_s ~ N(0.8 x_s, 0.2 I). The real
process scales and shifts: x_o = 1.4 x_s + 0.7, so theta | x_o is the same Gaussian at
(x_o - 0.7) / 1.4.
"""

from typing import Any

import torch
from sbi.inference import DirectPosterior
from sbi.neural_nets.estimators.base import ConditionalDensityEstimator
from torch import Size, Tensor, nn
from torch.distributions import Distribution, Independent, MultivariateNormal, Normal

NOISE_STD = 0.5
GAIN = 1 / (1 + NOISE_STD**2)
POSTERIOR_STD = (NOISE_STD**2 * GAIN) ** 0.5
SCALE, SHIFT = 1.4, 0.7


class GaussianEstimator(ConditionalDensityEstimator):
    """q(theta | h(x)) = N(h(x), 0.2 I) with h(x) = 0.8 x, a trainable linear map."""

    def __init__(self, dim: int = 2) -> None:
        linear = nn.Linear(dim, dim)
        with torch.no_grad():
            linear.weight.copy_(GAIN * torch.eye(dim))
            linear.bias.zero_()
        super().__init__(linear, Size((dim,)), Size((dim,)))
        # Keeps a parameter when the embedding is taken away.
        self.log_std = nn.Parameter(torch.tensor(POSTERIOR_STD).log().repeat(dim))

    @property
    def embedding_net(self) -> nn.Module:
        return self.net

    def _law(self, condition: Tensor) -> Distribution:
        return Independent(Normal(self.net(condition), self.log_std.exp()), 1)

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        return self._law(condition).log_prob(input)

    def sample(self, sample_shape: Size, condition: Tensor, **kwargs: Any) -> Tensor:
        return self._law(condition).sample(sample_shape)

    def loss(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        return -self.log_prob(input, condition)


def prior(dim: int = 2) -> MultivariateNormal:
    return MultivariateNormal(torch.zeros(dim), torch.eye(dim))


def simulator(theta: Tensor) -> Tensor:
    return theta + NOISE_STD * torch.randn_like(theta)


def real_process(theta: Tensor) -> Tensor:
    return SCALE * simulator(theta) + SHIFT


def posterior(dim: int = 2) -> DirectPosterior:
    """What a perfectly trained NPE would be."""
    return DirectPosterior(GaussianEstimator(dim), prior(dim))


def exact_posterior(x_s: Tensor) -> Distribution:
    """theta | x_s, for the x_s a real observation came from."""
    std = torch.tensor(POSTERIOR_STD, dtype=x_s.dtype)
    return Independent(Normal(GAIN * x_s, std), 1)


def undo(x_o: Tensor) -> Tensor:
    """The simulation behind a real observation."""
    return (x_o - SHIFT) / SCALE


def labelled(n: int, dim: int = 2) -> tuple[Tensor, Tensor]:
    """Parameters and real observations."""
    theta = prior(dim).sample((n,))
    return theta, real_process(theta)


def nats_lost(posterior: Any) -> float:
    """What a posterior is short of the exact one: mean log density at 300 new pairs."""
    torch.manual_seed(1)
    theta, x = labelled(300)
    found = posterior.log_prob_batched(theta[None], x, norm_posterior=False)
    return float((exact_posterior(undo(x)).log_prob(theta) - found[0]).mean())
