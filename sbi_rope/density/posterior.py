"""A density as an sbi posterior: the prior's support, normalisation, the batch."""

import functools
from collections.abc import Callable
from typing import Any

import torch
from sbi.inference import DirectPosterior
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope.coupling import Coupling
from sbi_rope.density.base import MAX_ENTRIES, Accept, Density, Prior
from sbi_rope.density.coupled import Coupled
from sbi_rope.density.sets import MakesSets
from sbi_rope.npe.prior import PriorDistribution
from sbi_rope.npe.sbi import MixedDensity
from sbi_rope.npe.standardisation import warn_of_far_entries
from sbi_rope.utils.errors import InvalidInputError, SamplingError
from sbi_rope.utils.progress import is_shown, progress_bar
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import Count, check
from sbi_rope.utils.tensors import as_batch, as_numbers, rows_with

# Rejection sampling gives up on observations of which, after MIN_OF_ROW proposals, less
# than a share of MIN_ACCEPTANCE lies inside the prior's support, once these had
# MIN_PROPOSALS together, and if they would take more than MAX_PROPOSALS further ones,
# which are minutes. In a stack the prior often keeps a share just below MIN_ACCEPTANCE.
MIN_OF_ROW, MIN_PROPOSALS, MAX_PROPOSALS = 5_000, 100_000, 10_000_000
MIN_ACCEPTANCE = 1e-3
# A flow takes about as long for this many draws as for a single one.
SMALL_BATCH = 512


