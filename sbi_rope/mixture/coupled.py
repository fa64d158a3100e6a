"""Embeddings that a batch of observations shares, weighted by couplings."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal, cast

import torch
from torch import Tensor, nn

from sbi_rope._sbi import embed, readable
from sbi_rope._standardisation import warn_of_far_entries
from sbi_rope._validation import check_weights
from sbi_rope.coupling import Coupling
from sbi_rope.errors import InvalidInputError, UnseenObservationError, warn_user
from sbi_rope.mixture.chunks import blocks
from sbi_rope.mixture.coupled_net import CoupledNet
from sbi_rope.mixture.parts import Mixing, Rows
from sbi_rope.settings import Count, check
from sbi_rope.tensors import as_batch, check_same_length

__all__ = ["CoupledEmbeddings"]


class CoupledEmbeddings(Mixing):
    r"""The simulations that a batch is coupled with, as embeddings of a mixture.

    The weights of observation i are :math:`\sum_k w_k \alpha^{(k)}_i`, summed over all
    couplings of all nets. All couplings weight the same simulations, so each
    :math:`q(\theta \mid h(x_{s,j}))` is evaluated once, however many couplings there
    are. RoPE's own posterior has one net and one coupling.

    An observation is found by its values. If several in the batch are equal, the row of
    the first is used for all of them.

    Args:
        embeddings: :math:`h(x_s)`, shape ``(n_s, l)``.
        batch: The real observations that were coupled, shape ``(n, *event)``.
        nets: Embedding nets with couplings of the whole batch. The shares of all
            couplings of all nets sum to one.
        num_observed: How many observations at the start of the batch are to be
            inferred; they become ``x_o``. All if None.
        unseen: What to do with an x outside the batch: ``"raise"`` an error, or
            ``"extend"`` the coupling by a softmax row under the same potential.

    Raises:
        InvalidInputError: If lengths, shapes or shares do not fit.
    """

    simulated: Tensor
    batch: Tensor

    def __init__(
        self,
        embeddings: Tensor,
        batch: Tensor,
        nets: Sequence[CoupledNet],
        *,
        num_observed: int | None = None,
        unseen: Literal["raise", "extend"] = "raise",
    ) -> None:
        super().__init__(batch.shape[1:], len(embeddings))
        check("unseen", unseen, Literal["raise", "extend"])
        if num_observed is not None:
            check("num_observed", num_observed, Count)
            if num_observed > len(batch):
                raise InvalidInputError(
                    f"Expected `num_observed` of at most {len(batch)}, the length of "
                    f"the batch; got {num_observed}."
                )
        self._nets = nn.ModuleList(nets)
        check_weights("shares", self.shares, len(self.couplings))
        for coupling in self.couplings:
            as_batch("coupling.simulated", coupling.simulated, embeddings.shape[1:])
            check_same_length("embeddings", embeddings, "simulated", coupling.simulated)
            check_same_length("batch", batch, "coupling.real", coupling.real)
        self.num_observed = len(batch) if num_observed is None else num_observed
        self.unseen: Literal["raise", "extend"] = unseen
        self.register_buffer("simulated", embeddings)
        self.register_buffer("batch", batch)
        self._extended: tuple[list[bytes], Tensor] | None = None
        self._index: dict[bytes, int] = {}
        for i, key in enumerate(_keys(batch)):
            self._index.setdefault(key, i)

    @property
    def embeddings(self) -> Tensor:
        """The embeddings of the simulations, shape ``(n_s, l)``."""
        return self.simulated

    @property
    def nets(self) -> list[CoupledNet]:
        """The embedding nets with their couplings."""
        return cast("list[CoupledNet]", list(self._nets))

    @property
    def couplings(self) -> tuple[Coupling, ...]:
        """All couplings, net by net."""
        return tuple(coupling for net in self.nets for coupling in net.couplings)

    @property
    def shares(self) -> tuple[float, ...]:
        """How much each of :attr:`couplings` counts; they sum to one."""
        return tuple(share for net in self.nets for share in net.shares)

    @property
    def x_o(self) -> Tensor:
        """The observations to be inferred, shape ``(n_o, *event)``."""
        return self.batch[: self.num_observed]

    @property
    def weights(self) -> Tensor:
        """The weights of ``x_o``, shape ``(n_o, n_s)``; do not write to them."""
        if len(self.couplings) == 1:
            weights = self.couplings[0].weights
            whole = self.num_observed == len(weights)
            return weights if whole else weights[: self.num_observed]
        embedded = self.embed(self.x_o)
        return torch.cat(
            [
                self.rows(embedded[block]).weights
                for block in blocks(len(embedded), self.num_embeddings)
            ]
        )

    def embed(self, x: Tensor) -> Tensor:
        """Embed observations with all nets, ``(n, *event)`` to ``(n, num_nets, l)``.

        Raises:
            UnseenObservationError: If an x is not in the batch and ``unseen="raise"``.
        """
        x = x.to(self.batch)
        found = [self._index.get(key, -1) for key in _keys(x)]
        index = torch.tensor(found, dtype=torch.long, device=self.batch.device)
        known = index.clamp_min(0)
        embedded = torch.stack([net.real[known] for net in self.nets], dim=1)
        new = index < 0
        if new.any():
            embedded[new] = self._unseen_embedded(x[new])
        return embedded

    def readable(self, x: Tensor) -> Tensor:
        """Tell which observations are in the batch, or can be read by all nets."""
        known = [key in self._index for key in _keys(x.to(self.batch))]
        new = torch.stack([readable(net.net, x) for net in self.nets]).all(dim=0)
        return torch.tensor(known, device=x.device) | new

    def rows(self, embedded: Tensor) -> Rows:
        """Return the weights of the simulations for a block of observations."""
        pairs = zip(self.nets, embedded.unbind(dim=1), strict=True)
        first, *others = (net.rows(real) for net, real in pairs if any(net.shares))
        return Rows(sum(others, start=first), self.simulated)

    def rows_of_each(self, embedded: Tensor) -> Iterator[Tensor]:
        """Yield the weights ``(n, n_s)`` by each of :attr:`couplings`."""
        for net, real in zip(self.nets, embedded.unbind(dim=1), strict=True):
            yield from net.rows_of_each(real)

    def with_shares(self, shares: Sequence[float]) -> "CoupledEmbeddings":
        """Return the same couplings with other shares, in the same order."""
        check_weights("shares", shares, len(self.couplings))
        nets, start = [], 0
        for net in self.nets:
            end = start + len(net.couplings)
            nets.append(net.with_shares(shares[start:end]))
            start = end
        return CoupledEmbeddings(
            self.simulated,
            self.batch,
            nets,
            num_observed=self.num_observed,
            unseen=self.unseen,
        )

    def restricted_to(self, index: int) -> "CoupledEmbeddings":
        """Return the same embeddings for one observation alone.

        Args:
            index: The number of the observation in ``x_o``.
        """
        row = torch.arange(self.num_observed, device=self.batch.device)[index][None]
        # The nets are needed only to extend the coupling.
        extends = self.unseen == "extend"
        nets = [
            net.restricted_to(row, net=net.net if extends else nn.Identity())
            for net in self.nets
        ]
        return CoupledEmbeddings(
            self.simulated, self.batch[row], nets, unseen=self.unseen
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
            raise UnseenObservationError(
                f"{len(x)} observation(s) are not in the batch of "
                f"{self.num_observed} that this posterior was built for. A posterior "
                "of RoPE answers for its own batch only, and `posterior[i]` knows its "
                "own observation alone. Couple the new batch with "
                "`rope.build_posterior(x_new)` or `stack(rope, x_new)`. Or pass "
                "`unseen='extend'` to either of them, which then extends the old "
                "coupling to new observations."
            )
        warn_of_far_entries("x", x, self.nets[0].net)
        embedded = torch.stack(
            [embed(net.net, x).to(net.real) for net in self.nets], dim=1
        )
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
        # `to` calls this for each module, but couplings are not modules.
        moved = super()._apply(fn, recurse)
        for net in self.nets:
            net.to_device(self.batch.device)
        self._extended = None
        return moved


def _keys(x: Tensor) -> list[bytes]:
    """Return a fingerprint of each row's values."""
    # Adding zero turns -0.0 into 0.0. The two are equal, and so should their bytes be.
    # The same holds for the NaN of missing entries, whose bits may differ.
    rows = x.detach().cpu().flatten(1) + 0.0
    rows = rows.where(~rows.isnan(), torch.nan).contiguous().numpy()
    return [hashlib.blake2b(row.tobytes(), digest_size=16).digest() for row in rows]
