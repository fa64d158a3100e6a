r"""FRISBI: a tuned embedding that is aligned with simulations while it is tuned."""

import copy
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from sbi_rope.baselines.networks import fit_rows
from sbi_rope.baselines.statistics import frozen_statistics
from sbi_rope.data.pairs import split_pairs
from sbi_rope.data.simulate import targets
from sbi_rope.density import Density, Flow, MixturePosterior, OverSimulations
from sbi_rope.methods.base import Method
from sbi_rope.methods.training import EstimatorBuilder
from sbi_rope.npe.sbi import ConditionalDensityEstimator, embed
from sbi_rope.npe.standardisation import warn_of_far_entries
from sbi_rope.rope.finetuning import trainable_copy
from sbi_rope.training.ensemble import Ensemble, embedded, log_density
from sbi_rope.training.fit import History, Training
from sbi_rope.utils.settings import Positive, check

# How the density is distilled.
DISTILLING = Training(
    training_batch_size=500,
    learning_rate=1e-3,
    validation_fraction=0.1,
    stop_after_epochs=5,
    max_num_epochs=50,
)
# Simulations from the prior that observations are coupled with, at most those that are
# stored, and simulations behind each target.
NUM_SIMULATIONS, SIMULATIONS_PER_TARGET = 1000, 100
# Draws of the mixture of each observation that a density is distilled from.
NUM_DRAWS = 100


class FRISBI(Method):
    r"""RoPE's tuning and transport in one loss, for any observation.

    With :math:`C_{ij} = \lVert g(x_{o,i}) - h(x_{s,j}) \rVert^2 / l` and
    :math:`\alpha_{ij} \propto \exp(-C_{ij} / \gamma)`, rows summing to one, it
    minimises

    .. math::
        \tfrac1{n_c} \sum_i \lVert g(x_{c,i}) - z_i \rVert^2 / l
        + \tfrac1{n_o} \sum_i \sum_j \alpha_{ij}\, C_{ij}, \qquad
        z_i = \mathbb{E}\, h(S(\theta_i)),

    starting from g = h. The posterior is the mixture :math:`\sum_j \alpha_j(x)\,
    q(\theta \mid h(x_{s,j}))`, or a density :math:`q_\phi(\theta \mid g(x))` that is
    trained on draws of it.

    It sees simulations, the calibration set and observations without parameters. Each
    row of the coupling is independent of the others: it is RoPE's with tau = 0, which
    does not trust the prior, and it answers for any x. It assumes that g starts near
    the right simulations: the second term is small near any of them.

    References:
        | Inductive Domain Transfer in Misspecified Simulation-Based Inference (Senouf
          et al., 2025)
        | https://arxiv.org/abs/2508.15593

    Args:
        prior, density_estimator, npe_training, simulator, device: See
            :class:`~sbi_rope.methods.Method`.
        gamma: :math:`\gamma`, in units of the mean squared difference of embeddings.
        distilled: Whether the posterior is :math:`q_\phi`.
        training: How g is trained, in batches of observations, each with all pairs; 100
            epochs in batches of 64 if None.
    """

    sees = frozenset({"simulations", "calibration", "observations"})
    starts_from_npe = True
    simulates = True
    default_training = Training(
        training_batch_size=64,
        learning_rate=1e-4,
        validation_fraction=0.2,
        stop_after_epochs=100,
        max_num_epochs=100,
    )

    def __init__(
        self,
        prior: Any,
        density_estimator: str | EstimatorBuilder = "nsf",
        *,
        gamma: float = 0.5,
        distilled: bool = False,
        **options: Any,
    ) -> None:
        check("gamma", gamma, Positive)
        super().__init__(prior, density_estimator, **options)
        self.gamma = gamma
        self.distilled = distilled

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        npe, _ = self._trained_npe(show_progress_bars=show_progress_bars)
        h, density = frozen_statistics(npe)
        warn_of_far_entries("x", self._data.calibration[1], h)
        source, embedding = self._source(), partial(embed, h)
        _, simulated = source.from_prior(NUM_SIMULATIONS, progress=show_progress_bars)
        z = targets(
            source,
            self._data.pairs,
            SIMULATIONS_PER_TARGET,
            embedding,
            progress=show_progress_bars,
        )
        aligned = Aligned(
            density,
            trainable_copy(h, z),
            torch.cat([embedding(simulated), z]),
            self._data.observations[0].shape[1:],
            self.gamma,
        )
        theta, x = self._data.calibration
        x_o = self._data.observations[0]
        train, held_out = split_pairs(theta, self.training.validation_fraction)

        def error(pairs: Tensor) -> Tensor:
            return (aligned.g(x[pairs]) - z[pairs]).square().mean()

        history = fit_rows(
            aligned.g,
            lambda rows: error(train) + aligned.transport_cost(x_o[rows]),
            (torch.arange(len(x_o)), held_out),
            self.training,
            validation_loss=error,
            pairs=theta,
            in_training_mode=False,
            label="FRISBI",
            show_progress_bars=show_progress_bars,
        )
        found: Density = aligned.eval()
        if self.distilled:
            found = self._distilled(aligned, show_progress_bars=show_progress_bars)
        return MixturePosterior(found, self._prior), history

    def _distilled(self, aligned: "Aligned", *, show_progress_bars: bool) -> Flow:
        """Return a density given g(x) that is trained on draws of the mixture."""
        x_o = self._data.observations[0]
        theta = aligned.sample(torch.Size((NUM_DRAWS,)), x_o).flatten(0, 1)
        z, number = embed(aligned.g, x_o), torch.arange(len(x_o)).repeat(NUM_DRAWS)
        density = copy.deepcopy(aligned.density).requires_grad_()
        fit_rows(
            density,
            lambda rows: density.loss(theta[rows], condition=z[number[rows]]).mean(),
            # No observation is both trained on and held out.
            split_pairs(number, DISTILLING.validation_fraction),
            DISTILLING,
            in_training_mode=False,
            label="Distilling",
            show_progress_bars=show_progress_bars,
        )
        return Flow(
            Ensemble([aligned.g], embedded, ()),
            Ensemble([density], log_density, ()),
            input_shape=aligned.input_shape,
            condition_shape=aligned.condition_shape,
        )


