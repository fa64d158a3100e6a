"""NPE fine-tuned on the calibration pairs (multi-fidelity NPE)."""

import copy
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from sbi_rope.data.pairs import MIN_PAIRS_FOR_HOLDOUT, Nodes, epochs_on_pairs
from sbi_rope.density import Flow, MixturePosterior
from sbi_rope.methods.base import Method
from sbi_rope.methods.training import EstimatorBuilder
from sbi_rope.npe.sbi import check_density, estimator_of, posterior_from
from sbi_rope.npe.standardisation import warn_of_far_entries
from sbi_rope.rope.finetuning import FINETUNING, best_rates, finetune_flow
from sbi_rope.training.fit import History, Training
from sbi_rope.utils.errors import InvalidInputError
from sbi_rope.utils.settings import Count, check

if TYPE_CHECKING:
    from typing_extensions import Self


class FinetunedNPE(Method):
    r"""NPE trained on simulations, then as a whole on the calibration pairs.

    .. math::
        \min_{q, h}\; \tfrac1{n_c} \sum_i -\log q(\theta_i \mid h(x_{o,i}))
        \quad\text{starting from the } q, h \text{ of NPE}

    All parameters, of the embedding net and of the density, are tuned in evaluation
    mode (no dropout, fixed batch statistics). A part of the pairs is held out; of
    several learning rates and of all epochs, the start included, the best is kept.

    With ``num_holdouts`` = K above one this is done K times, each with another part of
    the pairs held out, and the posterior is the average of the K networks,

    .. math:: p(\theta \mid x) = \tfrac1K \sum_k q_k(\theta \mid h_k(x)) ,

    which is better than each of them, and better calibrated.

    Sees simulations and the calibration set. To be preferred from some 200 pairs on;
    with 10 it can be worse than the prior. The posterior of
    :class:`~sbi_rope.discrepancy.DiscrepancyNPE` is a better start than that of NPE:
    pass it to :meth:`from_posterior`.

    References:
        | Multifidelity Simulation-based Inference for Computationally Expensive
          Simulators (Krouglova et al., 2025)
        | https://arxiv.org/abs/2502.08416

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``.
        density_estimator: A name, or what sbi's ``posterior_nn(...)`` returns. An
            embedding net inside it is copied, never trained in place.
        num_holdouts: How often it is tuned. With one, ``validation_fraction`` of the
            pairs are held out. With K, the pairs are cut into K parts (at most as many
            as there are groups) and each is held out once. With fewer than five groups
            none is held out, and it is tuned once.
        npe_training: How NPE is trained; ``Training()`` if None.
        training: How it is tuned, apart from the learning rate; at most 500 epochs in
            batches of 100, and 50 without improvement, if None.
        learning_rates: Each is tried from the start; the smallest is taken if there are
            too few pairs to hold some out.
        device: Where to train; data on other devices is moved there.

    Attributes:
        histories: The losses of the last training, of each network.

    Raises:
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
        super().__init__(prior, density_estimator, npe_training, device=device)
        self.num_holdouts = num_holdouts
        self.training = FINETUNING if training is None else training
        self.learning_rates = learning_rates
        self._start: Flow | None = None
        self.histories: tuple[History, ...] = ()

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
        """
        flow = getattr(posterior, "posterior_estimator", None)
        if not isinstance(flow, Flow):
            return super().from_posterior(posterior, **options)
        count = flow.num_members
        if options.setdefault("num_holdouts", count) != count:
            raise InvalidInputError(
                f"Expected `num_holdouts` of {count}, one for each embedding net of "
                f"the posterior; got {options['num_holdouts']!r}. Leave it out."
            )
        first = posterior_from(posterior, flow[[0]].estimator())
        method = super().from_posterior(first, **options)
        method._start = copy.deepcopy(flow)
        method._data.theta_names = getattr(posterior, "parameter_names", None)
        method._data.x_names = getattr(posterior, "x_names", None)
        return method

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        npe, _ = self._trained_npe(show_progress_bars=show_progress_bars)
        own = check_density(estimator_of(npe))
        start = Flow.of([own]) if self._start is None else self._start
        theta, x = self._data.calibration
        warn_of_far_entries("x", x, start)
        splits, training = self._splits(), self.training
        # There is one start for all splits, or as many as splits. Where pairs are too
        # few for that, splits are used again.
        count = max(start.num_members, len(splits))
        splits = [splits[k % len(splits)] for k in range(count)]
        max_num_epochs = epochs_on_pairs(theta, splits[0][1], training.max_num_epochs)
        rates = self.learning_rates if len(splits[0][1]) else [min(self.learning_rates)]
        members = [k for k in range(count) for _ in rates]
        sizes = len(start.nets), len(start.densities)
        flow = start.made_of([(k % sizes[0], k % sizes[1]) for k in members])
        histories = finetune_flow(
            flow,
            [Nodes.exact(theta)] * len(members),
            x,
            [split for split in splits for _ in rates],
            training=training,
            learning_rates=list(rates) * count,
            max_num_epochs=max_num_epochs,
            show_progress_bars=show_progress_bars,
        )
        best = best_rates(histories, len(rates))
        self.histories = tuple(histories[k] for k in best)
        history = self.histories[0]
        if self.num_holdouts == 1:
            return posterior_from(npe, flow[best].estimator(own)), history
        return MixturePosterior(flow[best], self._prior), history

    def _splits(self) -> list[tuple[Tensor, Tensor]]:
        """Return the rows to train on and those held out, for each network."""
        pairs = self._data.pairs
        if self.num_holdouts == 1 or pairs.num_groups < MIN_PAIRS_FOR_HOLDOUT:
            return [pairs.split(self.training.validation_fraction)]
        every = torch.arange(len(pairs)).to(pairs.group)
        folds = pairs.folds(self.num_holdouts)
        return [(every[~torch.isin(every, rows)], rows) for rows in folds]
