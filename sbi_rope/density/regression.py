r"""Regression of parameters on observations, without a simulator."""

import copy
import math
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor, nn
from torch.distributions import Chi2, MultivariateNormal

from sbi_rope.density.base import Density
from sbi_rope.npe.sbi import embed
from sbi_rope.utils.tensors import divisors

# More entries than these are reduced to principal components, at most so many.
MAX_ENTRIES, MAX_COMPONENTS = 20, 10
# Medians of the length scales, relative to the root of the number of inputs, of the
# variance and of the noise, and standard deviations of their logarithms in the prior.
# Chosen on calibration pairs, see benchmarks/choices.md.
LENGTH, VARIANCE, NOISE = (3.0, 0.5), (1.0, 2.0), (0.1, 2.0)
# Pairs that these are learned from, and steps of the optimiser.
MAX_PAIRS, MAX_STEPS = 100, 15
# The prior of the errors counts as so many pairs.
PSEUDO_PAIRS = 2


class GaussianProcess(Density):
    r"""A Gaussian process of the parameters, given an observation or its embedding.

    .. math::
        \theta \mid x \sim t_\nu\bigl(m(x),\; s(x)^2\, \Sigma\bigr), \qquad
        m(x) = k_x^\top K^{-1} \Theta, \quad
        s(x)^2 = k(x, x) + \sigma^2 - k_x^\top K^{-1} k_x,

    with a squared exponential kernel k that has a length scale for each input, and
    :math:`K = k(X, X) + \sigma^2 \operatorname{diag} w^{-1}`. More than 20 inputs are
    reduced to principal components. :math:`\Sigma` is the covariance of the errors of
    the pairs in units of s, each predicted without its group, which has a closed form.
    Two more pairs have errors of unit size.

    Args:
        theta: Parameters of n pairs, shape ``(n, d)``, each of which varies.
        x: Their observations, shape ``(n, *event)``.
        weights: How many independent pairs each counts as, shape ``(n,)``.
        groups: The number of the group of each, shape ``(n,)``.
        net: An embedding net, if the process is one of h(x).

    Attributes:
        hyperparameters: The variance of k, its length scales, and the noise.
    """

    mean: Tensor
    to_inputs: Tensor
    inputs: Tensor
    hyperparameters: Tensor
    inverse: Tensor
    coefficients: Tensor
    centre: Tensor
    factor: Tensor
    degrees: Tensor

    def __init__(
        self,
        theta: Tensor,
        x: Tensor,
        *,
        weights: Tensor,
        groups: Tensor,
        net: nn.Module | None = None,
    ) -> None:
        super().__init__(theta.shape[1:], x.shape[1:])
        self.representation = nn.Identity() if net is None else copy.deepcopy(net)
        w, phi, theta = weights.double(), self._represented(x), theta.double()
        mean, to_inputs = _inputs(phi)
        centre = w @ theta / w.sum()
        std = divisors((w @ (theta - centre).square() / w.sum()).sqrt())
        y = (theta - centre) / std
        learned = _learned((phi - mean) @ to_inputs, y)
        to_inputs = to_inputs / learned[1:-1]  # in length scales
        inputs = (phi - mean) @ to_inputs
        covariance = _kernel(inputs, inputs, learned[0]) + (learned[-1] / w).diag()
        inverse = torch.linalg.inv(covariance)
        coefficients, errors = inverse @ y, torch.empty_like(y)
        for group in groups.unique():
            rows = (groups == group).nonzero()[:, 0]
            block = torch.linalg.inv(inverse[rows][:, rows])
            errors[rows] = block @ coefficients[rows] / block.diagonal().sqrt()[:, None]
        scatter = errors.T @ (w[:, None] * errors)
        scatter = scatter + PSEUDO_PAIRS * torch.eye(len(std)).to(errors)
        factor = torch.linalg.cholesky(scatter / (w.sum() + PSEUDO_PAIRS))
        degrees = (w.sum() + PSEUDO_PAIRS - len(std)).clamp_min(PSEUDO_PAIRS)
        self.register_buffer("mean", mean)
        self.register_buffer("to_inputs", to_inputs)
        self.register_buffer("inputs", inputs)
        self.register_buffer("hyperparameters", learned)
        self.register_buffer("inverse", inverse)
        self.register_buffer("coefficients", std * coefficients)
        self.register_buffer("centre", centre)
        self.register_buffer("factor", std[:, None] * factor)
        self.register_buffer("degrees", degrees)
        self.eval().requires_grad_(requires_grad=False)

    def _represented(self, x: Tensor) -> Tensor:
        return embed(self.representation, x).flatten(1).double()

    def embed(self, x: Tensor) -> Tensor:
        """Return m(x) and s(x) of observations, ``(B, d + 1)``, float64."""
        variance, noise = self.hyperparameters[0], self.hyperparameters[-1]
        inputs = (self._represented(x) - self.mean) @ self.to_inputs
        kernel = _kernel(inputs, self.inputs, variance)
        explained = ((kernel @ self.inverse) * kernel).sum(dim=1, keepdim=True)
        scale = (variance - explained).clamp_min(0.0).add(noise).sqrt()
        mean = self.centre + kernel @ self.coefficients
        return torch.cat([mean, scale], dim=1)

    def log_q(self, theta: Tensor, z: Tensor) -> Tensor:
        """Return the log density at theta ``(S, B, d)``, shape ``(S, B)``, float64."""
        mean, scale = z[:, :-1], z[:, -1]
        d, degrees = mean.shape[1], self.degrees
        error = ((theta.double() - mean) / scale[:, None]).flatten(0, 1).T
        white = torch.linalg.solve_triangular(self.factor, error, upper=False)
        square = white.square().sum(dim=0).reshape(theta.shape[:2])
        log_volume = self.factor.diagonal().log().sum() + d * scale.log()
        return (
            torch.lgamma((degrees + d) / 2)
            - torch.lgamma(degrees / 2)
            - d / 2 * (degrees * math.pi).log()
            - log_volume
            - (degrees + d) / 2 * torch.log1p(square / degrees)
        )

    def draw(self, z: Tensor, row: Tensor) -> Tensor:
        """Draw once for each of n numbers of observations, ``(n, d)``."""
        mean, scale = z[row, :-1], z[row, -1:]
        normal = torch.randn(mean.shape).to(mean) @ self.factor.T
        chi = Chi2(self.degrees).sample(torch.Size((len(row), 1))) / self.degrees
        return (mean + scale * normal / chi.sqrt()).float()


