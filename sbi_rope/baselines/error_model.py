r"""The error model of RNPE and NNPE, and statistics with its errors taken away."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sbi_rope.npe.sbi import SliceSamplerVectorized
from sbi_rope.utils.settings import Positive, Settings, UnitInterval

# Draws of noise farther out are put here, since networks see them: 8e-5 of all.
BOUND = 1e3
# Widest bracket of the slice sampler; it also ends the search where a density is flat.
MAX_WIDTH = 50.0


@dataclass(frozen=True, kw_only=True)
class SpikeAndSlab(Settings):
    r"""What real statistics differ by from simulated ones: nothing much, or anything.

    .. math::
        p(y \mid s) = \prod_d (1 - \pi)\, \mathcal{N}(y_d;\, s_d, \sigma^2)
        + \pi\, \mathrm{Cauchy}(y_d;\, s_d, \lambda)

    The choice between the two is summed out. Statistics are in units of their standard
    deviation over simulations.

    References:
        | Robust Neural Posterior Estimation and Statistical Model Criticism
          (Ward et al., 2022), section 3.2
        | https://arxiv.org/abs/2210.06564

    Args:
        spike_std: :math:`\sigma`, of the Gaussian of a well described statistic.
        slab_scale: :math:`\lambda`, half the interquartile range of the Cauchy law of a
            misspecified one.
        slab_probability: :math:`\pi`, in [0, 1].
    """

    spike_std: Positive = 0.01
    slab_scale: Positive = 0.25
    slab_probability: UnitInterval = 0.5

    def sample_like(self, x: Tensor) -> Tensor:
        """Draw noise of the shape, dtype and device of a tensor."""
        spike = self.spike_std * torch.randn_like(x)
        slab = torch.empty_like(x).cauchy_(sigma=self.slab_scale)
        is_slab = torch.rand_like(x) < self.slab_probability
        return slab.where(is_slab, spike).clamp(-BOUND, BOUND)

    def log_prob(self, noise: Tensor) -> Tensor:
        """Return the log density of every entry of y - s, without the bound."""
        z = noise / self.spike_std
        spike = -0.5 * z**2 - math.log(self.spike_std * math.sqrt(2 * math.pi))
        z = noise / self.slab_scale
        slab = -torch.log1p(z**2) - math.log(self.slab_scale * math.pi)
        share = torch.tensor(self.slab_probability).to(noise)
        return torch.logaddexp(spike + torch.log1p(-share), slab + share.log())


def denoise(
    y: Tensor,
    *,
    log_density: Callable[[Tensor], Tensor],
    simulated: Tensor,
    error_model: SpikeAndSlab,
    num_draws: int,
    num_chains: int,
    warmup: int,
    thin: int,
) -> tuple[Tensor, Tensor]:
    r"""Draw the statistics that a simulator may have had behind real ones.

    .. math::
        p(s \mid y) \propto q(s)\, p(y \mid s)

    by slice sampling of :math:`z = \operatorname{asinh}((y - s) / \sigma)`, in which
    spike and slab are about equally wide. One chain starts at y, the others at the
    simulations to which the error model gives the largest density.

    Standardised real statistics y are ``(n, l)``, simulated ones ``(n_s, l)``. The
    first ``warmup`` sweeps of each chain are thrown away, then all but every
    ``thin``-th. The draws are ``(n, num_draws, l)``, and the largest split-R-hats of
    the statistics of each observation ``(n,)``.
    """
    rows = y.repeat_interleave(num_chains, dim=0).double()

    @torch.no_grad()
    def log_target(states: np.ndarray) -> np.ndarray:
        z = torch.as_tensor(states).to(rows)
        noise = error_model.spike_std * torch.sinh(z)
        log_q = log_density((rows - noise).to(y)).double()
        # The last two terms are the log of dn/dz up to a constant.
        terms = error_model.log_prob(noise) + torch.logaddexp(z, -z)
        return (log_q + terms.sum(dim=-1)).nan_to_num(nan=-torch.inf).cpu().numpy()

    starts = _starts(y, simulated, error_model, num_chains)
    sampler = SliceSamplerVectorized(
        log_target,
        starts.double().cpu().numpy(),
        num_chains=len(rows),
        tuning=warmup,  # all of what is not kept serves to tune the brackets
        init_width=1.0,
        max_width=MAX_WIDTH,
        verbose=False,
    )
    z = torch.as_tensor(sampler.run(math.ceil(num_draws / num_chains) * thin))
    z = z.to(rows).unflatten(0, (len(y), num_chains))
    noise = error_model.spike_std * torch.sinh(z)[:, :, thin - 1 :: thin]
    # In turns, so that dropping the last of an uneven number takes from all chains.
    s = (y[:, None, None] - noise).transpose(1, 2).flatten(1, 2)[:, :num_draws]
    return s.to(y), split_r_hat(z).amax(dim=-1).to(y)


def _starts(
    y: Tensor, simulated: Tensor, error_model: SpikeAndSlab, num_chains: int
) -> Tensor:
    """Return the first z of each chain, ``(n * num_chains, l)``."""
    starts = []
    for one in y:  # one at a time: n times n_s times l may be large
        log_prob = error_model.log_prob(one - simulated).sum(dim=-1)
        nearest = log_prob.topk(min(num_chains - 1, len(simulated))).indices
        # Of fewer simulations than chains some serve twice.
        nearest = nearest[torch.arange(num_chains - 1) % max(1, len(nearest))]
        starts.append(one - torch.cat([one[None], simulated[nearest]]))
    return torch.asinh(torch.cat(starts) / error_model.spike_std)


def split_r_hat(draws: Tensor) -> Tensor:
    r"""Return how much chains and their halves disagree; one if they do not.

    .. math::
        \hat R = \sqrt{\frac{n - 1}{n} + \frac{B}{n W}}

    with W the mean variance within half chains of n draws and B / n the variance of
    their means (Bayesian Data Analysis, Gelman et al., 2013, section 11.4). Draws are
    ``(..., num_chains, num_draws, l)``, and the result is ``(..., l)``.
    """
    half = draws.shape[-2] // 2
    halves = torch.cat([draws[..., :half, :], draws[..., -half:, :]], dim=-3)
    within = halves.var(dim=-2).mean(dim=-2)
    between = halves.mean(dim=-2).var(dim=-2)
    ratio = (between / within).nan_to_num(nan=0.0, posinf=torch.inf)
    return ((half - 1) / half + ratio).sqrt().where(between > 0, 1.0)
