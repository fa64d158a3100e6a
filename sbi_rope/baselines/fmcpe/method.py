r"""Flow matching corrected posterior estimation (FMCPE)."""

import copy
from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor, nn

from sbi_rope._random import seeded
from sbi_rope._sbi import (
    ConditionalDensityEstimator,
    direct_posterior,
    embed,
)
from sbi_rope._standardisation import warn_of_far_entries
from sbi_rope.baselines.fmcpe.pushed_forward import PushedForward
from sbi_rope.baselines.fmcpe.standardise import Standardise
from sbi_rope.baselines.fmcpe.to_simulations import ToSimulations
from sbi_rope.baselines.fmcpe.velocity import VelocityField
from sbi_rope.baselines.networks import fresh_copy
from sbi_rope.baselines.statistics import frozen_statistics
from sbi_rope.data import split_pairs
from sbi_rope.fit import History, Training, epochs_on_pairs, fit, shuffled
from sbi_rope.moments import draws
from sbi_rope.settings import Count, Positive, check
from sbi_rope.trainers.base import Method
from sbi_rope.trainers.starting_npe import StartingNPE
from sbi_rope.trainers.training import EstimatorBuilder

__all__ = ["FMCPE"]

DEFAULT_TRAINING = Training(
    training_batch_size=256,
    learning_rate=1e-3,
    validation_fraction=0.2,
    stop_after_epochs=300,
    max_num_epochs=300,
)
# An observation with more entries than this is a series or an image, whose entries
# share a unit, and of which the velocity fields see an embedding.
MAX_SUMMARIES = 20
# Most entries of simulations that are kept for training.
MAX_KEPT = 2**26
# Rows behind the loss on the held-out pairs, which are repeated for it.
NUM_HELD_OUT = 256

Space = Literal["input", "embedding"]


class Frozen(nn.Sequential):
    """A net that stays in evaluation mode while what contains it is trained."""

    def train(self, mode: bool = True) -> "Frozen":  # noqa: FBT001, FBT002
        """Do not switch to training mode."""
        return super().train(mode=False)


