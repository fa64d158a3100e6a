r"""Flow matching corrected posterior estimation (FMCPE)."""

import copy
from collections.abc import Callable
from typing import Any, Literal

import torch
from sbi.utils import mcmc_transform
from torch import Tensor, nn
from torch.distributions import Distribution

from sbi_rope._random import seeded
from sbi_rope._sbi import (
    ConditionalDensityEstimator,
    copy_of_prior,
    direct_posterior,
    embed,
    estimator_of,
)
from sbi_rope._standardisation import ROUNDING, warn_of_far_entries
from sbi_rope._training import (
    EPOCHS_WITHOUT_HOLDOUT,
    History,
    fit,
    split_pairs,
    warn_without_holdout,
)
from sbi_rope._validation import (
    check_choice,
    check_instance,
    check_integer,
    check_positive,
)
from sbi_rope.baselines.flow_matching import (
    VelocityField,
    follow,
    follow_back,
    matching_loss,
)
from sbi_rope.baselines.networks import fresh_copy
from sbi_rope.baselines.statistics import split_at_statistics
from sbi_rope.errors import InvalidInputError
from sbi_rope.mixture import Mixing, MixtureEstimator, Part, Rows, equal_rows
from sbi_rope.trainers.base import Method
from sbi_rope.trainers.starting_npe import StartingNPE
from sbi_rope.trainers.training import EstimatorBuilder, Training

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
# Most entries of simulations that are made of observations at a time.
MAX_ENTRIES = 2**22
# Simulations behind the moments of x, and draws of the prior behind those of theta.
NUM_DRAWS = 10_000
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

    along the way of theta back to :math:`\theta_0`. The noise :math:`\xi_k` is drawn
    once and is the same for all observations.

    Sees simulations and the calibration set, and simulates at the calibration
    parameters. It assumes little about what is wrong, and has to learn all of it from
    the pairs, which takes hundreds of them.

    Where this differs from the original code:

    - The density is an average over K = 100 simulations. With K = 1, as published, it
      is too small on average, because the logarithm of an average is larger than the
      average of logarithms.
    - Simulations at the calibration parameters are made once, 100 for each pair, and
      each batch chooses among them, instead of new ones for each batch.
    - Of all epochs the best on the held-out pairs is kept, the start included. Fields
      start at zero, at which both maps leave everything where it is.
    - The maps are integrated by the midpoint rule instead of Euler's, so that samples
      follow the density.
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
        num_draws: K.
        simulations_per_pair: Simulations at the parameters of each pair. Fewer are made
            if they are large.
        npe_training: How NPE is trained; ``Training()`` if None.
        training: How the fields are trained, at a rate that falls to zero along a
            cosine; 300 epochs in batches of 256 if None.
        device: Where to train; data on other devices is moved there.

    Raises:
        InvalidTypeError: If an argument has the wrong type.
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
        simulator: Callable[[Tensor], Tensor] | None = None,
        space: Space = "input",
        noise: float | None = 0.05,
        num_draws: int = 100,
        simulations_per_pair: int = 100,
        npe_training: Training | None = None,
        training: Training | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        check_choice("space", space, ("input", "embedding"))
        if noise is not None:
            check_positive("noise", noise)
        check_integer("num_draws", num_draws)
        check_integer("simulations_per_pair", simulations_per_pair)
        check_instance("training", training, Training, optional=True)
        npe = StartingNPE(density_estimator, npe_training)
        super().__init__(prior, npe=npe, simulator=simulator, device=device)
        Unbounded(self._prior)  # early, for its error
        self.space: Space = space
        self.noise = noise
        self.num_draws = num_draws
        self.simulations_per_pair = simulations_per_pair
        self.training = DEFAULT_TRAINING if training is None else training

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        npe, _ = self._trained_npe(show_progress_bars=show_progress_bars)
        estimator = copy.deepcopy(estimator_of(npe)).eval()
        h, density = split_at_statistics(
            estimator.requires_grad_(requires_grad=False), "embedding"
        )
        theta, x = self._data.calibration
        warn_of_far_entries("x", x, h)
        statistics = nn.Identity() if self.space == "input" else h
        bank = self._bank(statistics, show_progress_bars=show_progress_bars)
        unit = Standardise(bank.flatten(0, 1))
        to_simulations = ToSimulations(
            statistics,
            unit,
            self._field(x, unit, h, size=bank.shape[-1]),
            h if self.space == "input" else nn.Identity(),
            event_shape=x.shape[1:],
            noise=self.noise,
            num_draws=self.num_draws,
        ).to(self._device)
        base = MixtureEstimator([Part(density, to_simulations)], [1.0])
        pushed = PushedForward(
            base, self._prior, self._field(x, unit, h, size=theta.shape[1])
        ).to(self._device)
        history = self._train(
            pushed, to_simulations, density, bank, show_progress_bars=show_progress_bars
        )
        return direct_posterior(pushed.eval(), self._prior), history

    def _bank(self, statistics: nn.Module, *, show_progress_bars: bool) -> Tensor:
        """Return flat simulations at the calibration parameters, ``(n, c, m)``."""
        theta, x = self._data.calibration
        return self._source().draws(
            theta,
            max(1, min(self.simulations_per_pair, MAX_KEPT // x.numel())),
            lambda x: embed(statistics, x).flatten(1),
            progress=show_progress_bars,
        )

    def _field(
        self, x: Tensor, unit: "Standardise", h: nn.Module, *, size: int
    ) -> VelocityField:
        """Return an untrained velocity field of so many entries."""
        condition: nn.Module
        if self.space == "embedding":
            condition = nn.Sequential(copy.deepcopy(h), nn.Flatten(), unit)
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
        train, held_out = split_pairs(theta, self.training.validation_fraction)
        train, held_out = train.to(x.device), held_out.to(x.device)
        max_num_epochs = self.training.max_num_epochs
        if not len(held_out):
            warn_without_holdout(theta)
            max_num_epochs = min(max_num_epochs, EPOCHS_WITHOUT_HOLDOUT)

        def loss(rows: Tensor) -> Tensor:
            some = torch.randint(bank.shape[1], (len(rows),)).to(bank.device)
            of_simulations, simulated = to_simulations.loss(x[rows], bank[rows, some])
            with torch.no_grad():
                start = density.sample(torch.Size((1,)), simulated)[0]
            start = pushed.unbounded.replaced(start)
            return 0.5 * of_simulations + 0.5 * pushed.loss(x[rows], start, u[rows])

        def batches(epoch: int) -> Any:
            order = train[torch.randperm(len(train)).to(train.device)]
            size = self.training.training_batch_size
            return [(rows,) for rows in order.split(size)]

        def held_out_loss() -> Tensor:
            # The same noise for all epochs, so that they can be compared.
            repeats = -(-NUM_HELD_OUT // len(held_out))
            with seeded(0):
                return loss(held_out.repeat(repeats))

        return fit(
            nn.ModuleList([to_simulations.field, pushed.field]),
            batches,
            loss,
            validation_loss=held_out_loss if len(held_out) else None,
            learning_rate=self.training.learning_rate,
            max_num_epochs=max_num_epochs,
            stop_after_epochs=self.training.stop_after_epochs,
            clip_max_norm=self.training.clip_max_norm,
            decay=True,
            label="FMCPE",
            show_progress_bars=show_progress_bars,
        )


class Standardise(nn.Module):
    """Flat simulations in standard deviations from their mean; ``inverse`` undoes it.

    Args:
        rows: Simulations, shape ``(n, m)``. Long ones share a standard deviation.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, rows: Tensor) -> None:
        super().__init__()
        mean, std = _moments(rows)
        if len(std) > MAX_SUMMARIES:
            std = std.square().mean().sqrt().expand_as(std).clone()
        self.register_buffer("mean", mean)
        self.register_buffer("std", std)

    def forward(self, rows: Tensor) -> Tensor:
        """Return the standardised rows, ``(n, m)``."""
        return (rows - self.mean) / self.std

    def inverse(self, z: Tensor) -> Tensor:
        """Return the rows of standardised ones, ``(n, m)``."""
        return self.mean + self.std * z


class ToSimulations(Mixing):
    r"""Simulations like an observation, by flow matching from K draws of noise.

    .. math:: s_k(x_o) = h\bigl(T_x(x_o + \epsilon\, \xi_k;\, x_o)\bigr)

    All have equal weights.

    Args:
        statistics: What is mapped of an observation: itself, or its embedding.
        unit: Standardises what is mapped.
        field: The velocity field of the map.
        then: From what it is mapped to, to the embedding that NPE's density sees.
        event_shape: Shape of one observation.
        noise: :math:`\epsilon`; None leaves the observation out of the start.
        num_draws: K.
    """

    xi: Tensor

    def __init__(
        self,
        statistics: nn.Module,
        unit: Standardise,
        field: VelocityField,
        then: nn.Module,
        *,
        event_shape: torch.Size,
        noise: float | None,
        num_draws: int,
    ) -> None:
        super().__init__(event_shape, num_draws)
        self.statistics = statistics
        self.unit = unit
        self.field = field
        self.then = then
        self.noise = noise
        # On the CPU, so that a seed means the same on every device.
        noise_shape = num_draws, len(unit.mean)
        self.register_buffer("xi", torch.randn(noise_shape, device="cpu"))
        blank = unit.mean.new_zeros(1, *event_shape)
        self.shape = embed(statistics, blank).shape[1:]

    def loss(self, x_o: Tensor, simulated: Tensor) -> tuple[Tensor, Tensor]:
        """Return the loss of the field, and the embedding of a simulation like each.

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
        count = self.num_embeddings
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

    def rows(self, embedded: Tensor) -> Rows:
        """Weigh all draws equally."""
        return equal_rows(embedded)

    def _embedded(self, z: Tensor) -> Tensor:
        return embed(self.then, self.unit.inverse(z).reshape(len(z), *self.shape))


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
        self, base: MixtureEstimator, prior: Distribution, field: VelocityField
    ) -> None:
        super().__init__(nn.Identity(), base.input_shape, base.condition_shape)
        self.base = base
        self.unbounded = Unbounded(prior)
        self.field = field

    def loss(  # type: ignore[override]
        self, x_o: Tensor, start: Tensor, end: Tensor
    ) -> Tensor:
        """Return the loss of flow matching, a mean over all rows.

        Args:
            x_o: Observations, shape ``(n, *event)``.
            start: Draws of the density before the map, shape ``(n, d)``.
            end: What they are to be carried to, transformed, shape ``(n, d)``.
        """
        start = self.unbounded.transformed(start)
        return matching_loss(self.field, start, end, self.field.condition(x_o))

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Return the log density, shape ``(S, B)``; -inf outside the support."""
        theta = input if input.ndim == 3 else input[None]
        count, num_rows = theta.shape[0], max(theta.shape[1], len(condition))
        theta = theta.expand(count, num_rows, -1)
        c = self.field.condition(condition)
        c = c.expand(num_rows, -1).repeat(count, 1)
        u, log_scale, inside = self.unbounded.checked(theta.flatten(0, 1))
        u_start, divergence = follow_back(self.field, u, c)
        start = self.unbounded.inverse(u_start)
        _, log_scale_at_start, usable = self.unbounded.checked(start)
        base = self._log_prob_at_start(start.reshape(theta.shape), condition)
        rest = log_scale - log_scale_at_start - divergence
        log_prob = base + rest.reshape(count, num_rows)
        inside = (inside & usable).reshape(count, num_rows)
        return log_prob.where(inside, -torch.inf)

    def _log_prob_at_start(self, start: Tensor, condition: Tensor) -> Tensor:
        """Return the log density before the map, ``(S, B)``."""
        inside = self.unbounded.contains
        outside = 1 - self.base.mass(condition, accept=inside, cache={}).mass
        replaced = self.unbounded.prior.log_prob(start.flatten(0, 1))
        return torch.logaddexp(
            self.base.log_prob(start, condition),
            outside.clamp_min(0).log().to(start) + replaced.reshape(start.shape[:2]),
        )

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


class Unbounded(nn.Module):
    r"""Parameters without bounds, in standard deviations of the prior.

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``.

    Raises:
        InvalidInputError: If sbi knows no transform of its support.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, prior: Distribution) -> None:
        super().__init__()
        self.prior = copy_of_prior(prior)
        with seeded(0):
            draws = self.prior.sample(torch.Size((NUM_DRAWS,))).float()
        self._set_transform(draws.device)
        mean, std = _moments(self._transform(draws))
        self.register_buffer("mean", mean)
        self.register_buffer("std", std)

    def _set_transform(self, device: torch.device) -> None:
        if hasattr(self.prior, "to"):
            self.prior.to(device)
        try:
            with seeded(0):  # sbi draws from the prior to look at it
                transform = mcmc_transform(self.prior, device=str(device))
        except Exception as error:  # sbi raises all kinds
            raise InvalidInputError(
                "Expected a prior whose `support` torch's `biject_to` knows, or which "
                f"has a `mean` and a `stddev`; of this {type(self.prior).__name__} "
                f"`mcmc_transform` says {type(error).__name__}: {error}"
            ) from error
        self._transform: Any = transform

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:  # noqa: FBT001, FBT002
        before = self.mean.device
        moved = super()._apply(fn, recurse)
        if self.mean.device != before:
            self._set_transform(self.mean.device)
        return moved

    def transformed(self, theta: Tensor) -> Tensor:
        """Return parameters without bounds, ``(n, d)``."""
        return (self._transform(theta) - self.mean) / self.std

    def inverse(self, u: Tensor) -> Tensor:
        """Return the parameters of transformed ones, ``(n, d)``."""
        return self._transform.inv(self.mean + self.std * u)

    def contains(self, theta: Tensor) -> Tensor:
        """Tell which parameters ``(n, d)`` can be transformed."""
        return self.checked(theta)[2]

    def replaced(self, theta: Tensor) -> Tensor:
        """Replace parameters outside the prior's support by draws of the prior."""
        prior = self.prior.sample(torch.Size((len(theta),))).to(theta)
        return torch.where(self.contains(theta)[:, None], theta, prior)

    def checked(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Transform parameters that may be outside the prior's support.

        Returns:
            Transformed parameters ``(n, d)``, the logarithm of the volume that the
            transform multiplies by, ``(n,)``, and which rows are inside. The others
            have zeros.
        """
        try:
            inside = self.prior.support.check(theta)
        except (AttributeError, NotImplementedError):
            inside = torch.ones_like(theta[:, 0], dtype=torch.bool)
        if inside.ndim == 2:
            inside = inside.all(dim=1)
        some = self._transform.inv(self.mean.expand_as(theta))
        safe = torch.where(inside[:, None], theta, some)
        u = self._transform(safe)
        log_scale = self._transform.log_abs_det_jacobian(safe, u)
        if log_scale.ndim == 2:
            log_scale = log_scale.sum(dim=1)
        inside = inside & torch.isfinite(u).all(dim=1) & torch.isfinite(log_scale)
        u = (u - self.mean) / self.std
        return (
            u.where(inside[:, None], 0.0),
            log_scale.where(inside, 0.0) - self.std.log().sum(),
            inside,
        )


def _moments(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation, one where the latter would be zero."""
    std, mean = torch.std_mean(rows, dim=0)
    smallest = ROUNDING * mean.abs().clamp_min(ROUNDING)
    return mean, std.where(std > smallest, torch.ones_like(std))
