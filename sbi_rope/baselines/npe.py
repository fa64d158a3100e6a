"""The prior, NPE as it is, and NPE where its simulator is right.

The first and the last are baselines of Addressing Misspecification in Simulation-based
Inference through Data-driven Calibration (Wehenkel et al., 2025), section 4,
https://arxiv.org/abs/2405.08719.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from sbi_rope.data.simulate import Simulated
from sbi_rope.density import PriorPosterior
from sbi_rope.methods.base import Method
from sbi_rope.training.fit import History
from sbi_rope.utils.seeds import seeded


class PriorBaseline(Method):
    """The prior in the place of a posterior: a method that sees no data at all.

    Assumes that the prior is right, then it is calibrated. Whatever has a lower log
    posterior probability has learnt less than nothing.

    Args:
        prior, device: See :class:`~sbi_rope.methods.Method`.
    """

    sees = frozenset()

    def _fit(self, *, show_progress_bars: bool) -> tuple[PriorPosterior, None]:
        return PriorPosterior(self._prior), None


class PlainNPE(Method):
    r"""Neural posterior estimation, trained on simulations and trusted on real data.

    .. math::
        \min_q\; \mathbb{E}_{p(\theta)\, p(x_s \mid \theta)}
        \bigl[-\log q(\theta \mid h(x_s))\bigr]

    It sees simulations, and assumes that the simulator is right: nothing else here is
    as sharp then, and none is as wrong if it is not.

    References:
        | Automatic Posterior Transformation for Likelihood-free Inference
          (Greenberg et al., 2019)
        | https://arxiv.org/abs/1905.07488

    Args:
        prior, density_estimator, npe_training, device: See
            :class:`~sbi_rope.methods.Method`.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> from sbi_rope.methods import Training
        >>> prior = BoxUniform(torch.zeros(1), torch.ones(1))
        >>> theta = prior.sample((200,))
        >>> method = PlainNPE(prior, "mdn", npe_training=Training(max_num_epochs=1))
        >>> method = method.append_simulations(theta, theta + 0.1)
        >>> posterior = method.train(show_progress_bars=False).build_posterior()
        >>> posterior.sample((5,), x=torch.ones(1), show_progress_bars=False).shape
        torch.Size([5, 1])
    """

    sees = frozenset({"simulations"})
    starts_from_npe = True

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History | None]:
        return self._trained_npe(show_progress_bars=show_progress_bars)


class ReferenceNPE(PlainNPE):
    """NPE on simulations in the place of real observations: the reference, "SBI".

    Not a method for real data, but what inference would give if the simulator were
    right: the posterior is that of :class:`PlainNPE`, and is scored on fresh
    simulations of the test parameters, :meth:`simulated_test_set`. Training sees no
    labels; the test parameters are only simulated from, after the training.
    """

    def simulated_test_set(
        self, theta: Tensor, simulator: Callable[[Any], Any], *, seed: int | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return test parameters ``(n, d)``, each with one simulation.

        Simulations that are not finite are left out. The simulator may be batched or
        not; with a seed of None it uses the present random state.
        """
        theta = self._read_theta(theta)
        like = theta.new_empty(0, *self._event_shape or ())
        with seeded(seed):
            x, _ = Simulated(simulator, self._prior, like=like).simulate(theta)
        valid = torch.isfinite(x).flatten(1).all(dim=1)
        return theta[valid], x[valid]
