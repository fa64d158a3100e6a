"""The prior in the place of a posterior."""

from sbi_rope.density import PriorPosterior
from sbi_rope.trainers.base import Method

__all__ = ["PriorBaseline"]


class PriorBaseline(Method):
    """The prior in the place of a posterior: a method that sees no data at all.

    Assumes that the prior is right, then it is calibrated. Whatever has a lower log
    posterior probability has learnt less than nothing.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
        | Calibration (Wehenkel et al., 2025), section 4, Baselines
        | https://arxiv.org/abs/2405.08719

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``.
        device: Where the prior lives.

    Raises:
        InvalidInputError: If the prior is not a torch distribution.

    Example:
        >>> import torch
        >>> from sbi.utils import BoxUniform
        >>> method = PriorBaseline(BoxUniform(torch.zeros(2), torch.ones(2)))
        >>> method.train().build_posterior().log_prob(torch.zeros(1, 2))
        tensor([0.])
    """

    sees = frozenset()

    def _fit(self, *, show_progress_bars: bool) -> tuple[PriorPosterior, None]:
        return PriorPosterior(self._prior), None
