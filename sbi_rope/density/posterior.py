"""A density as an sbi posterior: the prior's support, normalisation, the batch."""

import copy
import operator
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope.coupling import Coupling
from sbi_rope.density.base import (
    DTYPE,
    MAX_ENTRIES,
    Accept,
    Density,
    Prior,
    num_fitting,
)
from sbi_rope.density.coupled import Coupled
from sbi_rope.density.sets import MakesSets
from sbi_rope.npe.prior import PriorDistribution
from sbi_rope.npe.sbi import BaseDirectPosterior, MixedDensity
from sbi_rope.npe.standardisation import warn_of_far_entries
from sbi_rope.utils.errors import InvalidInputError, SamplingError
from sbi_rope.utils.progress import is_shown, progress_bar
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import Count, Positive, check
from sbi_rope.utils.tensors import as_batch, as_numbers, rows_with

# An observation is slow if, after MIN_PROPOSALS proposals, less than a share of
# MIN_ACCEPTANCE of them lies inside the prior's support. Rejection sampling gives up on
# slow observations if they would take more than MAX_PROPOSALS further proposals, which
# are minutes. In a stack the prior often keeps a share just below MIN_ACCEPTANCE.
MIN_PROPOSALS, MIN_ACCEPTANCE, MAX_PROPOSALS = 100_000, 1e-3, 10_000_000
# Observations for which this many proposals were all rejected are counted together.
MIN_WITHOUT_ANY = 5_000
# A flow takes about as long for this many draws as for a single one.
SMALL_BATCH = 512


