"""RoPE's optimal transport without its fine-tuned embedding."""

from collections.abc import Callable
from typing import Any

import torch

from sbi_rope.coupling import SinkhornCoupler
from sbi_rope.density import MixturePosterior
from sbi_rope.errors import NotReadyError
from sbi_rope.fit import Training
from sbi_rope.rope import RoPE
from sbi_rope.settings import Count, check
from sbi_rope.trainers.base import Method
from sbi_rope.trainers.starting_npe import StartingNPE
from sbi_rope.trainers.training import EstimatorBuilder

__all__ = ["OTOnly"]


class OTOnly(Method):
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
        prior: A torch distribution over parameters of shape ``(d,)``.
        density_estimator: A name, or what sbi's ``posterior_nn(...)`` returns. An
            embedding net inside it is copied, never trained in place.
        simulator: Maps parameters to simulations, batched or not. Without one, the
            appended simulations are coupled with.
        coupler: Settings of the transport; ``SinkhornCoupler()`` if None.
        num_simulations: n_s; as many as there are observations, at least 1000, if None.
        npe_training: How NPE is trained; ``Training()`` if None.
        device: Where to train; data on other devices is moved there.

    Raises:
        InvalidInputError: If sbi knows no such estimator, or a setting is out of range.
        CouplingError: In ``train``, if the transport has not converged.
    """

    sees = frozenset({"simulations", "observations"})
    starts_from_npe = True
    simulates = True

    def __init__(
        self,
        prior: Any,
        density_estimator: str | EstimatorBuilder = "nsf",
        *,
        simulator: Callable[[Any], Any] | None = None,
        coupler: SinkhornCoupler | None = None,
        num_simulations: int | None = None,
        npe_training: Training | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        check("coupler", coupler, SinkhornCoupler | None)
        check("num_simulations", num_simulations, Count | None)
        npe = StartingNPE(density_estimator, npe_training)
        super().__init__(prior, npe=npe, simulator=simulator, device=device)
        self.coupler = coupler
        self.num_simulations = num_simulations

    def build_rope(self) -> RoPE:
        """Return RoPE without calibration pairs, to couple at many settings.

        The appended observations and ``coupler.gamma`` play no part in it.

        Raises:
            NotReadyError: If it does not start from a trained posterior, or needs
                simulations that were not appended.
        """
        if not self._has_npe:
            raise NotReadyError(
                "OTOnly has no trained NPE to couple with. Start it from one with "
                "`OTOnly.from_posterior(posterior)`."
            )
        if self.needs_simulations:
            self._check_data("simulations")
        npe, _ = self._trained_npe(show_progress_bars=False)
        return self._rope_of(npe)

    def _rope_of(self, npe: Any) -> RoPE:
        return RoPE(
            npe,
            simulator=self._simulator,
            simulations=self._looked_up,
            coupler=self.coupler,
        )

    def _fit(self, *, show_progress_bars: bool) -> tuple[MixturePosterior, Any]:
        npe, history = self._trained_npe(show_progress_bars=show_progress_bars)
        posterior = self._rope_of(npe).build_posterior(
            self._data.observations,
            num_simulations=self.num_simulations,
            show_progress_bars=show_progress_bars,
        )
        return posterior, history
