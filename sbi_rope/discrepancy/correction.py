"""Fit the discrepancy, and train a given NPE further on corrected simulations."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor, nn

from sbi_rope.data.pairs import Pairs, group_means
from sbi_rope.data.parameters import learn_parameters
from sbi_rope.data.simulate import Moments
from sbi_rope.density.flow import Flow
from sbi_rope.discrepancy.model import DiscrepancyModel, expected_means
from sbi_rope.discrepancy.posterior import (
    SMALLEST_ERROR,
    Discrepancy,
    DiscrepancyDraws,
    rounding,
)
from sbi_rope.discrepancy.unlabelled import LaplaceDiscrepancy
from sbi_rope.npe.sbi import ConditionalEstimator, embedding_of, has_parameters
from sbi_rope.npe.standardisation import Standardisation
from sbi_rope.training.fit import Courses, History, Training, fit
from sbi_rope.utils.errors import InvalidInputError
from sbi_rope.utils.seeds import seeded

# What is corrected: h(x), x itself, or g(x) with nets g tuned on other pairs, which
# move it towards h of simulations.
Space = Literal["embedding", "input", "tuned"]
# A discrepancy, and the probabilities of drawing simulations, which are equal if None.
Version = tuple[Discrepancy | LaplaceDiscrepancy, Tensor | None]

# Draws of the discrepancy for a training, and the limit on the entries of all together.
# Where it limits the draws, each of them serves a block of simulations of a step.
NUM_DRAWS, MAX_ENTRIES, BLOCK = 2000, 2**24, 40
# A discrepancy of more entries takes minutes and many GB of memory.
MOST_ENTRIES = 500
# More standard deviations than this refute that the simulator is right.
LARGEST_SURPRISE = 5.0
# Simulations in a step, and steps in a course.
BEHIND_NET = Training(training_batch_size=80, learning_rate=1e-2, max_num_epochs=250)
TRAINING = {
    "embedding": BEHIND_NET,
    "tuned": BEHIND_NET,
    "input": replace(BEHIND_NET, training_batch_size=160, max_num_epochs=400),
}
# Corrected simulations on which the loss before and after a course is compared.
NUM_COMPARED = 1920
# Courses follow each other until one gains less than 0.01 nats. In a stack a longer one
# follows only if the loss still falls by so many nats in the last quarter of the first.
# Chosen on calibration data, see benchmarks/choices.md.
COURSES = Courses(min_gain=0.01)
IN_A_STACK = Courses(min_gain=0.01, min_fall=0.15, max_num=2)


def network_of(estimator: ConditionalEstimator, space: Space) -> nn.Module:
    """Return the map from x to its representation that is corrected."""
    net = embedding_of(estimator)
    width = estimator.condition_shape.numel()
    if width > MOST_ENTRIES and (space == "input" or not has_parameters(net)):
        raise InvalidInputError(
            f"Expected x of at most {MOST_ENTRIES} entries, or an NPE with an "
            f"embedding net; got {width}. Train NPE with an embedding net."
        )
    if space != "input":
        return net
    if len(estimator.condition_shape) != 1:
        raise InvalidInputError(
            "Expected observations of shape (n, l) with space='input'; got those of "
            f"shape {tuple(estimator.condition_shape)}. Use space='embedding'."
        )
    return nn.Identity()


def fit_discrepancy(
    pairs: Pairs,
    z: Tensor,
    moments: Moments,
    standardisation: Standardisation,
    model: DiscrepancyModel,
) -> Discrepancy:
    """Fit the model to pairs, represented by z ``(n, l)``, in units of simulations."""
    z, moments = standardisation(z.double()), in_units(moments, standardisation)
    # With few pairs and many entries, a right simulator that fits badly can have more
    # evidence than all discrepancies, which have many coefficients to learn.
    found = surprise(pairs, z, moments)
    if found > LARGEST_SURPRISE and model.probability_of_none < 1.0:
        model = replace(model, probability_of_none=0.0)
    weights, groups = pairs.weight, pairs.group
    covariance = moments.covariance.mean(dim=0)
    return model.fit(z, moments.means, covariance, weights=weights, groups=groups)


def fit_version(
    pairs: Pairs,
    z: Tensor,
    moments: Moments,
    simulations: tuple[Tensor, Tensor],
    model: DiscrepancyModel,
    *,
    learn_prior: bool,
) -> tuple[Discrepancy, Tensor | None]:
    """Return what pairs say of the discrepancy, and of the parameters if learned."""
    theta_s, z_s = simulations
    unit = Standardisation(z_s.double())
    found = fit_discrepancy(pairs, z, moments, unit, model)
    if not learn_prior:
        return found, None
    weights = pairs.shared_weight
    return found, learn_parameters(pairs.theta, theta_s, weights=weights).probabilities


def in_units(moments: Moments, standardisation: Standardisation) -> Moments:
    """Return moments of the entries that vary, in their standard deviations."""
    varies = standardisation.varies
    if not varies.any():
        raise InvalidInputError(
            "Expected simulations that differ from each other; got the same x, or the "
            "same embedding, for all of them."
        )
    std = standardisation.std[varies]
    return Moments(
        means=standardisation(moments.means),
        covariance=moments.covariance[:, varies][:, :, varies] / std / std[:, None],
    )


def tuning_targets(
    pairs: Pairs, z: Tensor, moments: Moments, z_s: Tensor, *, seed: int | None = None
) -> Tensor:
    r"""Return the targets ``(n, l)`` of the tuning, :math:`E[h(S(\theta)) \mid y, x]`.

    A net that is tuned to averages given a partial label y alone would forget what x
    says about the other parameters. They are therefore also given x, under a
    discrepancy model of the embeddings z of these pairs. z_s is from the prior.
    """
    unit = Standardisation(z_s.double())
    found = fit_discrepancy(pairs, z, moments, unit, DiscrepancyModel())
    with seeded(seed):
        means = expected_means(found, unit(z.double()), unit(moments.means))
    return unit.undo(means).to(z)


def surprise(pairs: Pairs, z: Tensor, moments: Moments) -> float:
    r"""Return how badly a right simulator would fit, in standard deviations.

    .. math:: \frac{\sum_i w_i (T_i - E_i)}{\sqrt{\sum_i w_i^2 V_i}}, \qquad
        T_i = (z_i - m_i)^\top C^{-1} (z_i - m_i)

    If :math:`z_i` were a Gaussian simulation with the covariance :math:`C_i`, then
    :math:`T_i` would have the mean :math:`E_i = \operatorname{tr}(C^{-1} C_i)` and the
    variance :math:`V_i = 2 \operatorname{tr}((C^{-1} C_i)^2)`, with C the mean of all
    :math:`C_i`. Each group counts as one pair, with the means of its T, E and V. Of
    several possible means, ``(n, R, l)``, the nearest counts.
    """
    covariances = moments.covariance
    covariances = covariances + rounding(covariances.mean(dim=0)).diag()
    inverse = torch.linalg.inv(covariances.mean(dim=0))
    residual = z.to(covariances)[:, None] - moments.means
    found = (residual @ inverse * residual).sum(dim=2).amin(dim=1)
    relative = inverse @ covariances
    excess = found - relative.diagonal(dim1=1, dim2=2).sum(dim=1)
    variance = 2 * (relative * relative.mT).sum(dim=(1, 2))
    values = torch.stack([excess, variance], dim=1)
    values, w = group_means(values, pairs.shared_weight, pairs.group)
    excess, variance = values.T
    return float((w * excess).sum() / (w.square() * variance).sum().sqrt())


def correct_flow(
    estimator: ConditionalEstimator,
    simulations: tuple[Tensor, Tensor],
    versions: Sequence[Version],
    *,
    space: Space,
    num_steps: int | None = None,
    in_a_stack: bool = False,
    show_progress_bars: bool = False,
) -> tuple[Flow, nn.Module, list[History]]:
    r"""Train a copy of NPE for each version on corrected simulations, all at once.

    .. math::
        \min_q \; \mathbb E_{(A, b, \Sigma') \mid \text{pairs}}\;
        \mathbb E_{\theta, z_s} \mathbb E_{e \mid \Sigma'}
        \bigl[-\log q(\theta \mid A z_s + b + e)\bigr]

    The optimum is the posterior with the discrepancy integrated out. Every step draws
    new rows, corrections and errors. With ``space="input"`` all of NPE is trained,
    otherwise the density alone, for ``num_steps`` or in courses, which end earlier in a
    stack. Simulations are theta ``(n_s, d)`` from the prior and z ``(n_s, l)``.

    Return the copies, a module that replaces entries which do not vary in simulations,
    and the losses. With ``"tuned"`` the caller puts tuned nets and it in front.
    """
    theta, z = simulations
    whole, training = space == "input", TRAINING[space]
    unit = Standardisation(z.double())
    z, count, net = unit(z.double()), len(versions), embedding_of(estimator)
    courses = Courses(math.inf) if num_steps else COURSES
    if in_a_stack:
        most = IN_A_STACK.max_num if has_parameters(net) else 1
        courses = replace(IN_A_STACK, growth=2 if whole else 4, max_num=most)
    constants: nn.Module = nn.Identity()
    if not unit.varies.all():
        constants = SimulatedConstants(unit)
        net = nn.Sequential(*((constants, net) if whole else (net, constants)))
    flow = Flow.of([estimator] * count, nets=[net] * (count if whole else 1))
    size = max(1, min(NUM_DRAWS, MAX_ENTRIES // z.shape[1] ** 2 // count))
    block = 1 if size == NUM_DRAWS else BLOCK
    draws = DiscrepancyDraws.joined(
        one.sample(size, smallest_error=SMALLEST_ERROR[space]) for one, _ in versions
    )
    equal = torch.ones(len(theta), dtype=torch.double) / len(theta)
    upper = torch.stack([equal if p is None else p.cpu().double() for _, p in versions])
    upper = upper.cumsum(dim=1)

    def batch(num_rows: int) -> tuple[Tensor, Tensor]:
        """Draw theta and corrected z for each copy, ``(E, num_rows, ...)``."""
        uniform = torch.rand(count, num_rows, dtype=torch.double) * upper[:, -1:]
        rows = torch.searchsorted(upper, uniform).clamp_max(len(theta) - 1)
        rows = rows.to(z.device)
        draw = torch.randint(size, (count, num_rows // block))
        draw = (draw + size * torch.arange(count)[:, None]).to(z.device)
        corrected = draws.correct(z[rows.flatten()], draw.flatten())
        corrected = unit.undo(corrected.unflatten(0, rows.shape))
        return theta[rows], corrected.to(theta)

    def mean_loss(theta: Tensor, z: Tensor) -> Tensor:
        losses = flow.losses if whole else flow.losses_given
        return losses(theta, z).mean(dim=1)

    def compared_loss(*held_out: Tensor) -> Tensor:
        with seeded(0):  # the loss of a vector field draws random times
            return mean_loss(*held_out)

    histories = fit(
        flow if whole else flow.densities,
        lambda step: [batch(training.training_batch_size)],
        mean_loss,
        training,
        max_num_epochs=num_steps,
        validation_loss=compared_loss,
        held_out=batch(NUM_COMPARED),
        courses=courses,
        in_training_mode=False,
        label="Correcting NPE",
        show_progress_bars=show_progress_bars,
    )
    return flow, constants, histories


class SimulatedConstants(nn.Module):
    """Sets entries that never vary in simulations to their simulated value."""

    varies: Tensor
    values: Tensor

    def __init__(self, standardisation: Standardisation) -> None:
        super().__init__()
        self.register_buffer("varies", standardisation.varies)
        self.register_buffer("values", standardisation.mean)

    def forward(self, z: Tensor) -> Tensor:
        """Return z with these entries replaced."""
        return z.where(self.varies, self.values.to(z))
