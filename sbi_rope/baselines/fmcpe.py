r"""Flow matching corrected posterior estimation (FMCPE)."""

import copy
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from sbi_rope.baselines.flow_matching import Standardise, Unbounded, VelocityField
from sbi_rope.baselines.networks import fit_rows, fresh_copy
from sbi_rope.baselines.statistics import OverDraws, frozen_statistics
from sbi_rope.data.pairs import split_pairs
from sbi_rope.data.simulate import draws
from sbi_rope.density import Density
from sbi_rope.methods.base import Method
from sbi_rope.methods.training import EstimatorBuilder
from sbi_rope.npe.sbi import ConditionalDensityEstimator, direct_posterior, embed
from sbi_rope.npe.standardisation import warn_of_far_entries
from sbi_rope.training.ensemble import drawn
from sbi_rope.training.fit import History, Training
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import Positive, check

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

    It sees simulations and the calibration set. It assumes little about what is wrong,
    and has to learn all of it from the pairs, which takes hundreds of them.

    References:
        | Flow Matching for Robust Simulation-Based Inference under Model
          Misspecification (Ruhlmann et al., 2026)
        | https://arxiv.org/abs/2509.23385

    Args:
        prior, density_estimator, npe_training, simulator, device: See
            :class:`~sbi_rope.methods.Method`.
        space: Where observations are mapped to simulations: as they are (``"input"``,
            as published), or by their embedding, h(x_o) to h(x).
        noise: :math:`\epsilon`, in standard deviations of the simulations. The paper
            has .05, and .5 for its wind tunnel. With None, as in its Gaussian task, the
            way to a simulation starts at standard normal noise alone.
        training: How the fields are trained, at a rate that falls to zero along a
            cosine; 300 epochs in batches of 256 if None.
    """

    sees = frozenset({"simulations", "calibration"})
    starts_from_npe = True
    simulates = True
    default_training = Training(
        training_batch_size=256,
        learning_rate=1e-3,
        validation_fraction=0.2,
        stop_after_epochs=300,
        max_num_epochs=300,
    )

    def __init__(
        self,
        prior: Any,
        density_estimator: str | EstimatorBuilder = "nsf",
        *,
        space: Space = "input",
        noise: float | None = 0.05,
        **options: Any,
    ) -> None:
        check("space", space, Space)
        check("noise", noise, Positive | None)
        super().__init__(prior, density_estimator, **options)
        self.space: Space = space
        self.noise = noise

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
        observed = embed(statistics, x)
        seen_in = Standardise(observed.flatten(1), shared=share) if len(x) > 1 else unit
        to_simulations = ToSimulations(
            h if self.space == "input" else nn.Identity(),
            density,
            statistics,
            unit,
            self._field(x, seen_in, h, size=bank.shape[-1]),
            shapes=(x.shape[1:], observed.shape[1:]),
            noise=self.noise,
        ).to(self._device)
        pushed = PushedForward(
            to_simulations, self._prior, self._field(x, seen_in, h, size=theta.shape[1])
        ).to(self._device)
        u = pushed.unbounded.transformed(theta)

        def loss(rows: Tensor) -> Tensor:
            some = torch.randint(bank.shape[1], (len(rows),))
            of_simulations, z = to_simulations.field_loss(x[rows], bank[rows, some])
            of_theta = pushed.field_loss(x[rows], z, u[rows])
            return 0.5 * of_simulations + 0.5 * of_theta

        def held_out_loss(rows: Tensor) -> Tensor:
            # The same noise for all epochs, so that they can be compared.
            with seeded(0):
                return loss(rows.repeat(-(-NUM_HELD_OUT // len(rows))))

        history = fit_rows(
            nn.ModuleList([to_simulations.field, pushed.field]),
            loss,
            split_pairs(theta, self.training.validation_fraction),
            self.training,
            validation_loss=held_out_loss,
            pairs=theta,
            decay=True,
            in_training_mode=False,
            label="FMCPE",
            show_progress_bars=show_progress_bars,
        )
        return direct_posterior(pushed, self._prior), history

    def _field(
        self, x: Tensor, unit: Standardise, h: nn.Module, *, size: int
    ) -> VelocityField:
        """Return an untrained velocity field of so many entries."""
        if self.space == "embedding":
            condition = nn.Sequential(copy.deepcopy(h), nn.Flatten(), unit)
        elif x[0].numel() > MAX_SUMMARIES and any(True for _ in h.parameters()):
            condition = nn.Sequential(fresh_copy(h), nn.Flatten())
        else:
            condition = nn.Sequential(nn.Flatten(), unit)
        return VelocityField(size, condition, embed(condition, x[:1]).shape[1]).to(x)


class ToSimulations(OverDraws):
    r"""NPE averaged over simulations like an observation, of K draws of noise.

    .. math::
        \tfrac1K \sum_k q(\theta \mid s_k), \qquad
        s_k = h\bigl(T_x(x_o + \epsilon\, \xi_k;\, x_o)\bigr)

    What is mapped, in a unit, are ``statistics`` of an observation: itself, or its
    embedding. The shapes are those of both.
    """

    xi: Tensor

    def __init__(
        self,
        net: nn.Module,
        density: ConditionalDensityEstimator,
        statistics: nn.Module,
        unit: Standardise,
        field: VelocityField,
        *,
        shapes: tuple[torch.Size, torch.Size],
        noise: float | None,
    ) -> None:
        event_shape, self.shape = shapes
        super().__init__(net, density, NUM_DRAWS, event_shape)
        self.statistics = statistics
        self.unit = unit
        self.field = field
        self.noise = noise
        # On the CPU, so that a seed means the same on every device.
        xi = torch.randn(NUM_DRAWS, len(unit.mean), device="cpu")
        self.register_buffer("xi", xi)

    def field_loss(self, x_o: Tensor, simulated: Tensor) -> tuple[Tensor, Tensor]:
        """Return the loss of the field, and the embeddings of simulations like x_o.

        Each has a flat simulation with the same parameters, ``(n, m)``.
        """
        end, c = self.unit(simulated), self.field.condition(x_o)
        start, other = (self._start(x_o, torch.randn_like(end)) for _ in range(2))
        loss = self.field.loss(start, end, c)
        with torch.no_grad():
            return loss, self._embedded(self.field.follow(other, c))

    @torch.no_grad()
    def embed(self, x: Tensor) -> Tensor:
        """Return the embeddings of simulations like observations, ``(n, K, l)``."""
        count, parts = self.num_members, []
        for some in x.split(max(1, MAX_ENTRIES // self.xi.numel())):
            rows = some.repeat_interleave(count, dim=0)
            start = self._start(rows, self.xi.repeat(len(some), 1))
            c = self.field.condition(some).repeat_interleave(count, dim=0)
            z = self._embedded(self.field.follow(start, c))
            parts.append(z.unflatten(0, (len(some), count)))
        return torch.cat(parts)

    def _start(self, x: Tensor, noise: Tensor) -> Tensor:
        """Return where ways to simulations start, ``(n, m)``."""
        if self.noise is None:
            return noise
        return self.unit(embed(self.statistics, x).flatten(1)) + self.noise * noise

    def _embedded(self, z: Tensor) -> Tensor:
        simulated = self.unit.inverse(z).reshape(len(z), *self.shape)
        return super().embed(simulated)[:, 0]


class PushedForward(Density):
    r"""A density that a map :math:`T_\theta` carries on.

    What the density has outside the prior's support, the prior takes the place of:

    .. math:: p(\theta_0) = q(\theta_0) + (1 - Z)\, \pi(\theta_0), \qquad
        Z = \int_{\pi > 0} q .
    """

    def __init__(
        self, base: ToSimulations, prior: Distribution, field: VelocityField
    ) -> None:
        super().__init__(base.input_shape, base.condition_shape)
        self.base = base
        self.unbounded = Unbounded(prior)
        self.field = field

    def field_loss(self, x_o: Tensor, z: Tensor, end: Tensor) -> Tensor:
        """Return the loss of the field, from draws of q at embeddings to ends in u."""
        with torch.no_grad():
            start = self._started(self.base.densities.answer(drawn, z))
        return self.field.loss(start, end, self.field.condition(x_o))

    def _started(self, theta: Tensor) -> Tensor:
        """Return u of draws; the prior replaces those outside its support."""
        prior = self.unbounded.prior
        from_prior = prior.sample((len(theta),)).to(theta)
        inside = prior.inside(theta)[:, None]
        return self.unbounded.transformed(theta.where(inside, from_prior))

    def embed(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the embeddings of simulations like x, and what the field sees."""
        return self.base.embed(x), self.field.condition(x)

    def log_q(self, theta: Tensor, z: tuple[Tensor, Tensor]) -> Tensor:
        """Return the log density, shape ``(S, B)``; -inf outside the support."""
        of_base, c = z
        prior, unbounded = self.unbounded.prior, self.unbounded
        safe, inside = prior.moved_inside(theta.flatten(0, 1))
        u_end = unbounded.transformed(safe)
        u, divergence = self.field.follow_back(u_end, c.repeat(len(theta), 1))
        start = unbounded.inverse(u).reshape(theta.shape)
        log_q = self.base.log_q(start, of_base)
        log_prior = prior.log_prob(start)
        if not prior.is_unbounded:
            mass = self.base.mass(of_base, len(c), prior.inside)
            outside = (1 - mass).clamp_min(0)
            log_q = torch.logaddexp(log_q, outside.log() + log_prior)
        rest = unbounded.log_scale(u_end) - unbounded.log_scale(u) - divergence
        inside = inside.reshape(log_q.shape) & torch.isfinite(log_prior)
        return (log_q + rest.reshape(log_q.shape)).where(inside, -torch.inf)

    def draw(self, z: tuple[Tensor, Tensor], row: Tensor) -> Tensor:
        """Draw once for each of n numbers of observations, ``(n, d)``."""
        of_base, c = z
        start = self._started(self.base.draw(of_base, row))
        return self.unbounded.inverse(self.field.follow(start, c[row]))
