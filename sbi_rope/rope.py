"""Robust posterior estimation: the conductor of its three steps."""

import copy
import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor, nn

from sbi_rope._random import seeded
from sbi_rope._sbi import (
    ConditionalDensityEstimator,
    VectorFieldDensity,
    copy_of_prior,
    device_of,
    dtype_of,
    embed,
    embedding_of,
    estimator_of,
    headless,
    posterior_from,
    with_embedding,
)
from sbi_rope._simulations import SimulationSource, StoredSimulations
from sbi_rope._simulator import Simulator
from sbi_rope._standardisation import warn_of_far_entries
from sbi_rope._training import groups_of
from sbi_rope._validation import (
    check_batch,
    check_choice,
    check_default_dtype,
    check_device,
    check_finite,
    check_gradients,
    check_in_support,
    check_instance,
    check_integer,
    check_numbers,
    check_rows,
    check_same_length,
    check_tensor,
    check_unit_interval,
)
from sbi_rope.coupling import Coupling, SinkhornCoupler
from sbi_rope.errors import (
    CouplingError,
    InvalidInputError,
    NotReadyError,
    SimulationError,
    UnsupportedPosteriorError,
)
from sbi_rope.finetuning import CalibrationFinetuner, History
from sbi_rope.mixture import (
    CoupledContexts,
    CoupledNet,
    MixtureEstimator,
    MixturePosterior,
    Part,
)

__all__ = ["RoPE"]

# Simulations to couple with when the batch is smaller than this.
MIN_SIMULATIONS = 1000


