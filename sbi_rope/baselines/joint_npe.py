"""NPE on simulations and calibration pairs together (J-NPE)."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from sbi_rope.baselines.networks import fit_rows
from sbi_rope.data.pairs import split_pairs
from sbi_rope.methods.base import Method
from sbi_rope.npe.sbi import direct_posterior, embedding_of
from sbi_rope.npe.standardisation import warn_of_far_entries
from sbi_rope.training.fit import History, Training


class JointNPE(Method):
    r"""NPE whose batches are half simulations, half calibration pairs (J-NPE).

    .. math::
        \min_q\; \tfrac12 \mathbb{E}_{p(\theta, x_s)}\bigl[-\log q(\theta \mid
        h(x_s))\bigr] + \tfrac12 \tfrac1{n_c} \sum_i -\log q(\theta_i \mid h(x_{o,i}))

    An epoch is one pass over the simulations; the calibration pairs beside them are
    drawn with replacement. A part of the calibration pairs is held out and the network
    that does best on it is kept; of fewer than five pairs none is held out.

    It sees simulations and the calibration set. It assumes nothing about the
    misspecification and so has to learn it from the pairs alone, which takes hundreds
    of them.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
          Calibration (Wehenkel et al., 2025), section 4, Baselines
        | https://arxiv.org/abs/2405.08719

    Args:
        prior, density_estimator, device: See :class:`~sbi_rope.methods.Method`.
        training: How it is trained; the held-out share is that of the calibration
            pairs. ``Training(validation_fraction=0.2)`` if None.
    """

    sees = frozenset({"simulations", "calibration"})
    default_training = Training(validation_fraction=0.2)

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        theta, x = self._data.simulations
        theta_cal, x_cal = self._data.calibration
        train, held_out = split_pairs(theta_cal, self.training.validation_fraction)
        # As in NPE, the simulations alone say how x and theta are standardised.
        estimator = self._build(theta.cpu(), x.cpu()).to(self._device)
        warn_of_far_entries("x", x_cal, embedding_of(estimator))

        def loss_of(theta: Tensor, x: Tensor) -> Tensor:
            return estimator.loss(theta, condition=x).mean()

        def loss(rows: Tensor) -> Tensor:
            beside = train[torch.randint(len(train), (len(rows),))]
            return loss_of(
                torch.cat([theta[rows], theta_cal[beside]]),
                torch.cat([x[rows], x_cal[beside]]),
            )

        half = max(1, self.training.training_batch_size // 2)
        history = fit_rows(
            estimator,
            loss,
            (torch.arange(len(x)), held_out),
            replace(self.training, training_batch_size=half),
            validation_loss=lambda pairs: loss_of(theta_cal[pairs], x_cal[pairs]),
            pairs=theta_cal,
            label="J-NPE",
            show_progress_bars=show_progress_bars,
        )
        return direct_posterior(estimator, self._prior), history
