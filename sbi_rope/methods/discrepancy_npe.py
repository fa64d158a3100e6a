r"""NPE trained on corrected simulations, as learned from calibration pairs."""

from collections.abc import Callable, Sequence
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor, nn

from sbi_rope.data.simulate import Moments, Source, moments
from sbi_rope.density import MixturePosterior
from sbi_rope.discrepancy.correction import (
    Space,
    correct_flow,
    fit_version,
    network_of,
)
from sbi_rope.discrepancy.model import DiscrepancyModel
from sbi_rope.discrepancy.posterior import Discrepancy
from sbi_rope.discrepancy.report import DiscrepancyReport, report_discrepancy
from sbi_rope.methods.base import Method
from sbi_rope.methods.training import EstimatorBuilder
from sbi_rope.npe.sbi import (
    check_density,
    embed,
    embedding_of,
    estimator_of,
    posterior_from,
)
from sbi_rope.npe.standardisation import warn_of_far_entries
from sbi_rope.rope.finetuning import TUNING
from sbi_rope.training.ensemble import Ensemble
from sbi_rope.training.fit import History, Training
from sbi_rope.utils.errors import InvalidInputError, NotReadyError
from sbi_rope.utils.progress import is_shown
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import Count, Range, check
from sbi_rope.utils.tensors import as_batch

# Simulations at the parameters of each pair, and copies g with ``space="tuned"``.
SIMULATIONS_PER_PAIR, NUM_FOLDS = 100, 5


