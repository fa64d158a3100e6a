r"""Densities :math:`q(\theta \mid x)` for any observation x."""

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from sbi_rope._progress import progress_bar
from sbi_rope._random import seeded
from sbi_rope._sbi import ConditionalDensityEstimator
from sbi_rope.errors import warn_user

__all__ = ["Accept", "Density", "Mass", "batches", "num_fitting"]

# sbi converts every x to this dtype, and its estimators work in no other.
DTYPE = torch.float32

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


def batches(rows: Tensor, *, share: int = 1) -> Sequence[Tensor]:
    """Cut rows into batches of pairs for a flow, each of which counts ``share``."""
    size = GPU_BATCH
    if rows.device.type == "cpu":
        size = CPU_BATCH
        # glibc returns freed memory to the system, page by page, unless it once freed a
        # block of almost 32 MiB. Flows are a third faster with memory that is kept.
        torch.empty(2**25 - 2**16, dtype=torch.uint8)
    return rows.split(max(1, size // share))


def num_fitting(num_columns: int) -> int:
    """Return how many rows of so many entries are held at a time."""
    return max(1, MAX_ENTRIES // max(1, num_columns))


def without_nan_gradients(points: Tensor) -> Tensor:
    """Return points that have no gradient where a density of them is NaN."""
    if points.requires_grad:
        points.register_hook(lambda grad: grad.nan_to_num(nan=0.0))
    return points


def without_nan(log_q: Tensor) -> Tensor:
    """Count NaN densities as zero, so that their sum is not NaN."""
    undefined = torch.isnan(log_q)
    if not undefined.any():
        return log_q
    warn_user(
        f"{int(undefined.sum())} of {undefined.numel()} component densities are NaN "
        "and count as zero, because the density fails at these parameters or "
        "observations. Look for observations that are far from all simulations. If "
        "there are none, train NPE longer, or with another density estimator."
    )
    return log_q.where(~undefined, -torch.inf)


@dataclass(frozen=True)
class Mass:
    """The mass of a density inside the prior's support, for each observation.

    Attributes:
        mass: Shape ``(n,)``, float64.
        variance: The variance of this estimate, shape ``(n,)``, float64.
    """

    mass: Tensor
    variance: Tensor

    @property
    def standard_error(self) -> Tensor:
        """The standard error of the mass, shape ``(n,)``, float64."""
        return self.variance.sqrt()


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
        return next(self.buffers()).device

    def readable(self, x: Tensor) -> Tensor:
        """Tell which observations can be embedded, ``(n, *event)`` to ``(n,)``."""
        return torch.isfinite(x).flatten(1).all(dim=1)

    @property
    def coupled(self) -> Sequence[Any]:
        """The parts that belong to a batch of observations."""
        return []

    def restricted_to(self, index: int) -> "Density":
        """Return the same density for one observation of its batch, if it has one."""
        return self

    @torch.no_grad()
    def mass(
        self,
        z: Any,
        num_rows: int,
        accept: Accept,
        *,
        share: float = 1.0,
        seed: int = 0,
        show_progress_bars: bool = False,
    ) -> Mass:
        """Estimate the mass inside the prior's support, for B embedded observations.

        The random numbers are the same in every call. Those of an observation depend on
        its position in the batch.

        Args:
            z: What :meth:`embed` returned.
            num_rows: B.
            accept: Tells which parameters are inside.
            share: The weight of this density in a mixture. A smaller one needs fewer
                draws.
            seed: Another one for each part of a mixture, so that their errors average
                out.
            show_progress_bars: Whether to show progress if it takes long.
        """
        count = math.ceil(NUM_DRAWS * share)
        every = torch.arange(num_rows, device=self.device)
        with seeded(seed):
            inside = [
                accept(self.draw(z, some.repeat_interleave(count)))
                for some in normalising(
                    batches(every, share=count), show=show_progress_bars
                )
            ]
        mass = torch.cat(inside).double().reshape(num_rows, count).mean(dim=1)
        return Mass(mass, variance_of_share(mass, count))

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        r"""Return :math:`\log q(\theta \mid x)`.

        Args:
            input: theta, shape ``(S, B, d)`` or ``(B, d)``. One row of theta serves
                all observations.
            condition: Observations, shape ``(B, *event)``. One observation serves all
                rows of theta, and is embedded once.
            **kwargs: Not used; they are in sbi's signature.

        Returns:
            Shape ``(S, B)``.
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


def normalising(parts: Sequence[Any], *, show: bool) -> Any:
    """Return parts of a work, whose progress is shown once it takes seconds."""
    return progress_bar(parts, show=show, desc="Normalising", delay=5.0, leave=False)


def variance_of_share(share: Tensor, draws: int) -> Tensor:
    """Return the variance of a share of draws.

    Half a draw is added to those inside and to those outside, so that a share of zero
    or one has an error, too.
    """
    smoothed = (draws * share + 0.5) / (draws + 1)
    return smoothed * (1.0 - smoothed) / draws
