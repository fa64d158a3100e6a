r"""The discrepancy of x, learned from observations without labels, too."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from sbi_rope.data.simulate import Moments
from sbi_rope.discrepancy.posterior import (
    SMALLEST_ERROR,
    DiscrepancyDraws,
    noise_scale,
)
from sbi_rope.training.fit import Training, fit
from sbi_rope.utils.seeds import seeded

# Gaussians that the marginal density of simulations mixes, fitted to so many.
NUM_COMPONENTS, NUM_FITTED = 25, 8000
# Prior standard deviations of the offset, and of the diagonal and the other entries of
# the gain. Centre of those of the error, whose logarithms have standard deviation one.
OFFSET, DIAGONAL, OFF_DIAGONAL, ERROR = 0.3, 0.3, 0.1, 0.3
SEARCH = Training(learning_rate=3e-2, max_num_epochs=200)
# Steps of Newton's method, and the distance of gradients whose difference is taken.
NUM_HESSIANS, NUM_NEWTON, NUM_HALVINGS, STEP = 2, 5, 6, 1e-4


class Marginal(NamedTuple):
    """A Gaussian mixture of simulations from the prior, in float64."""

    weights: Tensor
    means: Tensor
    covariances: Tensor

    @classmethod
    def of(cls, z_s: Tensor) -> "Marginal":
        """Fit the mixture to simulations, shape ``(n_s, l)``."""
        from sklearn.mixture import GaussianMixture

        mixture = GaussianMixture(NUM_COMPONENTS, random_state=0, reg_covar=1e-4)
        mixture.fit(z_s[:NUM_FITTED].double().cpu().numpy())
        found = mixture.weights_, mixture.means_, mixture.covariances_
        return cls(*(torch.from_numpy(one).to(z_s.device) for one in found))


@dataclass(frozen=True, eq=False)
class LaplaceDiscrepancy:
    """A normal approximation of the posterior of gain, offset and error."""

    mode: Tensor  # in standard deviations of the prior, (P,)
    root: Tensor  # of the covariance, (P, P)
    scale: Tensor  # the diagonal of D, see DiscrepancyModel, (l,)

    def sample(
        self, num_draws: int, *, smallest_error: float, seed: int | None = None
    ) -> DiscrepancyDraws:
        """Draw gains, offsets and errors, see :meth:`Discrepancy.sample`."""
        with seeded(seed):
            normal = torch.randn(num_draws, len(self.mode)).to(self.mode)
        values = self.mode + normal @ self.root.T
        gain, offset, factor = _unpacked(values, len(self.scale))
        smallest = (smallest_error * self.scale).square().diag()
        factor = torch.linalg.cholesky(factor @ factor.mT + smallest)
        return DiscrepancyDraws(gain, offset, factor)


def fit_unlabelled(
    z: Tensor,
    moments: Moments,
    weights: Tensor,
    z_o: Tensor,
    marginal: Marginal,
    *,
    show_progress_bars: bool = False,
) -> list[LaplaceDiscrepancy]:
    r"""Return posteriors given labelled pairs and observations without labels.

    With :math:`z_o = A z_s + b + e`, :math:`e \sim \mathcal N(0, S)`, and a Gaussian
    mixture of simulations from the prior,

    .. math::
        z_i \mid \theta_i \sim \mathcal N(A m_i + b,\; A C_i A^\top + S), \qquad
        z_o \sim \sum_k \pi_k\, \mathcal N(A \mu_k + b,\; A \Sigma_k A^\top + S) .

    This is right only where the parameters of the observations follow the prior. The
    mode is searched from that of the labels alone, and its Hessian gives the covariance
    (Laplace's approximation). All quantities are in standard deviations of simulations.
    Each of E versions has weights, ``(E, n)``, and does not see those of weight zero.
    """
    z_o, width, count = z_o.double(), z.shape[1], len(weights)
    seen = (weights > 0)[..., None]
    z = z.double().where(seen, 0.0)
    mean = moments.mean.double().where(seen, 0.0)
    one = torch.eye(width).to(z)
    covariance = moments.covariance.double().where(seen[..., None], one)
    share = (weights / weights.sum(dim=1, keepdim=True))[..., None, None]
    scale = noise_scale((share * covariance).sum(dim=1))
    smallest = torch.diag_embed((SMALLEST_ERROR["input"] * scale).square())

    def loss(at: Tensor, *, unlabelled: bool = True) -> Tensor:
        gain, offset, factor = _unpacked(at, width)
        error = factor @ factor.mT + smallest
        around = gain[:, None] @ covariance @ gain[:, None].mT + error[:, None]
        rest = z - mean @ gain.mT - offset[:, None]
        log_p = (weights * _log_normal(rest[:, :, None], around)[..., 0]).sum(dim=1)
        if unlabelled:
            around = gain[:, None] @ marginal.covariances @ gain[:, None].mT
            centres = marginal.means @ gain.mT + offset[:, None]
            of_each = _log_normal(z_o - centres[:, :, None], around + error[:, None])
            of_each = of_each + marginal.weights.log()[:, None]
            log_p = log_p + of_each.logsumexp(dim=1).sum(dim=1)
        return at.square().sum(dim=1) / 2 - log_p

    num_entries = width**2 + width + width * (width + 1) // 2
    modes = _Modes(torch.zeros(count, num_entries).to(z))
    for unlabelled in (False, True):
        fit(
            modes,
            lambda step: [()],
            lambda u=unlabelled: loss(modes.values, unlabelled=u),
            SEARCH,
            decay=True,
            in_training_mode=False,
            label="Discrepancy of x_o",
            show_progress_bars=show_progress_bars and unlabelled,
        )
    parts = zip(*_polished(loss, modes.values.detach()), scale, strict=True)
    return [LaplaceDiscrepancy(*of_version) for of_version in parts]


class _Modes(nn.Module):
    """Points of E log posteriors, which are raised as the losses of E networks are."""

    def __init__(self, values: Tensor) -> None:
        super().__init__()
        self.values, self.num_members = nn.Parameter(values), len(values)


def _polished(loss: Callable[[Tensor], Tensor], at: Tensor) -> tuple[Tensor, Tensor]:
    """Return the modes, and roots of the covariances.

    Each Hessian, of differences of gradients, serves several steps of Newton's method.
    """

    def gradient(values: Tensor) -> Tensor:
        values = values.detach().requires_grad_()
        with torch.enable_grad():
            return torch.autograd.grad(loss(values).sum(), values)[0]

    root = torch.eye(at.shape[1]).to(at).expand(len(at), -1, -1)
    for _ in range(NUM_HESSIANS):
        columns = []
        for step in STEP * torch.eye(at.shape[1]).to(at):
            columns.append((gradient(at + step) - gradient(at - step)) / (2 * STEP))
        hessian = torch.stack(columns, dim=2)
        values, directions = torch.linalg.eigh((hessian + hessian.mT) / 2)
        # The prior by itself has the curvature one.
        root = directions / values.clamp_min(1.0).sqrt()[:, None]
        for _ in range(NUM_NEWTON):
            move = -(root @ (root.mT @ gradient(at)[..., None]))[..., 0]
            size, before = torch.ones(len(at), 1).to(at), loss(at)
            for _ in range(NUM_HALVINGS):
                size = torch.where(
                    (loss(at + size * move) > before)[:, None], size / 2, size
                )
            better = (loss(at + size * move) < before)[:, None]
            at = torch.where(better, at + size * move, at)
    return at, root


def _unpacked(values: Tensor, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return gain, offset and a factor of the error, of numbers ``(*batch, P)``."""
    sizes = width**2, width, width * (width + 1) // 2
    gain, offset, triangle = values.split(sizes, dim=-1)
    one = torch.eye(width).to(values)
    std = OFF_DIAGONAL + (DIAGONAL - OFF_DIAGONAL) * one
    gain = one + std * gain.unflatten(-1, (width, width))
    rows, columns = torch.tril_indices(width, width)
    entries = torch.where(
        rows == columns, ERROR * triangle.clamp(-8, 8).exp(), 0.3 * ERROR * triangle
    )
    factor = torch.zeros_like(gain)
    factor[..., rows, columns] = entries
    return gain, OFFSET * offset, factor


def _log_normal(rest: Tensor, covariance: Tensor) -> Tensor:
    """Return the log density of m values with each covariance, ``(*batch, m, l)``."""
    factor = torch.linalg.cholesky(covariance)
    white = torch.linalg.solve_triangular(factor, rest.mT, upper=False)
    log_volume = factor.diagonal(dim1=-2, dim2=-1).log().sum(dim=-1, keepdim=True)
    constant = rest.shape[-1] / 2 * math.log(2 * math.pi)
    return -white.square().sum(dim=-2) / 2 - log_volume - constant
