"""The density of the mixture, as an estimator in the sense of sbi."""

import hashlib
from typing import Any, Literal

import torch
from torch import Tensor, nn

from sbi_rope._sbi import ConditionalDensityEstimator, embed
from sbi_rope.coupling import Coupling
from sbi_rope.errors import InvalidInputError, UnseenObservationError, warn_user

__all__ = ["MAX_EVALUATIONS", "MixtureEstimator"]

# Most pairs of parameter and component that the flow sees at a time; this, and not the
# numbers of observations and simulations, bounds its memory.
MAX_EVALUATIONS = 100_000


class MixtureEstimator(ConditionalDensityEstimator):
    r"""The density :math:`\sum_j \alpha_{ij}\, q(\theta \mid h(x_{s,j}))` given x_o.

    An estimator in the sense of sbi, whose condition is a real observation. The prior's
    support is not its business; see :class:`MixturePosterior`.

    Args:
        components: :math:`q(\theta \mid s)`, an estimator conditioned on embeddings.
        contexts: :math:`h(x_s)`, shape ``(n_s, l)``.
        coupling: Where the weights come from, ``coupling.weights`` of shape
            ``(n_o, n_s)``.
        x_o: The batch of real observations, shape ``(n_o, *event)``.
        embedding_net: :math:`g`, needed to extend to unseen observations only.
        unseen: What to do with an x outside the batch: ``"raise"``, or ``"extend"`` by
            the softmax row of the same potential.
        tail_mass: Weight of the smallest components of each row that ``log_prob``
            leaves out; 0 evaluates all.
    """

    contexts: Tensor
    x_o: Tensor

    def __init__(
        self,
        components: ConditionalDensityEstimator,
        contexts: Tensor,
        coupling: Coupling,
        x_o: Tensor,
        *,
        embedding_net: nn.Module,
        unseen: Literal["raise", "extend"] = "raise",
        tail_mass: float = 1e-3,
    ) -> None:
        super().__init__(nn.Identity(), components.input_shape, x_o.shape[1:])
        self.components = components
        self.coupling = coupling
        self.unseen = unseen
        self.tail_mass = tail_mass
        self._g = embedding_net
        self.register_buffer("contexts", contexts)
        self.register_buffer("x_o", x_o)
        self._extended: tuple[list[bytes], Tensor] | None = None
        # The first row of equal observations stands for all of them.
        self._index: dict[bytes, int] = {}
        for i, key in enumerate(_keys(x_o)):
            self._index.setdefault(key, i)

    def to_device(self, device: str | torch.device) -> None:
        """Move the networks, the batch and the coupling."""
        self.to(device)
        self.coupling = self.coupling.to(device)
        self._extended = None

    def rows(self, x: Tensor) -> Tensor:
        """Return the mixture weights of observations, ``(n, *event)`` to ``(n, n_s)``.

        Raises:
            UnseenObservationError: If an x is not in the batch and ``unseen="raise"``.
        """
        x = x.to(self.x_o)
        found = [self._index.get(key, -1) for key in _keys(x)]
        index = torch.tensor(found, dtype=torch.long, device=self.x_o.device)
        weights = self.coupling.weights[index.clamp_min(0)]
        new = index < 0
        if new.any():
            weights[new] = self._extended_rows(x[new])
        return weights

    def _extended_rows(self, x: Tensor) -> Tensor:
        # log_prob and its normaliser, or the steps of map(), ask for the same rows.
        keys = _keys(x)
        if self._extended is None or self._extended[0] != keys:
            self._extended = (keys, self._extend(x))
        return self._extended[1]

    def _extend(self, x: Tensor) -> Tensor:
        if self.unseen == "raise":
            raise UnseenObservationError(
                f"{len(x)} observation(s) are not in the batch of "
                f"{len(self.x_o)} this posterior was built for, and a posterior of "
                "RoPE belongs to its batch. Either couple the new batch with "
                "`rope.build_posterior(x_new)`, or allow rows under the old coupling "
                "with `rope.build_posterior(x_o, unseen='extend')`."
            )
        rows = self.coupling.rows(embed(self._g, x))
        smallest = float((1.0 / rows.square().sum(dim=1)).min())
        warn_user(
            f"Extended the coupling to {len(x)} unseen observation(s); smallest "
            f"effective sample size {smallest:.1f} of {rows.shape[1]} simulations. "
            "Below about 50, couple the new batch instead."
        )
        return rows

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        r"""Return :math:`\log \sum_j \alpha_{ij} q(\theta \mid h(x_{s,j}))`.

        Args:
            input: theta, shape ``(S, B, d)`` or ``(B, d)``; B or 1 of them.
            condition: Real observations, shape ``(B, *event)``.
            **kwargs: None; kept for sbi's signature.

        Returns:
            Shape ``(S, B)``. With ``tail_mass`` = t the density is too small by at most
            t times the largest density among the components left out.
        """
        if input.shape[-len(self.input_shape) :] != self.input_shape:
            raise InvalidInputError(
                f"Expected `theta` of shape (..., {self.input_shape[0]}); got "
                f"{tuple(input.shape)}."
            )
        if torch.isnan(input).any():
            raise InvalidInputError("Expected `theta` without NaN.")
        if input.ndim == len(self.input_shape) + 1:
            input = input[None]
        weights = self.rows(condition)
        num_rows = max(input.shape[1], weights.shape[0])
        if {input.shape[1], weights.shape[0]} - {1, num_rows}:
            raise InvalidInputError(
                "Expected as many rows of `theta` as observations, or one of them; "
                f"got theta {tuple(input.shape)} and {weights.shape[0]} observations."
            )
        theta = input.expand(-1, num_rows, *self.input_shape)
        weights = weights.expand(num_rows, -1)
        theta = theta.to(self.contexts)

        kept, counts, order = self._without_tail(weights)
        # A block of rows times a chunk of theta fits into MAX_EVALUATIONS, unless a
        # single theta and row have more components than that.
        step = max(1, MAX_EVALUATIONS // int(counts.max()))
        blocks = [
            torch.cat(
                [
                    self._block_log_prob(part[:, block], order, kept, counts, block)
                    for block in _blocks(counts, max(1, MAX_EVALUATIONS // len(part)))
                ],
                dim=1,
            )
            for part in theta.split(step)
        ]
        return torch.cat(blocks)

    def _without_tail(self, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Sort each row and count the components that carry 1 - tail_mass of it."""
        sorted_weights, order = weights.sort(dim=1, descending=True)
        # Summed from the small end, where the digits are.
        tail = sorted_weights.flip(1).cumsum(dim=1).flip(1)
        counts = ((tail > self.tail_mass) & (sorted_weights > 0)).sum(dim=1)
        return sorted_weights, counts.clamp_min(1), order

    def _block_log_prob(
        self,
        theta: Tensor,
        order: Tensor,
        sorted_weights: Tensor,
        counts: Tensor,
        block: slice,
    ) -> Tensor:
        counts = counts[block]
        rows = torch.arange(len(counts), device=theta.device).repeat_interleave(counts)
        rank = torch.arange(len(rows), device=theta.device)
        rank = rank - (counts.cumsum(0) - counts)[rows]
        log_q = self.components.log_prob(
            theta[:, rows], condition=self.contexts[order[block][rows, rank]]
        )
        log_terms = log_q.double() + sorted_weights[block][rows, rank].log()

        # A log-sum-exp over the components of each row.
        shape = (len(theta), len(counts))
        index = rows.expand_as(log_terms)
        largest = log_terms.detach().new_full(shape, -torch.inf)
        largest = largest.scatter_reduce(1, index, log_terms.detach(), "amax")
        largest = largest.where(torch.isfinite(largest), 0.0)
        terms = (log_terms - largest.gather(1, index)).exp()
        total = torch.zeros_like(largest).index_add(1, rows, terms)
        return (total.log() + largest).to(theta.dtype)

    def sample(
        self, sample_shape: torch.Size, condition: Tensor, **kwargs: Any
    ) -> Tensor:
        """Draw from the mixtures, ``(*sample_shape, B, d)``; no support is enforced."""
        weights = self.rows(condition)
        num_samples = torch.Size(sample_shape).numel()
        rows = torch.arange(len(weights), device=weights.device).repeat(num_samples)
        theta = self.draw(rows, weights)
        return theta.reshape(*sample_shape, len(weights), *self.input_shape)

    @torch.no_grad()
    def draw(
        self, rows: Tensor, weights: Tensor, *, batch_size: int = MAX_EVALUATIONS
    ) -> Tensor:
        """Draw one theta for each entry of ``rows``, an index into ``weights``."""
        # Inverse transform: row i fills the interval [i, i + 1], so that one search
        # serves all rows.
        cumulative = weights.cumsum(dim=1)
        cumulative = cumulative / cumulative[:, -1:]
        cumulative += torch.arange(len(weights), device=weights.device)[:, None]
        # Rounding may carry a draw past the end of its row.
        positive = (weights > 0).flip(1).to(torch.int8)
        last = weights.shape[1] - 1 - positive.argmax(dim=1)
        theta = []
        for part in rows.split(batch_size):
            uniform = torch.rand(len(part), dtype=weights.dtype, device=part.device)
            # right=True passes over components of weight zero.
            found = torch.searchsorted(cumulative.flatten(), uniform + part, right=True)
            components = (found - part * weights.shape[1]).clamp_min(0)
            condition = self.contexts[torch.minimum(components, last[part])]
            draws = self.components.sample(torch.Size((1,)), condition=condition)
            theta.append(draws[0])
        return torch.cat(theta)

    def loss(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Return the negative log-probability, shape ``(B,)``."""
        return -self.log_prob(input[None], condition)[0]


def _keys(x: Tensor) -> list[bytes]:
    """Return a fingerprint of each row's values."""
    # Adding zero makes -0.0 and 0.0, which are equal, equal in their bytes too.
    rows = (x.detach().cpu().flatten(1) + 0.0).contiguous().numpy()
    return [hashlib.blake2b(row.tobytes(), digest_size=16).digest() for row in rows]


def _blocks(counts: Tensor, limit: int) -> list[slice]:
    """Cut rows into blocks of at most ``limit`` components, or one row."""
    blocks, start, filled = [], 0, 0
    for i, count in enumerate(counts.tolist()):
        if i > start and filled + count > limit:
            blocks.append(slice(start, i))
            start, filled = i, 0
        filled += count
    return [*blocks, slice(start, len(counts))]
