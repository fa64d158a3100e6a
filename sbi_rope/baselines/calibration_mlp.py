"""A network from real observations to a Gaussian over parameters, without simulator."""

import math
from typing import Any

import torch
from torch import Tensor, nn

from sbi_rope._random import seeded
from sbi_rope._sbi import (
    ConditionalDensityEstimator,
    direct_posterior,
    embedding_of,
    leave_out_constants,
)
from sbi_rope.baselines.networks import embedding_with_head
from sbi_rope.data import split_pairs
from sbi_rope.errors import InvalidInputError
from sbi_rope.fit import History, Training, fit_on_pairs
from sbi_rope.trainers.base import Method
from sbi_rope.trainers.training import EstimatorBuilder, estimator_builder

__all__ = ["CalibrationMLP", "DiagonalGaussian"]

DEFAULT_TRAINING = Training(
    training_batch_size=100,
    learning_rate=3e-4,
    validation_fraction=0.2,
    stop_after_epochs=200,
    max_num_epochs=2000,
)
# In standard deviations of the prior; a share of the held-out error; pairs.
FARTHEST, FLOOR, PSEUDO_PAIRS = 5.0, 0.1, 2
# Draws that stand in for the range of the prior, and for moments it does not know.
NUM_DRAWS = 10_000


class DiagonalGaussian(ConditionalDensityEstimator):
    r"""A Gaussian with a diagonal covariance whose parameters a network predicts.

    .. math::
        q(\theta \mid x) = \prod_k \mathcal{N}\bigl(\theta_k;\;
        m_k + 5 s_k \tanh(\mu_k(x) / 5),\; s_k^2 (w_k(x) + f_k^2)\bigr),
        \qquad w = \frac{25 e^v}{25 + e^v}

    Mean and standard deviation stay within five standard deviations of the prior. The
    floor f starts at zero, see :meth:`set_floor`, and the mean has no other bounds at
    the start, see :meth:`set_range`.

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

    def set_range(self, theta: Tensor) -> None:
        """Let no mean leave the range of draws from the prior.

        An observation unlike those it was trained on can carry it out of the prior's
        support, where no draw would ever be accepted.
        """
        self.lowest = theta.amin(dim=0).to(self.lowest)
        self.highest = theta.amax(dim=0).to(self.highest)

    @torch.no_grad()
    def set_floor(self, theta: Tensor, x: Tensor) -> None:
        """Let no standard deviation fall below a tenth of the root mean square error.

        Far from what it was trained on, a network can be sure of something wrong
        without bound. The pairs, ``(n, d)`` and ``(n, *event)``, it has not seen.
        """
        error = (theta - self._moments(x)[0]) / self.std
        # As if two more pairs were off by a standard deviation of the prior: a few
        # pairs can be met by chance.
        total = error.square().sum(dim=0) + PSEUDO_PAIRS
        self.floor = FLOOR * (total / (len(x) + PSEUDO_PAIRS)).sqrt()

    def _moments(self, condition: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log standard deviation of theta, each ``(B, d)``."""
        mean, log_variance = self.net(condition).chunk(2, dim=-1)
        mean = FARTHEST * torch.tanh(mean / FARTHEST)
        log_variance = -torch.logaddexp(
            -log_variance, torch.full_like(log_variance, -2 * math.log(FARTHEST))
        )
        log_variance = torch.logaddexp(log_variance, 2 * self.floor.log())
        mean = (self.mean + self.std * mean).clamp(self.lowest, self.highest)
        return mean, self.std.log() + 0.5 * log_variance

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Return the log density, shape ``(S, B)`` or ``(B,)``."""
        mean, log_std = self._moments(condition)
        z = (input - mean) * torch.exp(-log_std)
        return (-0.5 * z**2 - log_std - 0.5 * math.log(2 * math.pi)).sum(dim=-1)

    def sample(
        self, sample_shape: torch.Size, condition: Tensor, **kwargs: Any
    ) -> Tensor:
        """Draw parameters, shape ``(*sample_shape, B, d)``."""
        mean, log_std = self._moments(condition)
        noise = torch.randn(*sample_shape, *mean.shape).to(mean)
        return mean + log_std.exp() * noise

    def loss(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Return the negative log density, shape ``(B,)``."""
        return -self.log_prob(input, condition)


class CalibrationMLP(Method):
    r"""Regression from real observations to a diagonal Gaussian, without simulations.

    .. math::
        \min_{\mu, \sigma}\; \sum_i -\log \mathcal{N}\bigl(\theta_i;\, \mu(x_{o,i}),\,
        \operatorname{diag} \sigma^2(x_{o,i})\bigr)

    The network is the embedding net of the density estimator, its parameters drawn
    anew, with linear outputs for mean and log-variance; where the estimator has no
    embedding net, one with two hidden layers of 64 units. Parameters are standardised
    by the prior. A part of the pairs is held out and the best network on them is kept.
    No standard deviation is below a tenth of the root mean square error on them, and no
    mean is outside the range of the prior. Entries of x that are the same in all pairs
    are left out.

    Sees the calibration set alone. Assumes nothing of the simulator and that the
    posterior is about Gaussian. Says what the labels are worth without a simulator: a
    method that uses one and does worse is not worth its simulations.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
          Calibration (Wehenkel et al., 2025), section 4, Baselines
        | https://arxiv.org/abs/2405.08719

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``.
        density_estimator: A name, or what sbi's ``posterior_nn(...)`` returns; only its
            embedding net and its standardisation of x are used.
        training: How it is trained; at most 2000 epochs in batches of 100 at a learning
            rate of 3e-4, and 200 without improvement, if None.
        device: Where to train; data on other devices is moved there.

    Raises:
        InvalidInputError: In ``train``, if there is one pair only.
    """

    sees = frozenset({"calibration"})

    def __init__(
        self,
        prior: Any,
        density_estimator: str | EstimatorBuilder = "nsf",
        *,
        training: Training | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        super().__init__(prior, device=device)
        self._build = estimator_builder(density_estimator)
        self.training = training or DEFAULT_TRAINING

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        theta, x = self._data.calibration
        if len(x) < 2:
            raise InvalidInputError(
                "Expected at least 2 calibration pairs, by which x is standardised; "
                "got 1."
            )
        train, held_out = split_pairs(theta, self.training.validation_fraction)
        estimator = self._gaussian(theta[train], x[train]).to(self._device)
        history = fit_on_pairs(
            estimator,
            theta,
            x,
            (train, held_out),
            training=self.training,
            in_training_mode=True,
            label="MLP",
            show_progress_bars=show_progress_bars,
        )
        unseen = held_out if len(held_out) else train
        estimator.set_floor(theta[unseen], x[unseen])
        estimator.set_range(self._prior_draws())
        return direct_posterior(estimator, self._prior), history

    def _gaussian(self, theta: Tensor, x: Tensor) -> DiagonalGaussian:
        theta, x = theta.cpu(), x.cpu()
        embedding = embedding_of(self._build(theta, x))
        leave_out_constants(embedding)
        net = embedding_with_head(embedding, 2 * theta.shape[1], x)
        mean, std = self._prior.mean.cpu(), self._prior.stddev.cpu()
        return DiagonalGaussian(net, mean, std, x.shape[1:])

    def _prior_draws(self) -> Tensor:
        with seeded(0):
            return self._prior.sample(torch.Size((NUM_DRAWS,)))
