"""A network from real observations to a Gaussian over parameters, without simulator."""

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.distributions import Independent, Normal

from sbi_rope.baselines.networks import embedding_with_head, fit_rows
from sbi_rope.data.pairs import split_pairs
from sbi_rope.methods.base import Method
from sbi_rope.npe.sbi import (
    ConditionalDensityEstimator,
    direct_posterior,
    embedding_of,
    leave_out_constants,
)
from sbi_rope.training.fit import History, Training
from sbi_rope.utils.seeds import seeded

# In standard deviations of the prior; a share of the held-out error; pairs.
FARTHEST, FLOOR, PSEUDO_PAIRS = 5.0, 0.1, 2
# Draws that stand in for the range of the prior.
NUM_DRAWS = 10_000


class DiagonalGaussian(ConditionalDensityEstimator):
    r"""A Gaussian with a diagonal covariance whose parameters a network predicts.

    .. math::
        q(\theta \mid x) = \prod_k \mathcal{N}\bigl(\theta_k;\;
        m_k + 5 s_k \tanh(\mu_k(x) / 5),\; s_k^2 (w_k(x) + f_k^2)\bigr),
        \qquad w = \frac{25 e^v}{25 + e^v}

    Mean and standard deviation stay within five standard deviations of the prior. The
    floor f is zero until :meth:`set_bounds`.

    Args:
        net: Maps observations ``(n, *event)`` to means and log-variances ``(n, 2 d)``
            of theta in units of ``std`` about ``mean``.
        mean: m, shape ``(d,)``.
        std: s, shape ``(d,)``.
        condition_shape: Shape of one observation.
    """

    mean: Tensor
    std: Tensor
    floor: Tensor
    lowest: Tensor
    highest: Tensor

    def __init__(
        self, net: nn.Module, mean: Tensor, std: Tensor, condition_shape: torch.Size
    ) -> None:
        super().__init__(net, mean.shape, condition_shape)
        self.register_buffer("mean", mean)
        self.register_buffer("std", std)
        self.register_buffer("floor", torch.zeros_like(std))
        self.register_buffer("lowest", torch.full_like(mean, -torch.inf))
        self.register_buffer("highest", torch.full_like(mean, torch.inf))

    @torch.no_grad()
    def set_bounds(self, theta: Tensor, x: Tensor, draws: Tensor) -> None:
        """Bound the mean by draws of the prior, and the deviation by held-out errors.

        Far from what it was trained on, a network can be sure of something wrong, and
        its mean can leave the prior's support, where no draw would ever be accepted.
        """
        error = (theta - self.law(x).mean) / self.std
        # As if two more pairs were off by a standard deviation of the prior: a few
        # pairs can be met by chance.
        total = error.square().sum(dim=0) + PSEUDO_PAIRS
        self.floor = FLOOR * (total / (len(x) + PSEUDO_PAIRS)).sqrt()
        self.lowest, self.highest = draws.amin(dim=0), draws.amax(dim=0)

    def law(self, x: Tensor) -> Any:
        """Return the Gaussians of observations ``(B, *event)``."""
        mean, log_variance = self.net(x).chunk(2, dim=-1)
        mean = self.mean + self.std * FARTHEST * torch.tanh(mean / FARTHEST)
        most = torch.full_like(log_variance, 2 * math.log(FARTHEST))
        log_variance = -torch.logaddexp(-log_variance, -most)
        log_variance = torch.logaddexp(log_variance, 2 * self.floor.log())
        mean = mean.clamp(self.lowest, self.highest)
        std = self.std * (0.5 * log_variance).exp()
        return Independent(Normal(mean, std, validate_args=False), 1)

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Return the log density, shape ``(S, B)`` or ``(B,)``."""
        return self.law(condition).log_prob(input)

    def sample(
        self, sample_shape: torch.Size, condition: Tensor, **kwargs: Any
    ) -> Tensor:
        """Draw parameters, shape ``(*sample_shape, B, d)``."""
        return self.law(condition).sample(sample_shape)

    def loss(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Return the negative log density, shape ``(B,)``."""
        return -self.log_prob(input, condition)


class CalibrationMLP(Method):
    r"""Regression from real observations to a diagonal Gaussian, without simulations.

    .. math::
        \min_{\mu, \sigma}\; \sum_i -\log \mathcal{N}\bigl(\theta_i;\, \mu(x_{o,i}),\,
        \operatorname{diag} \sigma^2(x_{o,i})\bigr)

    The network is the embedding net of the density estimator, its parameters drawn
    anew, with linear outputs for mean and log-variance. Where the estimator has no
    embedding net, it has two hidden layers of 64 units. The network that is best on a
    hold-out set is kept. Entries of x that are the same in all pairs are left out.

    It sees the calibration set alone, and assumes that the posterior is about Gaussian.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
          Calibration (Wehenkel et al., 2025), section 4, Baselines
        | https://arxiv.org/abs/2405.08719

    Args:
        prior, device: See :class:`~sbi_rope.methods.Method`.
        density_estimator: A name, or what sbi's ``posterior_nn(...)`` returns; only its
            embedding net and its standardisation of x are used.
        training: At most 2000 epochs in batches of 100 at a learning rate of 3e-4, and
            200 without improvement, if None.
    """

    sees = frozenset({"calibration"})
    min_pairs = 2  # by which x is standardised
    default_training = Training(
        training_batch_size=100,
        learning_rate=3e-4,
        validation_fraction=0.2,
        stop_after_epochs=200,
        max_num_epochs=2000,
    )

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        theta, x = self._data.calibration
        train, held_out = split_pairs(theta, self.training.validation_fraction)
        seen = x[train].cpu()
        embedding = embedding_of(self._build(theta[train].cpu(), seen))
        leave_out_constants(embedding)
        net = embedding_with_head(embedding, 2 * theta.shape[1], seen)
        mean, std = self._prior.mean.cpu(), self._prior.stddev.cpu()
        estimator = DiagonalGaussian(net, mean, std, x.shape[1:]).to(self._device)
        history = fit_rows(
            estimator,
            lambda rows: estimator.loss(theta[rows], x[rows]).mean(),
            (train, held_out),
            self.training,
            pairs=theta,
            label="MLP",
            show_progress_bars=show_progress_bars,
        )
        unseen = held_out if len(held_out) else train
        with seeded(0):
            draws = self._prior.sample((NUM_DRAWS,))
        estimator.set_bounds(theta[unseen], x[unseen], draws)
        return direct_posterior(estimator, self._prior), history
