"""The mixture as an sbi posterior: the prior's support, normalisation, the batch."""

import copy
import operator
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from sbi.utils import within_support
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope._bounds import moved_inside
from sbi_rope._progress import is_shown
from sbi_rope._random import seeded
from sbi_rope._sbi import BaseDirectPosterior, MixedDensity, describe
from sbi_rope._standardisation import warn_of_far_entries
from sbi_rope.coupling import Coupling
from sbi_rope.errors import InvalidInputError, SamplingError
from sbi_rope.mixture.coupled import CoupledEmbeddings
from sbi_rope.mixture.estimator import MixtureEstimator
from sbi_rope.mixture.parts import DTYPE, parameters_of
from sbi_rope.mixture.sampling import Accept
from sbi_rope.mixture.truncation import Leakage, is_unbounded
from sbi_rope.saving import save
from sbi_rope.sets.makes_sets import MakesSets
from sbi_rope.settings import Count, Positive, check
from sbi_rope.tensors import as_numbers

__all__ = ["MixturePosterior"]


class MixturePosterior(MakesSets, BaseDirectPosterior):
    r"""A mixture of weighted densities as an sbi posterior.

    .. math::
        p(\theta \mid x)
        = \frac{\mathbf{1}[\theta \in \operatorname{supp} p]}{Z(x)}
        \sum_k w_k \sum_j a^k_j(x)\, q_k(\theta \mid s^k_j(x)),

    with Z(x) the mass inside the support of the prior. The posterior of RoPE has one
    part. Its embeddings are those of simulations, and its weights are rows of a
    coupling:

    .. math::
        p(\theta \mid x_{o,i})
        = \frac{\mathbf{1}[\theta \in \operatorname{supp} p]}{Z_i}
        \sum_j \alpha_{ij}\, q(\theta \mid h(x_{s,j})),
        \qquad Z_i = \sum_j \alpha_{ij} Z_j .

    It has all methods of sbi's :class:`DirectPosterior` and works with sbi's
    diagnostics. With a coupled part it belongs to a batch of observations. Then
    simulation-based calibration, coverage and similar diagnostics only make sense for
    the ``x_o`` of this posterior and their true parameters. Without a coupled part it
    is amortised and answers any x.

    Memory: apart from arguments and result it needs 100 MB, and what the flow needs for
    16,384 pairs of a parameter and a component (131,072 on a GPU), which is 50 MB for
    sbi's NSF. At most 2^19 weights, terms of the density or proposals are held at a
    time, or one row of weights if that is longer. A matrix of size n_o x n_s is never
    held. Tracking gradients takes memory of its own.

    Accuracy: ``log_prob`` leaves out the smallest weights of each row that sum to at
    most ``tail_mass`` = t, so that the density is too small by at most t times the
    largest density among the components left out.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
          Calibration (Wehenkel et al., 2025), eq. 5
        | https://arxiv.org/abs/2405.08719

    Args:
        estimator: The mixture.
        prior: The prior NPE was trained with.
        enable_transform: Whether ``map()`` searches in an unbounded space, as in sbi.
            For mixed discrete and continuous parameters it never does.
        warns: Whether an amortised posterior warns of observations whose entries are
            far from the simulations of NPE, if NPE standardises them. Those with which
            a stack scores the pairs do not, because RoPE has warned of these.
    """

    warns = True
    # The observation that the mass was last estimated for, and this mass.
    _latest: tuple[Tensor, Leakage] | None = None

    def __init__(
        self,
        estimator: MixtureEstimator,
        prior: Distribution,
        *,
        enable_transform: bool = True,
        warns: bool = True,
    ) -> None:
        # A category that sbi has standardised and put back may differ by rounding, and
        # is no category then.
        is_mixed = any(
            isinstance(part.density, MixedDensity) for part in estimator.parts
        )
        with seeded(0):  # sbi draws from the prior to find out about it
            super().__init__(
                estimator,
                prior,
                device=estimator.weights.device,
                enable_transform=enable_transform and not is_mixed,
            )
        self.posterior_estimator: MixtureEstimator = estimator
        # Posteriors of single observations share it, so that all is estimated once.
        self._cache: dict[int, Tensor] = {}
        self.warns = warns
        describe(self, _purpose(estimator))

    def __getstate__(self) -> dict[str, Any]:
        # Copies, files and posteriors of single observations do without it.
        return {**super().__getstate__(), "_latest": None}

    @property
    def is_amortised(self) -> bool:
        """Whether it answers any x, and belongs to no batch."""
        return not self.posterior_estimator.coupled

    # --- the batch ---

    @property
    def x_o(self) -> Tensor:
        """The batch of real observations, shape ``(n_o, *event)``.

        Raises:
            InvalidInputError: If the posterior is amortised. The other methods and
                properties of the batch raise it, too.
        """
        return self._coupled("x_o").x_o

    @property
    def couplings(self) -> tuple[Coupling, ...]:
        """All couplings of the batch with simulations."""
        self._coupled("couplings")
        coupled = self.posterior_estimator.coupled
        return tuple(part.coupling for part in coupled)

    @property
    def coupling(self) -> Coupling:
        """The coupling of the batch with the simulations, if there is a single one.

        Raises:
            InvalidInputError: If there are several.
        """
        self._coupled("coupling")
        coupling, *others = self.couplings
        if others:
            raise InvalidInputError(
                f"Expected a single coupling; got {1 + len(others)}. Use `couplings`."
            )
        return coupling

    @property
    def weights(self) -> Tensor:
        """Weights of the simulations, shape ``(n_o, n_s)``; rows sum to one.

        They are the weights within the coupled part, whatever the other parts weigh.

        Raises:
            InvalidInputError: If there are several couplings.
        """
        self._coupled("weights")
        return self.coupling.weights

    def _coupled(self, name: str) -> CoupledEmbeddings:
        if self.is_amortised:
            raise InvalidInputError(
                f"Expected a posterior of a batch for `{name}`; got an amortised one."
            )
        return self.posterior_estimator.coupled[0]

    def __len__(self) -> int:
        return len(self._coupled("len()").x_o)

    def __bool__(self) -> bool:
        return True  # also an amortised one, which has no length

    def __getitem__(self, index: int) -> "MixturePosterior":
        """Return the posterior of one observation, which is its default x.

        It does not know the other observations of the batch.
        """
        self._coupled("[i]")
        estimator = self.posterior_estimator.restricted_to(operator.index(index))
        view = copy.copy(self)
        view.posterior_estimator = estimator
        potential_fn: Any = copy.copy(self.potential_fn)
        potential_fn.posterior_estimator = estimator
        potential_fn.set_x(None)  # another observation may have been asked for last
        view.potential_fn = potential_fn
        view.set_default_x(view.x_o)
        whole = _purpose(self.posterior_estimator)
        describe(view, f"{whole} This is that of observation {index} alone.")
        return view

    def __iter__(self) -> Iterator["MixturePosterior"]:
        return (self[i] for i in range(len(self)))

    def to(self, device: str | torch.device) -> None:
        """Move the posterior, its coupling and its batch to a device.

        Posteriors of single observations (``posterior[i]``) share what is moved. Take
        them again after moving.

        Raises:
            InvalidInputError: If the prior cannot be moved. Nothing is moved then.
        """
        if not hasattr(self.prior, "to"):
            raise InvalidInputError(
                "Expected a prior with a method `to`, such as sbi's BoxUniform; got "
                f"{type(self.prior).__name__}."
            )
        # A new dictionary: posteriors of single observations share the old one.
        self._cache = {k: mass.to(device) for k, mass in self._cache.items()}
        self._latest = None
        with seeded(0):  # sbi draws from the prior to find out about it
            super().to(device)

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write this posterior to a file that :func:`sbi_rope.load` reads.

        No code is executed when the file is loaded. The posterior of one observation,
        ``posterior[i].save(path)``, holds no other observation.

        Args:
            path: The file. Its folder is made if there is none.
            overwrite: Whether to replace a file that exists.

        Raises:
            FileExistsError: If the file exists.
        """
        save(self, path, overwrite=overwrite)

    # --- sampling ---

    def sample(  # type: ignore[override]
        self,
        sample_shape: Any = (),
        x: Tensor | None = None,
        max_sampling_batch_size: int | None = None,
        show_progress_bars: bool | None = None,  # noqa: FBT001
        reject_outside_prior: bool = True,  # noqa: FBT001, FBT002
        max_sampling_time: float | None = None,
        return_partial_on_timeout: bool = False,  # noqa: FBT001, FBT002
    ) -> Tensor:
        r"""Draw from :math:`p(\theta \mid x)` of one observation.

        Args:
            sample_shape: Shape of the draws.
            x: An observation, from the batch if there is one; the default x if None.
            max_sampling_batch_size: As in :meth:`sample_batched`.
            show_progress_bars: As in :meth:`sample_batched`.
            reject_outside_prior: As in :meth:`sample_batched`.
            max_sampling_time: As in :meth:`sample_batched`.
            return_partial_on_timeout: As in :meth:`sample_batched`.

        Returns:
            Shape ``(*sample_shape, d)``.

        Raises:
            InvalidInputError: If x is not in the batch and ``unseen="raise"``.
            SamplingError: As in :meth:`sample_batched`.
        """
        x = self._one_x(x)
        samples = self.sample_batched(
            sample_shape,
            x,
            max_sampling_batch_size,
            show_progress_bars,
            reject_outside_prior,
            max_sampling_time,
            return_partial_on_timeout,
        )
        return samples.squeeze(-1 - len(self.posterior_estimator.input_shape))

    @torch.no_grad()
    def sample_batched(  # type: ignore[override]
        self,
        sample_shape: Any,
        x: Tensor,
        max_sampling_batch_size: int | None = None,
        show_progress_bars: bool | None = None,  # noqa: FBT001
        reject_outside_prior: bool = True,  # noqa: FBT001, FBT002
        max_sampling_time: float | None = None,
        return_partial_on_timeout: bool = False,  # noqa: FBT001, FBT002
    ) -> Tensor:
        r"""Draw from :math:`p(\theta \mid x_b)` of every observation of a batch.

        Args:
            sample_shape: Shape of the draws of each observation.
            x: Observations, shape ``(B, *event)``.
            max_sampling_batch_size: The largest number of draws the flow makes at a
                time. If None, the number that is fast on the device.
            show_progress_bars: Whether to show how many draws were accepted so far.
                None does so in a terminal or a notebook, but not in a file.
            reject_outside_prior: Whether to draw from the mixtures truncated to the
                prior's support, or from the whole mixtures.
            max_sampling_time: Seconds after which to give up, if draws outside the
                prior's support are rejected; None for no limit.
            return_partial_on_timeout: Must be False. Observations are drawn for one
                after the other, so that some would have no draw.

        Returns:
            Shape ``(*sample_shape, B, d)``.

        Raises:
            InvalidInputError: If an argument is outside its range, or an x is not in
                the batch and ``unseen="raise"``.
            SamplingError: If hardly any mass lies inside the prior's support, or the
                time is over.
        """
        if max_sampling_time is not None:
            check("max_sampling_time", max_sampling_time, Positive)
        if return_partial_on_timeout:
            raise InvalidInputError(
                "Expected `return_partial_on_timeout=False`: some observations would "
                "have no draw."
            )
        if max_sampling_batch_size is not None:
            check("max_sampling_batch_size", max_sampling_batch_size, Count)
        return self.posterior_estimator.sample(
            torch.Size(sample_shape),
            self._warned_of(self._batch_of_x(x)),
            accept=self._inside if reject_outside_prior else None,
            batch_size=max_sampling_batch_size,
            show_progress_bars=is_shown(show_progress_bars),
            max_sampling_time=max_sampling_time,
        )

    @property
    def _bound(self) -> Accept | None:
        """A function that tells which parameters are in the support; None if all."""
        return None if is_unbounded(self.prior) else self._inside

    def _inside(self, theta: Tensor) -> Tensor:
        return within_support(self.prior, theta).reshape(len(theta))

    def _moved_inside(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Return parameters, and which are inside; components may be NaN outside."""
        flat, inside = moved_inside(self.prior, theta.reshape(-1, theta.shape[-1]))
        return flat.reshape(theta.shape), inside.reshape(theta.shape[:-1])

    def set_default_x(self, x: Tensor) -> "MixturePosterior":
        """Set the observation that methods take when they are given none.

        Args:
            x: An observation, shape ``(*event)`` or ``(1, *event)``; it is copied.

        Returns:
            Itself, so that calls can be chained.

        Raises:
            InvalidInputError: If the shape does not fit, or a value is not finite.
        """
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

    def _batch_of_x(self, x: Tensor) -> Tensor:
        event_shape = self.posterior_estimator.condition_shape
        x = as_numbers("x", x, names=self.x_names).to(DTYPE)
        if x.shape == event_shape:
            x = x[None]
        return self.posterior_estimator.checked_x(x).to(x.device)

    def _parameters(self, theta: Tensor, *, batched: bool = False) -> Tensor:
        dim = self.posterior_estimator.input_shape[0]
        return parameters_of(theta, dim, batched=batched, names=self.parameter_names)

    def _warned_of(self, x: Tensor) -> Tensor:
        """Return observations, after a warning if entries are far from simulations."""
        if self.warns and self.is_amortised:  # RoPE has warned of its batch
            warn_of_far_entries("x", x, self.posterior_estimator)
        return x

    def log_prob(
        self,
        theta: Tensor,
        x: Tensor | None = None,
        norm_posterior: bool = True,  # noqa: FBT001, FBT002
        track_gradients: bool = False,  # noqa: FBT001, FBT002
        leakage_correction_params: dict | None = None,
    ) -> Tensor:
        r"""Return :math:`\log p(\theta \mid x)` of one observation.

        Args:
            theta: Parameters, shape ``(n, d)`` or ``(d,)``.
            x: An observation, from the batch if there is one; the default x if None.
            norm_posterior: Whether to divide by the mass inside the prior's support.
            track_gradients: Whether gradients with respect to theta are needed.
            leakage_correction_params: None, or ``{"show_progress_bars": True}`` to show
                the progress of the normalisation if it takes more than five seconds.

        Returns:
            Shape ``(n,)``; minus infinity outside the prior's support.

        Raises:
            InvalidInputError: If shapes do not fit, x is not finite, theta is NaN, or x
                is not in the batch and ``unseen="raise"``.
            SamplingError: If the mixture has no mass inside the prior's support.
        """
        theta = self._parameters(theta)
        safe, inside = self._moved_inside(theta)
        log_prob = super().log_prob(
            safe,
            self._warned_of(self._one_x(x)),
            norm_posterior,
            track_gradients,
            leakage_correction_params,
        )
        return log_prob.where(inside, -torch.inf)

    def potential(
        self,
        theta: Tensor,
        x: Tensor | None = None,
        track_gradients: bool = False,  # noqa: FBT001, FBT002
    ) -> Tensor:
        r"""Return :math:`\log p(\theta \mid x)` without normalisation.

        Args:
            theta: Parameters, shape ``(n, d)`` or ``(d,)``.
            x: As in :meth:`log_prob`.
            track_gradients: Whether gradients with respect to theta are needed.

        Returns:
            Shape ``(n,)``.

        Raises:
            InvalidInputError: As in :meth:`log_prob`.
        """
        theta = self._parameters(theta)
        return super().potential(theta, self._one_x(x), track_gradients)

    def log_prob_batched(
        self,
        theta: Tensor,
        x: Tensor,
        norm_posterior: bool = True,  # noqa: FBT001, FBT002
        track_gradients: bool = False,  # noqa: FBT001, FBT002
        leakage_correction_params: dict | None = None,
    ) -> Tensor:
        r"""Return :math:`\log p(\theta_b \mid x_b)` for every observation of a batch.

        Args:
            theta: Parameters, shape ``(B, d)`` or ``(S, B, d)``.
            x: Observations, shape ``(B, *event)``.
            norm_posterior: Whether to divide by the mass inside the prior's support.
            track_gradients: Whether gradients with respect to theta are needed.
            leakage_correction_params: None, or ``{"show_progress_bars": True}`` to show
                the progress of the normalisation if it takes more than five seconds.

        Returns:
            Shape ``(1, B)`` or ``(S, B)``; minus infinity outside the prior's support.

        Raises:
            InvalidInputError: If shapes do not fit, x is not finite, theta is NaN, or
                an x is not in the batch and ``unseen="raise"``.
            SamplingError: If a mixture has no mass inside the prior's support.
        """
        theta = self._parameters(theta, batched=True)
        safe, inside = self._moved_inside(theta)
        log_prob = super().log_prob_batched(
            safe,
            self._warned_of(self._batch_of_x(x)),
            norm_posterior,
            track_gradients,
            leakage_correction_params,
        )
        return log_prob.where(inside, -torch.inf)

    def map(  # type: ignore[override]
        self,
        x: Tensor | None = None,
        num_iter: int = 100,
        num_to_optimize: int = 5,
        learning_rate: float = 0.01,
        init_method: str | Tensor = "posterior",
        num_init_samples: int = 100,
        **options: Any,
    ) -> Tensor:
        """Return the maximum of the density given the default x, as in sbi.

        Every step evaluates all components for all starting points. sbi's defaults
        (1000 steps from the best 100 of 1000 samples) would take many minutes.

        Args:
            x: Must be None, as in sbi. Set the default x, or take ``posterior[i]``.
            num_iter: Number of steps of gradient ascent.
            num_to_optimize: Number of starting points: the samples with the highest
                density.
            learning_rate: Learning rate of the ascent, as in sbi.
            init_method: Where starting points come from, as in sbi.
            num_init_samples: Number of samples to choose the starting points from.
            **options: The other options of sbi's ``DirectPosterior.map``.

        Returns:
            Shape ``(1, d)``.
        """
        with torch.enable_grad():  # the caller may have switched gradients off
            return super().map(
                x=x,
                num_iter=num_iter,
                num_to_optimize=num_to_optimize,
                learning_rate=learning_rate,
                init_method=init_method,
                num_init_samples=num_init_samples,
                **options,
            )

    # --- normalisation ---

    def leakage(self, x: Tensor, *, show_progress_bars: bool = False) -> Leakage:
        r"""Return the mass of each mixture inside the prior's support, with its error.

        The mass :math:`Z_j` of every simulation's posterior is estimated once, from
        1024 draws, and kept. The mass of densities of x itself is estimated for each x.
        That of a single x is kept until another x is asked for. The draws have a seed
        of their own, so that ``log_prob`` always returns the same numbers.

        Args:
            x: Observations, shape ``(B, *event)``.
            show_progress_bars: Whether to show progress if the estimate takes long.

        Returns:
            The masses and their standard errors, both of shape ``(B,)``.
        """
        x = self._batch_of_x(x)
        if self._latest is not None:
            known, leakage = self._latest
            if known.device == x.device and torch.equal(known, x):
                return copy.deepcopy(leakage)
        leakage = self.posterior_estimator.mass(
            x,
            accept=self._bound,
            cache=self._cache,
            show_progress_bars=show_progress_bars,
        )
        if len(x) == 1:
            self._latest = x.clone(), copy.deepcopy(leakage)
        return leakage

    def leakage_correction(  # type: ignore[override]
        self,
        x: Tensor,
        *,
        show_progress_bars: bool = False,
        **kwargs: Any,
    ) -> Tensor:
        r"""Return :math:`Z_i`, shape ``(B,)``; sbi calls it in ``log_prob``."""
        if kwargs:
            raise InvalidInputError(
                "Expected no `leakage_correction_params` but `show_progress_bars`; got "
                f"{sorted(kwargs)}."
            )
        leakage = self.leakage(x, show_progress_bars=show_progress_bars)
        mass = leakage.mass.to(DTYPE)
        if not (mass > 0).all():
            rows = (mass <= 0).nonzero().flatten()
            raise SamplingError(
                f"The mixtures of rows {rows[:5].tolist()} of `x` have no mass inside "
                "the support of the prior. Leave them out, or train NPE longer."
            )
        return mass


def _purpose(estimator: MixtureEstimator) -> str:
    num_parts = len(estimator.parts)
    if not estimator.coupled:
        return f"It is a mixture of {num_parts} posterior densities, for any x."
    coupled = estimator.coupled[0]
    mixed = f"{num_parts} posterior densities"
    if num_parts == 1:
        mixed = f"{coupled.num_embeddings} simulated posteriors"
    return (
        f"It is the mixture of {mixed} for each of {len(coupled.x_o)} real "
        "observations."
    )