class MixturePosterior(MakesSets, BaseDirectPosterior):
    r"""A density as an sbi posterior, such as RoPE's mixture over simulations.

    .. math::
        p(\theta \mid x)
        = \frac{\mathbf{1}[\theta \in \operatorname{supp} p]}{Z(x)}\, q(\theta \mid x),

    with Z(x) the mass inside the support of the prior. For RoPE,

    .. math::
        q(\theta \mid x_{o,i}) = \sum_j \alpha_{ij}\, q(\theta \mid h(x_{s,j})),
        \qquad Z_i = \sum_j \alpha_{ij} Z_j .

    It has all methods of sbi's :class:`DirectPosterior` and works with sbi's
    diagnostics. That of RoPE belongs to a batch of observations, its ``x_o``. Others
    are amortised and answer any x. Apart from arguments and result it needs some 150
    MB.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
          Calibration (Wehenkel et al., 2025), eq. 5
        | https://arxiv.org/abs/2405.08719

    Args:
        density: q.
        prior: The prior that NPE was trained with.
        enable_transform: Whether ``map()`` searches in an unbounded space, as in sbi.
            For mixed discrete and continuous parameters it never does.
    """

    prior: PriorDistribution
    # One name for each parameter, and for each column of tables of x, if they have any.
    parameter_names: tuple[str, ...] | None = None
    x_names: tuple[str, ...] | None = None
    # Whether an amortised posterior warns of entries that are far from simulations.
    warns = True
    # The observations that the mass was last estimated for, and this mass.
    _latest: tuple[Tensor, Tensor] | None = None

    def __init__(
        self,
        density: Density,
        prior: Distribution,
        *,
        enable_transform: bool = True,
    ) -> None:
        # A category that sbi has standardised and put back may differ by rounding, and
        # is no category then.
        is_mixed = any(isinstance(part, MixedDensity) for part in density.modules())
        enable_transform = enable_transform and not is_mixed
        self._set_up(density, PriorDistribution(prior), enable_transform)

    def _set_up(self, density: Density, prior: Any, enable_transform: bool) -> None:  # noqa: FBT001
        with seeded(0):  # sbi draws from the prior to find out about it
            BaseDirectPosterior.__init__(
                self,
                density,
                prior,
                device=str(density.device),
                enable_transform=enable_transform,
            )
        self.posterior_estimator: Density = density

    def __str__(self) -> str:
        of = "any x" if self.is_amortised else f"each of {len(self)} x"
        return f"{type(self).__name__} p(θ|x) of {of}"

    def __getstate__(self) -> dict[str, Any]:
        # Copies, files and posteriors of single observations do without it.
        return {**super().__getstate__(), "_latest": None}

    # --- the batch ---

    @property
    def is_amortised(self) -> bool:
        """Whether it answers any x, and belongs to no batch."""
        return not self.posterior_estimator.coupled

    @property
    def x_o(self) -> Tensor:
        """The batch of real observations, shape ``(n_o, *event)``."""
        return self._coupled[0].x_o

    @property
    def coupling(self) -> Coupling:
        """The coupling of the batch with the simulations, if there is a single one."""
        coupled, *others = self._coupled
        if others:
            raise InvalidInputError(
                f"Expected a single coupling; got {1 + len(others)} in an average."
            )
        return coupled.coupling

    @property
    def weights(self) -> Tensor:
        """Weights of the simulations in the coupled part, shape ``(n_o, n_s)``."""
        return self.coupling.weights

    @property
    def _coupled(self) -> Sequence[Coupled]:
        if not (coupled := self.posterior_estimator.coupled):
            raise InvalidInputError(
                "Expected a posterior of a batch; got an amortised one, which has no "
                "`x_o`, coupling or length."
            )
        return coupled

    def __len__(self) -> int:
        return len(self.x_o)

    def __bool__(self) -> bool:
        return True  # also an amortised one, which has no length

    def __getitem__(self, index: int) -> "MixturePosterior":
        """Return the posterior of one observation alone, which is its default x."""
        index = range(len(self))[operator.index(index)]
        density = self.posterior_estimator.restricted_to(index)
        view = copy.copy(self)
        view.posterior_estimator = density
        potential_fn: Any = copy.copy(self.potential_fn)
        potential_fn.posterior_estimator = density
        potential_fn.set_x(None)  # another observation may have been asked for last
        view.potential_fn = potential_fn
        view.set_default_x(view.x_o)
        return view

    def to(self, device: str | torch.device) -> None:
        """Move the posterior, its coupling and its batch to a device.

        Posteriors of single observations (``posterior[i]``) have to be taken again.
        """
        x, self._latest = self.default_x, None
        self.prior.to(device)
        density = self.posterior_estimator.to(device)
        self._set_up(density, self.prior, self.enable_transform)
        if x is not None:
            self._keep_default_x(x)

    # --- arguments ---

    def set_default_x(self, x: Tensor) -> "MixturePosterior":
        """Set the observation ``(*event)`` of methods that are given none."""
        self._keep_default_x(self._warned_of(self._batch_of_x(x)))
        return self

    def _one_x(self, x: Tensor | None) -> Tensor:
        x = self.default_x if x is None else x
        if x is None:
            raise InvalidInputError(
                "Expected an observation `x`, or a default x; got neither."
            )
        batch = self._batch_of_x(x)
        if len(batch) > 1:
            raise InvalidInputError(
                f"Expected one observation; got {len(batch)}. For several, use the "
                "`_batched` methods."
            )
        return batch

    def _batch_of_x(self, x: Any) -> Tensor:
        """Return observations ``(n, *event)`` if the density can read them."""
        density = self.posterior_estimator
        x = as_numbers("x", x, names=self.x_names).to(DTYPE)
        x = x[None] if x.shape == density.condition_shape else x
        x = as_batch("x", x, density.condition_shape, finite=False).to(density.device)
        if not torch.isfinite(x).all() and (unread := ~density.readable(x)).any():
            raise InvalidInputError(
                "Expected `x` without NaN or Inf that the embedding net cannot read; "
                f"got {rows_with(unread)}."
            )
        return x

    def _parameters(self, theta: Any, *, batched: bool = False) -> Tensor:
        """Return parameters in float32, ``(n, d)``, or ``(S, B, d)`` of a batch."""
        # A bound of the prior is one in float32 only: 0.1 of float64 is below it.
        dim = self.posterior_estimator.input_shape[0]
        numbers = as_numbers("theta", theta, names=self.parameter_names)
        theta = theta if isinstance(theta, Tensor) else numbers  # which has gradients
        shape = tuple(theta.shape)
        if theta.ndim not in ((2, 3) if batched else (1, 2)) or shape[-1] != dim:
            expected = f"(B, {dim}) or (S, B, {dim})" if batched else f"(n, {dim})"
            raise InvalidInputError(
                f"Expected `theta` of shape {expected}; got {shape}."
            )
        if torch.isnan(theta).any() or not len(theta):
            raise InvalidInputError("Expected `theta` with numbers; got NaN or none.")
        theta = torch.atleast_2d(theta).to(self.posterior_estimator.device, DTYPE)
        return theta[None] if batched and theta.ndim == 2 else theta

    def _warned_of(self, x: Tensor) -> Tensor:
        """Return observations, after a warning if entries are far from simulations."""
        if self.warns and self.is_amortised:  # RoPE has warned of its batch
            warn_of_far_entries("x", x, self.posterior_estimator)
        return x

    # --- samples ---

    def sample(  # type: ignore[override]
        self, sample_shape: Any = (), x: Any = None, *args: Any, **options: Any
    ) -> Tensor:
        r"""Draw from :math:`p(\theta \mid x)` of one observation.

        The default x is taken if there is none. The other arguments, and errors, are
        those of :meth:`sample_batched`. The result has shape ``(*sample_shape, d)``.
        """
        x = self._one_x(x)
        return self.sample_batched(sample_shape, x, *args, **options).squeeze(-2)

    def sample_batched(  # type: ignore[override]
        self,
        sample_shape: Any,
        x: Tensor,
        max_sampling_batch_size: int | None = None,
        show_progress_bars: bool | None = None,  # noqa: FBT001
        reject_outside_prior: bool = True,  # noqa: FBT001, FBT002
        max_sampling_time: float | None = None,
    ) -> Tensor:
        r"""Draw from :math:`p(\theta \mid x_b)` of every observation of a batch.

        Args:
            sample_shape: Shape of the draws of each observation.
            x: Observations, shape ``(B, *event)``.
            max_sampling_batch_size: The most draws that are made at a time.
            show_progress_bars: Whether to show how many draws were accepted so far.
                None does so in a terminal or a notebook, but not in a file.
            reject_outside_prior: Whether to draw from the density truncated to the
                prior's support, or from the whole density.
            max_sampling_time: Seconds after which to give up; None for no limit.

        Returns:
            Shape ``(*sample_shape, B, d)``.

        Raises:
            InvalidInputError: If an x is not in the batch and ``unseen="raise"``.
            SamplingError: If hardly any mass lies inside the prior's support, or the
                time is over.
        """
        check("max_sampling_time", max_sampling_time, Positive | None)
        check("max_sampling_batch_size", max_sampling_batch_size, Count | None)
        x = self._warned_of(self._batch_of_x(x))
        shape = torch.Size(sample_shape)
        density = self.posterior_estimator.eval()
        z = density.embed(x)
        num_samples, num_rows = shape.numel(), len(x)
        total, start = num_samples * num_rows, time.monotonic()

        def propose(row: Tensor) -> Tensor:
            if max_sampling_time and time.monotonic() > start + max_sampling_time:
                raise SamplingError(
                    "Sampling took longer than `max_sampling_time`: not all of "
                    f"{total} draws were made."
                )
            parts = row.split(max_sampling_batch_size or len(row))
            return torch.cat([density.draw(z, some) for some in parts])

        draw: Callable[[Tensor], Tensor] = propose
        if reject_outside_prior:
            draw = rejecting(propose, self.prior.inside, num_rows)
        theta = torch.empty(total, *density.input_shape, device=density.device)
        show = is_shown(show_progress_bars)
        with (
            torch.no_grad(),
            progress_bar(show=show, desc="Sampling", total=total) as bar,
        ):
            # Observation by observation, so that few of them are needed at a time.
            for first in range(0, total, MAX_ENTRIES):
                last = min(first + MAX_ENTRIES, total)
                slot = torch.arange(first, last, device=theta.device)
                row, number = slot // num_samples, slot % num_samples
                theta[number * num_rows + row] = draw(row)
                bar.update(len(slot))
        return theta.reshape(*shape, num_rows, *density.input_shape)

    # --- density ---

    def log_prob(  # type: ignore[override]
        self,
        theta: Tensor,
        x: Tensor | None = None,
        norm_posterior: bool = True,  # noqa: FBT001, FBT002
        track_gradients: bool = False,  # noqa: FBT001, FBT002
    ) -> Tensor:
        r"""Return :math:`\log p(\theta \mid x)` of one observation.

        Args:
            theta: Parameters, shape ``(n, d)`` or ``(d,)``.
            x: An observation, from the batch if there is one; the default x if None.
            norm_posterior: Whether to divide by the mass inside the prior's support.
            track_gradients: Whether gradients with respect to theta are needed.

        Returns:
            Shape ``(n,)``; minus infinity outside the prior's support.

        Raises:
            InvalidInputError: If x is not in the batch and ``unseen="raise"``.
            SamplingError: If the density has no mass inside the prior's support.
        """
        theta, x = self._parameters(theta)[:, None], self._warned_of(self._one_x(x))
        return self._log_prob(theta, x, norm_posterior, track_gradients)[:, 0]

    def log_prob_batched(  # type: ignore[override]
        self, theta: Any, x: Any, *args: Any, **options: Any
    ) -> Tensor:
        r"""Return :math:`\log p(\theta_b \mid x_b)` for every observation of a batch.

        Parameters of shape ``(B, d)`` or ``(S, B, d)`` belong to observations
        ``(B, *event)``. One row of theta serves all observations, and one observation
        all rows of theta. The other arguments, and errors, are those of
        :meth:`log_prob`. The result has shape ``(1, B)`` or ``(S, B)``.
        """
        theta = self._parameters(theta, batched=True)
        x = self._warned_of(self._batch_of_x(x))
        if {theta.shape[1], len(x)} - {1, max(theta.shape[1], len(x))}:
            raise InvalidInputError(
                "Expected as many rows of `theta` as observations, or one of them; "
                f"got theta {tuple(theta.shape)} and {len(x)} observations."
            )
        return self._log_prob(theta, x, *args, **options)

    def _log_prob(
        self,
        theta: Tensor,
        x: Tensor,
        norm_posterior: bool = True,  # noqa: FBT001, FBT002
        track_gradients: bool = False,  # noqa: FBT001, FBT002
    ) -> Tensor:
        """Return the log density at theta ``(S, B, d)``; x is embedded once."""
        density = self.posterior_estimator.eval()
        # Networks may be NaN outside.
        safe, inside = self.prior.moved_inside(theta.flatten(0, 1))
        z = density.embed(x)
        with torch.set_grad_enabled(track_gradients):
            safe = safe.reshape(theta.shape)
            log_prob = density.log_prob_given(safe, z, len(x))
        if norm_posterior:
            log_prob = log_prob - self._normaliser(x, z).log()
        inside = inside.reshape(theta.shape[:2])
        return log_prob.to(DTYPE).where(inside, -torch.inf)

    def map(self, x: Tensor | None = None, **options: Any) -> Tensor:  # type: ignore[override]
        """Return the maximum of the density given the default x, as in sbi, ``(1, d)``.

        The defaults are smaller than those of sbi, which would take many minutes:
        ``num_iter`` and ``num_init_samples`` are 100, and ``num_to_optimize`` is 5.
        """
        own: dict[str, Any] = dict(
            num_iter=100, num_init_samples=100, num_to_optimize=5
        )
        with torch.enable_grad():  # the caller may have switched gradients off
            return super().map(x=x, **(own | options))

    # --- normalisation ---

    def leakage_correction(self, x: Tensor) -> Tensor:  # type: ignore[override]
        r"""Return the mass of the density inside the prior's support, ``(B,)``.

        It is estimated from 1024 draws with a seed of their own, so that ``log_prob``
        of observations ``(B, *event)`` always returns the same numbers.

        Raises:
            SamplingError: If one of the masses is zero.
        """
        x = self._batch_of_x(x)
        return self._normaliser(x, self.posterior_estimator.embed(x)).to(DTYPE)

    def _normaliser(self, x: Tensor, z: Any) -> Tensor:
        if self.prior.is_unbounded:
            return torch.ones(len(x), dtype=torch.double, device=x.device)
        if self._latest is not None and torch.equal(self._latest[0], x):
            return self._latest[1]
        mass = self.posterior_estimator.mass(z, len(x), self.prior.inside)
        if not (mass > 0).all():
            rows = (mass <= 0).nonzero().flatten()
            raise SamplingError(
                f"The densities of rows {rows[:5].tolist()} of `x` have no mass inside "
                "the support of the prior. Leave them out, or train NPE longer."
            )
        self._latest = x.clone(), mass
        return mass


