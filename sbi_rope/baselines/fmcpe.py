r"""Flow matching corrected posterior estimation (FMCPE)."""

import copy
from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from sbi_rope._random import seeded
from sbi_rope._sbi import ConditionalDensityEstimator, direct_posterior, embed
from sbi_rope._standardisation import warn_of_far_entries
from sbi_rope.baselines.flow_matching import (
    Standardise,
    Unbounded,
    VelocityField,
    follow,
    follow_back,
    matching_loss,
)
from sbi_rope.baselines.networks import fresh_copy
from sbi_rope.baselines.statistics import OverDraws, frozen_statistics
from sbi_rope.data import split_pairs
from sbi_rope.density import Density
from sbi_rope.fit import History, Training, epochs_on_pairs, fit, shuffled
from sbi_rope.settings import Positive, check
from sbi_rope.simulate import draws
from sbi_rope.trainers.base import Method
from sbi_rope.trainers.training import EstimatorBuilder

__all__ = ["FMCPE"]

DEFAULT_TRAINING = Training(
    training_batch_size=256,
    learning_rate=1e-3,
    validation_fraction=0.2,
    stop_after_epochs=300,
    max_num_epochs=300,
)
# The simulations like an observation that the density averages over, and those at the
# parameters of each pair. Fewer are made if they are large.
NUM_DRAWS, SIMULATIONS_PER_PAIR = 100, 100
# An observation with more entries than this is a series or an image, whose entries
# share a unit, and of which the velocity fields see an embedding.
MAX_SUMMARIES = 20
# Most entries of simulations that are kept for training, or made at a time.
MAX_KEPT, MAX_ENTRIES = 2**26, 2**22
# Rows behind the loss on the held-out pairs, which are repeated for it.
NUM_HELD_OUT = 256

