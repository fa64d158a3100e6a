"""The weighted embeddings of a block of observations, over all parts of a mixture."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_rope.mixture.parts import Mixing, Part, Rows

__all__ = ["Block", "Entries"]


@dataclass(frozen=True, eq=False)
class Entries:
    """Weighted embeddings that belong to one part.

    Attributes:
        part: The part.
        which: The positions of these entries among those asked for, shape ``(n,)``.
        row: The number of the observation of each entry.
        column: The number of its embedding among those of the part.
        rows: The weights and embeddings of the part.
    """

    part: Part
    which: Tensor
    row: Tensor
    column: Tensor
    rows: Rows

    def embeddings(self, some: Tensor) -> Tensor:
        """Return the embeddings of some of the entries, ``(m, l)``."""
        return self.rows.at(self.row[some], self.column[some])


class Block:
    r"""The embeddings of all parts for a block of b observations, side by side.

    Args:
        parts: The parts of the mixture.
        shares: The weights :math:`w_k` of the parts, none of them zero.
        rows: The weights and embeddings that each part gives the observations.

    Attributes:
        weights: :math:`w_k a^k_{ij}` of all embeddings of all parts, shape ``(b, c)``.
    """

    def __init__(
        self, parts: Sequence[Part], shares: Sequence[float], rows: Sequence[Rows]
    ) -> None:
        self.parts = parts
        self.rows = rows
        pairs = zip(shares, rows, strict=True)
        self.weights = torch.cat([share * part.weights for share, part in pairs], dim=1)
        # Some of thousands of simulations can be left out of the density. A part with a
        # small weight, such as the prior, cannot: far from the other parts it may be
        # the only one with any density.
        self._is_shared = torch.cat(
            [
                torch.full_like(of_part.weights[0], _are_shared(part.mixing))
                for part, of_part in zip(parts, rows, strict=True)
            ]
        ).bool()

    def without_tail(self, tail_mass: float) -> tuple[Tensor, Tensor, Tensor]:
        """Return row, column and log weight of the entries to evaluate.

        The smallest weights of each row are left out, as long as they sum to at most
        ``tail_mass``. Only embeddings that observations share can be left out.
        """
        # The sum starts at the smallest weights, so that rounding does not lose them.
        ascending, order = self.weights.where(self._is_shared, torch.inf).sort(dim=1)
        tail = ascending.cumsum(dim=1, dtype=torch.float64)
        weights = self.weights.gather(1, order)
        kept = (tail > tail_mass) & (weights > 0)
        kept[:, -1] = True
        row = kept.nonzero()[:, 0]
        return row, order[kept], weights[kept].double().log()

    def by_part(self, row: Tensor, column: Tensor) -> list[Entries]:
        """Group entries of ``weights`` by the part they belong to."""
        found, start = [], 0
        for part, rows in zip(self.parts, self.rows, strict=True):
            end = start + rows.weights.shape[1]
            which = ((column >= start) & (column < end)).nonzero().flatten()
            if len(which):
                found.append(
                    Entries(part, which, row[which], column[which] - start, rows)
                )
            start = end
        return found


def _are_shared(mixing: Mixing) -> bool:
    """Tell whether all observations share the same several embeddings."""
    return mixing.embeddings is not None and mixing.num_embeddings > 1
