r"""Densities :math:`q(\theta \mid x)` for any observation x."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from sbi_rope.npe.prior import PriorDistribution
from sbi_rope.npe.sbi import ConditionalDensityEstimator
from sbi_rope.utils.errors import warn_user
from sbi_rope.utils.seeds import seeded

# Tells which parameters ``(n, d)`` are inside the prior's support, ``(n,)``.
Accept = Callable[[Tensor], Tensor]
# Pairs of a parameter and a component in one call of a flow. On a CPU the intermediate
# results of a larger call leave the caches, and on a GPU a smaller one is all overhead.
CPU_BATCH, GPU_BATCH = 2**14, 2**17
# Weights, terms of a density or draws that are held at a time. With all that is
# computed from it each takes some 64 bytes.
MAX_ENTRIES = 2**19
# Draws from which the mass inside the prior's support is estimated.
NUM_DRAWS = 1024

# glibc keeps freed memory only after it once freed a block of almost 32 MiB. Flows are
# a third faster then.
torch.empty(2**25 - 2**16, dtype=torch.uint8)


def batches(rows: Tensor, *, share: int = 1) -> Sequence[Tensor]:
    """Cut rows into batches of pairs for a flow, each of which counts ``share``."""
    size = CPU_BATCH if rows.device.type == "cpu" else GPU_BATCH
    return rows.split(max(1, size // share))


def num_fitting(num_columns: int) -> int:
    """Return how many rows of so many entries are held at a time."""
    return max(1, MAX_ENTRIES // max(1, num_columns))


def without_nan(log_q: Tensor) -> Tensor:
    """Count NaN densities as zero, so that their sum is not NaN."""
    undefined = torch.isnan(log_q)
    if undefined.any():
        warn_user(
            f"{int(undefined.sum())} of {undefined.numel()} component densities are "
            "NaN and count as zero. Look for observations that are far from all "
            "simulations, or train NPE longer."
        )
    return log_q.where(~undefined, -torch.inf)


class Density(ConditionalDensityEstimator):
    r"""A density :math:`q(\theta \mid x)`, an estimator in the sense of sbi.

    A subclass defines :meth:`embed`, :meth:`log_q` and :meth:`draw`.

    Args:
        input_shape: Shape of the parameters, ``(d,)``.
        condition_shape: Shape of one observation.
    """

    def __init__(
        self, input_shape: Sequence[int], condition_shape: Sequence[int]
    ) -> None:
        super().__init__(
            nn.Identity(), torch.Size(input_shape), torch.Size(condition_shape)
        )

    @abstractmethod
    def embed(self, x: Tensor) -> Any:
        """Return what the density keeps of observations ``(B, *event)``."""

    @abstractmethod
    def log_q(self, theta: Tensor, z: Any) -> Tensor:
        """Return log densities at theta ``(S, B, d)`` of B embedded x, ``(S, B)``."""

    @abstractmethod
    def draw(self, z: Any, row: Tensor) -> Tensor:
        """Draw once for each of n numbers of embedded observations, ``(n, d)``."""

    @property
    def device(self) -> torch.device:
        """Where its tensors are."""
        return next(self.buffers(), torch.empty(0)).device

    def readable(self, x: Tensor) -> Tensor:
        """Tell which observations can be embedded, ``(n, *event)`` to ``(n,)``."""
        return torch.isfinite(x).flatten(1).all(dim=1)

    @torch.no_grad()
    def mass(self, z: Any, num_rows: int, accept: Accept) -> Tensor:
        """Estimate the mass inside the prior's support of B embedded observations.

        The random numbers are the same in every call. The result is float64.
        """
        rows = torch.arange(num_rows, device=self.device).split(num_fitting(NUM_DRAWS))
        with seeded(0):
            inside = [
                accept(self.draw(z, some.repeat_interleave(NUM_DRAWS))) for some in rows
            ]
        return torch.cat(inside).double().reshape(num_rows, NUM_DRAWS).mean(dim=1)

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        r"""Return :math:`\log q(\theta \mid x)`, shape ``(S, B)``.

        Args:
            input: theta, shape ``(S, B, d)`` or ``(B, d)``; one row serves all x.
            condition: Observations ``(B, *event)``; one serves all rows of theta.
            **kwargs: Not used.
        """
        z = self.embed(condition)
        return self.log_prob_given(input, z, len(condition)).to(input)

    def log_prob_given(self, theta: Tensor, z: Any, num_rows: int) -> Tensor:
        """Return what :meth:`log_prob` does, given B embedded observations, float64."""
        theta = theta if theta.ndim > 1 + len(self.input_shape) else theta[None]
        shape = len(theta), max(theta.shape[1], num_rows)
        theta = theta.expand(*shape, *self.input_shape)
        samples = theta.reshape(-1, num_rows, *self.input_shape)
        return self.log_q(samples, z).reshape(shape)

    @torch.no_grad()
    def sample(
        self, sample_shape: torch.Size, condition: Tensor, **kwargs: Any
    ) -> Tensor:
        """Draw for each observation, ``(*sample_shape, B, d)``."""
        count = torch.Size(sample_shape).numel()
        rows = torch.arange(len(condition), device=condition.device).repeat(count)
        theta = self.draw(self.embed(condition), rows)
        return theta.reshape(*sample_shape, len(condition), *self.input_shape)

    def loss(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Return the negative log-probability, shape ``(B,)``."""
        return -self.log_prob(input[None], condition)[0]


class Prior(Density):
    r"""The prior :math:`p(\theta)`, whatever x is.

    Args:
        prior: A distribution over parameters of shape ``(d,)``; it is copied.
        condition_shape: Shape of one observation.
    """

    placeholder: Tensor

    def __init__(self, prior: Distribution, condition_shape: Sequence[int]) -> None:
        prior = PriorDistribution(prior)
        super().__init__(prior.event_shape, condition_shape)
        self.prior = prior
        # A distribution has no device. This tensor is on the device of its draws.
        self.register_buffer("placeholder", torch.empty(0, device=prior.mean.device))

    def embed(self, x: Tensor) -> Tensor:
        """Return an empty embedding for each observation, ``(n, 0)``."""
        return x.new_empty(len(x), 0)

    def log_q(self, theta: Tensor, z: Tensor) -> Tensor:
        """Return the log density at theta ``(S, B, d)``, shape ``(S, B)``, float64."""
        return self.prior.log_prob(theta).double()

    def draw(self, z: Tensor, row: Tensor) -> Tensor:
        """Draw once for each of n numbers of observations, ``(n, d)``."""
        return self.prior.sample((len(row),)).to(z)

    def readable(self, x: Tensor) -> Tensor:
        """Tell that any observation will do."""
        return torch.ones(len(x), dtype=torch.bool, device=x.device)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:  # noqa: FBT001, FBT002
        # `to` calls this for each module, but a distribution is not a module.
        moved = super()._apply(fn, recurse)
        self.prior.to(self.device)
        return moved
