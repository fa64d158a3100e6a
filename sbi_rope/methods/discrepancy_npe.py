r"""NPE trained on corrected simulations, as learned from calibration pairs."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
from torch import Tensor

from sbi_rope.data.simulate import moments
from sbi_rope.discrepancy.correction import correct_flow, fit_version, network_of
from sbi_rope.discrepancy.model import DiscrepancyModel
from sbi_rope.discrepancy.posterior import Discrepancy
from sbi_rope.discrepancy.report import DiscrepancyReport, report_discrepancy
from sbi_rope.methods.base import Method
from sbi_rope.methods.training import EstimatorBuilder
from sbi_rope.npe.sbi import embed, embedding_of, estimator_of, posterior_from
from sbi_rope.npe.standardisation import warn_of_far_entries
from sbi_rope.training.fit import History
from sbi_rope.utils.errors import InvalidInputError, NotReadyError
from sbi_rope.utils.progress import is_shown
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import Count, Range, check
from sbi_rope.utils.tensors import as_batch

Corrected = Literal["embedding", "input"]
SIMULATIONS_PER_PAIR = 100


class DiscrepancyNPE(Method):
    r"""NPE for real observations, with the discrepancy of the simulator integrated out.

    A Bayesian linear model of how real observations follow from simulations
    (``DiscrepancyModel``) is fitted to the calibration pairs. Simulations are then
    corrected by draws from its posterior, and NPE is trained on them for some more
    seconds. The result is an ordinary amortised posterior for any observation.

    What is corrected depends on ``space``:

    - ``"embedding"``: the embedding h(x) of NPE. Only the density behind h is trained.
    - ``"input"``: x itself, a vector of a few summaries, none of which is missing. All
      of NPE is trained. This is better if h discards information that is needed when
      the simulator is wrong.

    One linear correction has to hold for all parameters. A handful of pairs is enough;
    ``docs/background/discrepancy.md`` says when it fails. FMPE and NPSE posteriors can
    be corrected too.

    Args:
        prior, density_estimator, npe_training, simulator, device: See ``Method``.
        space: What is corrected, see above.
        learn_prior: Whether to learn the distribution of real parameters from those of
            the pairs, see :func:`~sbi_rope.discrepancy.learn_parameters`. Pass False
            unless the pairs are drawn like the observations to be inferred.
        model: The model of the discrepancy; ``DiscrepancyModel()`` if None.
        num_simulations: Simulations from the prior to train on, if none were appended.
        num_steps: Gradient steps. If None, NPE is trained in at most twelve courses of
            250 steps (400 with ``"input"``), until one gains less than 0.01 nats.
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
        space: Corrected = "embedding",
        learn_prior: bool = True,
        model: DiscrepancyModel | None = None,
        num_simulations: int = 20_000,
        num_steps: int | None = None,
        **options: Any,
    ) -> None:
        check("space", space, Corrected)
        check("model", model, DiscrepancyModel | None)
        check("num_simulations", num_simulations, Annotated[int, Range(2)])
        check("num_steps", num_steps, Count | None)
        super().__init__(prior, density_estimator, **options)
        self.space: Corrected = space
        self.learn_prior = learn_prior
        self.model = DiscrepancyModel() if model is None else model
        self.num_simulations, self.num_steps = num_simulations, num_steps
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

        The method need not be trained. The report is about x itself, whatever
        ``space`` is.

        Args:
            summaries: A function from observations ``(n, *event)`` to a few summaries
                of each, ``(n, k)``, such as the means of parts of an image. It may
                return a NumPy array. If None, they are the entries of a vector x.
            x_names: Names of the summaries; numbered if None.
            seed: As in ``train``.
            show_progress_bars: As in ``train``.
        """
        self._check_data()
        pairs, show = self._data.pairs, is_shown(show_progress_bars)
        if pairs.x.ndim != 2 and summaries is None:
            raise InvalidInputError(
                f"Expected observations of shape (n, l); got {tuple(pairs.x.shape)}. "
                "Pass `summaries=`, a function from x to shape (n, k)."
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
            _, x_s = source.from_prior(self.num_simulations, seed=0, progress=show)
            report = report_discrepancy(
                as_batch("summaries of the pairs", summarised(pairs.x)),
                moments(source, pairs, SIMULATIONS_PER_PAIR, summarised, progress=show),
                as_batch("summaries of simulations", summarised(x_s)),
                model=self.model,
                groups=pairs.group,
            )
        return report if x_names is None else report.renamed(x_names)

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        show, pairs = show_progress_bars, self._data.pairs
        npe, _ = self._trained_npe(show_progress_bars=show)
        estimator, source = estimator_of(npe), self._source()
        warn_of_far_entries("x", pairs.x, embedding_of(estimator))
        h = partial(embed, network_of(estimator, self.space))
        found = moments(source, pairs, SIMULATIONS_PER_PAIR, h, progress=show)
        theta_s, x_s = self._data.simulations or source.from_prior(
            self.num_simulations, seed=0, progress=show
        )
        simulations = theta_s, as_batch("x of simulations", h(x_s))
        z, learn_prior = as_batch("x", h(pairs.x)), self.learn_prior
        version = fit_version(
            pairs, z, found, simulations, self.model, learn_prior=learn_prior
        )
        self._discrepancy, _ = version
        flow, _, [history] = correct_flow(
            estimator,
            simulations,
            [version],
            space=self.space,
            num_steps=self.num_steps,
            show_progress_bars=show,
        )
        return posterior_from(npe, flow.estimator(estimator)), history
