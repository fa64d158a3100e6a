"""What the single stages of RoPE have in common."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from sbi_rope._training import History
from sbi_rope.baselines.base import BuildsOnNPE
from sbi_rope.baselines.training import EstimatorBuilder, Training
from sbi_rope.rope import RoPE

__all__ = ["StageOfRoPE"]


class StageOfRoPE(BuildsOnNPE):
    """A method that is one of RoPE's stages, run by :class:`~sbi_rope.RoPE` itself.

    Args:
        prior: A torch distribution over parameters of shape ``(k,)``.
        density_estimator: A name, or what sbi's ``posterior_nn(...)`` returns. An
            embedding net inside it is copied, never trained in place.
        simulator: Maps parameters to simulations, batched or not. Without one, the
            appended simulations take its place.
        npe_training: How NPE is trained; ``Training()`` if None.
        device: Where to train; data on other devices is moved there.
    """

    def __init__(
        self,
        prior: Any,
        density_estimator: str | EstimatorBuilder = "nsf",
        *,
        simulator: Callable[[Tensor], Tensor] | None = None,
        npe_training: Training | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        super().__init__(
            prior, density_estimator, npe_training=npe_training, device=device
        )
        self._simulator = simulator

    @property
    def needs_simulations(self) -> bool:
        """Whether there is something to train or to look up on simulations."""
        return self._npe is None or self._simulator is None

    def _rope(
        self, *, show_progress_bars: bool, **options: Any
    ) -> tuple[RoPE, History | None]:
        """Return RoPE around the trained NPE, and how that was trained."""
        npe, history = self._trained_npe(show_progress_bars=show_progress_bars)
        stored = None if self._simulator is not None else self._simulations
        rope = RoPE(npe, simulator=self._simulator, simulations=stored, **options)
        return rope, history
