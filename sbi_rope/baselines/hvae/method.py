"""The hybrid VAE (HVAE): a deterministic simulator inside of an auto-encoder."""

import copy
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from sbi_rope._random import seeded
from sbi_rope._sbi import (
    embedding_of,
    estimator_of,
    headless,
    posterior_from,
)
from sbi_rope._standardisation import ROUNDING
from sbi_rope.baselines.hvae.embeddings import OverLatents
from sbi_rope.baselines.hvae.model import FrozenNPE, HybridVAE
from sbi_rope.baselines.hvae.networks import (
    ConditionalUNet,
    LatentEncoder,
)
from sbi_rope.baselines.hvae.prior import ContinuedPrior
from sbi_rope.baselines.hvae.training import train_hybrid
from sbi_rope.errors import InvalidInputError
from sbi_rope.fit import History, Training
from sbi_rope.settings import Count, NotNegative, check
from sbi_rope.trainers.base import Method
from sbi_rope.trainers.starting_npe import StartingNPE
from sbi_rope.trainers.training import EstimatorBuilder

__all__ = ["HVAE"]

DEFAULT_TRAINING = Training(
    training_batch_size=100,
    learning_rate=1e-3,
    validation_fraction=0.2,
    stop_after_epochs=30,
    max_num_epochs=100,
)
# Log-variance at which R2P starts, in units of the standardised data.
START_LOG_VARIANCE = -9.0
# Draws of z behind the loss on the held-out pairs.
NUM_LATENTS_HELD_OUT = 8


