r"""The densities of simulated and of real statistics given the parameters."""

from typing import Any

import torch
from sbi.neural_nets import likelihood_nn
from torch import Tensor, nn
from torch.distributions import Categorical, MixtureSameFamily, MultivariateNormal
from torch.nn import functional

from sbi_rope._sbi import gaussians_of
from sbi_rope._standardisation import Standardisation
from sbi_rope.data import split_pairs
from sbi_rope.fit import Training, fit, shuffled

__all__ = ["ErrorModel", "fit_surrogate", "log_likelihood"]

# Units of each of the two hidden layers, as in the original code.
HIDDEN = 128
# Gaussians that the density of simulated statistics mixes.
NUM_COMPONENTS = 5
# Standard deviation of the errors before training.
START = 0.5
# Noise on simulated statistics, without which those that depend on each other have no
# density, and the smallest standard deviation of an error.
JITTER, SMALLEST = 0.01, 1e-3


class ErrorModel(nn.Module):
    r"""By what a real statistic differs from a simulated one, given the parameters.

    .. math::
        y \mid s, \theta \sim \mathcal{N}\bigl(s + \mu + \mu(\theta),\,
        L(\theta) L(\theta)^\top\bigr), \qquad
        L(\theta) = \Lambda + \operatorname{diag} \sigma(\theta)

    with :math:`\Lambda` strictly lower triangular. It starts without an offset, with
    errors of half a standard deviation of the simulated statistics.

    Args:
        theta: Parameters of simulations, shape ``(n, d)``, for their units.
        size: Number of statistics, l.
        shift: Whether there is an offset :math:`\mu + \mu(\theta)`.
        depends_on_theta: Whether :math:`\mu(\theta)` and :math:`\sigma(\theta)` are
            networks; otherwise the former is zero, and the latter is constant.
    """

    def __init__(
        self, theta: Tensor, size: int, *, shift: bool, depends_on_theta: bool
    ) -> None:
        super().__init__()
        self.size = size
        self.offset = nn.Parameter(torch.zeros(size), requires_grad=shift)
        start = torch.full((size,), START)
        self.scale = nn.Parameter(start.expm1().log())  # of which softplus is START
        self.below = nn.Parameter(torch.zeros(size, size))
        self.shift = shift
        self.net = self._net(theta) if depends_on_theta else None
        self.to(theta)

    def _net(self, theta: Tensor) -> nn.Module:
        unit = Standardisation(theta)
        last = nn.Linear(HIDDEN, 2 * self.size)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        return nn.Sequential(
            unit,
            nn.Linear(int(unit.varies.sum()), HIDDEN),
            nn.Tanh(),
            nn.Linear(HIDDEN, HIDDEN),
            nn.Tanh(),
            last,
        )

    def forward(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        r"""Return the errors at parameters of shape ``(n, d)``.

        Returns:
            Their mean, shape ``(n, l)``, the part :math:`\mu(\theta)` of it, and their
            covariance, ``(n, l, l)``.
        """
        changes = theta.new_zeros(len(theta), 2 * self.size)
        if self.net is not None:
            changes = self.net(theta)
        of_mean, of_scale = changes.chunk(2, dim=1)
        of_mean = of_mean if self.shift else torch.zeros_like(of_mean)
        scale = functional.softplus(self.scale + of_scale) + SMALLEST
        factor = self.below.tril(diagonal=-1) + torch.diag_embed(scale)
        return self.offset + of_mean, of_mean, factor @ factor.mT


def fit_surrogate(
    theta: Tensor, s: Tensor, *, training: Training, show_progress_bars: bool
) -> Any:
    r"""Fit a mixture density network :math:`p(s \mid \theta)` to simulated statistics.

    Args:
        theta: Parameters, shape ``(n, d)``.
        s: Standardised statistics, shape ``(n, l)``.
        training: Batch size, learning rate and so on.
        show_progress_bars: Whether to show the course of the training.

    Returns:
        The network, frozen and in evaluation mode.
    """
    build = likelihood_nn("mdn", z_score_x="none", num_components=NUM_COMPONENTS)
    surrogate = build(theta.cpu(), s.cpu()).to(s.device)
    train, held_out = split_pairs(theta, training.validation_fraction)

    def batches(epoch: int) -> Any:
        for rows in shuffled(train, training.training_batch_size):
            yield theta[rows], s[rows]

    def loss(theta: Tensor, s: Tensor) -> Tensor:
        noisy = s + JITTER * torch.randn_like(s)
        return surrogate.loss(noisy, condition=theta).mean()

    fit(
        surrogate,
        batches,
        loss,
        training,
        validation_loss=(
            (lambda: loss(theta[held_out], s[held_out])) if len(held_out) else None
        ),
        label="Likelihood of the statistics",
        show_progress_bars=show_progress_bars,
    )
    return surrogate.requires_grad_(requires_grad=False)


def log_likelihood(
    surrogate: Any, errors: ErrorModel, y: Tensor, theta: Tensor
) -> tuple[Tensor, Tensor]:
    r"""Return the log density of real statistics given parameters.

    .. math::
        p(y \mid \theta) = \int p(s \mid \theta)\, p(y \mid s, \theta)\, ds
        = \sum_c \pi_c\, \mathcal{N}\bigl(y;\, m_c + \mu + \mu(\theta),\,
        S_c + L(\theta) L(\theta)^\top\bigr)

    with :math:`\pi_c, m_c, S_c` the weights, means and covariances of the surrogate at
    theta.

    Args:
        surrogate: What :func:`fit_surrogate` returns.
        errors: The error model.
        y: Standardised real statistics, shape ``(n, l)``.
        theta: Parameters, shape ``(n, d)``.

    Returns:
        The log densities, shape ``(n,)``, and :math:`\mu(\theta)`, shape ``(n, l)``.
    """
    logits, means, covariances = gaussians_of(surrogate, theta)
    mean, of_mean, covariance = errors(theta)
    # Errors that are no numbers any more make the loss no number, and training stops.
    factor, _ = torch.linalg.cholesky_ex(covariances + covariance[:, None].double())
    law = MixtureSameFamily(
        Categorical(logits=logits, validate_args=False),
        MultivariateNormal(
            means + mean[:, None],
            scale_tril=factor,
            validate_args=False,
        ),
        validate_args=False,
    )
    return law.log_prob(y.double()), of_mean