Space = Literal["input", "embedding"]


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

    along the way of theta back to :math:`\theta_0`. The noise :math:`\xi_k`, K = 100,
    is drawn once and is the same for all observations.

    Sees simulations and the calibration set, and simulates at the calibration
    parameters. It assumes little about what is wrong, and has to learn all of it from
    the pairs, which takes hundreds of them.

    References:
        | Flow Matching for Robust Simulation-Based Inference under Model
          Misspecification (Ruhlmann et al., 2026)
        | https://arxiv.org/abs/2509.23385

    Args:
        prior, density_estimator, npe_training, device: See :class:`Method`.
        simulator: Maps parameters to simulations, batched or not. Without one, the
            appended simulations with the nearest parameters take the place of
            simulations at the calibration parameters.
        space: Where observations are mapped to simulations: as they are (``"input"``,
            as published), or by their embedding, h(x_o) to h(x).
        noise: :math:`\epsilon`, in standard deviations of the simulations. The paper
            has .05, and .5 for its wind tunnel. With None, as in its Gaussian task, the
            way to a simulation starts at standard normal noise alone.
        training: How the fields are trained, at a rate that falls to zero along a
            cosine; 300 epochs in batches of 256 if None.

    Raises:
        UnsupportedPosteriorError: In ``train``, if the estimator has no density.
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
        npe_training: Training | None = None,
        training: Training | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        check("space", space, Literal["input", "embedding"])
        check("noise", noise, Positive | None)
        super().__init__(
            prior, density_estimator, npe_training, simulator=simulator, device=device
        )
        self.space: Space = space
        self.noise = noise
        self.training = training or DEFAULT_TRAINING

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        npe, _ = self._trained_npe(show_progress_bars=show_progress_bars)
        h, density = frozen_statistics(npe)
        theta, x = self._data.calibration
        warn_of_far_entries("x", x, h)
        statistics = nn.Identity() if self.space == "input" else h
        # Flat simulations at the calibration parameters, (n, c, m).
        _, bank = draws(
            self._source(),
            self._data.pairs,
            max(1, min(SIMULATIONS_PER_PAIR, MAX_KEPT // x.numel())),
            lambda x: embed(statistics, x).flatten(1),
            progress=show_progress_bars,
        )
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
        ).to(self._device)
        pushed = PushedForward(
            to_simulations, self._prior, self._field(x, seen_in, h, size=theta.shape[1])
        ).to(self._device)
        history = self._train(
            pushed, to_simulations, density, bank, show_progress_bars=show_progress_bars
        )
        return direct_posterior(pushed.eval(), self._prior), history

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
        pushed: "PushedForward",
        to_simulations: "ToSimulations",
        density: ConditionalDensityEstimator,
        bank: Tensor,
        *,
        show_progress_bars: bool,
    ) -> History:
        theta, x = self._data.calibration
        u = pushed.unbounded.transformed(theta)
        size = self.training.training_batch_size
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
            return 0.5 * of_simulations + 0.5 * pushed.loss(x[rows], start, u[rows])

        def held_out_loss() -> Tensor:
            # The same noise for all epochs, so that they can be compared.
            repeats = -(-NUM_HELD_OUT // len(held_out))
            with seeded(0):
                return loss(held_out.repeat(repeats))

        [history] = fit(
            nn.ModuleList([to_simulations.field, pushed.field]),
            lambda epoch: zip(shuffled(train, size), strict=True),
            loss,
            self.training,
            validation_loss=held_out_loss if len(held_out) else None,
            max_num_epochs=max_num_epochs,
            decay=True,
            label="FMCPE",
            show_progress_bars=show_progress_bars,
        )
        return history


class Frozen(nn.Sequential):
    """A net that stays in evaluation mode while what contains it is trained."""

    def train(self, mode: bool = True) -> "Frozen":  # noqa: FBT001, FBT002
        """Do not switch to training mode."""
        return super().train(mode=False)


class ToSimulations(OverDraws):
    r"""NPE averaged over simulations like an observation, of K draws of noise.

    .. math::
        \tfrac1K \sum_k q(\theta \mid s_k), \qquad
        s_k = h\bigl(T_x(x_o + \epsilon\, \xi_k;\, x_o)\bigr)

    Args:
        density: :math:`q(\theta \mid s)`.
        statistics: What is mapped of an observation: itself, or its embedding.
        unit: Standardises what is mapped.
        field: The velocity field of the map.
        then: From what it is mapped to, to the embedding that NPE's density sees.
        event_shape: Shape of one observation.
        noise: :math:`\epsilon`; None leaves the observation out of the start.
    """

    xi: Tensor

    def __init__(
        self,
        density: ConditionalDensityEstimator,
        statistics: nn.Module,
        unit: Standardise,
        field: VelocityField,
        then: nn.Module,
        *,
        event_shape: torch.Size,
        noise: float | None,
    ) -> None:
        super().__init__(then, density, NUM_DRAWS, event_shape)
        self.statistics = statistics
        self.unit = unit
        self.field = field
        self.noise = noise
        # On the CPU, so that a seed means the same on every device.
        xi = torch.randn(NUM_DRAWS, len(unit.mean), device="cpu")
        self.register_buffer("xi", xi)
        blank = unit.mean.new_zeros(1, *event_shape)
        self.shape = embed(statistics, blank).shape[1:]

    def field_loss(self, x_o: Tensor, simulated: Tensor) -> tuple[Tensor, Tensor]:
        """Return the loss of the field, and the embeddings of simulations like x_o.

        Args:
            x_o: Observations, shape ``(n, *event)``.
            simulated: A flat simulation with the same parameters, shape ``(n, m)``.
        """
        end, c = self.unit(simulated), self.field.condition(x_o)
        centre, scale = self._start(x_o)
        start, other = (centre + scale * torch.randn_like(end) for _ in range(2))
        loss = matching_loss(self.field, start, end, c)
        with torch.no_grad():
            return loss, self._embedded(follow(self.field, other, c))

    @torch.no_grad()
    def embed(self, x: Tensor) -> Tensor:
        """Return the embeddings of simulations like observations, ``(n, K, l)``."""
        size = max(1, MAX_ENTRIES // self.xi.numel())
        return torch.cat([self._like(part) for part in x.split(size)])

    def _like(self, x: Tensor) -> Tensor:
        count = self.num_members
        centre, scale = self._start(x)
        start = (centre[:, None] + scale * self.xi).flatten(0, 1)
        c = self.field.condition(x).repeat_interleave(count, dim=0)
        embedded = self._embedded(follow(self.field, start, c))
        return embedded.unflatten(0, (len(x), count))

    def _start(self, x: Tensor) -> tuple[Tensor, float]:
        """Return mean ``(n, m)`` and deviation of where ways to simulations start."""
        flat = self.unit(embed(self.statistics, x).flatten(1))
        if self.noise is None:
            return torch.zeros_like(flat), 1.0
        return flat, self.noise

    def _embedded(self, z: Tensor) -> Tensor:
        simulated = self.unit.inverse(z).reshape(len(z), *self.shape)
        return super().embed(simulated)[:, 0]


class PushedForward(ConditionalDensityEstimator):
    r"""A density that a map :math:`T_\theta` carries on.

    What the density has outside the prior's support, the prior takes the place of:

    .. math:: p(\theta_0) = q(\theta_0) + (1 - Z)\, \pi(\theta_0), \qquad
        Z = \int_{\pi > 0} q .

    Args:
        base: The density of :math:`\theta_0` given an observation.
        prior: The prior.
        field: The velocity field of the map.
    """

    def __init__(
        self, base: Density, prior: Distribution, field: VelocityField
    ) -> None:
        super().__init__(nn.Identity(), base.input_shape, base.condition_shape)
        self.base = base
        self.unbounded = Unbounded(prior)
        self.field = field

    def loss(  # type: ignore[override]
        self, x_o: Tensor, start: Tensor, end: Tensor
    ) -> Tensor:
        """Return the loss of flow matching, from draws of the base to ends in u."""
        start = self.unbounded.transformed(self.unbounded.replaced(start))
        return matching_loss(self.field, start, end, self.field.condition(x_o))

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Return the log density, shape ``(S, B)``; -inf outside the support."""
        theta = input if input.ndim == 3 else input[None]
        count, num_rows = theta.shape[0], max(theta.shape[1], len(condition))
        theta = theta.expand(count, num_rows, -1)
        c = self.field.condition(condition)
        c = c.expand(num_rows, -1).repeat(count, 1)
        u, log_scale, inside = self.unbounded.transformed_inside(theta.flatten(0, 1))
        u_start, divergence = follow_back(self.field, u, c)
        start = self.unbounded.inverse(u_start)
        usable = self.unbounded.contains(start)
        base = self._log_prob_at_start(start.reshape(theta.shape), condition)
        rest = log_scale - self.unbounded.log_scale(u_start) - divergence
        log_prob = base + rest.reshape(count, num_rows)
        inside = (inside & usable).reshape(count, num_rows)
        return log_prob.where(inside, -torch.inf)

    def _log_prob_at_start(self, start: Tensor, condition: Tensor) -> Tensor:
        """Return the log density before the map, ``(S, B)``."""
        prior = self.unbounded.prior
        z, num_rows = self.base.embed(condition), len(condition)
        log_q = self.base.log_prob_given(start, z, num_rows).to(start)
        if prior.is_unbounded:
            return log_q
        outside = 1 - self.base.mass(z, num_rows, self.unbounded.contains)
        replaced = prior.log_prob(start)
        return torch.logaddexp(log_q, outside.clamp_min(0).log().to(start) + replaced)

    @torch.no_grad()
    def sample(
        self, sample_shape: torch.Size, condition: Tensor, **kwargs: Any
    ) -> Tensor:
        """Draw parameters, shape ``(*sample_shape, B, d)``."""
        count, num_rows = torch.Size(sample_shape).numel(), len(condition)
        start = self.base.sample(torch.Size((count,)), condition).flatten(0, 1)
        u = self.unbounded.transformed(self.unbounded.replaced(start))
        c = self.field.condition(condition).repeat(count, 1)
        theta = self.unbounded.inverse(follow(self.field, u, c))
        return theta.reshape(*sample_shape, num_rows, -1)
