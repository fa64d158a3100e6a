"""Samples of a block of mixtures, without those outside the support of the prior."""

import math
import time
from collections.abc import Callable

import torch
from torch import Tensor

from sbi_rope.errors import SamplingError
from sbi_rope.mixture.block import Block
from sbi_rope.mixture.chunks import num_fitting
from sbi_rope.mixture.parts import DTYPE

__all__ = [
    "MIN_ACCEPTANCE",
    "MIN_PROPOSALS",
    "Accept",
    "BlockSampler",
    "deadline_after",
]

# An observation is slow if, after MIN_PROPOSALS proposals, less than a share of
# MIN_ACCEPTANCE of them lies inside the prior's support. Rejection sampling gives up on
# slow observations if they would take more than MAX_PROPOSALS further proposals, which
# are minutes. In a stack the prior often keeps a share just below MIN_ACCEPTANCE.
MIN_PROPOSALS, MIN_ACCEPTANCE, MAX_PROPOSALS = 100_000, 1e-3, 10_000_000
# Observations for which this many proposals were all rejected are counted together: if
# a whole batch lies outside the support, MIN_PROPOSALS for all of it are enough.
MIN_WITHOUT_ANY = 5_000
# A flow takes about as long for this many draws as for a single one.
SMALL_BATCH = 512

Accept = Callable[[Tensor], Tensor]


class BlockSampler:
    """Draws from the mixtures of a block of observations.

    Args:
        block: The weighted embeddings of the observations.
        accept: Tells which proposals ``(n, d)`` to keep; None keeps all.
        batch_size: The largest number of draws the flow makes at a time.
        first_row: The number of the block's first observation, for messages.
        deadline: When to give up, in seconds of ``time.monotonic()``.
    """

    def __init__(
        self,
        block: Block,
        *,
        accept: Accept | None,
        batch_size: int,
        first_row: int = 0,
        deadline: float = math.inf,
    ) -> None:
        self.block = block
        self.accept = accept
        self.batch_size = batch_size
        self.first_row = first_row
        self.deadline = deadline
        self.theta_shape = block.parts[0].density.input_shape
        weights = block.weights
        self.num_rows, self.num_components = weights.shape
        # Components are drawn by the inverse of the cumulative weights. Those of row i
        # fill the interval [i, i + 1], so that one search serves all rows. The offset i
        # costs digits, hence the double precision.
        cumulative = weights.cumsum(dim=1, dtype=torch.float64)
        cumulative /= cumulative[:, -1:].clone()
        cumulative += torch.arange(self.num_rows, device=weights.device)[:, None]
        self._cumulative = cumulative.flatten()
        # The last component of each row with a weight: rounding may carry a draw past
        # the end of its row.
        positive = (weights > 0).flip(1).to(torch.int8)
        self._last = self.num_components - 1 - positive.argmax(dim=1)
        self._proposed = torch.zeros_like(self._last)
        self._inside = torch.zeros_like(self._last)

    def sample(self, num_samples: int) -> Tensor:
        """Draw from every mixture, ``(num_samples, b, d)``.

        Raises:
            SamplingError: If hardly any draw is accepted for some observation, or the
                time is over.
        """
        slots = torch.arange(self.num_rows, device=self._last.device)
        slots = slots.repeat_interleave(num_samples)
        theta = self._propose(slots) if self.accept is None else self._fill(slots)
        return theta.unflatten(0, (self.num_rows, num_samples)).transpose(0, 1)

    def _propose(self, rows: Tensor) -> Tensor:
        """Draw one theta from the mixture of each entry of ``rows``."""
        uniform = torch.rand(len(rows), dtype=torch.float64, device=rows.device)
        # right=True skips components with a weight of zero.
        found = torch.searchsorted(self._cumulative, uniform + rows, right=True)
        found = (found - rows * self.num_components).clamp_min_(0)
        chosen = torch.minimum(found, self._last[rows])
        theta = self._empty(len(rows))
        for entries in self.block.by_part(rows, chosen):
            places = torch.arange(len(entries.which), device=rows.device)
            for some in places.split(self.batch_size):
                draws = entries.part.sample(entries.embeddings(some))
                # Under torch's autocast the draws may have another dtype.
                theta[entries.which[some]] = draws.to(DTYPE)
        return theta

    def _empty(self, count: int) -> Tensor:
        shape = (count, *self.theta_shape)
        return torch.empty(shape, dtype=DTYPE, device=self._last.device)

    def _fill(self, slots: Tensor) -> Tensor:
        """Propose theta for every slot (the number of a row) until one is accepted."""
        assert self.accept is not None
        theta = self._empty(len(slots))
        still_open = torch.ones(len(slots), dtype=torch.bool, device=slots.device)
        rate = 1.0
        while (open_slots := still_open.nonzero().flatten()).numel():
            if time.monotonic() > self.deadline:
                raise SamplingError(
                    "Sampling took longer than `max_sampling_time`: "
                    f"{len(open_slots)} of {len(slots)} draws are missing."
                )
            proposals = open_slots.repeat_interleave(_repeats(len(open_slots), rate))
            rows = slots[proposals]
            draws = self._propose(rows)
            accepted = self.accept(draws)
            # Of several proposals for a slot the first accepted one is kept.
            chosen = accepted.nonzero().flatten()
            filled = proposals[chosen]
            first = filled != filled.roll(1)
            first[:1] = True
            theta[filled[first]] = draws[chosen[first]]
            still_open[filled] = False
            self._count(rows, accepted, slots[still_open])
            rate = float(accepted.double().mean())
        return theta

    def _count(self, rows: Tensor, accepted: Tensor, missing: Tensor) -> None:
        """Count proposals, and give up on rows that would take too many more.

        Args:
            rows: The row of each proposal.
            accepted: Which proposals were accepted.
            missing: The row of each draw that is still missing.
        """
        self._proposed += rows.bincount(minlength=self.num_rows)
        self._inside += rows[accepted].bincount(minlength=self.num_rows)
        num_missing = missing.bincount(minlength=self.num_rows)
        share = self._inside / self._proposed.clamp_min(1)
        slow = (num_missing > 0) & (self._proposed >= MIN_PROPOSALS)
        slow &= share < MIN_ACCEPTANCE
        # Infinite if nothing was accepted so far.
        further = (num_missing[slow] / share[slow]).sum()
        hopeless = slow & (further > MAX_PROPOSALS)
        without_any = (self._proposed >= MIN_WITHOUT_ANY) & (self._inside == 0)
        if int(self._proposed[without_any].sum()) >= MIN_PROPOSALS:
            hopeless |= without_any
        if hopeless.any():
            numbers = (hopeless.nonzero().flatten()[:5] + self.first_row).tolist()
            raise SamplingError(
                f"Less than one in {int(1 / MIN_ACCEPTANCE)} draws lies inside the "
                f"support of the prior for rows {numbers} of `x`. Leave these "
                "observations out, train NPE longer, or pass "
                "reject_outside_prior=False."
            )


def deadline_after(seconds: float | None) -> float:
    """Return when so many seconds are over, by ``time.monotonic()``; None for never."""
    return math.inf if seconds is None else time.monotonic() + seconds


def _repeats(num_open: int, rate: float) -> int:
    """Return how many proposals to make for every open slot."""
    # At this rate most slots are filled. For the last few slots, more proposals take no
    # longer than one.
    wanted = max(int(1 / max(rate, MIN_ACCEPTANCE)), SMALL_BATCH // num_open)
    return max(1, min(wanted, num_fitting(num_open)))
