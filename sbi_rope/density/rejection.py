"""Draws of densities, without those outside the support of the prior."""

import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from sbi_rope._progress import progress_bar
from sbi_rope.density.base import MAX_ENTRIES, Accept, Density, num_fitting
from sbi_rope.errors import SamplingError

__all__ = ["sample_inside"]

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

# Draws once for each number of an observation, ``(n,)`` to ``(n, d)``.
Draw = Callable[[Tensor], Tensor]


@torch.no_grad()
def sample_inside(
    density: Density,
    z: Any,
    num_rows: int,
    num_samples: int,
    *,
    accept: Accept | None,
    batch_size: int | None = None,
    max_sampling_time: float | None = None,
    show_progress_bars: bool = False,
) -> Tensor:
    """Draw S times for each of B embedded observations, ``(S, B, d)``.

    Args:
        density: The density.
        z: What its ``embed`` returned.
        num_rows: B.
        num_samples: S.
        accept: Tells which draws to keep; None keeps all.
        batch_size: The largest number of draws that are made at a time; if None, the
            number that is fast on the device.
        max_sampling_time: Seconds after which rejection gives up; never if None.
        show_progress_bars: Whether to show how many draws were accepted so far.

    Raises:
        SamplingError: If hardly any draw is accepted for some observation, or the time
            is over.
    """
    start, device = time.monotonic(), density.device
    total = num_samples * num_rows
    theta = torch.empty(total, *density.input_shape, device=device)
    rejection = _Rejection(num_rows, device)

    def draw(row: Tensor) -> Tensor:
        if max_sampling_time and time.monotonic() > start + max_sampling_time:
            raise SamplingError(
                "Sampling took longer than `max_sampling_time`: not all of "
                f"{total} draws were made."
            )
        parts = row.split(batch_size or len(row))
        return torch.cat([density.draw(z, some) for some in parts])

    bar = progress_bar(show=show_progress_bars, desc="Sampling", total=total)
    with bar:
        # Observation by observation, so that few of them are needed at a time.
        for first in range(0, total, MAX_ENTRIES):
            last = min(first + MAX_ENTRIES, total)
            slot = torch.arange(first, last, device=device)
            row, number = slot // num_samples, slot % num_samples
            drawn = draw(row) if accept is None else rejection.fill(row, draw, accept)
            theta[number * num_rows + row] = drawn
            bar.update(len(slot))
    return theta.unflatten(0, (num_samples, num_rows))


class _Rejection:
    """Proposes until a draw is accepted, and counts the proposals of each row."""

    def __init__(self, num_rows: int, device: torch.device) -> None:
        self.num_rows = num_rows
        self.proposed = torch.zeros(num_rows, dtype=torch.long, device=device)
        self.inside = torch.zeros_like(self.proposed)

    def fill(self, slots: Tensor, draw: Draw, accept: Accept) -> Tensor:
        """Draw for every slot (the number of a row) until a draw is accepted."""
        theta: Tensor | None = None
        still_open = torch.ones_like(slots, dtype=torch.bool)
        rate = 1.0
        while (open_slots := still_open.nonzero().flatten()).numel():
            proposals = open_slots.repeat_interleave(_repeats(len(open_slots), rate))
            rows = slots[proposals]
            draws = draw(rows)
            accepted = accept(draws)
            if theta is None:
                theta = draws.new_empty(len(slots), *draws.shape[1:])
            # Of several proposals for a slot the first accepted one is kept.
            chosen = accepted.nonzero().flatten()
            filled = proposals[chosen]
            first = filled != filled.roll(1)
            first[:1] = True
            theta[filled[first]] = draws[chosen[first]]
            still_open[filled] = False
            self.count(rows, accepted, slots[still_open])
            rate = float(accepted.double().mean())
        assert theta is not None
        return theta

    def count(self, rows: Tensor, accepted: Tensor, missing: Tensor) -> None:
        """Count proposals, and give up on rows that would take too many more."""
        self.proposed += rows.bincount(minlength=self.num_rows)
        self.inside += rows[accepted].bincount(minlength=self.num_rows)
        num_missing = missing.bincount(minlength=self.num_rows)
        share = self.inside / self.proposed.clamp_min(1)
        slow = (num_missing > 0) & (self.proposed >= MIN_PROPOSALS)
        slow &= share < MIN_ACCEPTANCE
        # Infinite if nothing was accepted so far.
        further = (num_missing[slow] / share[slow]).sum()
        hopeless = slow & (further > MAX_PROPOSALS)
        without_any = (self.proposed >= MIN_WITHOUT_ANY) & (self.inside == 0)
        if int(self.proposed[without_any].sum()) >= MIN_PROPOSALS:
            hopeless |= without_any
        if hopeless.any():
            numbers = hopeless.nonzero().flatten()[:5].tolist()
            raise SamplingError(
                f"Less than one in {int(1 / MIN_ACCEPTANCE)} draws lies inside the "
                f"support of the prior for rows {numbers} of `x`. Leave these "
                "observations out, train NPE longer, or pass "
                "reject_outside_prior=False."
            )


def _repeats(num_open: int, rate: float) -> int:
    """Return how many proposals to make for every open slot."""
    # At this rate most slots are filled. For the last few slots, more proposals take no
    # longer than one.
    wanted = max(int(1 / max(rate, MIN_ACCEPTANCE)), SMALL_BATCH // num_open)
    return max(1, min(wanted, num_fitting(num_open)))
