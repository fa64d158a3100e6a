"""NPE fine-tuned on the calibration pairs (multi-fidelity NPE)."""

import copy
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from sbi_rope._groups import MIN_PAIRS_FOR_HOLDOUT, groups_of, split_groups, split_pairs
from sbi_rope._sbi import (
    ConditionalDensityEstimator,
    check_density,
    embedding_of,
    estimator_of,
    posterior_from,
    with_embedding,
)
from sbi_rope._standardisation import warn_of_far_entries
from sbi_rope._training import History, best_of_learning_rates
from sbi_rope.errors import InvalidInputError
from sbi_rope.mixture import (
    MixtureEstimator,
    MixturePosterior,
    OwnEmbeddings,
    part_of,
)
from sbi_rope.settings import Count, check
from sbi_rope.trainers.base import Method
from sbi_rope.trainers.starting_npe import StartingNPE
from sbi_rope.trainers.training import (
    FINETUNING,
    EstimatorBuilder,
    Training,
    train_on_pairs,
)

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["FinetunedNPE"]


class FinetunedNPE(Method):
    r"""NPE trained on simulations, then as a whole on the calibration pairs.

    .. math::
        \min_{q, h}\; \tfrac1{n_c} \sum_i -\log q(\theta_i \mid h(x_{o,i}))
        \quad\text{starting from the } q, h \text{ of NPE}

    All parameters, of the embedding net and of the density, are tuned in evaluation
    mode (no dropout, fixed batch statistics). A part of the pairs is held out; of
    several learning rates and of all epochs the best on them is kept, the starting
    point included.

    With ``num_holdouts`` = K above one this is done K times, each with another part of
    the pairs held out, and the posterior is the average of the K networks,

    .. math:: p(\theta \mid x) = \tfrac1K \sum_k q_k(\theta \mid h_k(x)) .

    Networks that few pairs have led astray are not astray in the same way, so that an
    average of five is better than each of them, and better calibrated.
    It is a :class:`~sbi_rope.MixturePosterior`, which is divided by its mass
    inside the prior's support, and says so with an error where there is none.

    Sees simulations and the calibration set. Assumes that what NPE has learnt is a good
    start. To be preferred from some 200 pairs on, where it is among the
    strongest of the cheap methods; with 10 it can be worse than the prior. The
    posterior of :class:`~sbi_rope.discrepancy.DiscrepancyNPE` is a better start than
    that of NPE: pass it to :meth:`from_posterior`.

    References:
        | Multifidelity Simulation-based Inference for Computationally Expensive
          Simulators (Krouglova et al., 2025)
        | https://arxiv.org/abs/2502.08416

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``.
        density_estimator: A name, or what sbi's ``posterior_nn(...)`` returns. An
            embedding net inside it is copied, never trained in place.
        num_holdouts: How often it is tuned. With one, ``validation_fraction`` of the
            pairs are held out. With K, the pairs are cut into K parts and each is held
            out once; if they have fewer than K different parameters there are as many
            parts as these. With fewer than five different parameters none is held out,
            and it is tuned once.
        npe_training: How NPE is trained; ``Training()`` if None.
        training: How it is tuned, apart from the learning rate; at most 500 epochs in
            batches of 100, and 50 without improvement, if None.
        learning_rates: Each is tried from the start; the smallest is taken if there are
            too few pairs to hold some out.
        device: Where to train; data on other devices is moved there.

    Raises:
        InvalidInputError: If an argument is of the wrong kind.
        UnsupportedPosteriorError: In ``train``, if the estimator has no density.
    """

    sees = frozenset({"simulations", "calibration"})
    starts_from_npe = True

    def __init__(
        self,
        prior: Any,
        density_estimator: str | EstimatorBuilder = "nsf",
        *,
        num_holdouts: int = 1,
        npe_training: Training | None = None,
        training: Training | None = None,
        learning_rates: tuple[float, ...] = (1e-4, 1e-3),
        device: str | torch.device = "cpu",
    ) -> None:
        check("num_holdouts", num_holdouts, Count)
        check("training", training, Training | None)
        npe = StartingNPE(density_estimator, npe_training)
        super().__init__(prior, npe=npe, device=device)
        self.num_holdouts = num_holdouts
        self.training = FINETUNING if training is None else training
        self.learning_rates = learning_rates
        self._starts: list[ConditionalDensityEstimator] = []
        self._other_histories: tuple[History, ...] = ()

    @classmethod
    def from_posterior(cls, posterior: Any, **options: Any) -> "Self":
        """Start from a trained NPE instead of training one.

        Args:
            posterior: What ``NPE(...).build_posterior()`` of sbi returns, or
                ``DiscrepancyNPE(...).build_posterior()``. It is copied and never
                changed. That of ``DiscrepancyNPE(space="tuned")`` averages over K
                embedding nets: network k starts from the one with net k, and
                ``num_holdouts`` is K.
            **options: Keyword arguments of the constructor, except for ``device`` and
                what concerns the training of NPE.

        Raises:
            UnsupportedPosteriorError: If it is none of these.
            InvalidInputError: If ``num_holdouts`` is not the number of embedding nets.
        """
        starts = _averaged(posterior)
        if not starts:
            return super().from_posterior(posterior, **options)
        if options.setdefault("num_holdouts", len(starts)) != len(starts):
            raise InvalidInputError(
                f"Expected `num_holdouts` of {len(starts)}, one for each embedding net "
                f"of the posterior; got {options['num_holdouts']!r}. Leave it out."
            )
        first = posterior_from(posterior, starts[0])
        method = super().from_posterior(first, **options)
        method._starts = copy.deepcopy(starts)
        method._data.theta_names = getattr(posterior, "parameter_names", None)
        method._data.x_names = getattr(posterior, "x_names", None)
        return method

    @property
    def history(self) -> History:
        """The losses of the last training; of several networks, those of the first."""
        return super().history

    @property
    def histories(self) -> tuple[History, ...]:
        """The losses of the last training, of each network."""
        return (self.history, *self._other_histories)

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        npe, _ = self._trained_npe(show_progress_bars=show_progress_bars)
        starts = self._starts or [estimator_of(npe)]
        warn_of_far_entries("x", self._data.calibration[1], embedding_of(starts[0]))
        splits = self._splits()
        # There is one start for all splits, or as many as splits. Where pairs are too
        # few for that, splits are used again.
        tuned = [
            self._tuned(
                starts[k % len(starts)],
                splits[k % len(splits)],
                show_progress_bars=show_progress_bars,
            )
            for k in range(max(len(starts), len(splits)))
        ]
        (estimator, history), *others = tuned
        self._other_histories = tuple(history for _, history in others)
        if self.num_holdouts == 1:
            return posterior_from(npe, estimator), history
        average = MixtureEstimator(
            [part_of(estimator) for estimator, _ in tuned],
            [1.0 / len(tuned)] * len(tuned),
        )
        return MixturePosterior(average, copy.deepcopy(self._prior)), history

    def _splits(self) -> list[tuple[Tensor, Tensor]]:
        """Return the rows to train on and those held out, for each network."""
        theta, _ = self._data.calibration
        groups = groups_of(theta)
        if self.num_holdouts == 1 or int(groups.max()) + 1 < MIN_PAIRS_FOR_HOLDOUT:
            return [split_pairs(theta, self.training.validation_fraction)]
        every = torch.arange(len(groups))
        parts = split_groups(groups, self.num_holdouts)
        return [(every[~torch.isin(every, rows)], rows) for rows in parts]

    def _tuned(
        self,
        start: Any,
        split: tuple[Tensor, Tensor],
        *,
        show_progress_bars: bool,
    ) -> tuple[ConditionalDensityEstimator, History]:
        """Tune a copy with each learning rate, and keep the best on the hold-out."""
        check_density(start)

        def tuned(
            learning_rate: float,
        ) -> tuple[ConditionalDensityEstimator, History]:
            estimator = copy.deepcopy(start).requires_grad_()
            history = train_on_pairs(
                estimator,
                *self._data.calibration,
                split,
                training=replace(self.training, learning_rate=learning_rate),
                in_training_mode=False,
                label="Fine-tuning NPE",
                show_progress_bars=show_progress_bars,
            )
            return estimator, history

        return best_of_learning_rates(
            tuned,
            self.learning_rates,
            num_held_out=len(split[1]),
            otherwise=min(self.learning_rates),
        )


def _averaged(posterior: Any) -> list[ConditionalDensityEstimator]:
    """Return the estimators that a posterior averages over; none if it is no average.

    They share the density.
    """
    if not isinstance(posterior, MixturePosterior):
        return []
    part, *others = posterior.posterior_estimator.parts
    if others or not isinstance(part.mixing, OwnEmbeddings):
        return []
    shape = part.mixing.event_shape
    return [
        with_embedding(part.density, net, condition_shape=shape)
        for net in part.mixing.nets
    ]
