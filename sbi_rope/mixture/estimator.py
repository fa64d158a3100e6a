"""The density of the mixture, as an estimator in the sense of sbi."""

import hashlib
from collections.abc import Callable, Iterator
from typing import Any, Literal

import torch
from torch import Tensor, nn
from tqdm.auto import tqdm

from sbi_rope._sbi import ConditionalDensityEstimator, embed
from sbi_rope.coupling import Coupling
from sbi_rope.errors import InvalidInputError, UnseenObservationError, warn_user
from sbi_rope.mixture.chunks import blocks, flow_batch, keep_freed_memory, num_fitting
from sbi_rope.mixture.sampling import Accept, BlockSampler
from sbi_rope.mixture.truncation import Leakage, component_mass, mixture_mass

__all__ = ["MixtureEstimator", "without_nan"]


class MixtureEstimator(ConditionalDensityEstimator):
    r"""The density :math:`\sum_j \alpha_{ij}\, q(\theta \mid h(x_{s,j}))` given x_o.

    An estimator in the sense of sbi, whose condition is a real observation. The prior's
    support is not its business; see :class:`MixturePosterior`.

    Args:
        components: :math:`q(\theta \mid s)`, an estimator conditioned on embeddings.
        contexts: :math:`h(x_s)`, shape ``(n_s, l)``.
        coupling: Where the weights come from, ``coupling.rows`` of its features of the
            observations, ``coupling.real`` of shape ``(n_o, l)``.
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

    def features(self, x: Tensor) -> Tensor:
        """Return the embeddings of observations, ``(n, *event)`` to ``(n, l)``.

        Raises:
            UnseenObservationError: If an x is not in the batch and ``unseen="raise"``.
        """
        x = x.to(self.x_o)
        found = [self._index.get(key, -1) for key in _keys(x)]
        index = torch.tensor(found, dtype=torch.long, device=self.x_o.device)
        features = self.coupling.real[index.clamp_min(0)]
        new = index < 0
        if new.any():
            features[new] = self._unseen_features(x[new])
        return features

    def row_blocks(self, features: Tensor) -> Iterator[tuple[slice, Tensor]]:
        """Yield the weights ``(b, n_s)`` of a block of observations after the other."""
        for block in blocks(len(features), len(self.contexts)):
            yield block, self.coupling.rows(features[block])

    def rows(self, x: Tensor) -> Tensor:
        """Return the mixture weights of observations, ``(n, *event)`` to ``(n, n_s)``.

        Raises:
            UnseenObservationError: If an x is not in the batch and ``unseen="raise"``.
        """
        return self.coupling.rows(self.features(x))

    def _unseen_features(self, x: Tensor) -> Tensor:
        # log_prob and its normaliser, or the steps of map(), ask for the same ones, and
        # earn one warning.
        keys = _keys(x)
        if self._extended is None or self._extended[0] != keys:
            self._extended = (keys, self._extend(x))
        return self._extended[1]

    def _extend(self, x: Tensor) -> Tensor:
        if self.unseen == "raise":
            raise UnseenObservationError(
                f"{len(x)} observation(s) are not in the batch of "
                f"{len(self.x_o)} this posterior was built for, and a posterior of "
                "RoPE belongs to its batch. Either couple the new batch, with "
                "`rope.build_posterior(x_new)` or `stack(rope, x_new)`, or allow rows "
                "under the old coupling: both take `unseen='extend'`."
            )
        features = embed(self._g, x).to(self.coupling.real)
        smallest = min(
            float((1.0 / rows.square().sum(dim=1)).min())
            for _, rows in self.row_blocks(features)
        )
        warn_user(
            f"Extended the coupling to {len(x)} unseen observation(s); smallest "
            f"effective sample size {smallest:.1f} of {len(self.contexts)} "
            "simulations. Below about 50, couple the new batch instead."
        )
        return features

    # --- density ---

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        r"""Return :math:`\log \sum_j \alpha_{ij} q(\theta \mid h(x_{s,j}))`.

        Args:
            input: theta, shape ``(S, B, d)`` or ``(B, d)``; B or 1 of them.
            condition: Real observations, shape ``(B, *event)``; B or 1 of them.
            **kwargs: None; kept for sbi's signature.

        Returns:
            Shape ``(S, B)``. With ``tail_mass`` = t the density is too small by at most
            t times the largest density among the components left out.
        """
        theta = self._checked(input)
        features = self.features(condition)
        num_rows = max(theta.shape[1], len(features))
        if {theta.shape[1], len(features)} - {1, num_rows}:
            raise InvalidInputError(
                "Expected as many rows of `theta` as observations, or one of them; "
                f"got theta {tuple(input.shape)} and {len(features)} observations."
            )
        keep_freed_memory(theta.device)
        shape = (len(theta), num_rows)
        if not theta.numel():
            return theta.new_empty(shape)
        # One observation serves all theta with one row of weights.
        num_columns = len(features)
        theta = theta.expand(-1, num_rows, *self.input_shape)
        theta = theta.reshape(-1, num_columns, *self.input_shape)
        parts = [
            self._block_log_prob(theta[:, block], weights)
            for block, weights in self.row_blocks(features)
        ]
        return torch.cat(parts, dim=1).reshape(shape).to(theta)

    def _checked(self, theta: Tensor) -> Tensor:
        """Return theta as ``(S, B, d)``."""
        if theta.shape[-len(self.input_shape) :] != self.input_shape:
            raise InvalidInputError(
                f"Expected `theta` of shape (..., {self.input_shape[0]}); got "
                f"{tuple(theta.shape)}."
            )
        if torch.isnan(theta).any():
            raise InvalidInputError("Expected `theta` without NaN.")
        if theta.ndim == len(self.input_shape) + 1:
            theta = theta[None]
        return theta.to(self.contexts)

    def _block_log_prob(self, theta: Tensor, weights: Tensor) -> Tensor:
        """Return the log density of theta ``(S, b, d)`` for rows ``(b, n_s)``."""
        row, component, log_weights = self._without_tail(weights)
        parts = []
        for part in theta.split(num_fitting(len(row))):
            log_q = without_nan(self._log_q(part, row, component).double())
            parts.append(_log_sum_exp(log_q + log_weights, row, len(weights)))
        return torch.cat(parts)

    def _without_tail(self, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return row, component and log weight of those that carry 1 - tail_mass."""
        # Summed from the small end, where the digits are.
        ascending, order = weights.sort(dim=1)
        tail = ascending.cumsum(dim=1, dtype=torch.float64)
        kept = (tail > self.tail_mass) & (ascending > 0)
        kept[:, -1] = True
        row = kept.nonzero()[:, 0]
        return row, order[kept], ascending[kept].double().log()

    def _log_q(self, theta: Tensor, row: Tensor, component: Tensor) -> Tensor:
        """Evaluate K components at theta of their row, ``(S, b, d)`` to ``(S, K)``.

        The flow sees batches of its own size, whatever rows and samples they mix.
        """
        shape = (len(theta), len(row))
        pairs = torch.arange(len(theta) * len(row), device=theta.device)
        log_q = []
        for batch in pairs.split(flow_batch(theta.device)):
            sample, k = batch // len(row), batch % len(row)
            points = theta[sample, row[k]]
            if points.requires_grad:
                # A component without a density at its point has no gradient there.
                points.register_hook(lambda grad: grad.nan_to_num(nan=0.0))
            condition = self.contexts[component[k]]
            log_q.append(self.components.log_prob(points[None], condition)[0])
        return torch.cat(log_q).reshape(shape)

    # --- samples ---

    @torch.no_grad()
    def sample(
        self,
        sample_shape: torch.Size,
        condition: Tensor,
        *,
        accept: Accept | None = None,
        batch_size: int | None = None,
        show_progress_bars: bool = False,
        make_sampler: Callable[..., BlockSampler] | None = None,
        **kwargs: Any,
    ) -> Tensor:
        """Draw from the mixtures of a batch.

        Args:
            sample_shape: Shape of the draws of each observation.
            condition: Real observations, shape ``(B, *event)``.
            accept: Tells which draws ``(n, d)`` to keep; None keeps all.
            batch_size: Most draws the flow makes at a time; if None what is fast on the
                device.
            show_progress_bars: Whether to show the draws accepted so far.
            make_sampler: What draws from a block of observations, given the block, its
                weights, and the options of :class:`BlockSampler`; that class if None.
            **kwargs: None; kept for sbi's signature.

        Returns:
            Shape ``(*sample_shape, B, d)``.

        Raises:
            SamplingError: If next to nothing is accepted for some observation.
        """
        keep_freed_memory(self.contexts.device)
        features = self.features(condition)
        num_samples = torch.Size(sample_shape).numel()
        shape = (num_samples, len(features), *self.input_shape)
        theta = self.contexts.new_empty(shape)
        total = num_samples * len(features)
        with tqdm(total=total, desc="Sampling", disable=not show_progress_bars) as bar:
            for block, weights in self.row_blocks(features):
                sampler = (make_sampler or self._sampler)(
                    block,
                    weights,
                    accept=accept,
                    batch_size=batch_size or flow_batch(theta.device),
                    first_row=block.start,
                )
                for part in blocks(num_samples, len(weights)):
                    theta[part, block] = sampler.sample(part.stop - part.start)
                    bar.update((part.stop - part.start) * len(weights))
        return theta.reshape(*sample_shape, *shape[1:])

    def _sampler(self, block: slice, weights: Tensor, **options: Any) -> BlockSampler:
        return BlockSampler(self.components, self.contexts, weights, **options)

    def mass(
        self, x: Tensor, *, accept: Accept | None, cache: dict[str, Tensor]
    ) -> Leakage:
        r"""Return :math:`Z_i = \sum_j \alpha_{ij} Z_j`, the mass that is accepted.

        Args:
            x: Observations, shape ``(n, *event)``.
            accept: Tells which parameters ``(n, d)`` count; None counts all.
            cache: Keeps :math:`Z_j`, which is estimated once.
        """
        if "component_mass" not in cache:
            cache["component_mass"] = component_mass(
                self.components, self.contexts, accept=accept
            )
        rows = (weights for _, weights in self.row_blocks(self.features(x)))
        return mixture_mass(cache["component_mass"], rows, exact=accept is None)

    def loss(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Return the negative log-probability, shape ``(B,)``."""
        return -self.log_prob(input[None], condition)[0]


def _keys(x: Tensor) -> list[bytes]:
    """Return a fingerprint of each row's values."""
    # Adding zero makes -0.0 and 0.0, which are equal, equal in their bytes too.
    rows = (x.detach().cpu().flatten(1) + 0.0).contiguous().numpy()
    return [hashlib.blake2b(row.tobytes(), digest_size=16).digest() for row in rows]


def without_nan(log_q: Tensor) -> Tensor:
    """Let components without a density at some theta not take the others with them."""
    undefined = torch.isnan(log_q)
    if not undefined.any():
        return log_q
    warn_user(
        f"{int(undefined.sum())} of {undefined.numel()} component densities are NaN "
        "and counted as zero: the flow fails at these simulations or parameters. Train "
        "NPE longer, or with another density estimator."
    )
    return log_q.where(~undefined, -torch.inf)


def _log_sum_exp(log_terms: Tensor, row: Tensor, num_rows: int) -> Tensor:
    """Sum the terms ``(S, K)`` of each row, ``(S, num_rows)``."""
    index = row.expand_as(log_terms)
    shape = (len(log_terms), num_rows)
    largest = log_terms.detach().new_full(shape, -torch.inf)
    largest = largest.scatter_reduce(1, index, log_terms.detach(), "amax")
    largest = largest.where(torch.isfinite(largest), 0.0)
    terms = (log_terms - largest.gather(1, index)).exp()
    total = torch.zeros_like(largest).index_add(1, row, terms)
    return total.log() + largest
