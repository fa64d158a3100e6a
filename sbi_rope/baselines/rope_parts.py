"""RoPE's two parts: fine-tuning without transport, and transport without fine-tuning.

Both are ablations of Addressing Misspecification in Simulation-based Inference through
Data-driven Calibration (Wehenkel et al., 2025), section 4, Baselines,
https://arxiv.org/abs/2405.08719.
"""

from typing import Any

from sbi_rope.coupling import SinkhornCoupler
from sbi_rope.density import MixturePosterior
from sbi_rope.methods.base import Method
from sbi_rope.methods.training import EstimatorBuilder
from sbi_rope.rope.finetuning import CalibrationFinetuner
from sbi_rope.rope.rope import RoPE
from sbi_rope.training.fit import History


class TuningOnly(Method):
    r"""The flow on the tuned embedding, :math:`q(\theta \mid g(x_o))`.

    Step 2 of RoPE without step 3: :meth:`RoPE.tuned_posterior
    <sbi_rope.RoPE.tuned_posterior>`.

    It sees simulations and the calibration set, and simulates at the calibration
    parameters. It assumes that :math:`g(x_o)` lands on the embeddings of simulations;
    it is sharp, and nothing tempers it where they do not.

    Args:
        prior, density_estimator, npe_training, simulator, device: See
            :class:`~sbi_rope.methods.Method`.
        finetuner: Settings of the fine-tuning; ``CalibrationFinetuner()`` if None.
    """

    sees = frozenset({"simulations", "calibration"})
    starts_from_npe = True
    simulates = True

    def __init__(
        self,
        prior: Any,
        density_estimator: str | EstimatorBuilder = "nsf",
        *,
        finetuner: CalibrationFinetuner | None = None,
        **options: Any,
    ) -> None:
        super().__init__(prior, density_estimator, **options)
        self.finetuner = finetuner

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        npe, _ = self._trained_npe(show_progress_bars=show_progress_bars)
        rope = RoPE(
            npe,
            simulator=self._simulator,
            simulations=self._looked_up,
            finetuner=self.finetuner,
        )
        rope.append_calibration(*self._data.calibration)
        rope.train(show_progress_bars=show_progress_bars)
        return rope.tuned_posterior(), rope.history


class OTOnly(Method):
    r"""Transport between :math:`h(x_o)` and :math:`h(x_s)`: RoPE without calibration.

    Step 3 of RoPE without step 2, g = h. The posterior answers for the appended
    observations only.

    It sees simulations and the observations to be inferred, no labels. It assumes that
    the prior is right and that h orders real observations as it orders simulations.

    Args:
        prior, density_estimator, npe_training, simulator, device: See
            :class:`~sbi_rope.methods.Method`.
        coupler: Settings of the transport; ``SinkhornCoupler()`` if None.
        num_simulations: n_s; as many as there are observations, at least 1000, if None.
    """

    sees = frozenset({"simulations", "observations"})
    starts_from_npe = True
    simulates = True

    def __init__(
        self,
        prior: Any,
        density_estimator: str | EstimatorBuilder = "nsf",
        *,
        coupler: SinkhornCoupler | None = None,
        num_simulations: int | None = None,
        **options: Any,
    ) -> None:
        super().__init__(prior, density_estimator, **options)
        self.coupler = coupler
        self.num_simulations = num_simulations

    def _fit(self, *, show_progress_bars: bool) -> tuple[MixturePosterior, Any]:
        npe, history = self._trained_npe(show_progress_bars=show_progress_bars)
        rope = RoPE(
            npe,
            simulator=self._simulator,
            simulations=self._looked_up,
            coupler=self.coupler,
        )
        posterior = rope.build_posterior(
            self._data.observations[0],
            num_simulations=self.num_simulations,
            show_progress_bars=show_progress_bars,
        )
        return posterior, history
