"""NPE fine-tuned on the calibration pairs (multi-fidelity NPE)."""

from typing import Any

import torch

from sbi_rope.data.pairs import (
    MIN_PAIRS_FOR_HOLDOUT,
    Nodes,
    epochs_on_pairs,
    split_pairs,
)
from sbi_rope.density import Flow, MixturePosterior
from sbi_rope.methods.base import Method
from sbi_rope.methods.training import EstimatorBuilder
from sbi_rope.npe.sbi import check_density, embedding_of, estimator_of, posterior_from
from sbi_rope.npe.standardisation import warn_of_far_entries
from sbi_rope.rope.finetuning import FINETUNING, best_rates, finetune_flow
from sbi_rope.training.fit import History
from sbi_rope.utils.settings import Count, check


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
    with 10 it can be worse than the prior. The posterior of ``DiscrepancyNPE`` is
    a better start than that of NPE: pass it to ``from_posterior``.

    References:
        | Multifidelity Simulation-based Inference for Computationally Expensive
          Simulators (Krouglova et al., 2025)
        | https://arxiv.org/abs/2502.08416

    Args:
        prior, density_estimator, npe_training, device: See ``Method``.
        num_holdouts: How often it is tuned. With one, ``validation_fraction`` of the
            pairs are held out. With K, the pairs are cut into K parts and each is held
            out once. With fewer than five groups none is held out.
        learning_rates: Each is tried from the start; the smallest is taken if there are
            too few pairs to hold some out.
        training: How it is tuned, apart from the learning rate; at most 500 epochs in
            batches of 100, and 50 without improvement, if None.

    Attributes:
        histories: The losses of the last training, of each network.
    """

    sees = frozenset({"simulations", "calibration"})
    starts_from_npe = True
    default_training = FINETUNING

    def __init__(
        self,
        prior: Any,
        density_estimator: str | EstimatorBuilder = "nsf",
        *,
        num_holdouts: int = 1,
        learning_rates: tuple[float, ...] = (1e-4, 1e-3),
        **options: Any,
    ) -> None:
        check("num_holdouts", num_holdouts, Count)
        super().__init__(prior, density_estimator, **options)
        self.num_holdouts, self.learning_rates = num_holdouts, learning_rates
        self.histories: tuple[History, ...] = ()

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        npe, _ = self._trained_npe(show_progress_bars=show_progress_bars)
        start, pairs = check_density(estimator_of(npe)), self._data.pairs
        theta, x = self._data.calibration
        warn_of_far_entries("x", x, embedding_of(start))
        if self.num_holdouts == 1 or pairs.num_groups < MIN_PAIRS_FOR_HOLDOUT:
            parts = split_pairs(pairs.group, self.training.validation_fraction)
            splits = [(parts[0].to(pairs.group), parts[1].to(pairs.group))]
        else:
            every = torch.arange(len(pairs)).to(pairs.group)
            folds = pairs.folds(self.num_holdouts)
            splits = [(every[~torch.isin(every, rows)], rows) for rows in folds]
        held_out, rates = splits[0][1], self.learning_rates
        if not len(held_out):
            rates = (min(rates),)
        jobs = [split for split in splits for _ in rates]
        flow = Flow.of([start]).made_of([(0, 0)] * len(jobs))
        histories = finetune_flow(
            flow,
            [Nodes.exact(theta)] * len(jobs),
            x,
            jobs,
            training=self.training,
            learning_rates=rates * len(splits),
            max_num_epochs=epochs_on_pairs(
                theta, held_out, self.training.max_num_epochs
            ),
            show_progress_bars=show_progress_bars,
        )
        best = best_rates(histories, len(rates))
        self.histories = tuple(histories[k] for k in best)
        if self.num_holdouts == 1:
            tuned = posterior_from(npe, flow[best].estimator(start))
        else:
            tuned = MixturePosterior(flow[best], self._prior)
        return tuned, self.histories[0]