class MixturePosterior(MakesSets, DirectPosterior):
    r"""A density as an sbi posterior, such as RoPE's mixture over simulations.

    .. math::
        p(\theta \mid x)
        = \frac{\mathbf{1}[\theta \in \operatorname{supp} p]}{Z(x)}\, q(\theta \mid x),

    with Z(x) the mass inside the support of the prior. It has all methods of sbi's
    :class:`DirectPosterior` and works with sbi's diagnostics. That of RoPE (see
    :class:`~sbi_rope.density.Coupled`) belongs to a batch, its ``x_o``. Others are
    amortised and answer any x.

    Args:
        density: q.
        prior: The prior that NPE was trained with.
        enable_transform: Whether ``map()`` searches in an unbounded space, as in sbi.
            For mixed discrete and continuous parameters it never does.
    """

    prior: PriorDistribution
    posterior_estimator: Density
    # One name for each parameter, and for each column of tables of x, if they have any.
    parameter_names: tuple[str, ...] | None = None
    x_names: tuple[str, ...] | None = None
    # Whether an amortised posterior warns of entries that are far from simulations.
    warns = True

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
        with seeded(0):  # sbi draws from the prior to find out about it
            super().__init__(
                density,
                PriorDistribution(prior),
                device=str(density.device),
                enable_transform=enable_transform and not is_mixed,
            )

    # --- the batch ---

    @property
    def is_amortised(self) -> bool:
        """Whether it answers any x, and belongs to no batch."""
        return not isinstance(self.posterior_estimator, Coupled)

    @property
    def x_o(self) -> Tensor:
        """The batch of real observations, shape ``(n_o, *event)``."""
        return self._coupled.x_o

    @property
    def coupling(self) -> Coupling:
        """The coupling of the batch with the simulations."""
        return self._coupled.coupling

    @property
    def weights(self) -> Tensor:
        """Weights of the simulations, shape ``(n_o, n_s)``."""
        return self.coupling.weights

    @property
    def _coupled(self) -> Coupled:
        if not isinstance(self.posterior_estimator, Coupled):
            raise InvalidInputError(
                "Expected a posterior of a batch; got an amortised one, which has no "
                "`x_o`, coupling or length."
            )
        return self.posterior_estimator

    def __len__(self) -> int:
        return len(self.x_o)

    def __bool__(self) -> bool:
        return True  # also an amortised one, which has no length

    def __getitem__(self, index: int) -> "MixturePosterior":
        """Return the posterior of one observation alone, which is its default x.

        Take it anew when the whole has moved to another device.
        """
        own, transform = self._coupled[index], self.enable_transform
        one = MixturePosterior(own, self.prior, enable_transform=transform)
        one.parameter_names, one.x_names = self.parameter_names, self.x_names
        return one.set_default_x(own.x_o)

    # --- arguments ---

    def set_default_x(self, x: Tensor) -> "MixturePosterior":
        """Set the observation ``(*event)`` of methods that are given none."""
        self._x, self._map = self._one_x(x).clone().to(self._device), None
        return self

    def _x_else_default_x(self, x: Any) -> Tensor:
        return self._one_x(x)  # sbi itself refuses any NaN

    def __getstate__(self) -> dict[str, Any]:
        # sbi hands out its own __dict__, which a shallow copy would then share.
        return dict(self.__dict__)

    def _one_x(self, x: Any) -> Tensor:
        return self._batch_of_x(self.default_x if x is None else x, rows=1)

    def _batch_of_x(self, x: Any, *, rows: int | None = None) -> Tensor:
        """Return observations ``(n, *event)``; warn of those far from simulations."""
        density = self.posterior_estimator
        event = density.condition_shape
        x = as_numbers("x", x, names=self.x_names).float()
        x = x[None] if x.shape == event else x
        x = as_batch("x", x, event, rows=rows, finite=False).to(density.device)
        if not self.is_amortised:  # RoPE has checked its batch
            return x
        if not torch.isfinite(x).all() and (unread := ~density.readable(x)).any():
            raise InvalidInputError(
                "Expected `x` without NaN or Inf that the embedding net cannot read; "
                f"got {rows_with(unread)}."
            )
        if self.warns:
            warn_of_far_entries("x", x, density)
        return x

    def _parameters(self, theta: Any, *, most_dims: int) -> Tensor:
        """Return parameters ``(*batch, d)`` in float32, with their gradients."""
        dim = self.posterior_estimator.input_shape[0]
        if not isinstance(theta, Tensor):
            theta = as_numbers("theta", theta, names=self.parameter_names)
        shape, batch = tuple(theta.shape), ("n", "S, B")[most_dims - 2]
        theta = torch.atleast_2d(theta)
        is_empty = not theta.numel() or theta.isnan().any()
        if theta.ndim > most_dims or theta.shape[-1] != dim or is_empty:
            raise InvalidInputError(
                f"Expected `theta` of shape ({batch}, {dim}) without NaN; got {shape}."
            )
        # A bound of the prior is one in float32 only: 0.1 of float64 is below it.
        return theta.to(self.posterior_estimator.device, torch.float32)

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

    @torch.no_grad()
    def sample_batched(  # type: ignore[override]
        self,
        sample_shape: Any,
        x: Tensor,
        max_sampling_batch_size: int | None = None,
        show_progress_bars: bool | None = None,  # noqa: FBT001
        reject_outside_prior: bool = True,  # noqa: FBT001, FBT002
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

        Returns:
            Shape ``(*sample_shape, B, d)``.

        Raises:
            InvalidInputError: If there is a batch, and an x is not in it.
            SamplingError: If hardly any mass lies inside the prior's support.
        """
        check("max_sampling_batch_size", max_sampling_batch_size, Count | None)
        x, density = self._batch_of_x(x), self.posterior_estimator.eval()
        draw = functools.partial(density.draw, density.embed(x))
        shape, num_rows = torch.Size(sample_shape), len(x)
        num_samples = shape.numel()
        total = num_samples * num_rows
        size = min(MAX_ENTRIES, max_sampling_batch_size or MAX_ENTRIES)
        if reject_outside_prior:
            counts = torch.zeros(2, num_rows, dtype=torch.long)
            draw = functools.partial(accepted, draw, self.prior.inside, counts, size)
        theta = torch.empty(total, *density.input_shape, device=density.device)
        # Observation by observation, so that few of them are needed at a time.
        slots = torch.arange(total, device=theta.device).split(size)
        show = is_shown(show_progress_bars)
        with progress_bar(show=show, desc="Sampling", total=total) as bar:
            for slot in slots if total else ():
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
            InvalidInputError: If there is a batch, and x is not in it.
            SamplingError: If the density has no mass inside the prior's support.
        """
        theta, x = self._parameters(theta, most_dims=2)[:, None], self._one_x(x)
        return self.log_prob_batched(theta, x, norm_posterior, track_gradients)[:, 0]

    def log_prob_batched(  # type: ignore[override]
        self,
        theta: Any,
        x: Any,
        norm_posterior: bool = True,  # noqa: FBT001, FBT002
        track_gradients: bool = False,  # noqa: FBT001, FBT002
    ) -> Tensor:
        r"""Return :math:`\log p(\theta_b \mid x_b)` for every observation of a batch.

        Parameters of shape ``(B, d)`` or ``(S, B, d)`` belong to observations
        ``(B, *event)``. One row of theta serves all observations, and one observation
        all rows of theta. The other arguments, and errors, are those of
        :meth:`log_prob`. The result has shape ``(1, B)`` or ``(S, B)``.
        """
        theta, x = self._parameters(theta, most_dims=3), self._batch_of_x(x)
        theta = theta if theta.ndim == 3 else theta[None]
        if theta.shape[1] != len(x) and 1 not in (theta.shape[1], len(x)):
            raise InvalidInputError(
                "Expected as many rows of `theta` as observations, or one of them; "
                f"got theta {tuple(theta.shape)} and {len(x)} observations."
            )
        density = self.posterior_estimator.eval()
        # Networks may be NaN outside.
        safe, inside = self.prior.moved_inside(theta.flatten(0, 1))
        z = density.embed(x)
        with torch.set_grad_enabled(track_gradients):
            log_prob = density.log_prob_given(safe.reshape(theta.shape), z, len(x))
        if norm_posterior:
            log_prob = log_prob - self._normaliser(x, z).log()
        inside = inside.reshape(theta.shape[:2])
        return log_prob.float().where(inside, -torch.inf)

    def map(self, x: Tensor | None = None, **options: Any) -> Tensor:  # type: ignore[override]
        """Return the maximum of the density given the default x, as in sbi, ``(1, d)``.

        The defaults are smaller than those of sbi, which would take many minutes:
        ``num_iter`` and ``num_init_samples`` are 100, and ``num_to_optimize`` is 5.
        """
        own = {"num_iter": 100, "num_init_samples": 100, "num_to_optimize": 5}
        options = {**own, **options}
        with torch.enable_grad():  # the caller may have switched gradients off
            return super().map(x=x, **options)

    # --- normalisation ---

    def leakage_correction(self, x: Tensor) -> Tensor:  # type: ignore[override]
        r"""Return the mass of the density inside the prior's support, ``(B,)``.

        It is estimated from 1024 draws with a seed of their own, so that ``log_prob``
        of observations ``(B, *event)`` always returns the same numbers.

        Raises:
            SamplingError: If one of the masses is zero.
        """
        x = self._batch_of_x(x)
        return self._normaliser(x, self.posterior_estimator.embed(x)).float()

    def _normaliser(self, x: Tensor, z: Any) -> Tensor:
        if self.prior.is_unbounded:
            return torch.ones(len(x), dtype=torch.double, device=x.device)
        mass = self.posterior_estimator.mass(z, len(x), self.prior.inside)
        if not (mass > 0).all():
            rows = (mass <= 0).nonzero().flatten()
            raise SamplingError(
                f"The densities of rows {rows[:5].tolist()} of `x` have no mass inside "
                "the support of the prior. Leave them out, or train NPE longer."
            )
        return mass


def accepted(
    draw: Callable[[Tensor], Tensor],
    accept: Accept,
    counts: Tensor,
    size: int,
    row: Tensor,
) -> Tensor:
    """Draw for each of n numbers of rows until one is accepted, ``(n, d)``.

    At most ``size`` draws are made at a time. The ``counts`` of proposed and accepted
    draws of each row, ``(2, B)``, go on from call to call.
    """
    (proposed, inside), num_rows = counts, counts.shape[1]
    theta, rate = torch.empty(0), 1.0
    left = torch.arange(len(row), device=row.device)
    while count := len(left):
        # For the last few, more proposals take no longer than one.
        wanted = max(int(1 / max(rate, MIN_ACCEPTANCE)), SMALL_BATCH // count)
        repeats = max(1, min(wanted, size // count))
        rows = row[left].repeat_interleave(repeats)
        draws = draw(rows)
        fits = accept(draws)
        if not len(theta):
            theta = draws.new_empty(len(row), *draws.shape[1:])
        rate = float(fits.double().mean())
        proposed += rows.bincount(minlength=num_rows).cpu()
        inside += rows[fits].bincount(minlength=num_rows).cpu()
        # Of several proposals for one the first that fits is kept.
        fits = fits.reshape(count, repeats)
        found, first = fits.any(dim=1), fits.byte().argmax(dim=1)
        draws = draws.unflatten(0, fits.shape)
        theta[left[found]] = draws[found, first[found]]
        left = left[~found]
        missing = row[left].bincount(minlength=num_rows).cpu()
        is_slow = (missing > 0) & (proposed >= MIN_OF_ROW)
        is_slow &= inside < MIN_ACCEPTANCE * proposed
        # Where all were rejected, a tenth of a draw counts as accepted.
        further = (missing * proposed / (inside + 0.1))[is_slow].sum()
        if proposed[is_slow].sum() >= MIN_PROPOSALS and further > MAX_PROPOSALS:
            numbers = is_slow.nonzero().flatten()[:5].tolist()
            raise SamplingError(
                f"Less than one in {1 / MIN_ACCEPTANCE:g} draws lies inside the "
                f"support of the prior for rows {numbers} of `x`. Leave these out, "
                "train NPE longer, or pass reject_outside_prior=False."
            )
    return theta


class PriorPosterior(MixturePosterior):
    r"""The prior :math:`p(\theta)`, in the form of an sbi posterior that ignores x.

    ``sample`` and ``log_prob`` need no observation, and the batched methods take
    observations of any shape.

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``. It is copied.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> posterior = PriorPosterior(BoxUniform(torch.zeros(2), torch.ones(2)))
        >>> posterior.sample_batched((5,), x=torch.zeros(3, 7)).shape
        torch.Size([5, 3, 2])
    """

    def __init__(self, prior: Any) -> None:
        # Some priors have no transform.
        super().__init__(Prior(prior, (0,)), prior, enable_transform=False)

    def _one_x(self, x: Any) -> Tensor:
        return torch.empty(1, 0, device=self.posterior_estimator.device)

    def _batch_of_x(self, x: Any, *, rows: int | None = None) -> Tensor:
        return self._one_x(x).expand(len(as_numbers("x", x)), 0)
