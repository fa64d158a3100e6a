"""The density of a stack: the merged couplings, and densities of x itself."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import torch
from torch import Tensor, nn
from tqdm.auto import tqdm

from sbi_rope._sbi import ConditionalDensityEstimator
from sbi_rope.mixture import Leakage, MixtureEstimator
from sbi_rope.mixture.chunks import flow_slices
from sbi_rope.mixture.estimator import without_nan
from sbi_rope.mixture.sampling import Accept, BlockSampler
from sbi_rope.mixture.truncation import LEAKAGE_DRAWS
from sbi_rope.stacking.coupling import StackedCoupling
from sbi_rope.stacking.parts import (
    Part,
    PriorDensity,
    log_prob_of_pairs,
    share_inside,
)

__all__ = ["StackedEstimator"]


class StackedEstimator(ConditionalDensityEstimator):
    r"""The density :math:`\sum_k w_k\, q_k(\theta \mid x_o)` given x_o.

    Args:
        mixture: The couplings, merged; their shares are those of all couplings.
        parts: Densities of x itself, such as the prior and NPE.
        weights: Of each coupling, then of each part; they sum to one.
    """

    weights: Tensor

    def __init__(
        self,
        mixture: MixtureEstimator,
        parts: Sequence[Part],
        weights: Tensor,
    ) -> None:
        super().__init__(nn.Identity(), mixture.input_shape, mixture.condition_shape)
        self.mixture = mixture
        self._parts = nn.ModuleList(parts)
        self.register_buffer("weights", weights)

    @property
    def parts(self) -> list[Part]:
        """The densities of x itself."""
        return cast("list[Part]", list(self._parts))

    def with_weights(self, weights: Tensor) -> "StackedEstimator":
        """Return a stack of the same candidates with other weights."""
        mixture = copy.copy(self.mixture)
        shares = weights[: len(self.coupling.couplings)]
        # Without any weight their shares do not matter, but must be numbers.
        total = shares.sum().clamp_min(torch.finfo(shares.dtype).tiny)
        mixture.coupling = replace(self.coupling, shares=shares / total)
        return StackedEstimator(mixture, self.parts, weights)

    @property
    def _shares(self) -> Tensor:
        """The weight of all couplings together, then of each part."""
        count = len(self.coupling.couplings)
        return torch.cat([self.weights[:count].sum()[None], self.weights[count:]])

    # What MixturePosterior reads of its estimator.

    @property
    def contexts(self) -> Tensor:
        """The embeddings of the simulations, shape ``(n_s, l)``."""
        return self.mixture.contexts

    @property
    def x_o(self) -> Tensor:
        """The batch of real observations, shape ``(n_o, *event)``."""
        return self.mixture.x_o

    @property
    def coupling(self) -> Any:
        """The merged coupling."""
        return self.mixture.coupling

    def to_device(self, device: str | torch.device) -> None:
        """Move all parts."""
        self.to(device)
        self.mixture.to_device(device)
        for part in self.parts:
            if isinstance(part, PriorDensity):
                part.to_device(device)

    # --- density ---

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        r"""Return :math:`\log \sum_k w_k q_k(\theta \mid x_o)`.

        Args:
            input: theta, shape ``(S, B, d)`` or ``(B, d)``; B or 1 of them.
            condition: Real observations, shape ``(B, *event)``; B or 1 of them.
            **kwargs: None; kept for sbi's signature.

        Returns:
            Shape ``(S, B)``.
        """
        mixed = self.mixture.log_prob(input, condition).double()
        shares = self._shares
        terms = [mixed + shares[0].log()]
        theta = (input if input.ndim == 3 else input[None]).to(self.contexts)
        condition = condition.to(self.x_o)
        shape = torch.Size((len(theta), mixed.shape[1]))
        pairs = theta.expand(*shape, -1).reshape(-1, *self.input_shape)
        row = torch.arange(shape[1], device=theta.device).expand(shape).flatten()
        row = row.clamp_max(len(condition) - 1)
        for part, share in zip(self.parts, shares[1:], strict=True):
            features = part.features(condition)
            log_q = log_prob_of_pairs(part, pairs, features, row)
            terms.append(log_q.reshape(shape).double() + share.log())
        return torch.logsumexp(torch.stack(terms), dim=0).to(theta)

    @torch.no_grad()
    def candidate_log_probs(
        self,
        theta: Tensor,
        x: Tensor,
        *,
        log_q: Tensor | None = None,
        component_mass: Tensor | None = None,
    ) -> Tensor:
        """Return the log density of each candidate by itself at pairs.

        Args:
            theta: Parameters, shape ``(n, d)``.
            x: Their observations, shape ``(n, *event)``.
            log_q: What :meth:`component_log_probs` returns for theta, if it is known.
            component_mass: The mass of each component inside the support of the prior,
                shape ``(n_s,)``; without it couplings are not normalised either.

        Returns:
            Shape ``(n, K)``, float64: couplings first, then the parts, which are not
            corrected for leakage.
        """
        if log_q is None:
            log_q = self.component_log_probs(theta)
        features = self.mixture.features(x)
        coupling: StackedCoupling = self.coupling
        scores = []
        for rows in coupling.rows_of_each(features):
            score = torch.logsumexp(rows.log() + log_q, dim=1)
            if component_mass is not None:
                score = score - (rows.to(component_mass) @ component_mass).log()
            scores.append(score)
        row = torch.arange(len(x), device=theta.device)
        scores += [
            log_prob_of_pairs(part, theta, part.features(x), row) for part in self.parts
        ]
        return torch.stack([score.double() for score in scores], dim=1)

    @torch.no_grad()
    def component_log_probs(
        self, theta: Tensor, *, show_progress_bars: bool = False
    ) -> Tensor:
        r"""Return :math:`\log q(\theta_i \mid h(x_{s,j}))`.

        Args:
            theta: Parameters, shape ``(n, d)``.
            show_progress_bars: Whether to show progress.

        Returns:
            Shape ``(n, n_s)``.
        """
        n, n_s = len(theta), len(self.contexts)
        pairs = flow_slices(n * n_s, theta.device)
        index = torch.arange(n * n_s, device=theta.device)
        log_q = [
            self.mixture.components.log_prob(
                theta[index[block] // n_s][None], self.contexts[index[block] % n_s]
            )[0]
            for block in tqdm(pairs, desc="Scoring", disable=not show_progress_bars)
        ]
        return without_nan(torch.cat(log_q)).reshape(n, n_s)

    def mass(
        self, x: Tensor, *, accept: Accept | None, cache: dict[str, Tensor]
    ) -> Leakage:
        r"""Return :math:`\sum_k w_k Z_k(x)`, the mass that is accepted.

        Args:
            x: Observations, shape ``(n, *event)``.
            accept: Tells which parameters ``(n, d)`` count; None counts all.
            cache: Keeps what is estimated once.
        """
        x = x.to(self.x_o)
        own = self.mixture.mass(x, accept=accept, cache=cache)
        shares = self._shares
        mass = shares[0] * own.mass
        variance = (shares[0] * own.standard_error).square()
        for part, weight in zip(self.parts, shares[1:], strict=True):
            # What weighs no more than log_prob may leave out counts as inside.
            negligible = bool(weight <= self.mixture.tail_mass)
            if accept is None or negligible:
                mass = mass + weight
                continue
            # As many draws as its share of the stack: what counts is the error of
            # the sum.
            draws = int(torch.ceil(LEAKAGE_DRAWS * weight))
            inside = share_inside(part, part.features(x), accept, draws)
            smoothed = (draws * inside + 0.5) / (draws + 1)
            mass = mass + weight * inside
            variance = variance + weight**2 * smoothed * (1 - smoothed) / draws
        return Leakage(mass, variance.sqrt())

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
        **kwargs: Any,
    ) -> Tensor:
        """Draw from the stacks of a batch; see :meth:`MixtureEstimator.sample`."""
        condition = condition.to(self.x_o)
        extra = [part.features(condition) for part in self.parts]

        def make_sampler(block: slice, weights: Tensor, **options: Any) -> BlockSampler:
            return StackSampler(
                self.mixture.components,
                self.contexts,
                weights,
                parts=list(zip(self.parts, (e[block] for e in extra), strict=True)),
                shares=self._shares,
                **options,
            )

        return self.mixture.sample(
            sample_shape,
            condition,
            accept=accept,
            batch_size=batch_size,
            show_progress_bars=show_progress_bars,
            make_sampler=make_sampler,
        )

    def loss(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Return the negative log-probability, shape ``(B,)``."""
        return -self.log_prob(input[None], condition)[0]


class StackSampler(BlockSampler):
    """Draws from the stacks of a block of observations.

    Args:
        *args: As :class:`BlockSampler`, of the mixture.
        parts: The other densities, each with its features of the block.
        shares: Of the mixture and of each part.
        **options: As :class:`BlockSampler`.
    """

    def __init__(
        self,
        *args: Any,
        parts: list[tuple[Any, Tensor]],
        shares: Tensor,
        **options: Any,
    ) -> None:
        super().__init__(*args, **options)
        self.parts, self.shares = parts, shares

    def _propose(self, rows: Tensor) -> Tensor:
        theta = self.contexts.new_empty(len(rows), *self.components.input_shape)
        chosen = torch.multinomial(self.shares, len(rows), replacement=True)
        for k in range(len(self.shares)):
            slots = (chosen == k).nonzero().flatten()
            if not len(slots):
                continue
            if k == 0:
                theta[slots] = super()._propose(rows[slots])
                continue
            part, features = self.parts[k - 1]
            for some in slots.split(self.batch_size):
                theta[some] = part.sample(features[rows[some]])
        return theta