class DiscrepancyNPE(Method):
    r"""NPE for real observations, with the discrepancy of the simulator integrated out.

    A Bayesian linear model of how real observations follow from simulations
    (:class:`DiscrepancyModel`) is fitted to the calibration pairs. Simulations are then
    corrected by draws from its posterior, and NPE is trained on them for some more
    seconds. The result is an ordinary amortised posterior for any observation.

    What is corrected depends on ``space``:

    - ``"embedding"``: the embedding h(x) of NPE. Only the density behind h is trained.
    - ``"input"``: x itself, a vector of a few summaries, none of which is missing. All
      of NPE is trained. This is better if h discards information that is needed when
      the simulator is wrong.
    - ``"tuned"``: five copies g of h are tuned as RoPE tunes its own, with rehearsal,
      each without one fold of the pairs. The discrepancy is that between g of the pairs
      in the fold and h of simulations. The posterior averages over the copies. This is
      for large nets that have never seen the effect which the simulator lacks.

    One linear correction has to hold for all parameters. A handful of pairs is enough;
    ``docs/background/discrepancy.md`` says when it fails. FMPE and NPSE posteriors can
    be corrected too, except with ``space="tuned"``.

    References:
        | Bayesian Calibration of Computer Models (Kennedy and O'Hagan, 2001)
        | https://doi.org/10.1111/1467-9868.00294

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``.
        density_estimator: A name, or what sbi's ``posterior_nn(...)`` returns. An
            embedding net inside it is copied, never trained in place.
        simulator: Maps parameters to simulations, batched or not. If None, the
            appended simulations are used instead.
        space: What is corrected, see above.
        learn_prior: Whether to learn the distribution of real parameters from those of
            the pairs, see :func:`~sbi_rope.discrepancy.learn_parameters`. Pass False
            unless the pairs are drawn like the observations to be inferred.
        model: The model of the discrepancy; ``DiscrepancyModel()`` if None.
        num_simulations: Simulations from the prior to train on, if none were appended.
        num_steps: Gradient steps. If None, NPE is trained in at most twelve courses of
            250 steps (400 with ``"input"``), until one gains less than 0.01 nats.
        npe_training: How NPE is trained; ``Training()`` if None.
        device: Where to train; data on other devices is moved there.
    """

    sees = frozenset({"simulations", "calibration"})
    starts_from_npe = True
    simulates = True
    min_pairs = 2  # fewer do not show the error of the discrepancy

    def __init__(
        self,
        prior: Any,
        density_estimator: str | EstimatorBuilder = "nsf",
        *,
        simulator: Callable[[Any], Any] | None = None,
        space: Space = "embedding",
        learn_prior: bool = True,
        model: DiscrepancyModel | None = None,
        num_simulations: int = 20_000,
        num_steps: int | None = None,
        npe_training: Training | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        check("space", space, Space)
        check("learn_prior", learn_prior, bool)
        check("model", model, DiscrepancyModel | None)
        check("num_simulations", num_simulations, Annotated[int, Range(2)])
        check("num_steps", num_steps, Count | None)
        super().__init__(
            prior, density_estimator, npe_training, simulator=simulator, device=device
        )
        self.space: Space = space
        self.learn_prior = learn_prior
        self.model = DiscrepancyModel() if model is None else model
        self.num_simulations = num_simulations
        self.num_steps = num_steps
        self._discrepancy: Discrepancy | None = None

    @property
    def discrepancy(self) -> Discrepancy:
        """The posterior of gain, offset and error after the last training."""
        if self._posterior is None or self._discrepancy is None:
            raise NotReadyError("No discrepancy fitted yet. Call `train()` first.")
        return self._discrepancy

    def report(
        self,
        *,
        summaries: Callable[[Tensor], Any] | None = None,
        x_names: Sequence[str] | None = None,
        seed: int | None = 0,
        show_progress_bars: bool | None = None,
    ) -> DiscrepancyReport:
        """Compare simulations with real observations, summary by summary.

        The method need not be trained, and with a simulator it needs no appended
        simulations. The report is about x itself, whatever ``space`` is.

        Args:
            summaries: A function from observations ``(n, *event)`` to a few summaries
                of each, ``(n, k)``, such as the means of parts of an image. It may
                return a NumPy array. If None, they are the entries of a vector x.
            x_names: Names of the summaries; numbered if None.
            seed: Seed of the simulations, as in ``train``.
            show_progress_bars: As in ``train``.

        Returns:
            The gain, shift and error of each summary with 95 % intervals.
        """
        self._check_data("calibration")
        if self._simulator is None:
            self._check_data("simulations")
        x, show = self._data.pairs.x, is_shown(show_progress_bars)
        if x.ndim != 2 and summaries is None:
            raise InvalidInputError(
                f"Expected observations of shape (n, l); got {tuple(x.shape)}. Pass "
                "`summaries=`, a function from x to shape (n, k)."
            )

        def summarised(x: Tensor) -> Tensor:
            if summaries is None:
                return x
            found = summaries(x.clone())  # which may work in place
            width, name = np.shape(found)[-1:], "summaries(x)"
            found = as_batch(name, found, width, rows=len(x), finite=False)
            return found.to(x.device)

        with seeded(seed):
            source = self._source()
            _, simulated = source.from_prior(
                self.num_simulations, seed=0, progress=show
            )
            report = report_discrepancy(
                as_batch("summaries of the pairs", summarised(x)),
                self._moments(source, summarised, progress=show),
                as_batch("summaries of simulations", summarised(simulated)),
                model=self.model,
                groups=self._data.pairs.group,
                show_progress_bars=show,
            )
        return report if x_names is None else report.renamed(x_names)

    def _moments(
        self, source: Source, embed: Callable[[Tensor], Tensor], *, progress: bool
    ) -> Moments:
        pairs = self._data.pairs
        return moments(source, pairs, SIMULATIONS_PER_PAIR, embed, progress=progress)

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        show = show_progress_bars
        npe, _ = self._trained_npe(show_progress_bars=show)
        estimator = estimator_of(npe)
        if self.space == "tuned":
            check_density(estimator, because="space='tuned' averages over nets")
        pairs, source = self._data.pairs, self._source()
        warn_of_far_entries("x", pairs.x, embedding_of(estimator))
        net = network_of(estimator, self.space)
        found = self._moments(source, lambda x: embed(net, x), progress=show)
        if self._data.count("simulations"):
            theta_s, x_s = self._data.simulations
        else:
            theta_s, x_s = source.from_prior(
                self.num_simulations, seed=0, progress=show
            )
        if self.space == "input":
            as_batch("x", pairs.x)
            as_batch("x of simulations", x_s)
        z, nets = embed(net, pairs.x), None
        if self.space == "tuned":
            nets, z = self._cross_fitted(
                net, found.mean.to(z), x_s, show_progress_bars=show
            )
        simulations = theta_s, embed(net, x_s)
        given, learn_prior = (pairs, z, found, simulations), self.learn_prior
        version = fit_version(*given, self.model, learn_prior=learn_prior)
        self._discrepancy, _ = version
        correction = correct_flow(
            estimator,
            simulations,
            [version],
            space=self.space,
            num_steps=self.num_steps,
            show_progress_bars=show,
        )
        [history], flow = correction.histories, correction.flow
        if nets is None:
            return posterior_from(npe, flow.estimator(estimator)), history
        # An entry that is constant in h can vary in g.
        members = [(number, 0) for number in range(len(nets))]
        average = flow.made_of(members, nets.then(correction.constants))
        return MixturePosterior(average, self._prior), history

    def _cross_fitted(
        self, h: nn.Module, targets: Tensor, x_s: Tensor, *, show_progress_bars: bool
    ) -> tuple[Ensemble, Tensor]:
        """Tune a copy of h without each fold, and embed the fold with it."""
        pairs = self._data.pairs
        if pairs.num_groups == 1:
            raise InvalidInputError(
                "Expected calibration pairs of different parameters with space='tuned';"
                f" all {len(pairs)} have the same. Use space='embedding'."
            )
        every = torch.arange(len(pairs)).to(pairs.group)
        folds = pairs.folds(NUM_FOLDS)
        # The simulations may be sorted, and rehearsal takes the first ones.
        order = torch.randperm(len(x_s)).to(x_s.device)
        nets, _ = TUNING.tuned(
            h,
            pairs.x,
            [targets] * len(folds),
            [every[~torch.isin(every, fold)] for fold in folds],
            groups=pairs.group,
            draw_simulations=lambda count: x_s[order[:count]],
            show_progress_bars=show_progress_bars,
        )
        z = torch.empty_like(targets)
        for number, fold in enumerate(folds):
            z[fold] = embed(nets.member(number), pairs.x[fold])
        return nets, z