def rejecting(
    propose: Callable[[Tensor], Tensor], accept: Accept, num_rows: int
) -> Callable[[Tensor], Tensor]:
    """Return a function that proposes until a draw of each row is accepted."""
    proposed, inside = torch.zeros(2, num_rows, dtype=torch.long)

    def draw(row: Tensor) -> Tensor:
        theta = torch.empty(0)
        still_open = torch.ones_like(row, dtype=torch.bool)
        rate = 1.0
        while (open_slots := still_open.nonzero().flatten()).numel():
            # For the last few slots, more proposals take no longer than one.
            count = len(open_slots)
            wanted = max(int(1 / max(rate, MIN_ACCEPTANCE)), SMALL_BATCH // count)
            repeats = max(1, min(wanted, num_fitting(count)))
            proposals = open_slots.repeat_interleave(repeats)
            rows = row[proposals]
            draws = propose(rows)
            accepted = accept(draws)
            if not len(theta):
                theta = draws.new_empty(len(row), *draws.shape[1:])
            # Of several proposals for a slot the first accepted one is kept.
            chosen = accepted.nonzero().flatten()
            filled = proposals[chosen]
            first = filled != filled.roll(1)
            first[:1] = True
            theta[filled[first]] = draws[chosen[first]]
            still_open[filled] = False
            proposed.add_(rows.bincount(minlength=num_rows).cpu())
            inside.add_(rows[accepted].bincount(minlength=num_rows).cpu())
            missing = row[still_open].bincount(minlength=num_rows).cpu()
            _give_up_on_hopeless(proposed, inside, missing)
            rate = float(accepted.double().mean())
        return theta

    return draw


def _give_up_on_hopeless(proposed: Tensor, inside: Tensor, missing: Tensor) -> None:
    """Raise if some rows would take too many more proposals."""
    share = inside / proposed.clamp_min(1)
    slow = (missing > 0) & (proposed >= MIN_PROPOSALS) & (share < MIN_ACCEPTANCE)
    # Infinite if nothing was accepted so far.
    further = (missing[slow] / share[slow]).sum()
    hopeless = slow & (further > MAX_PROPOSALS)
    without_any = (proposed >= MIN_WITHOUT_ANY) & (inside == 0)
    if int(proposed[without_any].sum()) >= MIN_PROPOSALS:
        hopeless |= without_any
    if hopeless.any():
        numbers = hopeless.nonzero().flatten()[:5].tolist()
        raise SamplingError(
            f"Less than one in {int(1 / MIN_ACCEPTANCE)} draws lies inside the support "
            f"of the prior for rows {numbers} of `x`. Leave these observations out, "
            "train NPE longer, or pass reject_outside_prior=False."
        )


class PriorPosterior(MixturePosterior):
    r"""The prior :math:`p(\theta)`, in the form of an sbi posterior that ignores x.

    ``sample`` and ``log_prob`` need no observation, and the batched methods take
    observations of any shape.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
        | Calibration (Wehenkel et al., 2025), section 4, Baselines
        | https://arxiv.org/abs/2405.08719

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``. It is copied.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> posterior = PriorPosterior(BoxUniform(torch.zeros(2), torch.ones(2)))
        >>> posterior.sample_batched((5,), x=torch.zeros(3, 7)).shape
        torch.Size([5, 3, 2])
    """

    def __init__(self, prior: Any) -> None:
        density = Prior(prior, (0,))
        try:
            super().__init__(density, density.prior)
        except Exception:  # sbi raises all kinds if it cannot transform the prior
            super().__init__(density, density.prior, enable_transform=False)

    def _one_x(self, x: Any) -> Tensor:
        return torch.empty(1, 0, device=self.posterior_estimator.device)

    def _batch_of_x(self, x: Any) -> Tensor:
        count = len(as_numbers("x", x))
        return torch.empty(count, 0, device=self.posterior_estimator.device)
