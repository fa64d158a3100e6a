"""Robust posterior estimation: the class that runs its three steps."""

import copy
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from sbi_rope.coupling import SinkhornCoupler
from sbi_rope.data.labels import draws_of, given_groups, given_labels, given_weights
from sbi_rope.data.pairs import Pairs, effective_number, groups_of
from sbi_rope.data.simulate import Source, moments, source_of, targets
from sbi_rope.density import Coupled, MixturePosterior
from sbi_rope.discrepancy.correction import tuning_targets
from sbi_rope.npe.sbi import TrainedNPE, embed
from sbi_rope.npe.standardisation import warn_of_far_entries
from sbi_rope.rope.finetuning import CalibrationFinetuner, History
from sbi_rope.utils.errors import (
    InvalidInputError,
    NotReadyError,
    UnsupportedPosteriorError,
    warn_user,
)
from sbi_rope.utils.progress import is_shown
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import Count, check
from sbi_rope.utils.tensors import as_numbers, column_names, rows_with

# The number of simulations to couple with if the batch has fewer observations.
MIN_SIMULATIONS = 1000


class RoPE:
    r"""Repairs a trained sbi posterior with a few labelled real observations.

    An NPE posterior is :math:`q(\theta \mid h(x))`, trained on simulations. RoPE

    1. tunes a copy g of h so that :math:`g(x_o)` comes close to the embeddings by h of
       simulations with the same parameters (:meth:`train`; needs calibration pairs);
    2. couples a batch of real observations with simulations by optimal transport
       between :math:`g(x_o)` and :math:`h(x_s)`;
    3. returns for each observation the mixture
       :math:`\sum_j \alpha_{ij}\, q(\theta \mid h(x_{s,j}))` (:meth:`build_posterior`
       does steps 2 and 3).

    Without calibration pairs, g = h (the paper's "OT-only"). The posterior is copied
    and never changed.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
          Calibration (Wehenkel et al., 2025), Algorithm 1
        | https://arxiv.org/abs/2405.08719

    Args:
        posterior: What ``NPE(...).build_posterior()`` returns, or the posterior of
            MNPE, FMPE or NPSE (these two without ``log_prob``), trained in one round.
        simulator: Maps parameters ``(n, d)`` to simulations ``(n, *event)``, or one
            ``(d,)`` to one ``(*event)``; tensors or NumPy arrays. A row of x may depend
            on the same row of theta only, with noise from the global generator of
            torch, NumPy or Python. Simulations that the embedding net cannot read (NaN
            or Inf), and calls in which the simulator raises, are dropped and counted.
            :func:`~sbi_rope.parallel` calls it in several processes.
        simulations: Instead of a simulator, stored pairs (theta, x) with theta drawn
            from the prior.
        num_simulations: For a slow simulator, the number of simulations in all. They
            are made from the prior at once, and then used like stored ones.
            ``docs/howto/simulators.md`` says how many are made if None.
        finetuner: Settings of step 1; ``CalibrationFinetuner()`` if None.
        coupler: Settings of step 2; ``SinkhornCoupler()`` if None.
        parameter_names: One name for each parameter. If None, the columns of the first
            table of parameters, or "theta_1" and so on.

    Attributes:
        npe: A copy of the posterior, in its parts.
        pairs: The calibration pairs appended so far, with draws of their parameters.
        source: Where simulations come from; ``num_calls`` counts the rows of theta that
            were simulated, and ``num_dropped`` those dropped because of NaN or Inf.

    Raises:
        UnsupportedPosteriorError: If the posterior has no embedding to work with, or if
            the embedding of a row depends on the other rows of a batch.
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
        >>> rope = rope.append_calibration(theta_cal, x_cal).train()
        >>> posterior = rope.build_posterior(x_o)
        >>> posterior.sample_batched((5,), x=x_o, show_progress_bars=False).shape
        torch.Size([5, 30, 1])
    """

    def __init__(
        self,
        posterior: Any,
        *,
        simulator: Callable[[Any], Any] | None = None,
        simulations: tuple[Tensor, Tensor] | None = None,
        num_simulations: int | None = None,
        finetuner: CalibrationFinetuner | None = None,
        coupler: SinkhornCoupler | None = None,
        parameter_names: Sequence[str] | None = None,
    ) -> None:
        self.finetuner = CalibrationFinetuner() if finetuner is None else finetuner
        self.coupler = SinkhornCoupler() if coupler is None else coupler
        check("finetuner", self.finetuner, CalibrationFinetuner)
        check("coupler", self.coupler, SinkhornCoupler)
        x_names = None
        if simulations is not None:
            theta, x = simulations
            x_names = column_names(x)
            parameter_names = parameter_names or column_names(theta)
            simulations = (as_numbers("theta", theta, names=parameter_names), x)
        self.npe = TrainedNPE(posterior, parameter_names)
        self.npe.x_names = x_names
        x_like = self.npe.like.new_empty(0, *self.npe.event_shape)
        self.source: Source = source_of(
            self.npe.prior,
            simulator=simulator,
            simulations=simulations,
            num_simulations=num_simulations,
            like=x_like,
            readable=self.npe.readable,
        )
        self.pairs = Pairs.exact(self.npe.like, x_like)
        self._names: tuple[Hashable, ...] = ()
        self._embed = partial(embed, self.npe.h)
        self._g: nn.Module | None = None
        self._history: History | None = None

    def append_calibration(
        self,
        theta: Tensor,
        x: Tensor,
        *,
        theta_std: Tensor | float | None = None,
        weights: Tensor | None = None,
        groups: Tensor | Sequence[int | str] | None = None,
    ) -> "RoPE":
        r"""Add real observations with known parameters; return this object.

        Labels need not be exact. A label is then a measurement
        :math:`y_j \sim \mathcal N(\theta_j, \sigma_j^2)` of some or all parameters.
        Whatever needs the parameters is averaged over :math:`p(\theta \mid y)` under
        the prior.

        The columns of a table are put into the order of the names that RoPE knows. Rows
        of theta and x are paired by position, not by their row labels.

        Args:
            theta: Parameters, shape ``(n, d)``, inside the prior's support. NaN stands
                for a parameter that was not measured. In the most general case, a
                label is S draws from :math:`p(\theta \mid y)` under the prior, shape
                ``(n, S, d)``.
            x: Real observations, shape ``(n, *event)``.
            theta_std: The standard deviations of the measurements, in the units of
                theta: a number, or shape ``(d,)`` or ``(n, d)``. Zero is exact. A label
                with noise may be outside the prior's support. None if all are exact.
            weights: How many pairs each pair counts as, shape ``(n,)``; one if None.
            groups: A number or a name for each pair. Pairs of one group are recordings
                of one person or specimen. They are held out together, and count once
                in scores. If None, pairs with equal labels are a group.

        Raises:
            InvalidInputError: If an exact theta is outside the prior's support, or no
                parameters inside it fit a label. Nothing is added then.
        """
        names = self.npe.parameter_names or column_names(theta)
        draws, y, std = given_labels(
            theta, theta_std, like=self.npe.like, prior=self.npe.prior, names=names
        )
        weight = given_weights(weights, len(y), y.device)
        of_rows = given_groups(groups, len(y))
        x_names = self.npe.x_names or column_names(x)
        x = self.npe.as_x("x", x, rows=len(y))
        rows = torch.arange(len(y), device=y.device)
        new = Pairs(theta=draws, x=x, group=rows, weight=weight, y=y, std=std)
        if self.npe.is_mixed and not new.are_exact:
            raise UnsupportedPosteriorError(
                "Expected exact labels, because some parameters are discrete (MNPE); "
                "got others."
            )
        self.npe.embed("x", x, self.npe.h)
        warn_of_far_entries("x", x, self.npe.h)
        if (unknown := torch.isnan(y).all(dim=1)).any():
            raise InvalidInputError(
                "Expected labels of at least one parameter in each pair; got NaN only "
                f"in {rows_with(unknown)}."
            )
        if len(self.pairs) and bool(self._names) != bool(of_rows):
            raise InvalidInputError(
                "Expected `groups` of all calibration pairs, or of none; got some."
            )
        pairs, of_rows = self.pairs + new, self._names + of_rows
        group = groups_of(of_rows).to(y.device) if of_rows else pairs.label
        theta = draws_of(pairs, self.npe.prior)
        pairs = replace(pairs, theta=theta, group=group)
        total = float(pairs.weight.sum())
        if total < effective_number(pairs.weight) / 2:
            warn_user(
                f"The weights of {len(pairs)} pairs sum to {total:.3g}, and all "
                "together count as so many pairs; do not normalise them."
            )
        self.pairs, self._names = pairs, of_rows
        self.npe.parameter_names, self.npe.x_names = names, x_names
        self._g, self._history = None, None
        return self

    def train(
        self, *, seed: int | None = None, show_progress_bars: bool | None = None
    ) -> "RoPE":
        """Tune the embedding net on all calibration pairs; return this object.

        Every call starts from the embedding net of NPE. Where labels are not exact,
        targets are averages given the label and x, under a discrepancy model of the
        embedding. They take one simulation at each draw of a label.

        Args:
            seed: Seed of the simulations and of the hold-out split, for torch, NumPy
                and Python; None uses their states.
            show_progress_bars: Whether to show the progress of simulations and losses.
                None does so in a terminal or a notebook, but not in a file.
        """
        if not len(self.pairs):
            raise NotReadyError(
                "No calibration pairs; call `append_calibration(theta, x)` first."
            )
        pairs, show = self.pairs, is_shown(show_progress_bars)
        source, how, h = self.source, self.finetuner, self._embed
        of_pairs = source, pairs, how.simulations_per_target, h
        with seeded(seed):
            if pairs.are_exact:
                aims = targets(*of_pairs, progress=show)
            else:
                _, x_s = source.from_prior(MIN_SIMULATIONS, seed=0, progress=show)
                found = moments(*of_pairs, progress=show)
                aims = tuning_targets(pairs, h(pairs.x), found, h(x_s))
            nets, [self._history] = how.tuned(
                self.npe.h,
                pairs.x,
                [aims],
                [torch.arange(len(pairs)).to(pairs.group)],
                groups=pairs.group,
                weights=pairs.weight,
                draw_simulations=lambda n: source.from_prior(n, seed=0, progress=show)[
                    1
                ],
                show_progress_bars=show,
            )
        self._g = nets.member(0)
        return self

    def embed(
        self,
        x_o: Tensor,
        *,
        num_simulations: int | None = None,
        seed: int | None = None,
        show_progress_bars: bool | None = None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return x_o, g(x_o), parameters of simulations theta, and h(x_s).

        The arguments are those of :meth:`build_posterior`. With the same
        ``num_simulations`` and ``seed``, it couples with the same simulations.
        """
        if len(self.pairs) and self._g is None:
            raise NotReadyError(
                f"{len(self.pairs)} calibration pairs were appended; call `train()` "
                "first."
            )
        check("num_simulations", num_simulations, Count | None)
        x_o = self.npe.as_x("x_o", x_o)
        real = self.npe.embed("x_o", x_o, self._net)
        with seeded(seed):
            theta, simulated = self.source.from_prior(
                num_simulations or max(len(x_o), MIN_SIMULATIONS),
                progress=is_shown(show_progress_bars),
            )
        return x_o, real, theta, self._embed(simulated)

    def build_posterior(
        self,
        x_o: Tensor,
        *,
        coupler: SinkhornCoupler | None = None,
        num_simulations: int | None = None,
        seed: int | None = None,
        show_progress_bars: bool | None = None,
    ) -> MixturePosterior:
        """Couple a batch of real observations with simulations.

        After one training, it can be called for any number of batches and couplers.
        There is a warning if a coupling has not converged.

        Args:
            x_o: The batch, shape ``(n_o, *event)``. Each posterior depends on the whole
                batch. There is a warning if it has fewer than 20 observations.
            coupler: Settings for this batch; those of this object if None.
            num_simulations: n_s; ``max(n_o, 1000)`` if None. Of stored simulations
                there may be fewer.
            seed: As in :meth:`train`.
            show_progress_bars: As in :meth:`train`.

        Raises:
            NotReadyError: If calibration pairs were appended after the last training.
        """
        coupler = self.coupler if coupler is None else coupler
        check("coupler", coupler, SinkhornCoupler)
        x_o, real, _, simulated = self.embed(
            x_o,
            num_simulations=num_simulations,
            seed=seed,
            show_progress_bars=show_progress_bars,
        )
        npe = self.npe
        warn_of_far_entries("x_o", x_o, npe.h)
        coupling = coupler.couple(real, simulated)
        posterior = MixturePosterior(
            Coupled(npe.density(), x_o, coupling),
            npe.prior,
            enable_transform=npe.enable_transform,
        )
        posterior.parameter_names, posterior.x_names = npe.parameter_names, npe.x_names
        return posterior

    @property
    def _net(self) -> nn.Module:
        return self.npe.h if self._g is None else self._g

    def tuned_posterior(self) -> Any:
        r"""Return the flow on the tuned embedding, :math:`q(\theta \mid g(x))`.

        It is an sbi posterior for any x, the paper's ablation "tuning-only".
        """
        return self.npe.posterior(self.tuned_embedding_net)

    @property
    def tuned_embedding_net(self) -> nn.Module:
        """A copy of g, the tuned embedding net."""
        if self._g is None:
            raise NotReadyError("No tuned embedding net yet. Call `train()` first.")
        return copy.deepcopy(self._g)

    @property
    def is_trained(self) -> bool:
        """Whether the net is tuned on all calibration pairs appended so far."""
        return self._g is not None

    @property
    def history(self) -> History:
        """The losses of the last training."""
        if self._history is None:
            raise NotReadyError("Nothing was trained yet. Call `train()` first.")
        return self._history
