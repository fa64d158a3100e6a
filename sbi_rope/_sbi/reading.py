"""What an embedding net can read, and whether it reads each observation by itself."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from sbi_rope._sbi.embedding import embed, standardisation_of
from sbi_rope.errors import UnsupportedPosteriorError

__all__ = ["check_rows_apart", "readable", "reads_missing"]

# Observations that are embedded alone and in a batch.
NUM_ROWS = 4
# The two may differ by this share of the largest embedding. Rounding depends on the
# size of a batch, and is largest for convolutions on a GPU.
ROUNDING = 0.01


def readable(net: nn.Module, x: Tensor) -> Tensor:
    """Tell which observations an embedding net can read, ``(n, *event)`` to ``(n,)``.

    It can read what is finite. Where some entries are missing (NaN), it depends on the
    net: sbi's ``PermutationInvariantEmbedding`` leaves out trials that are missing, and
    most other nets return NaN. Nothing can be read from Inf, or if all is missing.

    Raises:
        UnsupportedPosteriorError: If entries are missing, and the net embeds such an
            observation differently among others.
    """
    rows = x.flatten(1)
    finite, missing = torch.isfinite(rows), torch.isnan(rows)
    can_read = finite.all(dim=1)
    partial = finite.any(dim=1) & missing.any(dim=1) & (finite | missing).all(dim=1)
    if partial.any():
        try:
            embedded = embed(net, x[partial])
        except Exception:  # nets refuse NaN with errors of any kind
            return can_read
        can_read[partial] = torch.isfinite(embedded).flatten(1).all(dim=1)
        _check_missing_apart(net, x[partial & can_read][: NUM_ROWS // 2])
    return can_read


def reads_missing(
    net: nn.Module, event_shape: Sequence[int], device: torch.device
) -> bool:
    """Tell whether an embedding net can leave out trials that are missing (NaN).

    Args:
        net: The net.
        event_shape: The shape of one observation, ``(num_trials, l)`` of a set.
        device: Where the net is.
    """
    if len(event_shape) != 2 or event_shape[0] < 2:
        return False
    x = torch.zeros(1, *event_shape, device=device)
    x[:, -1] = torch.nan
    try:
        return bool(torch.isfinite(embed(net, x)).all())
    except Exception:  # nets refuse NaN with errors of any kind
        return False


def check_rows_apart(
    net: nn.Module, event_shape: Sequence[int], device: torch.device
) -> None:
    """Raise unless the embedding of a row is the same alone and among other rows.

    Args:
        net: The net.
        event_shape: The shape of one observation.
        device: Where the net is.

    Raises:
        UnsupportedPosteriorError: If the embedding depends on the other rows.
    """
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(NUM_ROWS, *event_shape, generator=generator).to(device)
    standardisation = standardisation_of(net)
    if standardisation is not None:
        mean, std = standardisation
        x = mean + std * x
    if _rows_are_mixed(net, x):
        raise UnsupportedPosteriorError(
            "Expected an embedding net that reads each observation by itself; this one "
            "returns something else for a row of a batch than for the same row alone. "
            "Remove what it computes over the batch, and train NPE again."
        )


def _check_missing_apart(net: nn.Module, x: Tensor) -> None:
    """Raise if the embedding of a set of trials depends on what others lack."""
    full = x.nan_to_num(0.0)
    sparse = full.clone()
    if x.ndim > 2:
        sparse[:, 1:] = torch.nan
    # Sets with some, with no and with most trials missing, side by side.
    if _rows_are_mixed(net, torch.stack([x, full, sparse], dim=1).flatten(0, 1)):
        raise UnsupportedPosteriorError(
            "Expected an embedding net that reads each observation by itself; with "
            "missing values (NaN), this one returns something else for a row of a "
            "batch than for the same row alone. PermutationInvariantEmbedding of sbi "
            "0.27 does so if a trial has more than one column, because it takes the "
            "number of trials from another row. Train NPE with a net of your own, in "
            "which a set has `(~x.isnan().any(dim=-1)).sum(dim=1)` trials, or with "
            "one column for each trial, or without missing trials."
        )


def _rows_are_mixed(net: nn.Module, x: Tensor) -> bool:
    """Tell whether rows are embedded differently in a batch than alone."""
    try:
        with torch.random.fork_rng(_devices(x)):
            together, again = embed(net, x), embed(net, x)
            alone = torch.cat([embed(net, row) for row in x.split(1)])
    except Exception:  # the net may take no such numbers
        return False
    usable = torch.isfinite(together) & torch.isfinite(alone)
    if not usable.any() or not torch.equal(together[usable], again[usable]):
        return False  # a net with noise of its own
    margin = ROUNDING * together[usable].abs().max()
    return bool(((together - alone).abs()[usable] > margin).any())


def _devices(x: Tensor) -> list[torch.device]:
    return [x.device] if x.device.type == "cuda" else []
