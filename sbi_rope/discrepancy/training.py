r"""Train a density on corrected simulations."""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from sbi_rope._progress import progress_bar
from sbi_rope._random import seeded
from sbi_rope._standardisation import Standardisation
from sbi_rope._training import History, adam, differentiable
from sbi_rope.discrepancy.posterior import DiscrepancyDraws

__all__ = ["IN_A_STACK", "ONE_COURSE", "UNTIL_SETTLED", "train_on_corrected"]

BATCH_SIZE = 500
CLIP_MAX_NORM = 5.0
# Each point of the history averages over so many steps.
STEPS_PER_POINT = 20
# The loss is compared on NUM_COMPARED corrected simulations, which are the same for all
# courses.
NUM_COMPARED, MAX_COURSES = 2000, 12


# The nats by which a course has to lower the loss for another to follow. In a stack,
# where many versions are trained, a smaller gain is not worth the time. Chosen on
# calibration data, see benchmarks/choices.md.
ONE_COURSE, UNTIL_SETTLED, IN_A_STACK = math.inf, 0.01, 0.1


def train_on_corrected(
    density: Any,
    theta: Tensor,
    z: Tensor,
    draws: DiscrepancyDraws,
    standardisation: Standardisation,
    *,
    probabilities: Tensor | None,
    num_steps: int,
    min_gain: float = ONE_COURSE,
    learning_rate: float,
    show_progress_bars: bool,
) -> History:
    r"""Train :math:`q(\theta \mid z)` on simulations as they would be observed.

    .. math::
        \min_q \; \mathbb E_{(A, b, \Sigma') \mid \text{pairs}}\;
        \mathbb E_{\theta, z_s} \mathbb E_{e \mid \Sigma'}
        \bigl[-\log q(\theta \mid A z_s + b + e)\bigr]

    The optimum is the posterior with the discrepancy integrated out. Every step draws
    new rows, new corrections and new errors. A network of usual size does not overfit
    them, so that no simulations are held out.

    Args:
        density: An estimator of sbi that is conditioned on z. It is trained in place,
            in evaluation mode.
        theta: Parameters from the prior, shape ``(n, d)``.
        z: A simulation of each, shape ``(n, l)``.
        draws: Draws of the discrepancy, in the units of ``standardisation``.
        standardisation: The mean and standard deviation of z.
        probabilities: The probability of each simulation; equal if None.
        num_steps: Gradient steps of a course.
        min_gain: The nats by which a course has to lower the loss for another to
            follow. A density that is much too narrow at the start needs several.
        learning_rate: Learning rate of Adam, which falls to zero in each course.
        show_progress_bars: Whether to show the loss during training.
    """
    density.requires_grad_().eval()
    z = standardisation(z.double())

    def batch(size: int) -> tuple[Tensor, Tensor]:
        rows = _draw(len(theta), size, probabilities).to(theta.device)
        return theta[rows], standardisation.undo(draws.correct(z[rows])).to(theta)

    compared = batch(NUM_COMPARED)
    loss, losses = _loss(density, *compared), []
    for _ in range(MAX_COURSES):
        losses += _one_course(
            density, batch, num_steps, learning_rate, show_progress_bars
        )
        before, loss = loss, _loss(density, *compared)
        if not before - loss > min_gain:
            break
    density.requires_grad_(requires_grad=False)
    parts = torch.tensor(losses).split(STEPS_PER_POINT)
    return History(
        [float(part.mean()) for part in parts], [], len(parts) - 1, learning_rate
    )


def _one_course(
    density: Any,
    batch: Callable[[int], tuple[Tensor, Tensor]],
    num_steps: int,
    learning_rate: float,
    show_progress_bars: bool,  # noqa: FBT001
) -> list[float]:
    parameters = list(density.parameters())
    optimizer = adam(parameters, learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, num_steps)
    losses: list[float] = []
    bar = progress_bar(range(num_steps), show=show_progress_bars, desc="Correcting NPE")
    for _ in bar:
        theta, corrected = batch(BATCH_SIZE)
        optimizer.zero_grad()
        with differentiable(density):
            loss = density.loss(theta, condition=corrected).mean()
            loss.backward()
        nn.utils.clip_grad_norm_(parameters, CLIP_MAX_NORM)
        for parameter in parameters:
            if parameter.grad is not None:  # a parameter may have no part in the loss
                parameter.grad.nan_to_num_(0.0, 0.0, 0.0)
        optimizer.step()
        schedule.step()
        losses.append(float(loss.detach()))
        bar.set_postfix(loss=losses[-1], refresh=False)
    return losses


@torch.no_grad()
def _loss(density: Any, theta: Tensor, corrected: Tensor) -> float:
    with seeded(0):  # the loss of a vector field draws random times
        return float(density.loss(theta, condition=corrected).mean())


def _draw(count: int, size: int, probabilities: Tensor | None) -> Tensor:
    if probabilities is None:
        return torch.randint(count, (size,))
    return torch.multinomial(probabilities.cpu(), size, replacement=True)