class RoPE:
    r"""Repairs a trained sbi posterior with a few labelled real observations.

    An NPE posterior is :math:`q(\theta \mid h(x))`, trained on simulations. RoPE

    1. tunes a copy g of h so that :math:`g(x_o)` lands where h puts simulations with
       the same parameters (:meth:`train`; needs calibration pairs);
    2. couples a batch of real observations with simulations by optimal transport
       between :math:`g(x_o)` and :math:`h(x_s)`;
    3. returns for each observation the mixture
       :math:`\sum_j \alpha_{ij}\, q(\theta \mid h(x_{s,j}))` (:meth:`build_posterior`).

    Without calibration pairs step 1 is skipped, g = h (the paper's "OT-only"). The
    posterior passed in is copied and never changed.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
          Calibration (Wehenkel et al., 2025), Algorithm 1
        | https://arxiv.org/abs/2405.08719

    Args:
        posterior: What ``NPE(...).build_posterior()`` returns, or the posterior of
            MNPE, FMPE or NPSE (the last two have no ``log_prob``). A default x is
            ignored. The posterior must be amortised: one trained over several rounds
            fits one observation only, which cannot be recognised here.
        simulator: Maps parameters ``(n, d)`` to simulations ``(n, *event)``, or one
            ``(d,)`` to one ``(*event)``; simulations with NaN are dropped and counted.
            A row of x may depend on the same row of theta only, which is tried on some
            fifteen simulations.
        simulations: Instead of a simulator, stored pairs (theta, x) drawn from the
            prior. Fine-tuning then uses those with the nearest parameters.
        finetuner: Settings of step 1; ``CalibrationFinetuner()`` if None.
        coupler: Settings of step 2; ``SinkhornCoupler()`` if None.

    Raises:
        UnsupportedPosteriorError: If the posterior has no embedding to work with.
        InvalidInputError: If both or none of simulator and simulations are given, or
            their shapes do not fit the posterior.
        NotReadyError: If torch's default dtype is not float32.
        SimulationError: If the simulator raises or returns something unusable.

    Example:
        >>> from sbi.inference import NPE
        >>> from sbi.utils import BoxUniform
        >>> _ = torch.manual_seed(0)
        >>> prior = BoxUniform(torch.zeros(1), torch.ones(1))
        >>> simulator = lambda theta: theta + 0.1 * torch.randn_like(theta)
        >>> theta = prior.sample((200,))
        >>> npe = NPE(prior, show_progress_bars=False)
        >>> _ = npe.append_simulations(theta, simulator(theta)).train(max_num_epochs=2)

        >>> theta_cal, theta_o = prior.sample((10,)), prior.sample((30,))
        >>> x_cal, x_o = simulator(theta_cal) + 0.3, simulator(theta_o) + 0.3
        >>> rope = RoPE(npe.build_posterior(), simulator=simulator)
        >>> rope = rope.append_calibration(theta_cal, x_cal)
        >>> rope = rope.train(show_progress_bars=False)
        >>> posterior = rope.build_posterior(x_o)
        >>> posterior.sample_batched((5,), x=x_o, show_progress_bars=False).shape
        torch.Size([5, 30, 1])
    """

    def __init__(
        self,
        posterior: Any,
        *,
        simulator: Callable[[Tensor], Tensor] | None = None,
        simulations: tuple[Tensor, Tensor] | None = None,
        finetuner: CalibrationFinetuner | None = None,
        coupler: SinkhornCoupler | None = None,
    ) -> None:
        check_instance("finetuner", finetuner, CalibrationFinetuner, optional=True)
        check_instance("coupler", coupler, SinkhornCoupler, optional=True)
        check_default_dtype()
        estimator = estimator_of(posterior)
        embedding_of(estimator)
        if dtype_of(estimator) != torch.float32:
            raise UnsupportedPosteriorError(
                f"Expected an estimator in float32; got {dtype_of(estimator)}. sbi "
                "converts every x to float32; convert the estimator with `.float()`."
            )
        # Copies: neither training here nor moving our posterior to another device may
        # touch what belongs to the user.
        self._estimator = (
            copy.deepcopy(estimator).eval().requires_grad_(requires_grad=False)
        )
        self._posterior: Any = posterior_from(posterior, self._estimator)
        self._prior = copy_of_prior(posterior.prior)
        self._h = embedding_of(self._estimator)
        self._q = headless(self._estimator)
        self._g: nn.Module | None = None
        self._history: History | None = None
        self.finetuner = CalibrationFinetuner() if finetuner is None else finetuner
        self.coupler = SinkhornCoupler() if coupler is None else coupler

        self._theta_cal = torch.empty(
            0,
            *estimator.input_shape,
            dtype=dtype_of(estimator),
            device=device_of(estimator),
        )
        self._x_cal = self._theta_cal.new_empty(0, *estimator.condition_shape)
        self._targets: Tensor | None = None
        self._rehearsed: dict[int, Tensor] = {}
        self._source = self._make_source(simulator, simulations)

    def _make_source(
        self,
        simulator: Callable[[Tensor], Tensor] | None,
        simulations: tuple[Tensor, Tensor] | None,
    ) -> SimulationSource:
        if (simulator is None) == (simulations is None):
            raise InvalidInputError(
                "Expected exactly one of `simulator` and `simulations`; got "
                f"{'none' if simulator is None else 'both'}."
            )
        event_shape = self._estimator.condition_shape
        if simulations is not None:
            return StoredSimulations(
                simulations,
                self._prior,
                theta_shape=self._estimator.input_shape,
                event_shape=event_shape,
                like=self._theta_cal,
            )
        assert simulator is not None
        return Simulator(
            simulator, self._prior, event_shape=event_shape, like=self._theta_cal
        )

    def append_calibration(self, theta: Tensor, x: Tensor) -> "RoPE":
        """Add real observations with known parameters; may be called repeatedly.

        Args:
            theta: Parameters, shape ``(n, d)``, inside the prior's support.
            x: Real observations, shape ``(n, *event)``.

        Returns:
            Itself, so that calls can be chained.

        Raises:
            InvalidTypeError: If one of them is not a tensor.
            InvalidInputError: If shapes, row counts or devices do not fit, a value is
                not finite, or a theta is outside the prior's support. Nothing is added
                then.
        """
        theta = self._checked("theta", theta, self._estimator.input_shape)
        x = self._checked("x", x, self._estimator.condition_shape)
        check_same_length("theta", theta, "x", x)
        check_in_support("theta", theta, self._prior)
        self._embedded("x", x, self._h)
        warn_of_far_entries("x", x, self._h)
        self._theta_cal = torch.cat([self._theta_cal, theta])
        self._x_cal = torch.cat([self._x_cal, x])
        self._g, self._history, self._targets = None, None, None
        return self

    def train(
        self, *, seed: int | None = None, show_progress_bars: bool = True
    ) -> "RoPE":
        """Tune the embedding net on all calibration pairs appended so far.

        Training again starts anew from the embedding net of NPE.

        Args:
            seed: Seed of the simulations and of the hold-out split, for torch, NumPy
                and Python; None uses their states.
            show_progress_bars: Whether to show the course of the loss.

        Returns:
            Itself, so that calls can be chained.

        Raises:
            NotReadyError: If no calibration pairs were appended, or in inference mode.
            SimulationError: If the simulator fails at the calibration parameters.
        """
        check_gradients()
        check_instance("finetuner", self.finetuner, CalibrationFinetuner)
        if not len(self._x_cal):
            raise NotReadyError(
                "No calibration pairs to train on. Call `append_calibration(theta, "
                "x)` first, or go on to `build_posterior(x_o)`, which then couples "
                "with the embedding net as NPE left it (OT-only)."
            )
        known = None if self.finetuner.resample_targets else self._targets

        def draw_targets(count: int) -> Tensor:
            if known is not None:
                return known
            return self._draw_targets(self._theta_cal, count, show_progress_bars)

        result = self.finetuner.finetune(
            self._h,
            self._x_cal,
            draw_targets,
            draw_simulations=lambda count: self._draw_rehearsal(
                count, progress=show_progress_bars
            ),
            groups=groups_of(self._theta_cal),
            seed=seed,
            show_progress_bars=show_progress_bars,
        )
        self._g, self._history = result.embedding_net, result.history
        return self

    def draw_targets(
        self,
        rows: Tensor,
        *,
        seed: int | None = None,
        show_progress_bars: bool = True,
    ) -> Tensor:
        r"""Return where tuning moves some pairs, :math:`E_\varepsilon[h(S(\theta_i))]`.

        Args:
            rows: Numbers of calibration pairs, shape ``(m,)``.
            seed: Seed of the simulations; None uses the states of torch, NumPy and
                Python.
            show_progress_bars: Whether to show the progress of slow simulations.

        Returns:
            Shape ``(m, l)``. They depend on the parameters of these pairs only.

        Raises:
            InvalidInputError: If a row is not the number of a pair, or there is none.
            SimulationError: If the simulator fails.
        """
        check_rows("rows", rows, len(self._x_cal))
        if not len(rows):
            raise InvalidInputError("Expected `rows` with at least one pair; got none.")
        count = self.finetuner.simulations_per_target
        with seeded(seed):
            return self._draw_targets(self._theta_cal[rows], count, show_progress_bars)

    def _draw_targets(self, theta: Tensor, count: int, progress: bool) -> Tensor:  # noqa: FBT001
        stored = isinstance(self._source, StoredSimulations)
        targets = self._source.targets(
            theta,
            self.finetuner.num_neighbors if stored else count,
            self._embed_simulations,
            progress=progress,
        )
        usable = torch.isfinite(torch.linalg.vector_norm(targets, dim=1))
        if not usable.all():
            raise SimulationError(
                "Expected simulations with a finite embedding; got NaN, Inf or numbers "
                f"too large to compare at the calibration parameters "
                f"{theta[~usable][:5].tolist()}. Check what the simulator returns "
                "there, or remove these pairs."
            )
        return targets

    def _draw_rehearsal(self, count: int, *, progress: bool) -> Tensor:
        # Drawn once for all that share these simulations, such as the folds of a
        # stack; under a seed of its own, so that nothing depends on who came first.
        if count not in self._rehearsed:
            with seeded(0):
                _, x = self._source.from_prior(
                    None, count, lambda x: x, progress=progress
                )
            self._rehearsed[count] = x
        return self._rehearsed[count]

    def draw_simulations(
        self,
        num_simulations: int | None = None,
        *,
        at_least: int = MIN_SIMULATIONS,
        seed: int | None = None,
        show_progress_bars: bool = True,
    ) -> tuple[Tensor, Tensor]:
        r"""Return parameters from the prior and embeddings :math:`h(x_s)`.

        With the same number and seed these are the simulations that
        :meth:`build_posterior` couples with.

        Args:
            num_simulations: n_s; ``at_least`` if None (or all stored ones, if there
                are fewer).
            at_least: The number without ``num_simulations``.
            seed: Seed of the simulations; None uses the states of torch, NumPy and
                Python.
            show_progress_bars: Whether to show the progress of slow simulations.

        Returns:
            Parameters, shape ``(n_s, d)``, and the embedding of a simulation of each,
            shape ``(n_s, l)``; without simulations that are not finite.

        Raises:
            InvalidInputError: If there are fewer stored simulations than asked for.
            SimulationError: If the simulator fails.
        """
        if num_simulations is not None:
            check_integer("num_simulations", num_simulations)
        check_integer("at_least", at_least)
        with seeded(seed):
            return self._source.from_prior(
                num_simulations,
                at_least,
                self._embed_simulations,
                progress=show_progress_bars,
            )

    def embed_observations(self, x_o: Tensor) -> Tensor:
        r"""Return :math:`g(x_o)`, shape ``(n_o, l)``; g = h without calibration pairs.

        Args:
            x_o: Real observations, shape ``(n_o, *event)``.

        Raises:
            NotReadyError: If calibration pairs were appended after the last training.
            InvalidInputError: If x_o has the wrong shape or device, is empty, or it or
                its embedding is not finite.
        """
        if len(self._x_cal) and self._g is None:
            raise NotReadyError(
                f"{len(self._x_cal)} calibration pairs were appended but not trained "
                "on. Call `train()` first."
            )
        x_o = self._checked("x_o", x_o, self._estimator.condition_shape)
        return self._embedded("x_o", x_o, self._h if self._g is None else self._g)

    def with_pairs(self, rows: Tensor, *, targets: Tensor | None = None) -> "RoPE":
        """Return an untrained RoPE of the same NPE and simulator, with some pairs only.

        Args:
            rows: Numbers of the calibration pairs to keep, shape ``(m,)``.
            targets: What :meth:`draw_targets` returned for these rows, so that
                :meth:`train` does not simulate again; of no effect if the finetuner
                draws new ones in every step.

        Raises:
            InvalidInputError: If a row is not the number of a pair, or there are not as
                many targets as rows.
        """
        check_rows("rows", rows, len(self._x_cal))
        if targets is not None:
            targets = check_tensor("targets", targets)
            check_batch("targets", targets, targets.shape[1:])
            check_same_length("rows", rows, "targets", targets)
            targets = targets.clone()
        part = copy.copy(self)
        part._theta_cal, part._x_cal = self._theta_cal[rows], self._x_cal[rows]
        part._targets = targets
        part._g, part._history = None, None
        return part

    def with_finetuner(self, finetuner: CalibrationFinetuner) -> "RoPE":
        """Return a RoPE with the same pairs and another finetuner, not trained yet.

        Targets that were handed to :meth:`with_pairs` stay, if they are what the other
        finetuner would have asked for.

        Args:
            finetuner: Settings of the tuning.

        Returns:
            Another RoPE, which shares the simulations to rehearse with; this one stays
            as it is.

        Raises:
            InvalidTypeError: If it is something else.
        """
        check_instance("finetuner", finetuner, CalibrationFinetuner)
        other = copy.copy(self)
        other.finetuner = finetuner
        other._g, other._history = None, None
        for name in ("simulations_per_target", "num_neighbors"):
            if getattr(finetuner, name) != getattr(self.finetuner, name):
                other._targets = None
        return other

    def build_posterior(
        self,
        x_o: Tensor,
        *,
        coupler: SinkhornCoupler | None = None,
        num_simulations: int | None = None,
        seed: int | None = None,
        unseen: Literal["raise", "extend"] = "raise",
        require_convergence: bool = True,
        tail_mass: float = 1e-3,
        show_progress_bars: bool = True,
    ) -> MixturePosterior:
        """Couple a batch of real observations with simulations.

        The trained state is reused: call it for as many batches and couplers as needed.
        With the same seed the simulations are the same.

        Args:
            x_o: The batch, shape ``(n_o, *event)``. Posteriors depend on the whole
                batch, and a batch of fewer than 20 earns a warning.
            coupler: Replaces the coupler of this object for this batch.
            num_simulations: n_s; ``max(n_o, 1000)`` if None (or all stored ones, if
                there are fewer).
            seed: Seed of the simulations, for torch, NumPy and Python; None uses their
                states.
            unseen: What the posterior does with an x outside the batch: ``"raise"``,
                or ``"extend"`` the coupling by one row.
            require_convergence: Whether a coupling that has not converged is an error.
            tail_mass: Share of the weights ``log_prob`` may leave out, in [0, 1].
            show_progress_bars: Whether to show the progress of slow simulations.

        Returns:
            The posteriors of the batch.

        Raises:
            NotReadyError: If calibration pairs were appended after the last training.
            InvalidInputError: If x_o has the wrong shape or device, is empty, or not
                finite.
            CouplingError: If the coupling has not converged.
            SimulationError: If the simulator fails.
        """
        coupler = self._coupler_or(coupler)
        batch = self._embed_batch(
            x_o,
            num_simulations=num_simulations,
            seed=seed,
            unseen=unseen,
            tail_mass=tail_mass,
            show_progress_bars=show_progress_bars,
        )
        with parameters_named(batch.theta):
            coupling = coupler.couple(batch.real, batch.simulated, seed=seed)
        if require_convergence:
            _check_converged(coupling, coupler)
        return self._mixture(batch, coupling)

    def sweep(
        self,
        x_o: Tensor,
        *,
        gammas: Sequence[float],
        taus: Sequence[float],
        coupler: SinkhornCoupler | None = None,
        num_simulations: int | None = None,
        seed: int | None = None,
        unseen: Literal["raise", "extend"] = "raise",
        require_convergence: bool = True,
        tail_mass: float = 1e-3,
        show_progress_bars: bool = True,
    ) -> Iterator[MixturePosterior]:
        """Couple a batch at every gamma and every tau, with the same simulations.

        The same as :meth:`build_posterior` at each, up to the tolerance of the coupler,
        in less time: the simulations are drawn and embedded once, their posteriors are
        normalised once, and each coupling starts from its neighbour
        (:meth:`SinkhornCoupler.sweep <sbi_rope.SinkhornCoupler.sweep>`).

        Args:
            x_o: As in :meth:`build_posterior`, and so are the arguments not listed.
            gammas: Values of gamma; descending ones are handed out soonest.
            taus: Values of tau.
            coupler: Settings other than gamma and tau.
            num_simulations: As in :meth:`build_posterior`.
            seed: As in :meth:`build_posterior`.
            unseen: As in :meth:`build_posterior`.
            require_convergence: As in :meth:`build_posterior`.
            tail_mass: As in :meth:`build_posterior`.
            show_progress_bars: As in :meth:`build_posterior`.

        Returns:
            An iterator over the posteriors: all taus of the first gamma, then of the
            second, and so on.

        Raises:
            InvalidInputError: If there is no gamma or tau or one is outside its range,
                or as in :meth:`build_posterior`.
            NotReadyError: As in :meth:`build_posterior`.
            CouplingError: When the iteration reaches a coupling that has not converged.
            SimulationError: If the simulator fails.
        """
        coupler = self._coupler_or(coupler)
        gammas, taus = check_numbers("gammas", gammas), check_numbers("taus", taus)
        batch = self._embed_batch(
            x_o,
            num_simulations=num_simulations,
            seed=seed,
            unseen=unseen,
            tail_mass=tail_mass,
            show_progress_bars=show_progress_bars,
        )
        with parameters_named(batch.theta):
            couplings = coupler.sweep(
                batch.real, batch.simulated, gammas=gammas, taus=taus, seed=seed
            )

        def posteriors() -> Iterator[MixturePosterior]:
            settings = itertools.product(gammas, taus)
            # In our hands: moving a posterior to a device gives it another.
            shared: dict[int, Tensor] = {}
            for gamma, tau in settings:
                with parameters_named(batch.theta):
                    coupling = next(couplings)
                if require_convergence:
                    _check_converged(coupling, replace(coupler, gamma=gamma, tau=tau))
                yield self._mixture(batch, coupling, shared=shared)

        return posteriors()

    def _coupler_or(self, coupler: SinkhornCoupler | None) -> SinkhornCoupler:
        coupler = self.coupler if coupler is None else coupler
        check_instance("coupler", coupler, SinkhornCoupler)
        return coupler

    def _embed_batch(
        self,
        x_o: Tensor,
        *,
        num_simulations: int | None,
        seed: int | None,
        unseen: Literal["raise", "extend"],
        tail_mass: float,
        show_progress_bars: bool,
    ) -> "_Batch":
        check_choice("unseen", unseen, ("raise", "extend"))
        check_unit_interval("tail_mass", tail_mass)
        real = self.embed_observations(x_o)
        warn_of_far_entries("x_o", x_o.to(real), self._h)
        theta, simulated = self.draw_simulations(
            num_simulations,
            at_least=max(len(real), MIN_SIMULATIONS),
            seed=seed,
            show_progress_bars=show_progress_bars,
        )
        return _Batch(
            x_o=self._checked("x_o", x_o, self._estimator.condition_shape),
            real=real,
            theta=theta,
            simulated=simulated,
            embedding_net=self._h if self._g is None else self._g,
            unseen=unseen,
            tail_mass=tail_mass,
        )

    def _mixture(
        self,
        batch: "_Batch",
        coupling: Coupling,
        *,
        shared: dict[int, Tensor] | None = None,
    ) -> MixturePosterior:
        # Each posterior its own net and density: moving one to a device leaves the
        # others.
        net = CoupledNet(copy.deepcopy(batch.embedding_net), [coupling])
        mixing = CoupledContexts(batch.simulated, batch.x_o, [net], unseen=batch.unseen)
        part = Part(copy.deepcopy(self._components()), mixing)
        mixture = MixtureEstimator([part], [1.0], tail_mass=batch.tail_mass)
        return MixturePosterior(
            mixture,
            copy.deepcopy(self._prior),
            enable_transform=self._posterior.enable_transform,
            shared=shared,
        )

    def tuned_posterior(self) -> Any:
        r"""Return the flow on the tuned embedding, :math:`q(\theta \mid g(x))`.

        The paper's ablation without transport ("tuning-only"), an ordinary sbi
        posterior for any x.

        Raises:
            NotReadyError: If ``train()`` was not called.
        """
        if self._g is None:
            raise NotReadyError("No tuned embedding net yet. Call `train()` first.")
        tuned = with_embedding(self._estimator, self._g)
        return posterior_from(self._posterior, copy.deepcopy(tuned))

    @property
    def source(self) -> SimulationSource:
        """Where simulations come from; copies with other pairs share it."""
        return self._source

    @property
    def npe(self) -> Any:
        """A copy of the NPE posterior that is repaired."""
        return posterior_from(self._posterior, copy.deepcopy(self._estimator))

    @property
    def calibration(self) -> tuple[Tensor, Tensor]:
        """The calibration pairs appended so far, theta and x."""
        return self._theta_cal.clone(), self._x_cal.clone()

    @property
    def embedding_net(self) -> nn.Module:
        """A copy of h, the embedding net of NPE with sbi's standardising layer."""
        return copy.deepcopy(self._h)

    @property
    def tuned_embedding_net(self) -> nn.Module:
        """A copy of g, the tuned embedding net."""
        if self._g is None:
            raise NotReadyError("No tuned embedding net yet. Call `train()` first.")
        return copy.deepcopy(self._g)

    @property
    def history(self) -> History:
        """The losses of the last training."""
        if self._history is None:
            raise NotReadyError("Nothing was trained yet. Call `train()` first.")
        return self._history

    @property
    def num_dropped_simulations(self) -> int:
        """Number of simulations dropped so far because of NaN or Inf."""
        return self._source.num_dropped

    def __repr__(self) -> str:
        state = "trained" if self._g is not None else "not trained"
        return (
            f"RoPE({type(self._estimator).__name__}, {len(self._x_cal)} calibration "
            f"pairs, {state}, {self.coupler})"
        )

    def _components(self) -> ConditionalDensityEstimator:
        if isinstance(self._q, ConditionalDensityEstimator):
            return self._q
        return VectorFieldDensity(self._q, self._prior, self._posterior.sample_with)

    def _embed_simulations(self, x: Tensor) -> Tensor:
        return embed(self._h, x)

    def _embedded(self, name: str, x: Tensor, net: nn.Module) -> Tensor:
        """Return the embedding of observations, if it is finite, and so its length."""
        embedded = embed(net, x)
        usable = torch.isfinite(torch.linalg.vector_norm(embedded, dim=1))
        if not usable.all():
            rows = (~usable).nonzero().flatten()
            largest = float(x[rows[0]].abs().max())
            raise InvalidInputError(
                f"Expected `{name}` with a finite embedding; got NaN, Inf or numbers "
                f"too large to compare for {len(rows)} of {len(x)} rows (first: "
                f"{rows[:5].tolist()}, with values of up to {largest:.2g}). Remove or "
                "repair these rows."
            )
        return embedded

    def _checked(self, name: str, value: Tensor, event_shape: torch.Size) -> Tensor:
        """Check a batch of the user and return a copy in the estimator's dtype."""
        check_device(name, check_tensor(name, value), device_of(self._estimator))
        value = check_batch(name, value, event_shape)
        value = value.detach().to(dtype_of(self._estimator), copy=True)
        check_finite(name, value)  # the estimator's dtype may hold less
        return value


