"""Fine-tune NPE on the pairs of a fold, but for a part that is held out."""

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from sbi_rope._labels import Nodes
from sbi_rope._sbi import embedding_of, headless
from sbi_rope._training import History, best_of_learning_rates, shuffled
from sbi_rope.stacking.workbench import Fold
from sbi_rope.trainers.training import FINETUNING, rows_with_density, train_network

__all__ = ["finetune_without"]

# Of training with rehearsal: pairs in a batch, as many simulations as pairs, and steps
# in an epoch, after each of which the held-out part is scored.
BATCH_SIZE, STEPS = 50, 100
# It stops after so many epochs without improvement. No other number was tried. What it
# gains on calibration data is in benchmarks/choices.md.
REHEARSED = replace(FINETUNING, stop_after_epochs=10)


def finetune_without(
    start: Any,
    fold: Fold,
    part: int,
    *,
    learning_rates: Sequence[float],
    rehearse: bool = False,
) -> Any:
    r"""Train an estimator on the pairs of a fold, except for one held-out part.

    .. math::
        \min_q \; \sum_{i \notin \text{part}} -\log q(\theta_i \mid x_i)
        \quad\text{until}\quad \sum_{i \in \text{part}} -\log q(\theta_i \mid x_i)
        \quad\text{does not fall any more}

    With rehearsal the mean over the pairs and that over simulations count half each:

    .. math::
        \min_q \; \tfrac12 \operatorname{mean}_{i \notin \text{part}}
        \bigl[-\log q(\theta_i \mid x_i)\bigr]
        + \tfrac12 \mathbb{E}_{p(\theta, x_s)}\bigl[-\log q(\theta \mid x_s)\bigr]

    The density of a label that is not exact is an average over the parameters that it
    leaves possible (:mod:`sbi_rope._labels.nodes`), and a weight multiplies its term.

    All parameters are trained in evaluation mode. Of all epochs and learning rates the
    one with the lowest loss on the held-out part is kept; this can be the start.
    Without rehearsal a candidate averages the nets that hold out each part of a fold in
    turn, which reduces the effect of overfitting.

    Args:
        start: An estimator of sbi with a density; it is not changed.
        fold: The pairs that may be learned from.
        part: The number of the part to hold out, one of ``fold.parts``.
        learning_rates: Of Adam; each is tried from the start.
        rehearse: Whether to train on simulations, too. A large net that keeps seeing
            them learns more from the pairs before it overfits.

    Returns:
        The trained estimator, in evaluation mode.
    """
    bench = fold.bench
    nodes = None if bench.labels.are_exact else fold.nodes(start)

    def losses_of(estimator: Any) -> Callable[[Tensor], Tensor]:
        if nodes is not None:
            return _losses_of_labels(fold, nodes, estimator)
        return lambda rows: estimator.loss(bench.theta[rows], condition=bench.x[rows])

    split = rows_with_density(
        losses_of(start), fold.rows_without(part), fold.parts[part]
    )

    def tuned(learning_rate: float) -> tuple[Any, History]:
        estimator = copy.deepcopy(start).requires_grad_()
        history = _train(
            estimator,
            losses_of(estimator),
            fold,
            split,
            learning_rate=learning_rate,
            rehearse=rehearse,
        )
        return estimator.requires_grad_(requires_grad=False), history

    estimator, _ = best_of_learning_rates(
        tuned,
        learning_rates,
        num_held_out=len(split[1]),
        otherwise=min(learning_rates),
    )
    return estimator


def _train(
    estimator: Any,
    losses: Callable[[Tensor], Tensor],
    fold: Fold,
    split: tuple[Tensor, ...],
    *,
    learning_rate: float,
    rehearse: bool,
) -> History:
    """Train an estimator in place on the first rows of a split; stop by the others.

    ``losses`` maps rows to the negative log density of each.
    """
    bench, (train, held_out) = fold.bench, split
    weights = bench.labels.pair_weights
    # The order of the batches depends on the fold alone, not on what was drawn before.
    order = torch.Generator().manual_seed(fold.seed)

    def loss(rows: Tensor, among: Tensor = train) -> Tensor:
        if weights is None:
            return losses(rows).mean()
        # In a batch of few pairs, each counts as it does among all.
        factors = weights[rows] / weights[among].mean()
        return (factors.to(bench.theta) * losses(rows)).mean()

    def batches(epoch: int) -> Iterator[tuple[Tensor]]:
        size = FINETUNING.training_batch_size
        return zip(shuffled(train, size, generator=order), strict=True)

    def rehearsed_batches(epoch: int) -> Iterator[tuple[Tensor, Tensor]]:
        num_simulations = len(bench.simulations[0])
        for _ in range(STEPS):
            pairs = torch.randint(len(train), (BATCH_SIZE,), generator=order)
            others = torch.randint(num_simulations, (BATCH_SIZE,), generator=order)
            yield train[pairs.to(train.device)], others

    def rehearsed_loss(rows: Tensor, others: Tensor) -> Tensor:
        theta, x = (one[others.to(one.device)] for one in bench.simulations)
        return 0.5 * loss(rows) + 0.5 * estimator.loss(theta, condition=x).mean()

    return train_network(
        estimator,
        rehearsed_batches if rehearse else batches,
        rehearsed_loss if rehearse else loss,
        replace(REHEARSED if rehearse else FINETUNING, learning_rate=learning_rate),
        validation_loss=lambda: loss(held_out, held_out),
        in_training_mode=False,
        label="Fine-tuning NPE",
        show_progress_bars=False,
    )


def _losses_of_labels(
    fold: Fold, nodes: Nodes, estimator: Any
) -> Callable[[Tensor], Tensor]:
    """Return a function from rows to the negative log densities of their labels."""
    bench = fold.bench
    place = torch.empty_like(bench.groups, device=fold.rows.device)
    place[fold.rows] = torch.arange(len(fold.rows), device=fold.rows.device)
    # The estimator itself would embed an observation once for each of its nodes.
    embedding, density = embedding_of(estimator), headless(estimator)

    def losses(rows: Tensor) -> Tensor:
        of_rows = nodes[place[rows]]
        embedded = embedding(bench.x[rows])
        return -of_rows.log_mean(
            density.log_prob(of_rows.theta.movedim(1, 0), embedded).T
        )

    return losses
