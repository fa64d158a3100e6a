"""RoPE's optimal transport without its fine-tuned embedding."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from sbi_rope._validation import check_instance, check_integer
from sbi_rope.baselines.base import UsesObservations
from sbi_rope.baselines.stage import StageOfRoPE
from sbi_rope.baselines.training import EstimatorBuilder, Training
from sbi_rope.coupling import SinkhornCoupler
from sbi_rope.mixture import MixturePosterior

__all__ = ["OTOnly"]


class OTOnly(StageOfRoPE, UsesObservations):
    r"""Transport between :math:`h(x_o)` and :math:`h(x_s)`: RoPE without calibration.

    Step 3 of RoPE without step 2, g = h.

    Sees simulations and the observations to be inferred, no labels. Assumes that the
    prior is right and that h orders real observations as it orders simulations. To be
    preferred without any labels, and where the misspecification is mild.

    The posterior answers for the appended observations only.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
          Calibration (Wehenkel et al., 2025), section 4, Baselines
        | https://arxiv.org/abs/2405.08719

    Args:
        prior: A torch distribution over parameters of shape ``(k,)``.
        density_estimator: A name, or what sbi's ``posterior_nn(...)`` returns. An
            embedding net inside it is copied, never trained in place.
        simulator: Maps parameters to simulations, batched or not. Without one, the
            appended simulations are coupled with.
        coupler: Settings of the transport; ``SinkhornCoupler()`` if None.
        num_simulations: n_s; as many as there are observations, at least 1000, if None.
        npe_training: How NPE is trained; ``Training()`` if None.
        device: Where to train; data on other devices is moved there.

    Raises:
        InvalidTypeError: If an argument has the wrong type.
        InvalidInputError: If sbi knows no estimator of that name.
        CouplingError: In ``train``, if the transport has not converged.
    """

    def __init__(
        self,
        prior: Any,
        density_estimator: str | EstimatorBuilder = "nsf",
        *,
        simulator: Callable[[Tensor], Tensor] | None = None,
        coupler: SinkhornCoupler | None = None,
        num_simulations: int | None = None,
        npe_training: Training | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        check_instance("coupler", coupler, SinkhornCoupler, optional=True)
        if num_simulations is not None:
            check_integer("num_simulations", num_simulations)
        super().__init__(
            prior,
            density_estimator,
            simulator=simulator,
            npe_training=npe_training,
            device=device,
        )
        self.coupler = coupler
        self.num_simulations = num_simulations

    def _fit(self, *, show_progress_bars: bool) -> tuple[MixturePosterior, Any]:
        rope, history = self._rope(
            coupler=self.coupler, show_progress_bars=show_progress_bars
        )
        posterior = rope.build_posterior(
            self._observations,
            num_simulations=self.num_simulations,
            show_progress_bars=show_progress_bars,
        )
        return posterior, history