def _kernel(a: Tensor, b: Tensor, variance: Tensor) -> Tensor:
    """Return the kernel of all inputs in length scales, ``(n, m)``."""
    return variance * torch.exp(-torch.cdist(a, b).square() / 2)


def _inputs(phi: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean, and the map to standardised entries or components."""
    mean, std = phi.mean(dim=0), phi.std(dim=0, correction=0)
    to_inputs = torch.where(std > 0, 1 / std, 0.0)
    if phi.shape[1] <= MAX_ENTRIES:
        return mean, to_inputs.diag()
    centred = (phi - mean) * to_inputs
    _, size, directions = torch.linalg.svd(centred, full_matrices=False)
    varied = int((size > 1e-6 * size[0]).sum())
    count = max(1, min(MAX_COMPONENTS, len(phi) // 2, varied))
    scale = size[:count] / len(phi) ** 0.5
    return mean, to_inputs[:, None] * directions[:count].T / scale.clamp_min(1e-6)


def _learned(inputs: Tensor, y: Tensor) -> Tensor:
    """Return the variance, the length scales and the noise at their posterior mode."""
    some = torch.randperm(len(inputs))[:MAX_PAIRS].to(inputs.device)
    inputs, targets, width = inputs[some].cpu(), y[some].cpu(), inputs.shape[1]
    medians = [VARIANCE[0], *[LENGTH[0] * width**0.5] * width, NOISE[0]]
    start = torch.tensor(medians, dtype=torch.double).log()
    spread = torch.tensor([VARIANCE[1], *[LENGTH[1]] * width, NOISE[1]])
    bounds = np.log([(1e-3, 1e4), *[(1e-2, 1e5)] * width, (1e-8, 1e2)])

    @torch.enable_grad()
    def negative_log_posterior(at: np.ndarray) -> tuple[float, np.ndarray]:
        log = torch.from_numpy(at).requires_grad_()
        variance, lengths, noise = log.exp().tensor_split([1, -1])
        scaled = inputs / lengths
        covariance = _kernel(scaled, scaled, variance) + noise * torch.eye(len(scaled))
        law = MultivariateNormal(torch.zeros(len(scaled)).double(), covariance)
        value = ((log - start) / spread).square().sum() / 2
        value = value - law.log_prob(targets.T).sum()
        (gradient,) = torch.autograd.grad(value, log)
        return value.item(), gradient.numpy()

    options: Any = {"method": "L-BFGS-B", "options": {"maxiter": MAX_STEPS}}
    found = minimize(
        negative_log_posterior, start.numpy(), jac=True, bounds=bounds, **options
    )
    return torch.from_numpy(np.exp(found.x)).to(y)
