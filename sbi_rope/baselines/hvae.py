"""The hybrid VAE (HVAE): a deterministic simulator inside of an auto-encoder."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from sbi_rope.baselines.hvae_model import (
    ConditionalUNet,
    ContinuedPrior,
    HybridVAE,
    LatentEncoder,
)
from sbi_rope.baselines.networks import fit_rows
from sbi_rope.baselines.statistics import OverDraws, frozen_statistics
from sbi_rope.data.pairs import split_pairs
from sbi_rope.methods.base import Method
from sbi_rope.methods.training import EstimatorBuilder
from sbi_rope.npe.sbi import posterior_from
from sbi_rope.training.ensemble import embedded
from sbi_rope.training.fit import History, Training
from sbi_rope.utils.errors import InvalidInputError
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import Count, check

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
    :math:`f(\theta)`, to which P2R adds with z what it lacks. P2R and R2P are U-Nets;
    :math:`q(z \mid x_o)` is an untrained embedding net with a linear layer. An
    observation has m entries. The posterior mixes :math:`q(\theta \mid h(\tilde x))`
    over 64 draws of z. The epoch that is best on held-out pairs is kept.

    It sees simulations, the calibration set and observations without parameters. It
    assumes series or images, a simulator that can be differentiated once its noise is
    left out, and a prior on a box, whose sides may be infinite. The densities stay as
    narrow as those of NPE.

    References:
        | Physics-Integrated Variational Autoencoders for Robust and Interpretable
          Generative Modeling (Takeishi and Kalousis, 2021)
        | https://arxiv.org/abs/2102.13156
        | Addressing Misspecification in Simulation-based Inference through Data-driven
          Calibration (Wehenkel et al., 2025), appendices on tasks C and E
        | https://arxiv.org/abs/2405.08719

    Args:
        prior, npe_training, device: See :class:`~sbi_rope.methods.Method`.
        density_estimator: A name, or what sbi's ``posterior_nn(...)`` returns; a
            normalizing flow of nflows or zuko.
        physics: f, from theta ``(n, d)`` to ``(n, *event)``: the simulator without
            noise and nuisances, differentiable by torch.
        training: How the networks are trained; at most 100 passes over the observations
            in batches of 100 at a learning rate of 1e-3, and 30 without improvement, if
            None.
        width: Channels of the first block of the U-Nets. The paper has 64; 8 takes a
            fraction of the time on a CPU.

    Raises:
        InvalidInputError: In ``train``, if the physics is not differentiable.
    """

    sees = frozenset({"simulations", "calibration", "observations"})
    starts_from_npe = True
    default_training = Training(
        training_batch_size=100,
        learning_rate=1e-3,
        validation_fraction=0.2,
        stop_after_epochs=30,
        max_num_epochs=100,
    )

    def __init__(
        self,
        prior: Any,
        density_estimator: str | EstimatorBuilder = "nsf",
        *,
        physics: Callable[[Tensor], Tensor],
        width: int = 64,
        **options: Any,
    ) -> None:
        check("width", width, Count)
        super().__init__(prior, density_estimator, **options)
        self.physics = physics
        self.width = width

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        with seeded(0):
            theta = self._prior.sample((1,)).requires_grad_()
            if not self.physics(theta).requires_grad:
                raise InvalidInputError(
                    "Expected `physics` to be differentiable by torch; got a result "
                    "without gradients."
                )
        npe, _ = self._trained_npe(show_progress_bars=show_progress_bars)
        h, density = frozen_statistics(npe)
        seen = torch.cat([self._data.observations[0], self._data.calibration[1]])
        model = HybridVAE(
            LatentEncoder(h, LATENT_DIM, seen),
            ConditionalUNet(seen, LATENT_DIM, width=self.width),
            ConditionalUNet(seen, LATENT_DIM, width=self.width),
            npe=(h, density),
            physics=self.physics,
            prior=ContinuedPrior(self._prior),
        ).to(self._device)
        # On the CPU, so that a seed means the same on every device.
        noise = torch.randn(NUM_LATENTS, LATENT_DIM, device="cpu").to(self._device)
        # They share the networks of the model.
        posterior, scored = (
            OverLatents(model, noise[:count], seen.shape[1:])
            for count in (NUM_LATENTS, NUM_LATENTS_HELD_OUT)
        )
        theta, x = self._data.calibration
        train, held_out = split_pairs(theta, self.training.validation_fraction)
        unlabelled = torch.cat([self._data.observations[0], x[train]])

        def loss(rows: Tensor) -> Tensor:
            order = train[torch.randperm(len(train))]
            some = order[: self.training.training_batch_size]
            return model.objective(unlabelled[rows], theta[some], x[some])

        history = fit_rows(
            model,
            loss,
            (torch.arange(len(unlabelled)), held_out),
            self.training,
            validation_loss=lambda rows: scored.loss(theta[rows], x[rows]).mean(),
            pairs=theta,
            label="HVAE",
            show_progress_bars=show_progress_bars,
        )
        return posterior_from(npe, posterior.eval()), history


class OverLatents(OverDraws):
    r"""NPE averaged over simulations like an observation, of S draws of the latent.

    .. math::
        \tfrac1S \sum_k q(\theta \mid h(\mathrm{R2P}(x_o, z_k))), \quad
        z_k = m(x_o) + \sigma(x_o) \, \epsilon_k

    The noise :math:`\epsilon`, ``(S, l_z)``, is the same for all observations. The
    networks are those of the model.
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
        count, parts = self.num_members, []
        size = MAX_ENTRIES // (self.condition_shape.numel() * count)
        for some in x.split(max(1, size)):
            law = self.encoder(some)
            z = law.mean[:, None] + law.stddev[:, None] * self.noise
            x_s = self.reality_to_physics(some, z.flatten(0, 1)).mean
            s = self.nets.answer(embedded, x_s)
            parts.append(s.unflatten(0, (len(some), count)))
        return torch.cat(parts)