@dataclass(frozen=True, eq=False, kw_only=True)
class _Batch:
    """Real observations, what they are coupled with, and how they are looked up."""

    x_o: Tensor
    real: Tensor
    theta: Tensor
    simulated: Tensor
    embedding_net: nn.Module
    unseen: Literal["raise", "extend"]
    tail_mass: float


@contextmanager
def parameters_named(theta: Tensor) -> Iterator[None]:
    """Say which observations and simulations a coupling failed for, in RoPE's words.

    The rows of simulations mean nothing to users, for whom they were drawn.

    Args:
        theta: The parameters of the simulations, shape ``(n_s, d)``.
    """
    try:
        yield
    except CouplingError as error:
        reason = error.reason.replace("`real`", "`x_o`")
        reason = reason.replace("`simulated`", "the simulations")
        if error.simulated_rows:
            rows = list(error.simulated_rows[:5])
            reason += f" Their parameters are {theta[rows].tolist()}."
        raise CouplingError(reason) from error


def _check_converged(coupling: Coupling, coupler: SinkhornCoupler) -> None:
    if coupling.converged:
        return
    raise CouplingError(
        f"The coupling has not converged: marginal error {coupling.marginal_error:.1e} "
        f"after {coupling.num_iterations} iterations, tolerance "
        f"{coupler.tolerance:.1e}. Use a larger gamma (now {coupler.gamma}), tau < 1 "
        f"(now {coupler.tau}), more max_iterations, or accept it with "
        "require_convergence=False."
    )
