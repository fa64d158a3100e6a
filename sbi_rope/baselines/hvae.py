"""The hybrid VAE (HVAE): a deterministic simulator inside of an auto-encoder."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
from torch import Tensor

from sbi_rope._random import seeded
from sbi_rope._sbi import posterior_from
from sbi_rope._standardisation import ROUNDING
from sbi_rope.baselines.hvae_model import (
    ContinuedPrior,
    HybridVAE,
    LatentEncoder,
    drawn,
)
from sbi_rope.baselines.networks import ConditionalUNet
from sbi_rope.baselines.statistics import OverDraws, frozen_statistics
from sbi_rope.data import split_pairs, too_few_pairs
from sbi_rope.density import Density
from sbi_rope.ensemble import embedded
from sbi_rope.errors import InvalidInputError, warn_user
from sbi_rope.fit import History, Training, fit
from sbi_rope.settings import Count, check
from sbi_rope.trainers.base import Method
from sbi_rope.trainers.training import EstimatorBuilder

__all__ = ["HVAE"]

DEFAULT_TRAINING = Training(
    training_batch_size=100,
    learning_rate=1e-3,
    validation_fraction=0.2,
    stop_after_epochs=30,
    max_num_epochs=100,
)
# Length of z, its draws behind the posterior, and behind the loss on held-out pairs.
LATENT_DIM, NUM_LATENTS, NUM_LATENTS_HELD_OUT = 5, 64, 8
# Most entries of series or images that the U-Net sees at a time.
MAX_ENTRIES = 2**18


class HVAE(Method):
    r"""An auto-encoder of real data with the simulator in its middle and NPE before it.

    .. math::
        \max \; \frac1n \sum_i \mathrm{ELBO}(x_{o,i}) + m \, \frac1{n_c} \sum_j
        \mathbb{E} \log q\bigl(\theta_j \mid h(\tilde x_j)\bigr)

    .. math::
        \mathrm{ELBO}(x_o) = \mathbb{E} \log \mathcal{N}\bigl(x_o;
        \mathrm{P2R}(f(\theta), z)\bigr)
        - \mathrm{KL}\bigl(q(z \mid x_o) \,\|\, \mathcal{N}(0, I)\bigr)
        - \mathbb{E} \log \frac{q(\theta \mid h(\tilde x))}{p(\theta)}

    Inference: :math:`z \sim q(z \mid x_o)`, a simulation like the observation,
    :math:`\tilde x = \mathrm{R2P}(x_o, z)`, and :math:`\theta \sim q(\theta \mid
    h(\tilde x))` by NPE, which stays as it is. Explanation: the deterministic physics
    :math:`f(\theta)`, to which P2R adds with z what it lacks. P2R and R2P are U-Nets
    whose means are their inputs plus what they learn, and the mean of R2P is taken;
    :math:`q(z \mid x_o)` is an embedding net like that of NPE, untrained, with a linear
    layer. An observation has m entries. The posterior mixes :math:`q(\theta \mid
    h(\tilde x))` over 64 draws of z whose noise is fixed.

    Sees simulations, the calibration set and observations without parameters. Their
    means and standard deviations scale the data; a part of the pairs is held out, and
    the epoch with the largest log-probability on them is kept, the start included. Of
    fewer than 5 pairs none is held out, and the objective on held-out observations
    decides; of fewer than 5 observations the last epoch is kept. Assumes series or
    images, a simulator that can be differentiated once its noise is left out, and a
    prior on a box. The densities stay as narrow as those of NPE.

    References:
        | Physics-Integrated Variational Autoencoders for Robust and Interpretable
          Generative Modeling (Takeishi and Kalousis, 2021)
        | https://arxiv.org/abs/2102.13156
        | Addressing Misspecification in Simulation-based Inference through Data-driven
          Calibration (Wehenkel et al., 2025), appendices on tasks C and E
        | https://arxiv.org/abs/2405.08719

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``, its support a
            box, whose sides may be infinite.
        density_estimator: A name, or what sbi's ``posterior_nn(...)`` returns; a
            normalizing flow of nflows or zuko.
        physics: f, from theta ``(n, d)`` to ``(n, *event)``: the simulator without
            noise and nuisances, differentiable by torch.
        npe_training: How NPE is trained; ``Training()`` if None.
        training: How the networks are trained; at most 100 passes over the observations
            in batches of 100 at a learning rate of 1e-3, and 30 without improvement, if
            None.
        width: Channels of the first block of the U-Nets. The paper has 64; 8 takes a
            fraction of the time on a CPU.
        device: Where to train; data on other devices is moved there.

    Raises:
        InvalidInputError: If the prior's support is not a box. In ``train``, if the
            physics is not differentiable.
    """

    sees = frozenset({"simulations", "calibration", "observations"})
    starts_from_npe = True

    def __init__(
        self,
        prior: Any,
        density_estimator: str | EstimatorBuilder = "nsf",
        *,
        physics: Callable[[Tensor], Tensor],
        npe_training: Training | None = None,
        training: Training | None = None,
        width: int = 64,
        device: str | torch.device = "cpu",
    ) -> None:
        check("width", width, Count)
        super().__init__(prior, density_estimator, npe_training, device=device)
        self._continued_prior = ContinuedPrior(self._prior)
        self.training = training or DEFAULT_TRAINING
        self.physics = physics
        self.width = width

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        with seeded(0):
            theta = self._prior.sample(torch.Size((1,))).to(self._device, torch.float32)
            if not self.physics(theta.requires_grad_()).requires_grad:
                raise InvalidInputError(
                    "Expected `physics` to be differentiable by torch; got a result "
                    "without gradients."
                )
        npe, _ = self._trained_npe(show_progress_bars=show_progress_bars)
        model = self._model(npe)
        # On the CPU, so that a seed means the same on every device.
        noise = torch.randn(NUM_LATENTS, LATENT_DIM, device="cpu").to(self._device)
        event_shape = self._data.observations.shape[1:]
        posterior, held_out = (
            OverLatents(model, noise[:count], event_shape)
            for count in (NUM_LATENTS, NUM_LATENTS_HELD_OUT)
        )
        history = self._train(model, held_out, show_progress_bars=show_progress_bars)
        return posterior_from(npe, posterior.eval()), history

    def _model(self, npe: Any) -> HybridVAE:
        h, density = frozen_statistics(npe)
        x = torch.cat([self._data.observations, self._data.calibration[1]])
        # One number a channel: pixels that never change have no standard deviation. Nor
        # has a channel that only rounding changes.
        channels = x.transpose(0, 1).flatten(1) if x.ndim == 4 else x.reshape(1, -1)
        std, mean = torch.std_mean(channels, dim=1)
        unet = partial(
            ConditionalUNet,
            tuple(x.shape[1:]),
            LATENT_DIM,
            width=self.width,
            mean=mean,
            std=std.where(std > ROUNDING * mean.abs(), 1.0),
        )
        model = HybridVAE(
            LatentEncoder(h, LATENT_DIM, x),
            unet(),
            unet(),
            npe=(h, density),
            physics=self.physics,
            prior=self._continued_prior,
        )
        return model.to(self._device)

    def _train(
        self, model: HybridVAE, scored: Density, *, show_progress_bars: bool
    ) -> History:
        """Train in place; held out are pairs, or observations if pairs are few.

        The density shares the networks of the model, to score held-out pairs by.
        """
        theta, x = self._data.calibration
        x_o, training = self._data.observations, self.training
        train, held_out = split_pairs(theta, training.validation_fraction)
        pairs = theta[train], x[train]
        validation_loss: Callable[[], Tensor] | None = None
        if len(held_out):

            def loss_of_pairs() -> Tensor:
                return -scored.log_prob(theta[held_out], x[held_out]).mean()

            validation_loss = loss_of_pairs
        else:
            warn_user(
                f"{too_few_pairs(theta)}: none is held out, and the networks "
                "are chosen by the objective on held-out observations. Append at least "
                "5 pairs of different parameters to choose them by what matters."
            )
            rows, held_out = split_pairs(
                torch.arange(len(x_o)), training.validation_fraction
            )
            left_out, x_o = x_o[held_out], x_o[rows]

            def objective() -> Tensor:
                with seeded(0):  # or the luckiest epoch would be kept
                    return model.objective(left_out, *pairs)

            validation_loss = objective if len(held_out) else None
        unlabelled = torch.cat([x_o, pairs[1]])

        def batches(epoch: int) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
            """Pass over all observations, each batch together with one of pairs."""
            size = training.training_batch_size
            for rows in torch.randperm(len(unlabelled)).split(size):
                some = torch.randperm(len(pairs[1]))[:size]
                yield unlabelled[rows], pairs[0][some], pairs[1][some]

        [history] = fit(
            model,
            batches,
            model.objective,
            training,
            validation_loss=validation_loss,
            label="HVAE",
            show_progress_bars=show_progress_bars,
        )
        return history


class OverLatents(OverDraws):
    r"""NPE averaged over simulations like an observation, of S draws of the latent.

    .. math::
        \tfrac1S \sum_k q(\theta \mid h(\mathrm{R2P}(x_o, z_k))), \quad
        z_k = m(x_o) + \sigma(x_o) \, \epsilon_k

    The noise is the same for all observations.

    Args:
        model: The model, whose networks are shared.
        noise: :math:`\epsilon`, shape ``(S, l_z)``.
        event_shape: Shape of one observation.
    """

    noise: Tensor

    def __init__(
        self, model: HybridVAE, noise: Tensor, event_shape: torch.Size
    ) -> None:
        super().__init__(*model.npe, len(noise), event_shape)
        self.encoder = model.encoder
        self.reality_to_physics = model.reality_to_physics
        self.register_buffer("noise", noise)

    @torch.no_grad()
    def embed(self, x: Tensor) -> Tensor:
        """Return the embeddings, ``(n, *event)`` to ``(n, S, l)``."""
        size = self.condition_shape.numel()
        num_rows = max(1, MAX_ENTRIES // (size * self.num_members))
        num_draws = max(1, MAX_ENTRIES // size)
        return torch.cat(
            [
                torch.cat(
                    [self._block(rows, some) for some in self.noise.split(num_draws)],
                    dim=1,
                )
                for rows in x.split(num_rows)
            ]
        )

    def _block(self, x_o: Tensor, noise: Tensor) -> Tensor:
        """Return the embeddings of some draws, ``(b, s, l)``."""
        mean, log_variance = (moment[:, None] for moment in self.encoder(x_o))
        z = drawn(mean, log_variance, noise).flatten(0, 1)
        x_s, _ = self.reality_to_physics(x_o, z)
        s = self.nets.answer(embedded, x_s)
        return s.unflatten(0, (len(x_o), len(noise)))
