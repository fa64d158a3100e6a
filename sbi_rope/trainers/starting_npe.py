"""The NPE that a method starts from."""

import copy
from typing import Any

from torch.distributions import Distribution

from sbi_rope._sbi import (
    direct_posterior,
    estimator_of,
    posterior_from,
)
from sbi_rope.fit import History, Training
from sbi_rope.settings import check
from sbi_rope.trainers.data import Data
from sbi_rope.trainers.training import (
    EstimatorBuilder,
    estimator_builder,
    train_on_simulations,
)

__all__ = ["StartingNPE"]


class StartingNPE:
    """The NPE that a method starts from, trained on its simulations or beforehand.

    Args:
        density_estimator: A name, or what sbi's ``posterior_nn(...)`` returns. An
            embedding net inside it is copied, never trained in place.
        training: How NPE is trained; ``Training()`` if None.

    Raises:
        InvalidInputError: If sbi knows no estimator of that name.
    """

    def __init__(
        self, density_estimator: str | EstimatorBuilder, training: Training | None
    ) -> None:
        check("npe_training", training, Training | None)
        self._build = estimator_builder(density_estimator)
        self._training = Training() if training is None else training
        self._given: Any = None

    @property
    def is_given(self) -> bool:
        """Whether it was trained beforehand, and needs no simulations."""
        return self._given is not None

    def replace_by(self, posterior: Any) -> None:
        """Take a copy of a trained posterior of sbi instead of training one."""
        estimator = copy.deepcopy(estimator_of(posterior))
        self._given = posterior_from(posterior, estimator)

    def posterior(
        self, prior: Distribution, data: Data, *, show_progress_bars: bool
    ) -> tuple[Any, History | None]:
        """Return the posterior of NPE, and its losses if it is trained now."""
        if self._given is not None:
            return self._given, None
        theta, x = data.simulations
        estimator, history = train_on_simulations(
            prior,
            self._build,
            theta,
            x,
            training=self._training,
            show_progress_bars=show_progress_bars,
        )
        return direct_posterior(estimator, prior), history
