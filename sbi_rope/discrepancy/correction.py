"""Fit the discrepancy, and train a given NPE further on corrected simulations."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor, nn

from sbi_rope._random import seeded
from sbi_rope._sbi import ConditionalEstimator, embedding_of
from sbi_rope._standardisation import Standardisation
from sbi_rope.data import Counts, groups_of
from sbi_rope.density.flow import Flow
from sbi_rope.discrepancy.model import DiscrepancyModel
from sbi_rope.discrepancy.posterior import Discrepancy, DiscrepancyDraws
from sbi_rope.discrepancy.regression import SMALLEST_NOISE
from sbi_rope.errors import InvalidInputError
from sbi_rope.fit import Courses, History, Training, fit
from sbi_rope.moments import Moments

__all__ = [
    "Correction",
    "Space",
    "correct_flow",
    "fit_discrepancy",
    "network_of",
    "surprise",
]

# What is corrected: h(x), x itself, or g(x) with nets g tuned on other pairs. In the
# last case simulations are still represented by h(x), because g is tuned towards h.
Space = Literal["embedding", "input", "tuned"]

# The number of draws of the discrepancy for a training, and the limit on the entries of
# all draws together. Embeddings of a hundred dimensions get fewer draws.
NUM_DRAWS, MAX_ENTRIES = 2000, 2**24
# Smallest standard deviation of the error, in standard deviations of simulations. It is
# smaller for x, which can be known more precisely than an embedding.
SMALLEST_ERROR = {"embedding": 0.01, "tuned": 0.01, "input": 0.003}
# More standard deviations than this refute that the simulator is right.
LARGEST_SURPRISE = 5.0
# Gradient steps of a course, and simulations in each. The density behind an embedding
# net adapts within a hundred steps; a whole network takes longer.
NUM_STEPS = {"embedding": 200, "tuned": 200, "input": 400}
BATCH_SIZE = 160
# Corrected simulations on which the loss before and after a course is compared.
NUM_COMPARED = 1920
LEARNING_RATES = {"embedding": 5e-3, "tuned": 5e-3, "input": 2e-3}
# Another course follows if one has lowered the loss by so many nats. In a stack, where
# many versions are trained, it also has to fall by more in the last quarter of one,
# and there are fewer: one course is enough for most, but not for images. Chosen on
# calibration data, see benchmarks/choices.md.
UNTIL_SETTLED, STILL_FALLING, MAX_IN_A_STACK = 0.01, 0.15, 3


@dataclass(frozen=True, eq=False, kw_only=True)
class Correction:
    """Copies of NPE that were trained on corrected simulations.

    Attributes:
        flow: All copies.
        constants: A layer that replaces entries without variation in simulations, to
            put behind an embedding net of real observations. The flow contains it.
        histories: The losses of the training of each copy.
    """

    flow: Flow
    constants: nn.Module
    histories: list[History]


def network_of(estimator: ConditionalEstimator, space: Space) -> nn.Module:
    """Return the map from x to its representation that is corrected.

    Raises:
        InvalidInputError: If the input is to be corrected and is not a vector.
    """
    if space != "input":
        return embedding_of(estimator)
    if len(estimator.condition_shape) != 1:
        raise InvalidInputError(
            "Expected observations of shape (n, l) with space='input'; got those of "
            f"shape {tuple(estimator.condition_shape)}. Use space='embedding'."
        )
    return nn.Identity()


def fit_discrepancy(
    z: Tensor,
    moments: Moments,
    standardisation: Standardisation,
    model: DiscrepancyModel,
    *,
    weights: Tensor | None = None,
    groups: Tensor | None = None,
) -> Discrepancy:
    """Fit the model to calibration pairs, in standard deviations of simulations.

    That the simulator is right counts as impossible if the pairs refute it by
    themselves, see :func:`surprise`. The evidence alone would not: with few pairs and
    many entries, a right simulator that fits badly can have more of it than all
    discrepancies, each of which has many coefficients to learn.

    Args:
        z: The representations of the real observations, shape ``(n, l)``.
        moments: The moments of simulations at the parameters of the pairs.
        standardisation: That of z over simulations from the prior.
        model: The model of the discrepancy.
        weights: How many pairs each pair counts as, shape ``(n,)``.
        groups: A number for each pair, the same for recordings of one person.

    Raises:
        InvalidInputError: If nothing varies between simulations.
    """
    varies = standardisation.varies
    if not varies.any():
        raise InvalidInputError(
            "Expected simulations that differ from each other; got the same embedding "
            "(or the same x) for all of them."
        )
    std = standardisation.std[varies]
    covariances = moments.covariance[:, varies][:, :, varies] / std / std[:, None]
    z, means = standardisation(z.double()), standardisation(moments.means)
    covariance = covariances.mean(dim=0)
    is_certain = model.probability_of_none in (0.0, 1.0)
    if not is_certain:
        found = surprise(z, means, covariances, weights=weights, groups=groups)
        if found > LARGEST_SURPRISE:
            model = replace(model, probability_of_none=0.0)
    return model.fit(z, means, covariance, weights=weights, groups=groups)


def surprise(
    z: Tensor,
    means: Tensor,
    covariances: Tensor,
    *,
    weights: Tensor | None = None,
    groups: Tensor | None = None,
) -> float:
    r"""Return how badly a right simulator would fit, in standard deviations.

    .. math:: \frac{\sum_i w_i (T_i - E_i)}{\sqrt{\sum_i w_i^2 V_i}}, \qquad
        T_i = (z_i - m_i)^\top C^{-1} (z_i - m_i)

    If :math:`z_i` were a simulation with the covariance :math:`C_i`, then :math:`T_i`
    would have the mean :math:`E_i = \operatorname{tr}(C^{-1} C_i)` and, if it were
    Gaussian, the variance :math:`V_i = 2 \operatorname{tr}((C^{-1} C_i)^2)`. Here C is
    the mean of all :math:`C_i`. In the worst case, pairs of a group have everything in
    common, so that each group counts as one pair, with the means of its T, E and V.

    Args:
        z: The representations of the real observations, shape ``(n, l)``.
        means: :math:`m_i`, shape ``(n, l)``, or its possible values, ``(n, R, l)``, of
            which the nearest counts.
        covariances: :math:`C_i`, shape ``(n, l, l)``.
        weights: :math:`w_i`, shape ``(n,)``; one if None.
        groups: A number for each pair, shape ``(n,)``; None if all differ.
    """
    noise = SMALLEST_NOISE**2 * torch.eye(z.shape[1]).to(covariances)
    covariances = covariances + noise
    residual = z.to(covariances).reshape(len(z), -1, z.shape[1]) - means.reshape(
        len(z), -1, z.shape[1]
    )
    factor = torch.linalg.cholesky(covariances.mean(dim=0))
    white = torch.linalg.solve_triangular(factor, residual.mT, upper=False)
    found = white.square().sum(dim=1).amin(dim=1)
    inverse = torch.cholesky_inverse(factor)
    relative = inverse @ covariances
    expected = relative.diagonal(dim1=1, dim2=2).sum(dim=1)
    variance = 2 * (relative * relative.mT).sum(dim=(1, 2))
    w = torch.ones_like(found) if weights is None else weights.to(found)
    excess = found - expected
    if groups is not None:
        numbers = groups_of(groups)
        counts = Counts(w / numbers.bincount()[numbers].to(w), groups)
        excess, w = counts.of_groups(excess)
        variance, _ = counts.of_groups(variance)
    return float((w * excess).sum() / (w.square() * variance).sum().sqrt())


def correct_flow(
    estimator: ConditionalEstimator,
    simulations: tuple[Tensor, Tensor],
    discrepancies: Sequence[Discrepancy],
    *,
    space: Space,
    probabilities: Sequence[Tensor | None],
    num_steps: int | None = None,
    learning_rate: float | None = None,
    in_a_stack: bool = False,
    show_progress_bars: bool = False,
) -> Correction:
    r"""Train copies of NPE on simulations as they would be observed, all at once.

    .. math::
        \min_q \; \mathbb E_{(A, b, \Sigma') \mid \text{pairs}}\;
        \mathbb E_{\theta, z_s} \mathbb E_{e \mid \Sigma'}
        \bigl[-\log q(\theta \mid A z_s + b + e)\bigr]

    The optimum is the posterior with the discrepancy integrated out. Every step draws
    new rows, new corrections and new errors. A network of usual size does not overfit
    them, so that no simulations are held out.

    Args:
        estimator: The estimator of NPE; it is not changed.
        simulations: Parameters from the prior, shape ``(n_s, d)``, and the
            representation of a simulation of each, shape ``(n_s, l)``.
        discrepancies: The discrepancy of each copy, in standard deviations of these.
        space: What is corrected. With ``"input"`` all of NPE is trained, otherwise the
            density behind the embedding net alone.
        probabilities: For each copy, the probabilities with which simulations are
            drawn; None makes them equal.
        num_steps: Gradient steps of a single course. If None, courses follow each
            other, whose length depends on the space.
        learning_rate: Learning rate of Adam, which falls to zero in each course; it
            depends on the space if None.
        in_a_stack: Whether to stop earlier, because many copies are trained.
        show_progress_bars: Whether to show the loss during training.

    Returns:
        The trained copies. With ``space="tuned"`` their embedding net is h. The caller
        replaces h by a tuned net and the constants.
    """
    theta, z = simulations
    unit = Standardisation(z.double())
    z, count = unit(z.double()), len(discrepancies)
    constants = nn.Identity() if unit.varies.all() else SimulatedConstants(unit)
    net = embedding_of(estimator)
    if not unit.varies.all():
        order = (constants, net) if space == "input" else (net, constants)
        net = nn.Sequential(*order)
    flow = Flow.of([estimator] * count, nets=[net] * (count if space == "input" else 1))
    network = flow if space == "input" else flow.densities
    losses = flow.losses if space == "input" else flow.losses_given
    size = max(1, min(NUM_DRAWS, MAX_ENTRIES // z.shape[1] ** 2 // count))
    draws = DiscrepancyDraws.joined(
        [
            one.sample(size, smallest_error=SMALLEST_ERROR[space])
            for one in discrepancies
        ]
    )
    equal = torch.full((len(theta),), 1.0 / len(theta), dtype=torch.double)
    upper = torch.stack([equal if p is None else p.cpu() for p in probabilities])
    upper = upper.double().cumsum(dim=1)

    def batch(count: int) -> tuple[Tensor, Tensor]:
        """Return theta and corrected z for each copy, ``(E, count, ...)``."""
        uniform = torch.rand(len(upper), count, dtype=torch.double) * upper[:, -1:]
        rows = torch.searchsorted(upper, uniform).clamp_max(len(theta) - 1)
        rows = rows.to(z.device)
        draw = torch.randint(size, rows.shape)
        draw = (draw + size * torch.arange(len(rows))[:, None]).to(z.device)
        corrected = draws.correct(z[rows.flatten()], draw.flatten())
        corrected = unit.undo(corrected.unflatten(0, rows.shape))
        return theta[rows], corrected.to(theta)

    def mean_loss(theta: Tensor, z: Tensor) -> Tensor:
        return losses(theta, z).mean(dim=1)

    compared = [batch(BATCH_SIZE) for _ in range(NUM_COMPARED // BATCH_SIZE)]

    def compared_loss() -> Tensor:
        with seeded(0):  # the loss of a vector field draws random times
            return torch.stack([mean_loss(*some) for some in compared]).mean(dim=0)

    if num_steps:
        courses = Courses(compared_loss, math.inf)
    elif in_a_stack:
        courses = Courses(compared_loss, UNTIL_SETTLED, STILL_FALLING, MAX_IN_A_STACK)
    else:
        courses = Courses(compared_loss, UNTIL_SETTLED)
    histories = fit(
        network,
        lambda step: [batch(BATCH_SIZE)],
        mean_loss,
        Training(
            learning_rate=learning_rate or LEARNING_RATES[space],
            max_num_epochs=num_steps or NUM_STEPS[space],
        ),
        courses=courses,
        in_training_mode=False,
        label="Correcting NPE",
        show_progress_bars=show_progress_bars,
    )
    return Correction(flow=flow, constants=constants, histories=histories)


class SimulatedConstants(nn.Module):
    """Sets entries that are the same in all simulations to their simulated value.

    The density has never seen these entries vary, so that its answer to another value
    would be arbitrary.
    """

    varies: Tensor
    values: Tensor

    def __init__(self, standardisation: Standardisation) -> None:
        super().__init__()
        self.register_buffer("varies", standardisation.varies)
        self.register_buffer("values", standardisation.mean)

    def forward(self, z: Tensor) -> Tensor:
        """Return z with these entries replaced, in the same shape."""
        return z.where(self.varies, self.values.to(z))
