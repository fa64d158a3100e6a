"""Fit the discrepancy, and train a given NPE further on corrected simulations."""

import copy
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor, nn

from sbi_rope._groups import groups_of
from sbi_rope._means import Counts
from sbi_rope._sbi import ConditionalEstimator, embedding_of, headless, with_embedding
from sbi_rope._standardisation import Standardisation
from sbi_rope._training import History
from sbi_rope.discrepancy.model import DiscrepancyModel
from sbi_rope.discrepancy.posterior import Discrepancy
from sbi_rope.discrepancy.regression import SMALLEST_NOISE
from sbi_rope.discrepancy.training import (
    ONE_COURSE,
    UNTIL_SETTLED,
    train_on_corrected,
)
from sbi_rope.errors import InvalidInputError
from sbi_rope.simulate import Moments

__all__ = [
    "Correction",
    "Space",
    "correct_npe",
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
# Gradient steps of a course. The density behind an embedding net adapts within a
# hundred steps; a whole network takes longer. Chosen on calibration data.
NUM_STEPS = {"embedding": 150, "tuned": 150, "input": 400}
LEARNING_RATES = {"embedding": 5e-3, "tuned": 5e-3, "input": 2e-3}


@dataclass(frozen=True, eq=False, kw_only=True)
class Correction:
    """An estimator trained on corrected simulations, and the discrepancy it knows.

    Attributes:
        estimator: An estimator of sbi for real observations x.
        discrepancy: The posterior of gain, offset and error.
        history: The losses of its training.
        constants: A layer that replaces entries without variation in simulations, to
            put behind an embedding net of real observations. The estimator contains it.
    """

    estimator: Any
    discrepancy: Discrepancy
    history: History
    constants: nn.Module


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


def correct_npe(
    estimator: ConditionalEstimator,
    simulations: tuple[Tensor, Tensor],
    z: Tensor,
    moments: Moments,
    *,
    space: Space,
    model: DiscrepancyModel,
    weights: Tensor | None = None,
    groups: Tensor | None = None,
    probabilities: Tensor | None = None,
    num_steps: int | None = None,
    min_gain: float = UNTIL_SETTLED,
    learning_rate: float | None = None,
    show_progress_bars: bool = False,
) -> Correction:
    """Fit a discrepancy to calibration pairs, and train NPE on corrected simulations.

    Args:
        estimator: The estimator of NPE; it is not changed.
        simulations: Parameters from the prior, shape ``(n_s, d)``, and the
            representation of a simulation of each, shape ``(n_s, l)``.
        z: The representations of the real observations of the pairs, ``(n_c, l)``.
        moments: The moments of simulations at the parameters of the pairs.
        space: What z is: embeddings h(x), x itself, or embeddings by tuned nets.
        model: The model of the discrepancy.
        weights: How many pairs each pair counts as, shape ``(n_c,)``; one if None.
        groups: A number for each pair, the same for recordings of one person.
        probabilities: The probabilities with which simulations are drawn; None makes
            them equal.
        num_steps: Gradient steps of a single course. If None, courses follow each
            other, whose length depends on the space.
        min_gain: The nats by which a course has to lower the loss for another to
            follow, if ``num_steps`` is None.
        learning_rate: Learning rate of Adam; it depends on the space if None.
        show_progress_bars: Whether to show the loss during training.

    Returns:
        The corrected estimator. With ``space="tuned"`` its embedding net is h. The
        caller replaces h by a tuned net and the constants.
    """
    theta, z_s = simulations
    standardisation = Standardisation(z_s.double())
    discrepancy = fit_discrepancy(
        z, moments, standardisation, model, weights=weights, groups=groups
    )
    corrected = copy.deepcopy(estimator)
    # The two share their parameters, so that training one trains the other.
    density: Any = corrected if space == "input" else headless(corrected)
    history = train_on_corrected(
        density,
        theta,
        z_s,
        discrepancy.sample(
            min(NUM_DRAWS, max(1, MAX_ENTRIES // len(discrepancy.noise) ** 2)),
            smallest_error=SMALLEST_ERROR[space],
        ),
        standardisation,
        probabilities=probabilities,
        num_steps=NUM_STEPS[space] if num_steps is None else num_steps,
        min_gain=min_gain if num_steps is None else ONE_COURSE,
        learning_rate=(
            LEARNING_RATES[space] if learning_rate is None else learning_rate
        ),
        show_progress_bars=show_progress_bars,
    )
    constants: nn.Module = nn.Identity()
    if not standardisation.varies.all():
        constants = SimulatedConstants(standardisation)
        corrected = _with_constants(corrected, constants, space)
    return Correction(
        estimator=corrected.eval(),
        discrepancy=discrepancy,
        history=history,
        constants=constants,
    )


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


def _with_constants(estimator: Any, constants: nn.Module, space: Space) -> Any:
    net = embedding_of(estimator)
    parts = (constants, net) if space == "input" else (net, constants)
    return with_embedding(estimator, nn.Sequential(*parts))
