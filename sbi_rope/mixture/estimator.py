"""The density of a mixture of weighted parts, as an estimator in the sense of sbi."""

import copy
import math
from collections.abc import Iterator, Sequence
from itertools import chain
from typing import Any, cast

import torch
from torch import Tensor, nn

from sbi_rope._progress import progress_bar
from sbi_rope._sbi import MixtureDensity
from sbi_rope.errors import InvalidInputError
from sbi_rope.mixture.block import Block
from sbi_rope.mixture.chunks import blocks, flow_batch, keep_freed_memory
from sbi_rope.mixture.coupled import CoupledEmbeddings
from sbi_rope.mixture.density import block_log_prob
from sbi_rope.mixture.parts import DTYPE, Part
from sbi_rope.mixture.sampling import Accept, BlockSampler, deadline_after
from sbi_rope.mixture.truncation import (
    LEAKAGE_DRAWS,
    Leakage,
    component_mass,
    own_mass,
    shared_mass,
)
from sbi_rope.tensors import as_batch, rows_with

__all__ = ["MixtureEstimator"]

TAIL_MASS = 1e-3


class MixtureEstimator(MixtureDensity):
    r"""A mixture of densities, each of which is itself mixed over embeddings.

    .. math::
        p(\theta \mid x) = \sum_k w_k \sum_j a^k_j(x)\, q_k(\theta \mid s^k_j(x))

    It is an estimator in the sense of sbi, and its condition is an observation. It does
    not know the support of the prior; :class:`~sbi_rope.MixturePosterior` does.

    Args:
        parts: The densities :math:`q_k`, each with its weights :math:`a^k` and
            embeddings :math:`s^k`. Several of them may belong to a batch if their
            ``x_o`` are the same.
        weights: :math:`w`, one for each part, which sum to one. Parts with a weight of
            zero are not evaluated.
        tail_mass: ``log_prob`` leaves out the smallest weights of each observation that
            sum to at most this. Only embeddings that observations share are left out,
            such as the simulations of a coupling. 0 evaluates all.

    Raises:
        InvalidInputError: If shapes of theta or x differ between parts, or parts belong
            to different batches.
    """

    weights: Tensor

    def __init__(
        self,
        parts: Sequence[Part],
        weights: Sequence[float] | Tensor,
        *,
        tail_mass: float = TAIL_MASS,
    ) -> None:
        first = parts[0]
        super().__init__(
            nn.Identity(), first.density.input_shape, first.mixing.event_shape
        )
        for part in parts:
            shapes = (part.density.input_shape, part.mixing.event_shape)
            if shapes != (self.input_shape, self.condition_shape):
                raise InvalidInputError(
                    f"Expected parts of theta {tuple(self.input_shape)} given x "
                    f"{tuple(self.condition_shape)}, as the first; got theta "
                    f"{tuple(shapes[0])} given x {tuple(shapes[1])}."
                )
        self.tail_mass = tail_mass
        self._parts = nn.ModuleList(parts)
        tensors = chain(self._parts.buffers(), self._parts.parameters())
        device = next(tensors, torch.empty(0)).device
        shares = torch.as_tensor(weights, dtype=torch.double, device=device)
        self.register_buffer("weights", shares)
        for other in self.coupled[1:]:
            if not torch.equal(other.x_o, self.coupled[0].x_o):
                raise InvalidInputError(
                    "Expected the same `x_o` in all coupled parts; got different ones."
                )

    @property
    def parts(self) -> list[Part]:
        """All parts, also those with a weight of zero."""
        return cast("list[Part]", list(self._parts))

    def taken_apart(self) -> tuple[list[Part], list[float]]:
        """Return copies of the parts, and their weights, for another mixture."""
        return copy.deepcopy(self).parts, self.weights.tolist()

    @property
    def coupled(self) -> list[CoupledEmbeddings]:
        """The coupled embeddings of those parts that belong to a batch."""
        mixings = [part.mixing for part in self.parts]
        return [mixing for mixing in mixings if isinstance(mixing, CoupledEmbeddings)]

    def restricted_to(self, index: int) -> "MixtureEstimator":
        """Return the same mixture for one observation of the batch.

        It shares its densities with this mixture, and holds no other observation.

        Args:
            index: The number of the observation in ``x_o``.
        """
        parts = [
            Part(part.density, part.mixing.restricted_to(index))
            if isinstance(part.mixing, CoupledEmbeddings)
            else part
            for part in self.parts
        ]
        return MixtureEstimator(parts, self.weights, tail_mass=self.tail_mass)

    # --- density ---

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        r"""Return :math:`\log p(\theta \mid x)`.

        Args:
            input: theta, shape ``(S, B, d)`` or ``(B, d)``. One row of theta serves
                all observations.
            condition: Observations, shape ``(B, *event)``. One observation serves all
                rows of theta.
            **kwargs: Not used; they are in sbi's signature.

        Returns:
            Shape ``(S, B)``. With ``tail_mass`` = t the density is too small by at most
            t times the largest density among the terms left out.

        Raises:
            InvalidInputError: If the numbers of rows do not fit, or an x is not in the
                batch of a coupled part with ``unseen="raise"``.
        """
        theta, x = self._as_samples(input), self.checked_x(condition)
        num_rows = max(theta.shape[1], len(x))
        if {theta.shape[1], len(x)} - {1, num_rows}:
            raise InvalidInputError(
                "Expected as many rows of `theta` as observations, or one of them; "
                f"got theta {tuple(input.shape)} and {len(x)} observations."
            )
        keep_freed_memory(theta.device)
        shape = (len(theta), num_rows)
        if not theta.numel():
            return theta.new_empty(shape)
        # A single observation needs one row of weights only: all theta become samples
        # of that row.
        theta = theta.expand(-1, num_rows, *self.input_shape)
        theta = theta.reshape(-1, len(x), *self.input_shape)
        parts, shares = self._used
        log_probs = [
            block_log_prob(theta[:, rows], block, tail_mass=self.tail_mass)
            for rows, block in _blocks(parts, shares, x)
        ]
        return torch.cat(log_probs, dim=1).reshape(shape).to(theta)

    @torch.no_grad()
    def part_log_probs(self, theta: Tensor, x: Tensor) -> Tensor:
        r"""Return the log density of each part by itself at pairs of theta and x.

        It does not depend on the weights of the parts, and leaves nothing out.

        Args:
            theta: Parameters, shape ``(n, d)``.
            x: Their observations, shape ``(n, *event)``.

        Returns:
            :math:`\log \sum_j a^k_j(x_i) q_k(\theta_i \mid s^k_j(x_i))`, shape
            ``(n, K)``, float64.

        Raises:
            InvalidInputError: If the numbers of rows do not fit.
        """
        pairs, x = self._as_samples(theta), self.checked_x(x)
        log_probs = pairs.new_empty(len(x), len(self.parts), dtype=torch.double)
        for number, part in enumerate(self.parts):
            for rows, block in _blocks([part], [1.0], x):
                log_prob = block_log_prob(pairs[:, rows], block, tail_mass=0.0)
                log_probs[rows, number] = log_prob[0]
        return log_probs

    @property
    def _used(self) -> tuple[list[Part], list[float]]:
        """The parts with a weight above zero, and these weights."""
        used = [
            (part, share)
            for part, share in zip(self.parts, self.weights.tolist(), strict=True)
            if share
        ]
        return [part for part, _ in used], [share for _, share in used]

    def _as_samples(self, theta: Tensor) -> Tensor:
        """Return theta as ``(S, B, d)``."""
        theta = theta[None] if theta.ndim == 2 else theta
        return theta.to(self.weights.device, DTYPE)

    def checked_x(self, x: Tensor) -> Tensor:
        """Return observations ``(n, *event)`` if all parts can read them.

        Raises:
            InvalidInputError: If a shape does not fit, or a value is not finite. Some
                embedding nets can do with missing values (NaN).
        """
        x = as_batch("x", x, self.condition_shape, finite=False)
        x = x.to(self.weights.device, DTYPE)
        if not torch.isfinite(x).all():
            can_read = torch.stack([part.mixing.readable(x) for part in self._used[0]])
            unread = ~can_read.all(dim=0)
            if unread.any():
                raise InvalidInputError(
                    "Expected `x` that the embedding net can read; got NaN or Inf in "
                    f"{rows_with(unread)}."
                )
        return x

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
        max_sampling_time: float | None = None,
        **kwargs: Any,
    ) -> Tensor:
        """Draw from the mixtures of a batch.

        Args:
            sample_shape: Shape of the draws of each observation.
            condition: Observations, shape ``(B, *event)``.
            accept: Tells which draws ``(n, d)`` to keep; None keeps all.
            batch_size: The largest number of draws the flow makes at a time. If None,
                the number that is fast on the device.
            show_progress_bars: Whether to show how many draws were accepted so far.
            max_sampling_time: Seconds after which rejection gives up; never if None.
            **kwargs: Not used; they are in sbi's signature.

        Returns:
            Shape ``(*sample_shape, B, d)``.

        Raises:
            SamplingError: If hardly any draw is accepted for some observation, or the
                time is over.
        """
        deadline = deadline_after(max_sampling_time)
        x = self.checked_x(condition)
        keep_freed_memory(x.device)
        num_samples = torch.Size(sample_shape).numel()
        shape = (num_samples, len(x), *self.input_shape)
        theta = x.new_empty(shape)
        total = num_samples * len(x)
        with progress_bar(show=show_progress_bars, desc="Sampling", total=total) as bar:
            for rows, block in _blocks(*self._used, x):
                sampler = BlockSampler(
                    block,
                    accept=accept,
                    batch_size=batch_size or flow_batch(x.device),
                    first_row=rows.start,
                    deadline=deadline,
                )
                for part in blocks(num_samples, len(block.weights)):
                    theta[part, rows] = sampler.sample(part.stop - part.start)
                    bar.update((part.stop - part.start) * len(block.weights))
        return theta.reshape(*sample_shape, *shape[1:])

    # --- mass inside the prior's support ---

    def mass(
        self,
        x: Tensor,
        *,
        accept: Accept | None,
        cache: dict[int, Tensor],
        show_progress_bars: bool = False,
    ) -> Leakage:
        r"""Return the mass of each observation's mixture inside the prior's support.

        .. math:: Z(x) = \sum_k w_k \sum_j a^k_j(x)\, Z_k(s^k_j(x))

        For embeddings that observations share, :math:`Z_k` is estimated once, from 1024
        draws for each. For embeddings that belong to one observation it is estimated
        for each x, from 1024 draws times the weight of the part. The smallest parts,
        which together weigh less than one in 1024, count as inside.

        Args:
            x: Observations, shape ``(n, *event)``.
            accept: Tells which parameters ``(n, d)`` are inside; None means all.
            cache: Keeps the masses that are estimated once, by the number of the part.
            show_progress_bars: Whether to show progress if the estimate takes long.
        """
        x = self.checked_x(x)
        mass = torch.zeros(len(x), dtype=torch.double, device=x.device)
        variance = torch.zeros_like(mass)
        ascending, order = self.weights.sort()
        small = set(order[ascending.cumsum(dim=0) < 1 / LEAKAGE_DRAWS].tolist())
        for k, share in enumerate(self.weights.tolist()):
            if not share:
                continue
            part = self.parts[k]
            embedded = part.mixing.embed(x)
            if accept is None:
                mass += share
                continue
            if k in small:
                own = Leakage(torch.ones_like(mass), torch.full_like(mass, 0.5))
            elif part.mixing.embeddings is None:
                own = own_mass(
                    part,
                    embedded,
                    accept=accept,
                    num_draws=math.ceil(LEAKAGE_DRAWS * share),
                    seed=k,
                    show_progress_bars=show_progress_bars,
                )
            else:
                if k not in cache:
                    cache[k] = component_mass(
                        part.density,
                        part.mixing.embeddings,
                        accept=accept,
                        show_progress_bars=show_progress_bars,
                    )
                own = shared_mass(part, embedded, cache[k])
            mass += share * own.mass
            variance += (share * own.standard_error).square()
        return Leakage(mass, variance.sqrt())

    def loss(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Return the negative log-probability, shape ``(B,)``."""
        return -self.log_prob(input[None], condition)[0]


def _blocks(
    parts: Sequence[Part], shares: Sequence[float], x: Tensor
) -> Iterator[tuple[slice, Block]]:
    """Yield the weighted embeddings of one block of observations after the other."""
    embedded = [part.mixing.embed(x) for part in parts]
    num_columns = sum(part.mixing.num_embeddings for part in parts)
    for rows in blocks(len(x), num_columns):
        of_each = [
            part.mixing.rows(values[rows])
            for part, values in zip(parts, embedded, strict=True)
        ]
        yield rows, Block(parts, shares, of_each)