class Aligned(OverSimulations):
    r"""A mixture over simulations, weighted by their distance from an observation.

    .. math::
        \alpha_j(x) \propto \exp\bigl(-\lVert g(x) - s_j \rVert^2
        / (l \gamma)\bigr)

    The simulations :math:`s_j` are embedded, shape ``(n_s, l)``.
    """

    def __init__(
        self,
        density: ConditionalDensityEstimator,
        g: nn.Module,
        simulated: Tensor,
        event_shape: torch.Size,
        gamma: float,
    ) -> None:
        super().__init__(density, simulated, event_shape)
        self.g = g
        self.gamma = gamma

    def embed(self, x: Tensor) -> Tensor:
        """Embed observations, ``(n, *event)`` to ``(n, l)``."""
        return embed(self.g, x)

    def rows(self, z: Tensor) -> Tensor:
        """Return the weights of the simulations, ``(b, n_s)``; rows sum to one."""
        return self._weights(_cost(z.double(), self.simulated.double()))

    def transport_cost(self, x: Tensor) -> Tensor:
        """Return the mean cost of a coupling of observations, with its gradient."""
        cost = _cost(self.g(x), self.simulated)
        return (self._weights(cost) * cost).sum(dim=1).mean()

    def _weights(self, cost: Tensor) -> Tensor:
        return torch.softmax(-cost / self.gamma, dim=1)


def _cost(real: Tensor, simulated: Tensor) -> Tensor:
    return (real[:, None] - simulated).square().mean(dim=2)
