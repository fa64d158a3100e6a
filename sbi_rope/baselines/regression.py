r"""Regression of parameters on real observations, without a simulator."""

from sbi_rope.density import GaussianProcess, MixturePosterior
from sbi_rope.methods.base import Method
from sbi_rope.utils.errors import InvalidInputError


class Regression(Method):
    r"""A Gaussian process from real observations to parameters, without simulations.

    Sees the calibration set alone, and assumes that parameters depend smoothly on the
    entries of x, or on its principal components if there are more than 20. Says what
    the labels are worth without a simulator: a method that uses one and does worse is
    not worth its simulations. See :class:`~sbi_rope.density.GaussianProcess`.

    References:
        | Gaussian Processes for Machine Learning (Rasmussen and Williams, 2006)
        | http://gaussianprocess.org/gpml, sections 2.2, 5.4.1 and 5.4.2

    Args:
        prior, device: See :class:`~sbi_rope.methods.Method`.

    Raises:
        InvalidInputError: In ``train``, if a parameter is the same in all pairs.
    """

    sees = frozenset({"calibration"})
    min_pairs = 2

    def _fit(self, *, show_progress_bars: bool) -> tuple[MixturePosterior, None]:
        pairs = self._data.pairs
        if bool((pairs.mean == pairs.mean[0]).all(dim=0).any()):
            raise InvalidInputError(
                "Expected calibration pairs that differ in each parameter; got one "
                "that is the same in all."
            )
        density = GaussianProcess(
            pairs.mean, pairs.x, weights=pairs.shared_weight, groups=pairs.group
        )
        return MixturePosterior(density, self._prior), None