class HVAE(Method):
    r"""An auto-encoder of real data with the simulator in its middle and NPE before it.

    .. math::
        \max \; \frac1n \sum_i \mathrm{ELBO}(x_{o,i}) + w \, \frac1{n_c} \sum_j
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
    that predict mean and log-variance; :math:`q(z \mid x_o)` is an embedding net like
    that of NPE, untrained, with a linear layer. The posterior mixes
    :math:`q(\theta \mid h(\tilde x))` over ``num_latents`` draws of z whose noise is
    fixed.

    Sees simulations, the calibration set and observations without parameters. Their
    means and standard deviations scale the data; a part of the pairs is held out, and
    the epoch with the largest log-probability on them is kept, the start included. Of
    fewer than 5 pairs none is held out, and the objective on held-out observations
    decides; of fewer than 5 observations the last epoch is kept. Assumes series or
    images, a simulator that can be differentiated once its noise is left out, and a
    prior on a box. To be preferred where the physics lacks an effect that is the same
    in kind for all observations and many of these are at hand. On the pendulum with 50
    pairs it does better than NPE and worse than :class:`FinetunedNPE`: the densities
    stay as narrow as those of NPE.

    Where this differs from the paper, and from the original code:

    - The printed U-Nets cannot be run; ours have four up-convolutions, and outputs for
      the log-variance. Their means are their inputs plus what they learn, so that
      training starts at NPE.
    - w is not stated. At 1 the ELBO, a sum over all entries of x, outweighs the pairs;
      the default weighs them like all entries together.
    - The mean of R2P is taken. Draws from it (``noisy=True``) leave a valid bound.
    - Draws of theta outside of the prior's support are brought to its edge for the
      physics, and the density falls off exponentially there instead of ending. The
      gradient of a draw is that of implicit functions, for all flows.
    - There are none of the regularisers of the original code, as in the paper, and NPE
      takes the place of its physics encoder.

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
            normalizing flow of nflows or zuko. An embedding net inside it is copied,
            never trained in place.
        physics: f, from theta ``(n, d)`` to ``(n, *event)``: the simulator without
            noise and nuisances, differentiable by torch.
        npe_training: How NPE is trained; ``Training()`` if None.
        training: How the networks are trained; at most 100 passes over the observations
            in batches of 100 at a learning rate of 1e-3, and 30 without improvement, if
            None.
        width: Channels of the first block of the U-Nets. The paper has 64; 8 takes a
            fraction of the time on a CPU.
        latent_dim: Length of z.
        num_latents: Components of the posterior.
        calibration_weight: w; the number of entries of an observation if None. The
            paper's objective has 1.
        residual: Whether U-Nets start as the identity.
        noisy: Whether simulations are drawn from R2P; otherwise its mean is taken.
        device: Where to train; data on other devices is moved there.

    Raises:
        InvalidInputError: If an argument is outside its range, sbi knows no estimator
            of that name, or the prior's support is not a box. In ``train``, if the
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
        latent_dim: int = 5,
        num_latents: int = 64,
        calibration_weight: float | None = None,
        residual: bool = True,
        noisy: bool = False,
        device: str | torch.device = "cpu",
    ) -> None:
        check("training", training, Training | None)
        check("width", width, Count)
        check("latent_dim", latent_dim, Count)
        check("num_latents", num_latents, Count)
        check("calibration_weight", calibration_weight, NotNegative | None)
        npe = StartingNPE(density_estimator, npe_training)
        super().__init__(prior, npe=npe, device=device)
        ContinuedPrior(self._prior)  # early, for its error
        self.training = DEFAULT_TRAINING if training is None else training
        self.physics = physics
        self.width = width
        self.latent_dim = latent_dim
        self.num_latents = num_latents
        self.calibration_weight = calibration_weight
        self.residual = residual
        self.noisy = noisy

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        with seeded(0):
            theta = self._prior.sample(torch.Size((1,))).to(self._device, torch.float32)
            if not self.physics(theta.requires_grad_()).requires_grad:
                raise InvalidInputError(
                    "Expected `physics` to be differentiable by torch; got a result "
                    "without gradients."
                )
        npe, _ = self._trained_npe(show_progress_bars=show_progress_bars)
        estimator = (
            copy.deepcopy(estimator_of(npe)).eval().requires_grad_(requires_grad=False)
        )
        model = self._model(estimator)
        event_shape = self._data.observations.shape[1:]
        # On the CPU, so that a seed means the same on every device.
        noise = torch.randn(self.num_latents, self.latent_dim, device="cpu")
        x_noise = (
            torch.randn(self.num_latents, *event_shape, device="cpu")
            if self.noisy
            else None
        )
        mixture, held_out = (
            self._mixture(model, noise[:count], x_noise)
            for count in (self.num_latents, NUM_LATENTS_HELD_OUT)
        )
        weight = self.calibration_weight
        history = train_hybrid(
            model,
            held_out,
            self._data.observations,
            *self._data.calibration,
            weight=event_shape.numel() if weight is None else weight,
            training=self.training,
            show_progress_bars=show_progress_bars,
        )
        return posterior_from(npe, mixture.eval()), history

    def _mixture(
        self, model: HybridVAE, z_noise: Tensor, x_noise: Tensor | None
    ) -> OverLatents:
        """Return NPE averaged over draws of z, with the networks of the model."""
        if x_noise is not None:
            x_noise = x_noise[: len(z_noise)]
        event_shape = self._data.observations.shape[1:]
        return OverLatents(model, z_noise, x_noise, event_shape).to(self._device)

    def _model(self, estimator: Any) -> HybridVAE:
        x = torch.cat([self._data.observations, self._data.calibration[1]])
        npe = FrozenNPE(embedding_of(estimator), headless(estimator))
        # One number a channel: pixels that never change have no standard deviation. Nor
        # has a channel that only rounding changes.
        channels = x.transpose(0, 1).flatten(1) if x.ndim == 4 else x.reshape(1, -1)
        std, mean = torch.std_mean(channels, dim=1)
        unet = partial(
            ConditionalUNet,
            tuple(x.shape[1:]),
            self.latent_dim,
            width=self.width,
            mean=mean,
            std=std.where(std > ROUNDING * mean.abs(), 1.0),
            residual=self.residual,
        )
        model = HybridVAE(
            LatentEncoder(npe.embedding, self.latent_dim, x),
            unet(log_variance=START_LOG_VARIANCE),
            unet(),
            npe=npe,
            physics=self.physics,
            prior=ContinuedPrior(self._prior, device=self._device),
            noisy=self.noisy,
        )
        return model.to(self._device)
