"""NPE with a penalty on embeddings that tell real observations from simulations."""

from typing import Any

import torch
from torch import Tensor

from sbi_rope.methods.base import Method
from sbi_rope.methods.training import (
    EstimatorBuilder,
    SimulationTrainer,
    train_on_simulations,
)
from sbi_rope.npe.sbi import direct_posterior, embedding_of
from sbi_rope.training.fit import History, Training
from sbi_rope.utils.errors import warn_user
from sbi_rope.utils.settings import NotNegative, check

# Simulations, and observations, behind the discrepancy of each step, at most.
NUM_ROWS = 200


def squared_mmd(simulated: Tensor, observed: Tensor) -> Tensor:
    r"""Return the squared maximum mean discrepancy between two sets of embeddings.

    .. math::
        \widehat{\mathrm{MMD}}^2 = \frac1{m^2} \sum_{i,j} k(s_i, s_j)
        + \frac1{n^2} \sum_{i,j} k(o_i, o_j) - \frac2{m n} \sum_{i,j} k(s_i, o_j),
        \qquad k(a, b) = \exp\Bigl(-\frac{\lVert a - b \rVert^2}
        {\operatorname{median}_{ij} \lVert s_i - s_j \rVert^2}\Bigr)

    The embeddings are ``(m, l)`` and ``(n, l)``. This is the biased estimate, never
    negative: pairs of an embedding with itself are counted, in the median too.
    Gradients pass through the median.

    References:
        | A Kernel Two-Sample Test (Gretton et al., 2012), eq. 5
        | https://jmlr.org/papers/v13/gretton12a.html
    """
    within_simulated = _squared_distances(simulated, simulated)
    across = _squared_distances(simulated, observed)
    # Embeddings that have all become equal have no scale of their own, and dividing by
    # their median would leave NaN, in the gradient before the value.
    rounding = torch.finfo(across.dtype)
    smallest = rounding.eps * across.detach().max() + rounding.tiny
    scale = torch.maximum(within_simulated.median(), smallest)

    def mean_kernel(squared_distances: Tensor) -> Tensor:
        return torch.exp(-squared_distances / scale).mean()

    within_observed = _squared_distances(observed, observed)
    within = mean_kernel(within_simulated) + mean_kernel(within_observed)
    return within - 2 * mean_kernel(across)


def _squared_distances(a: Tensor, b: Tensor) -> Tensor:
    # Not through matrix products, which leave embeddings at a distance of themselves.
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist").square()


class NPERS(Method):
    r"""NPE with robust statistics: the embedding may not tell real from simulated.

    .. math::
        \min_{q, h}\; \mathbb{E}_{p(\theta, x_s)}\bigl[-\log q(\theta \mid h(x_s))\bigr]
        + \beta \, \mathrm{MMD}^2\bigl(\{h(x_s)\}, \{h(x_o)\}\bigr)

    with the discrepancy ``squared_mmd``. Each gradient step draws anew, without
    replacement, 200 of all simulations and 200 of all observations for it, and embeds
    them in evaluation mode: batch statistics are those of the simulations. The first
    term alone, on held-out simulations, decides when to stop and which network to keep.

    It sees simulations and the observations to be inferred, no labels. It assumes that
    the prior is right, and that some statistics of x are informative and not
    misspecified. Where every informative statistic is wrong, the posterior is sharp
    around the wrong value. Without an embedding net that can be trained, the method is
    NPE, and warns.

    References:
        | Learning Robust Statistics for Simulation-based Inference under Model
          Misspecification (Huang et al., 2023)
        | https://arxiv.org/abs/2305.15871

    Args:
        prior, density_estimator, device: See
            :class:`~sbi_rope.methods.Method`. The estimator should have an
            embedding net.
        regularisation: The weight :math:`\beta`; at 0 the method is NPE.
        training: How it is trained; ``Training()`` if None.
    """

    sees = frozenset({"simulations", "observations"})
    default_training = Training()

    def __init__(
        self,
        prior: Any,
        density_estimator: str | EstimatorBuilder = "nsf",
        *,
        regularisation: float = 1.0,
        **options: Any,
    ) -> None:
        check("regularisation", regularisation, NotNegative)
        super().__init__(prior, density_estimator, **options)
        self.regularisation = regularisation

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        theta, x = self._data.simulations
        penalty = self._penalty

        class Trainer(SimulationTrainer):
            def _loss(self, *args: Any, **kwargs: Any) -> Tensor:
                net: Any = self._neural_net
                added = penalty(net, x) if net.training else 0.0
                return super()._loss(*args, **kwargs) + added

        estimator, history = train_on_simulations(
            self._prior,
            self._build,
            theta,
            x,
            training=self.training,
            show_progress_bars=show_progress_bars,
            trainer=Trainer,
        )
        if self.regularisation and not _has_trainable_embedding(estimator):
            warn_user(
                "NPE-RS has nothing to regularise, because the density estimator has "
                "no embedding net that can be trained: what was trained is NPE. Pass "
                "`posterior_nn(..., embedding_net=net)` as `density_estimator`."
            )
        return direct_posterior(estimator, self._prior), history

    def _penalty(self, estimator: Any, x: Tensor) -> Tensor | float:
        r"""Return :math:`\beta \mathrm{MMD}^2`; zero if nothing depends on it."""
        if not self.regularisation or not _has_trainable_embedding(estimator):
            return 0.0
        embedding = embedding_of(estimator)
        # Batch normalisation would centre each of the two sets, and dropout is noise.
        embedding.eval()
        simulated, observed = (
            embedding(rows[torch.randperm(len(rows))[:NUM_ROWS]]).flatten(1)
            for rows in (x, self._data.observations[0])
        )
        embedding.train()
        return self.regularisation * squared_mmd(simulated, observed)


def _has_trainable_embedding(estimator: Any) -> bool:
    return any(p.requires_grad for p in embedding_of(estimator).parameters())
