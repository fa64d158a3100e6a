r"""The linear-Gaussian task, whose posteriors are all known."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor, nn
from torch.distributions import MultivariateNormal, Normal, StudentT

from sbi_rope.tasks.base import Task
from sbi_rope.tasks.networks import fully_connected
from sbi_rope.tasks.splits import DrawnPairs, Part
from sbi_rope.tasks.variants import COMMON_VARIANTS
from sbi_rope.utils.errors import InvalidInputError
from sbi_rope.utils.settings import Number, Positive, Range, Settings, default_names
from sbi_rope.utils.tensors import as_batch

MAX_DIM = 25
NOISE_STD = 0.5
# Each entry of x also sees the parameter before its own, so that parameters are
# correlated given x.
COUPLING = 0.5
# The errors of the variants in which no gain and offset describe what is wrong.
BEND = 0.5
TAILS_STD, TAILS_FREEDOM = 0.3, 1.5


@dataclass(frozen=True, kw_only=True)
class LinearGaussianSimulator(Settings):
    r"""A linear map of the parameters with Gaussian noise, then a gain and an offset.

    .. math:: x = s\, (A \theta + \sigma \varepsilon) + m, \qquad
        \varepsilon \sim \mathcal{N}(0, I), \qquad
        A_{kk} = 1, \; A_{k, k-1} = 1/2.

    Args:
        dim: Number :math:`d` of parameters and of entries of x.
        noise_std: The noise :math:`\sigma`.
        scale: The gain :math:`s`, which is 1 in the simulator.
        shift: The offset :math:`m` of all entries, which is 0 in the simulator.

    Example:
        >>> simulator = LinearGaussianSimulator(dim=2, noise_std=1e-6)
        >>> simulator(torch.tensor([[1.0, 2.0]])).round(decimals=3)
        tensor([[1.0000, 2.5000]])
    """

    dim: Annotated[int, Range(1, MAX_DIM)] = 2
    noise_std: Positive = NOISE_STD
    scale: Number = 1.0
    shift: Number = 0.0

    def __call__(self, theta: Tensor) -> Tensor:
        """Simulate ``theta`` of shape ``(n, d)``, to the same shape."""
        theta = as_batch("theta", theta, (self.dim,), empty=True)
        return self.observe(theta, torch.randn_like(theta))

    def observe(self, theta: Tensor, noise: Tensor) -> Tensor:
        r"""Return observations for given noise :math:`\varepsilon`, differentiable."""
        clean = theta @ self.matrix(theta).T
        return self.scale * (clean + self.noise_std * noise) + self.shift

    def matrix(self, like: Tensor) -> Tensor:
        """Return the matrix A, with the dtype and device of a tensor."""
        diagonal = torch.ones(self.dim, dtype=like.dtype, device=like.device)
        return torch.diag(diagonal) + COUPLING * torch.diag(diagonal[1:], diagonal=-1)

    def posterior(self, x: Tensor) -> MultivariateNormal:
        r"""Return :math:`p(\theta \mid x)` for a standard normal prior.

        .. math:: \Sigma^{-1} = I + A^\top A / \sigma^2, \qquad
            \mu = \Sigma A^\top \frac{x - m}{s \sigma^2}.

        Args:
            x: Observations, shape ``(n, d)``.

        Returns:
            One Gaussian for each row, batch shape ``(n,)``, float64.
        """
        x = as_batch("x", x, (self.dim,)).double()
        matrix = self.matrix(x)
        precision = torch.eye(self.dim, dtype=x.dtype, device=x.device)
        precision = precision + matrix.T @ matrix / self.noise_std**2
        undone = (x - self.shift) / (self.scale * self.noise_std**2)
        mean = torch.linalg.solve(precision, (undone @ matrix).T).T
        return MultivariateNormal(mean, precision_matrix=precision)


class LinearGaussian(Task):
    r"""A Gaussian task of up to 25 dimensions whose true posterior is in closed form.

    The prior is standard normal, the simulator linear with Gaussian noise
    (:class:`LinearGaussianSimulator`). The real process is the simulator followed by
    an unknown gain and offset, :math:`x_o = s x_s + m`: it satisfies the assumption of
    RoPE that :math:`x_o` is independent of :math:`\theta` given :math:`x_s`, and an
    ideal method recovers the posterior of the simulation, :meth:`get_true_posterior`.
    The task is not in the paper.

    Two variants are made for linear models of the discrepancy to fail. In ``"curved"``
    :math:`(A \theta)_k^2 / 2` is added to each entry, so that two parameters can have
    the same observation. In ``"heavy_tails"`` each entry has an error of Student's t
    distribution with 1.5 degrees of freedom, whose variance is infinite, times 0.3.

    Args:
        variant, root, label_noise: See :class:`~sbi_rope.tasks.Task`.
        dim: Number of parameters and of entries of x, from 1 to 25.
        scale: Gain of the real process, not 0.
        shift: Offset of the real process. With a gain of 1 and an offset of 0 the
            simulator is exact.
        noise_std: Standard deviation of the noise.

    Example:
        >>> task = LinearGaussian(dim=3)
        >>> theta, x_o = task.get_test_set(100)
        >>> task.get_true_posterior(x_o).log_prob(theta).shape
        torch.Size([100])
    """

    name = "linear_gaussian"
    misspecification = "the real process has another gain and an offset"
    variants = COMMON_VARIANTS | {
        "curved": "the error of the simulator is a square of the parameters",
        "heavy_tails": "the real process has errors of infinite variance",
    }
    shifted_region = {"theta_1": (0.5, math.inf)}  # noqa: RUF012

    def __init__(
        self,
        *,
        variant: str | None = None,
        root: str | Path | None = None,
        label_noise: float | None = None,
        dim: int = 2,
        scale: float = 1.4,
        shift: float = 0.7,
        noise_std: float = NOISE_STD,
    ) -> None:
        super().__init__(variant=variant, root=root, label_noise=label_noise)
        exact = variant == "well_specified"
        self._real = LinearGaussianSimulator(
            dim=dim,
            noise_std=noise_std,
            scale=1.0 if exact else scale,
            shift=0.0 if exact else shift,
        )
        self.dim = dim
        self.parameter_names = default_names(dim)
        self.parameter_units = ("1",) * dim
        self.x_names = tuple(f"x_{k + 1}" for k in range(dim))
        self.x_shape = (dim,)
        self.noise_std = noise_std

    def get_prior(self) -> MultivariateNormal:
        """Return the standard normal prior."""
        zeros = torch.zeros(self.dim, dtype=torch.float32)
        return MultivariateNormal(zeros, torch.eye(self.dim, dtype=torch.float32))

    def prior_quantiles(self, theta: Tensor) -> Tensor:
        """Return the normal distribution function of each entry, ``(n, d)``."""
        return Normal(theta.new_zeros(()), theta.new_ones(())).cdf(theta)

    def get_simulator(self) -> LinearGaussianSimulator:
        """Return the simulator, with gain 1 and offset 0."""
        return LinearGaussianSimulator(dim=self.dim, noise_std=self.noise_std)

    def get_embedding_net(self, *, light: bool = False) -> nn.Module:
        """Return a network with two hidden layers of 64 and 2 d outputs."""
        return fully_connected(self.dim, (64, 64, 2 * self.dim))

    @property
    def has_true_posterior(self) -> bool:
        """Whether the variant has a posterior in closed form."""
        return self.variant not in ("curved", "heavy_tails")

    def get_true_posterior(self, x_o: Tensor) -> MultivariateNormal:
        r"""Return :math:`p(\theta \mid x_o)` of the real process under the prior.

        It is exact for real parameters that follow the prior, hence in all variants
        but ``"prior_shift"``.

        Args:
            x_o: Real observations, shape ``(n, d)``.

        Returns:
            One Gaussian for each row, batch shape ``(n,)``, float64.

        Raises:
            InvalidInputError: In ``"curved"`` and ``"heavy_tails"``, whose posteriors
                have no closed form.
        """
        if not self.has_true_posterior:
            raise InvalidInputError(
                "Expected a variant with a posterior in closed form; got "
                f"{self.variant!r}."
            )
        return self._real.posterior(x_o)

    def _real_process(self, part: Part) -> DrawnPairs:
        return replace(self._simulated_process(), observe=self._observe)

    def _observe(self, theta: Tensor) -> Tensor:
        x = self._real(theta)
        if self.variant == "curved":
            return x + BEND * (theta @ self._real.matrix(theta).T).square()
        if self.variant == "heavy_tails":
            freedom = theta.new_full((), TAILS_FREEDOM)  # torch's default may change
            return x + TAILS_STD * StudentT(freedom).sample(x.shape)
        return x
