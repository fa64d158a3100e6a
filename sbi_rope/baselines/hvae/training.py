"""How the networks of the HVAE are trained, and by what their best state is chosen."""

from collections.abc import Callable, Iterator
from functools import partial

import torch
from torch import Tensor

from sbi_rope._random import seeded
from sbi_rope.baselines.hvae.model import HybridVAE
from sbi_rope.data import split_pairs, too_few_pairs
from sbi_rope.density import Density
from sbi_rope.errors import warn_user
from sbi_rope.fit import History, Training, fit

__all__ = ["train_hybrid"]


def train_hybrid(
    model: HybridVAE,
    posterior: Density,
    x_o: Tensor,
    theta: Tensor,
    x: Tensor,
    *,
    weight: float,
    training: Training,
    show_progress_bars: bool,
) -> History:
    """Train a model in place and leave it at its best on what is held out.

    Held out are pairs, or if there are fewer than five, observations.

    Args:
        model: What is trained.
        posterior: A density that shares its networks, to score held-out pairs by.
        x_o: Observations without parameters, shape ``(n, *event)``.
        theta: Parameters of the calibration pairs, shape ``(m, d)``.
        x: Their observations, shape ``(m, *event)``.
        weight: Of the pairs' mean log-probability in the objective.
        training: Batch size, learning rate and so on.
        show_progress_bars: Whether to show the course of the loss.

    Returns:
        The losses and the epoch that was kept.
    """
    train, held_out = split_pairs(theta, training.validation_fraction)
    pairs = theta[train], x[train]
    objective = partial(model.objective, weight=weight)
    validation_loss: Callable[[], Tensor] | None = None
    if len(held_out):
        validation_loss = partial(
            _held_out_loss, posterior, theta[held_out], x[held_out]
        )
    else:
        warn_user(
            f"{too_few_pairs(theta)}: none is held out, and the networks "
            "are chosen by the objective on held-out observations. Append at least 5 "
            "pairs of different parameters to choose them by what matters."
        )
        rows, held_out = split_pairs(
            torch.arange(len(x_o)), training.validation_fraction
        )
        if len(held_out):
            validation_loss = partial(
                _with_same_draws, objective, x_o[held_out], *pairs
            )
        x_o = x_o[rows]
    [history] = fit(
        model,
        partial(_batches, torch.cat([x_o, pairs[1]]), *pairs, training),
        objective,
        training,
        validation_loss=validation_loss,
        label="HVAE",
        show_progress_bars=show_progress_bars,
    )
    return history


def _batches(
    unlabelled: Tensor, theta: Tensor, x: Tensor, training: Training, epoch: int
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Pass over all observations, each batch together with one of pairs."""
    size = training.training_batch_size
    for rows in torch.randperm(len(unlabelled)).split(size):
        pairs = torch.randperm(len(x))[:size]
        yield unlabelled[rows], theta[pairs], x[pairs]


def _held_out_loss(posterior: Density, theta: Tensor, x: Tensor) -> Tensor:
    return -posterior.log_prob(theta, x).mean()


def _with_same_draws(objective: Callable[..., Tensor], *data: Tensor) -> Tensor:
    # Or the luckiest epoch would be kept.
    with seeded(0):
        return objective(*data)
