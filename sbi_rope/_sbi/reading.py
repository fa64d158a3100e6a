"""What an embedding net can read, and whether it reads each observation by itself."""

import torch
from torch import Tensor, nn

from sbi_rope._random import seeded
from sbi_rope._sbi.embedding import embed
from sbi_rope.errors import UnsupportedPosteriorError

__all__ = ["check_rows_apart", "readable"]

# A row may differ by this share of the largest embedding when it is alone. Rounding
# depends on the size of a batch, and is largest for convolutions on a GPU.
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
        some = x[partial & can_read][:2]
        full = some.nan_to_num(0.0)
        sparse = full.clone()
        if x.ndim > 2:
            sparse[:, 1:] = torch.nan
        # sbi 0.27 takes the number of trials from another row if trials have several
        # columns. Sets with some, no and most trials missing stand side by side here.
        check_rows_apart(net, torch.stack([some, full, sparse], dim=1).flatten(0, 1))
    return can_read


def check_rows_apart(net: nn.Module, x: Tensor) -> None:
    """Raise if the embedding of a row is another one alone than among other rows."""
    try:
        with seeded(0):
            together, again = embed(net, x), embed(net, x)
            alone = torch.cat([embed(net, row) for row in x.split(1)])
    except Exception:  # the net may take no such numbers
        return
    usable = torch.isfinite(together) & torch.isfinite(alone)
    if not usable.any() or not torch.equal(together[usable], again[usable]):
        return  # a net with noise of its own
    margin = ROUNDING * together[usable].abs().max()
    if bool(((together - alone).abs()[usable] > margin).any()):
        missing = " with missing entries (NaN)" if x.isnan().any() else ""
        raise UnsupportedPosteriorError(
            f"Expected an embedding net that reads each observation{missing} by "
            "itself; got another embedding of a row alone than in a batch."
        )
