"""NPE fine-tuned on the calibration pairs (multi-fidelity NPE)."""

import copy
from dataclasses import replace
from typing import Any

import torch

from sbi_rope._sbi import (
    ConditionalDensityEstimator,
    estimator_of,
    posterior_from,
)
from sbi_rope._training import History, split_pairs
from sbi_rope._validation import check_instance, check_positive
from sbi_rope.baselines.base import BuildsOnNPE, UsesCalibration
from sbi_rope.baselines.training import EstimatorBuilder, Training, train_on_pairs
from sbi_rope.errors import InvalidInputError, UnsupportedPosteriorError

__all__ = ["FinetunedNPE"]

DEFAULT_TRAINING = Training(
    training_batch_size=100,
    validation_fraction=0.2,
    stop_after_epochs=50,
    max_num_epochs=500,
)


class FinetunedNPE(BuildsOnNPE, UsesCalibration):
    r"""NPE trained on simulations, then as a whole on the calibration pairs.

    .. math::
        \min_{q, h}\; \tfrac1{n_c} \sum_i -\log q(\theta_i \mid h(x_{o,i}))
        \quad\text{starting from the } q, h \text{ of NPE}

    All parameters, of the embedding net and of the density, are tuned in evaluation
    mode (no dropout, fixed batch statistics). A part of the pairs is held out; of
    several learning rates and of all epochs the best on them is kept, the starting
    point included.

    Sees simulations and the calibration set. Assumes that what NPE has learnt is a good
    start. To be preferred from some 200 pairs on, where it is among the
    strongest of the cheap methods; with 10 it can be worse than the prior.

    References:
        | Multifidelity Simulation-based Inference for Computationally Expensive
          Simulators (Krouglova et al., 2025)
        | https://arxiv.org/abs/2502.08416

    Args:
        prior: A torch distribution over parameters of shape ``(k,)``.
        density_estimator: A name, or what sbi's ``posterior_nn(...)`` returns. An
            embedding net inside it is copied, never trained in place.
        npe_training: How NPE is trained; ``Training()`` if None.
        training: How it is tuned, apart from the learning rate; at most 500 epochs in
            batches of 100, and 50 without improvement, if None.
        learning_rates: Each is tried from the start; the smallest is taken if there are
            too few pairs to hold some out.
        device: Where to train; data on other devices is moved there.

    Raises:
        InvalidTypeError: If an argument has the wrong type.
        InvalidInputError: If sbi knows no estimator of that name, or a learning rate is
            not positive.
        UnsupportedPosteriorError: In ``train``, if the estimator has no density.
    """

    def __init__(
        self,
        prior: Any,
        density_estimator: str | EstimatorBuilder = "nsf",
        *,
        npe_training: Training | None = None,
        training: Training | None = None,
        learning_rates: tuple[float, ...] = (1e-4, 1e-3),
        device: str | torch.device = "cpu",
    ) -> None:
        check_instance("training", training, Training, optional=True)
        check_instance("learning_rates", learning_rates, tuple)
        if not learning_rates:
            raise InvalidInputError(
                "Expected at least one of `learning_rates`; got ()."
            )
        for rate in learning_rates:
            check_positive("learning_rates", rate)
        super().__init__(
            prior, density_estimator, npe_training=npe_training, device=device
        )
        self.training = DEFAULT_TRAINING if training is None else training
        self.learning_rates = learning_rates

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        npe, _ = self._trained_npe(show_progress_bars=show_progress_bars)
        start = estimator_of(npe)
        if not isinstance(start, ConditionalDensityEstimator):
            raise UnsupportedPosteriorError(
                "Expected an estimator with a density to tune by; got "
                f"{type(start).__name__}. Use NPE instead of FMPE or NPSE."
            )
        theta, x = self._calibration
        split = split_pairs(theta, self.training.validation_fraction)
        has_holdout = len(split[1]) > 0
        rates = self.learning_rates if has_holdout else (min(self.learning_rates),)
        results = []
        for rate in rates:
            estimator = copy.deepcopy(start).requires_grad_()
            history = train_on_pairs(
                estimator,
                theta,
                x,
                split,
                training=replace(self.training, learning_rate=rate),
                in_training_mode=False,
                label="Fine-tuning NPE",
                show_progress_bars=show_progress_bars,
            )
            results.append((estimator, history))
        estimator, history = min(results, key=lambda r: r[1].kept_validation_loss)
        return posterior_from(npe, estimator), history