class FMCPE(Method):
    r"""Flow matching from observations to simulations, and from NPE to the labels.

    .. math::
        \tilde x_k = T_x(x_o + \epsilon\, \xi_k;\, x_o), \qquad
        \theta_0 \sim \tfrac1K \sum_k q(\theta \mid h(\tilde x_k)), \qquad
        \theta = T_\theta(\theta_0;\, x_o)

    Both maps follow velocity fields that are trained on the calibration pairs by flow
    matching: :math:`T_x` from an observation with noise to a simulation with the same
    parameters, and :math:`T_\theta` from a draw of NPE to the parameters. Where theta
    is bounded, :math:`T_\theta` works on the transform of sbi's ``mcmc_transform``,
    so that no draw leaves the prior's support. The density is

    .. math::
        \log p(\theta \mid x_o) = \log \tfrac1K \sum_k q(\theta_0 \mid h(\tilde x_k))
        - \int_0^1 \nabla \cdot v_\theta \, dt ,

    along the way of theta back to :math:`\theta_0`. The noise :math:`\xi_k` is drawn
    once and is the same for all observations.

    Sees simulations and the calibration set, and simulates at the calibration
    parameters. It assumes little about what is wrong, and has to learn all of it from
    the pairs, which takes hundreds of them.

    Where this differs from the original code:

    - The density is an average over K = 100 simulations. With K = 1 it is too small on
      average, because the logarithm of an average is larger than the average of
      logarithms. The published code has no density.
    - Simulations are in standard deviations of all simulations at the calibration
      parameters, and parameters in those of the prior. The original takes those of one
      simulation for each pair, and of the labels.
    - Times are uniform. The original draws later ones more often in one of its tasks.
    - Simulations at the calibration parameters are made once, 100 for each pair, and
      each batch chooses among them, instead of new ones for each batch.
    - Of all epochs the best on the held-out pairs is kept, the start included. Fields
      start at zero, at which both maps leave everything where it is.
    - The maps are integrated by ten steps of the midpoint rule instead of twenty of
      Euler's, so that samples follow the density.
    - Parameters on a bound of the prior are taken for parameters next to it, because
      the transform would put them infinitely far away.
    - Of a series or an image, :math:`v_x` sees an untrained copy of NPE's embedding
      net of the observation, and z itself. The original embeds z, too.
    - Draws of NPE outside the prior's support are replaced by draws of the prior.
    - ``space="embedding"`` is not in the original. :math:`T_x` then maps h(x_o) to h(x)
      and fields see h(x_o).

    References:
        | Flow Matching for Robust Simulation-Based Inference under Model
          Misspecification (Ruhlmann et al., 2026)
        | https://arxiv.org/abs/2509.23385

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``.
        density_estimator: A name, or what sbi's ``posterior_nn(...)`` returns. An
            embedding net inside it is copied, never trained in place.
        simulator: Maps parameters to simulations, batched or not. Without one, the
            appended simulations with the nearest parameters take the place of
            simulations at the calibration parameters.
        space: Where observations are mapped to simulations: as they are
            (``"input"``, as published), or by their embedding.
        noise: :math:`\epsilon`, in standard deviations of the simulations. The paper
            has .05, and .5 for its wind tunnel. With None, as in its Gaussian task, the
            way to a simulation starts at standard normal noise alone.
        num_draws: The number K of draws that the density averages over.
        simulations_per_pair: Simulations at the parameters of each pair. Fewer are made
            if they are large.
        npe_training: How NPE is trained; ``Training()`` if None.
        training: How the fields are trained, at a rate that falls to zero along a
            cosine; 300 epochs in batches of 256 if None.
        device: Where to train; data on other devices is moved there.

    Raises:
        InvalidInputError: If sbi knows no estimator of that name, an argument is
            outside its range, or the prior has neither a support nor moments that sbi's
            ``mcmc_transform`` knows.
        UnsupportedPosteriorError: In ``train``, if the estimator has no density.
        SimulationError: In ``train``, if the simulator fails.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> prior = BoxUniform(torch.zeros(1), torch.ones(1))
        >>> theta = prior.sample((200,))
        >>> method = FMCPE(
        ...     prior, "mdn", simulator=lambda theta: theta,
        ...     npe_training=Training(max_num_epochs=1),
        ...     training=Training(max_num_epochs=1),
        ... )
        >>> method = method.append_simulations(theta, theta)
        >>> method = method.append_calibration(theta[:20], theta[:20] + 0.3)
        >>> posterior = method.train(seed=0, show_progress_bars=False).build_posterior()
        >>> posterior.sample((5,), x=torch.ones(1), show_progress_bars=False).shape
        torch.Size([5, 1])
    """

    sees = frozenset({"simulations", "calibration"})
    starts_from_npe = True
    simulates = True

    def __init__(
        self,
        prior: Any,
        density_estimator: str | EstimatorBuilder = "nsf",
        *,
        simulator: Callable[[Any], Any] | None = None,
        space: Space = "input",
        noise: float | None = 0.05,
        num_draws: int = 100,
        simulations_per_pair: int = 100,
        npe_training: Training | None = None,
        training: Training | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        check("space", space, Literal["input", "embedding"])
        check("noise", noise, Positive | None)
        check("num_draws", num_draws, Count)
        check("simulations_per_pair", simulations_per_pair, Count)
        check("training", training, Training | None)
        npe = StartingNPE(density_estimator, npe_training)
        super().__init__(prior, npe=npe, simulator=simulator, device=device)
        self.space: Space = space
        self.noise = noise
        self.num_draws = num_draws
        self.simulations_per_pair = simulations_per_pair
        self.training = DEFAULT_TRAINING if training is None else training

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        npe, _ = self._trained_npe(show_progress_bars=show_progress_bars)
        h, density = frozen_statistics(npe)
        theta, x = self._data.calibration
        warn_of_far_entries("x", x, h)
        statistics = nn.Identity() if self.space == "input" else h
        bank = self._bank(statistics, show_progress_bars=show_progress_bars)
        share = bank.shape[-1] > MAX_SUMMARIES
        unit = Standardise(bank.flatten(0, 1), shared=share)
        # Real observations may be far from simulations, so that they have a unit of
        # their own where the fields see them. One observation has none.
        observed = embed(statistics, x).flatten(1)
        seen_in = Standardise(observed, shared=share) if len(x) > 1 else unit
        to_simulations = ToSimulations(
            density,
            statistics,
            unit,
            self._field(x, seen_in, h, size=bank.shape[-1]),
            h if self.space == "input" else nn.Identity(),
            event_shape=x.shape[1:],
            noise=self.noise,
            num_draws=self.num_draws,
        ).to(self._device)
        pushed = PushedForward(
            to_simulations, self._prior, self._field(x, seen_in, h, size=theta.shape[1])
        ).to(self._device)
        history = self._train(
            pushed, to_simulations, density, bank, show_progress_bars=show_progress_bars
        )
        return direct_posterior(pushed.eval(), self._prior), history

    def _bank(self, statistics: nn.Module, *, show_progress_bars: bool) -> Tensor:
        """Return flat simulations at the calibration parameters, ``(n, c, m)``."""
        pairs = self._data.pairs
        _, bank = draws(
            self._source(),
            pairs,
            max(1, min(self.simulations_per_pair, MAX_KEPT // pairs.x.numel())),
            lambda x: embed(statistics, x).flatten(1),
            progress=show_progress_bars,
        )
        return bank

    def _field(
        self, x: Tensor, unit: Standardise, h: nn.Module, *, size: int
    ) -> VelocityField:
        """Return an untrained velocity field of so many entries."""
        condition: nn.Module
        if self.space == "embedding":
            condition = nn.Sequential(Frozen(copy.deepcopy(h)), nn.Flatten(), unit)
        elif x[0].numel() > MAX_SUMMARIES and any(True for _ in h.parameters()):
            condition = nn.Sequential(fresh_copy(h), nn.Flatten())
        else:
            condition = nn.Sequential(nn.Flatten(), unit)
        return VelocityField(size, condition, embed(condition, x[:1]).shape[1]).to(x)

    def _train(
        self,
        pushed: PushedForward,
        to_simulations: ToSimulations,
        density: ConditionalDensityEstimator,
        bank: Tensor,
        *,
        show_progress_bars: bool,
    ) -> History:
        theta, x = self._data.calibration
        u = pushed.unbounded.transformed(theta)
        train, held_out = split_pairs(theta, self.training.validation_fraction)
        train, held_out = train.to(x.device), held_out.to(x.device)
        max_num_epochs = epochs_on_pairs(theta, held_out, self.training.max_num_epochs)

        def loss(rows: Tensor) -> Tensor:
            some = torch.randint(bank.shape[1], (len(rows),)).to(bank.device)
            of_simulations, simulated = to_simulations.field_loss(
                x[rows], bank[rows, some]
            )
            with torch.no_grad():
                start = density.sample(torch.Size((1,)), simulated)[0]
            start = pushed.unbounded.replaced(start)
            return 0.5 * of_simulations + 0.5 * pushed.loss(x[rows], start, u[rows])

        def batches(epoch: int) -> Any:
            return zip(shuffled(train, self.training.training_batch_size), strict=True)

        def held_out_loss() -> Tensor:
            # The same noise for all epochs, so that they can be compared.
            repeats = -(-NUM_HELD_OUT // len(held_out))
            with seeded(0):
                return loss(held_out.repeat(repeats))

        [history] = fit(
            nn.ModuleList([to_simulations.field, pushed.field]),
            batches,
            loss,
            self.training,
            validation_loss=held_out_loss if len(held_out) else None,
            max_num_epochs=max_num_epochs,
            decay=True,
            label="FMCPE",
            show_progress_bars=show_progress_bars,
        )
        return history
