"""NPE on simulations and calibration pairs together (J-NPE)."""

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from sbi_rope._sbi import direct_posterior, embedding_of
from sbi_rope._standardisation import warn_of_far_entries
from sbi_rope.data import split_pairs, too_few_pairs
from sbi_rope.errors import warn_user
from sbi_rope.fit import History, Training, fit
from sbi_rope.trainers.base import Method
from sbi_rope.trainers.training import EstimatorBuilder, estimator_builder

__all__ = ["JointNPE"]

DEFAULT_TRAINING = Training(validation_fraction=0.2)


class JointNPE(Method):
    r"""NPE whose batches are half simulations, half calibration pairs (J-NPE).

    .. math::
        \min_q\; \tfrac12 \mathbb{E}_{p(\theta, x_s)}\bigl[-\log q(\theta \mid
        h(x_s))\bigr] + \tfrac12 \tfrac1{n_c} \sum_i -\log q(\theta_i \mid h(x_{o,i}))

    An epoch is one pass over the simulations; the calibration pairs beside them are
    drawn with replacement. A part of the calibration pairs is held out and the network
    that does best on it is kept; below five pairs the held-out data are simulations.

    Sees simulations and the calibration set. Assumes nothing about the misspecification
    and so has to learn it from the pairs alone, which takes hundreds of them.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
          Calibration (Wehenkel et al., 2025), section 4, Baselines
        | https://arxiv.org/abs/2405.08719

    Args:
        prior, density_estimator, device: See :class:`Method`.
        training: How it is trained; the held-out share is that of the calibration
            pairs. ``Training(validation_fraction=0.2)`` if None.
    """

    sees = frozenset({"simulations", "calibration"})

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
        theta, x = self._data.simulations
        theta_cal, x_cal = self._data.calibration
        train, held_out = split_pairs(theta_cal, self.training.validation_fraction)
        theta_held, x_held = theta_cal[held_out], x_cal[held_out]
        if not len(held_out):
            # Nothing real to choose by; simulations at least say when to stop.
            warn_user(
                f"{too_few_pairs(theta_cal)}: none is held out, and the best network "
                "is chosen on simulations."
            )
            rows, held_out = split_pairs(theta, self.training.validation_fraction)
            theta_held, x_held = theta[held_out], x[held_out]
            theta, x = theta[rows], x[rows]
        # As in NPE, the simulations alone say how x and theta are standardised.
        estimator = self._build(theta.cpu(), x.cpu()).to(self._device)
        warn_of_far_entries("x", x_cal, embedding_of(estimator))
        half = max(1, min(self.training.training_batch_size // 2, len(x)))

        def batches(step: int) -> Iterator[tuple[Tensor, Tensor]]:
            order = torch.randperm(len(x))
            for chosen in order[: len(x) - len(x) % half].split(half):
                pairs = train[torch.randint(len(train), (half,))]
                yield (
                    torch.cat([theta[chosen], theta_cal[pairs]]),
                    torch.cat([x[chosen], x_cal[pairs]]),
                )

        def loss(theta: Tensor, x: Tensor) -> Tensor:
            return estimator.loss(theta, condition=x).mean()

        [history] = fit(
            estimator,
            batches,
            loss,
            self.training,
            validation_loss=lambda: loss(theta_held, x_held),
            label="J-NPE",
            show_progress_bars=show_progress_bars,
        )
        return direct_posterior(estimator, self._prior), history
