"""An embedding net, and couplings of the observations it embedded."""

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor, nn

from sbi_rope.coupling import Coupling
from sbi_rope.coupling.cost import row_blocks
from sbi_rope.errors import InvalidInputError

__all__ = ["CoupledNet"]


class CoupledNet(nn.Module):
    r"""An embedding net g, and couplings of the observations it embedded.

    Args:
        net: g. It is needed for unseen observations only.
        couplings: Couplings of :math:`g(x)` of a batch with the same simulations.
        shares: How much each coupling counts in the weights of the mixture. The default
            is one coupling with a share of one.
    """

    def __init__(
        self,
        net: nn.Module,
        couplings: Sequence[Coupling],
        shares: Sequence[float] = (1.0,),
    ) -> None:
        super().__init__()
        if not len(couplings) or len(couplings) != len(shares):
            raise InvalidInputError(
                "Expected `couplings` and as many `shares`, at least one; got "
                f"{len(couplings)} and {len(shares)}."
            )
        self.net = net
        self.couplings = tuple(couplings)
        self.shares = tuple(float(share) for share in shares)

    @property
    def real(self) -> Tensor:
        """The embeddings of the batch, shape ``(n, l)``."""
        return self.couplings[0].real

    def rows(self, real: Tensor) -> Tensor:
        r"""Return :math:`\sum_k w_k \alpha^{(k)}`, ``(n, l)`` to ``(n, n_s)``."""
        used = [k for k, share in enumerate(self.shares) if share]
        total = real.new_zeros(len(real), len(self.couplings[0].simulated))
        # Blocks of this size stay in the cache. Couplings use the same.
        for block in row_blocks(real, total.shape[1]):
            rows_of_each = self.rows_of_each(real[block], used)
            for k, rows in zip(used, rows_of_each, strict=True):
                total[block].add_(rows, alpha=self.shares[k])
        return total

    def rows_of_each(
        self, real: Tensor, numbers: Sequence[int] | None = None
    ) -> Iterator[Tensor]:
        """Yield the weights ``(n, n_s)`` by one coupling after the other.

        Distances are computed once for all of them.

        Args:
            real: Embeddings of observations, shape ``(n, l)``.
            numbers: The numbers of the couplings; all if None.
        """
        distances: dict[bool, Tensor] = {}
        for k in range(len(self.couplings)) if numbers is None else numbers:
            coupling = self.couplings[k]
            if coupling.direct not in distances:
                distances[coupling.direct] = coupling.distances(real)
            yield coupling.rows(real, distances=distances[coupling.direct])

    def with_shares(self, shares: Sequence[float]) -> "CoupledNet":
        """Return the same couplings with other shares."""
        return CoupledNet(self.net, self.couplings, shares)

    def restricted_to(self, rows: Tensor, *, net: nn.Module) -> "CoupledNet":
        """Return the couplings of some observations, with another net."""
        couplings = [coupling.restricted_to(rows) for coupling in self.couplings]
        return CoupledNet(net, couplings, self.shares)

    def to_device(self, device: torch.device) -> None:
        """Move the couplings to a device."""
        self.couplings = tuple(coupling.to(device) for coupling in self.couplings)
