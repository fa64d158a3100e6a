"""Embeddings that a batch of observations shares, weighted by a coupling."""

import hashlib
from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor, nn

from sbi_rope._sbi import embed, readable
from sbi_rope._standardisation import warn_of_far_entries
from sbi_rope.coupling import Coupling
from sbi_rope.coupling.cost import row_blocks
from sbi_rope.errors import InvalidInputError, warn_user
from sbi_rope.mixture.chunks import blocks
from sbi_rope.mixture.parts import Mixing, Rows

__all__ = ["CoupledEmbeddings"]


class CoupledEmbeddings(Mixing):
    r"""The simulations that a batch is coupled with, as embeddings of a mixture.

    The weights of observation i are the row :math:`\alpha_i` of the coupling. An
    observation is found by its values. If several in the batch are equal, the row of
    the first is used for all of them.

    Args:
        simulated: :math:`h(x_s)`, shape ``(n_s, l)``.
        x_o: The real observations that were coupled, shape ``(n_o, *event)``.
        net: The embedding net g of real observations, for unseen ones.
        coupling: The coupling of :math:`g(x_o)` with the simulations.
        unseen: What to do with an x outside the batch: ``"raise"`` an error, or
            ``"extend"`` the coupling by a softmax row under the same potential.
    """

    simulated: Tensor
    x_o: Tensor

    def __init__(
        self,
        simulated: Tensor,
        x_o: Tensor,
        net: nn.Module,
        coupling: Coupling,
        *,
        unseen: Literal["raise", "extend"] = "raise",
    ) -> None:
        super().__init__(x_o.shape[1:], len(simulated))
        self.net = net
        self.coupling = coupling
        self.unseen: Literal["raise", "extend"] = unseen
        self.register_buffer("simulated", simulated)
        self.register_buffer("x_o", x_o)
        self._extended: tuple[list[bytes], Tensor] | None = None
        self._index: dict[bytes, int] = {}
        for i, key in enumerate(_keys(x_o)):
            self._index.setdefault(key, i)

    @property
    def embeddings(self) -> Tensor:
        """The embeddings of the simulations, shape ``(n_s, l)``."""
        return self.simulated

    def embed(self, x: Tensor) -> Tensor:
        """Embed observations, ``(n, *event)`` to ``(n, l)``.

        Raises:
            InvalidInputError: If an x is not in the batch and ``unseen="raise"``.
        """
        x = x.to(self.x_o)
        found = [self._index.get(key, -1) for key in _keys(x)]
        index = torch.tensor(found, dtype=torch.long, device=self.x_o.device)
        embedded = self.coupling.real[index.clamp_min(0)]
        new = index < 0
        if new.any():
            embedded[new] = self._unseen_embedded(x[new])
        return embedded

    def readable(self, x: Tensor) -> Tensor:
        """Tell which observations are in the batch, or can be read by the net."""
        known = [key in self._index for key in _keys(x.to(self.x_o))]
        return torch.tensor(known, device=x.device) | readable(self.net, x)

    def rows(self, embedded: Tensor) -> Rows:
        """Return the weights of the simulations for a block of observations."""
        weights = embedded.new_empty(len(embedded), self.num_embeddings)
        # Blocks of this size stay in the cache.
        for block in row_blocks(embedded, self.num_embeddings):
            real = embedded[block]
            distances = self.coupling.distances(real)
            weights[block] = self.coupling.rows(real, distances=distances)
        return Rows(weights, self.simulated)

    def restricted_to(self, index: int) -> "CoupledEmbeddings":
        """Return the same embeddings for one observation alone, by its number."""
        row = torch.arange(len(self.x_o), device=self.x_o.device)[index][None]
        net = self.net if self.unseen == "extend" else nn.Identity()
        coupling = self.coupling.restricted_to(row)
        return CoupledEmbeddings(
            self.simulated, self.x_o[row], net, coupling, unseen=self.unseen
        )

    def __getstate__(self) -> dict[str, Any]:
        # The observations that were asked for last are no part of the posterior.
        return {**super().__getstate__(), "_extended": None}

    def _unseen_embedded(self, x: Tensor) -> Tensor:
        # log_prob and its normalisation, or the steps of map(), ask for the same x
        # again. The last answer is kept, so that there is one warning only.
        keys, kept = _keys(x), self._extended
        if kept is None or kept[0] != keys:
            # The attribute is set at once and not read again, because another thread
            # may ask for other observations.
            self._extended = kept = (keys, self._extend(x))
        return kept[1]

    def _extend(self, x: Tensor) -> Tensor:
        if self.unseen == "raise":
            raise InvalidInputError(
                f"Expected `x` of the batch that this posterior was built for; got "
                f"{len(x)} others. Couple them with `rope.build_posterior(x)`."
            )
        warn_of_far_entries("x", x, self.net)
        embedded = embed(self.net, x).to(self.coupling.real)
        smallest = min(
            float((1 / self.rows(embedded[block]).weights.square().sum(dim=1)).min())
            for block in blocks(len(embedded), self.num_embeddings)
        )
        warn_user(
            f"Extended the coupling to {len(x)} unseen observation(s). The smallest "
            f"effective sample size is {smallest:.1f} of {self.num_embeddings} "
            "simulations. If it is below about 50, couple the new batch instead."
        )
        return embedded

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:  # noqa: FBT001, FBT002
        # `to` calls this for each module, but a coupling is not a module.
        moved = super()._apply(fn, recurse)
        self.coupling = self.coupling.to(self.x_o.device)
        self._extended = None
        return moved


def _keys(x: Tensor) -> list[bytes]:
    """Return a fingerprint of each row's values."""
    # Adding zero turns -0.0 into 0.0. The two are equal, and so should their bytes be.
    # The same holds for the NaN of missing entries, whose bits may differ.
    rows = x.detach().cpu().flatten(1) + 0.0
    rows = rows.where(~rows.isnan(), torch.nan).contiguous().numpy()
    return [hashlib.blake2b(row.tobytes(), digest_size=16).digest() for row in rows]
