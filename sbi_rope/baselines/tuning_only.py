"""RoPE's fine-tuned embedding without its optimal transport."""

from collections.abc import Callable
from typing import Any

import torch

from sbi_rope.finetuning import CalibrationFinetuner
from sbi_rope.fit import History, Training
from sbi_rope.rope import RoPE
from sbi_rope.settings import check
from sbi_rope.trainers.base import Method
from sbi_rope.trainers.starting_npe import StartingNPE
from sbi_rope.trainers.training import EstimatorBuilder

__all__ = ["TuningOnly"]


class TuningOnly(Method):
    r"""The flow on the tuned embedding, :math:`q(\theta \mid g(x_o))`.

    Step 2 of RoPE without step 3: :meth:`RoPE.tuned_posterior
    <sbi_rope.RoPE.tuned_posterior>`.

    Sees simulations and the calibration set, and simulates at the calibration
    parameters. Assumes that :math:`g(x_o)` lands on the embeddings of simulations.
    To be preferred where a few pairs suffice to tune the embedding; it is sharp and
    has nothing to temper it where they do not.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
          Calibration (Wehenkel et al., 2025), section 4, Baselines
        | https://arxiv.org/abs/2405.08719

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``.
        density_estimator: A name, or what sbi's ``posterior_nn(...)`` returns. An
            embedding net inside it is copied, never trained in place.
        simulator: Maps parameters to simulations, batched or not. Without one, the
            targets come from the appended simulations with the nearest parameters.
        finetuner: Settings of the fine-tuning; ``CalibrationFinetuner()`` if None.
        npe_training: How NPE is trained; ``Training()`` if None.
        device: Where to train; data on other devices is moved there.

    Raises:
        InvalidInputError: If sbi knows no such estimator, or a setting is out of range.
    """

    sees = frozenset({"simulations", "calibration"})
    starts_from_npe = True
    simulates = True

    def __init__(
        self,
        prior: Any,
        density_estimator: str | EstimatorBuilder = "nsf",
        *,
        simulator: Callable[[Any], Any] | None = None,
        finetuner: CalibrationFinetuner | None = None,
        npe_training: Training | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        check("finetuner", finetuner, CalibrationFinetuner | None)
        npe = StartingNPE(density_estimator, npe_training)
        super().__init__(prior, npe=npe, simulator=simulator, device=device)
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
