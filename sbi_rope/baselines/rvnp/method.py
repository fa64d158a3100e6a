r"""Robust variational neural posterior estimation (RVNP)."""

import copy
from typing import Annotated, Any, Literal

import torch
from torch import Tensor

from sbi_rope._random import seeded
from sbi_rope._sbi import (
    embed,
    estimator_of,
    posterior_from,
)
from sbi_rope.baselines.rvnp.bound import Bound
from sbi_rope.baselines.rvnp.likelihood import ErrorModel, fit_surrogate
from sbi_rope.baselines.statistics import (
    NoiseOn,
    SoftClip,
    split_at_statistics,
    standardisation_of_statistics,
    with_clip,
)
from sbi_rope.data import split_pairs
from sbi_rope.fit import History, Training, fit, shuffled
from sbi_rope.settings import NotNegative, Range, check
from sbi_rope.tensors import as_batch
from sbi_rope.trainers.base import Method
from sbi_rope.trainers.starting_npe import StartingNPE
from sbi_rope.trainers.training import EstimatorBuilder

__all__ = ["RVNP"]

DEFAULT_TRAINING = Training(
    training_batch_size=50,
    learning_rate=1e-3,
    stop_after_epochs=20,
    max_num_epochs=200,
    clip_max_norm=10.0,
)


class RVNP(Method):
    r"""NPE trained on real observations, with an error model that is learned from them.

    .. math::
        p(y \mid \theta) = \int p(s \mid \theta)\, \mathcal{N}\bigl(y;\, s + \mu
        + \mu(\theta),\, L(\theta) L(\theta)^\top\bigr)\, ds, \qquad
        L(\theta) = \Lambda + \operatorname{diag} \sigma(\theta)

    is the density of a real statistic y whose simulation is s, in units of the standard
    deviation over the simulations. As published, there is no offset :math:`\mu +
    \mu(\theta)`; with ``shift=True`` there is one. The density of s is learned from
    simulations. The errors are learned without labels, by maximising over all
    observations the importance-weighted bound on their evidence

    .. math::
        \log \tfrac1K \sum_k v_k - \lambda\, \mathbb{E} \lVert \mu(\theta) \rVert^2,
        \qquad v_k = \frac{p(y \mid \theta_k)\, p(\theta_k)}{r(\theta_k)}, \qquad
        \theta_k \sim r = \tfrac34\, q(\theta \mid y) + \tfrac14\, p(\theta),

    while the posterior q follows the weighted draws, by minimising
    :math:`-\sum_k w_k \log q(\theta_k \mid y)` with :math:`w_k = v_k / \sum_j v_j`.
    It starts as NPE.

    Sees simulations and observations without labels. It assumes that the parameters of
    the observations follow the prior: an error is seen only by what it does to the
    distribution of all observations, and errors that leave this distribution as it is,
    such as an offset that a shift of all parameters would explain as well, are not
    found. It also assumes Gaussian errors, and at least some tens of observations.

    Where this differs from the original code:

    - The density of simulated statistics is a mixture of Gaussians, so that the
      integral over s is exact. There it is a flow, and the integral an average over 32
      of its draws, which cannot resolve errors that are smaller than the noise of the
      simulator.
    - q follows the weighted draws (reweighted wake-sleep, Bornschein and Bengio, 2015)
      instead of the gradient of the bound with respect to each draw. Both have the
      posterior under the error model as their optimum. This one needs neither a flow
      that can be differentiated through its draws nor a prior with soft edges. A
      quarter of the draws come from the prior, so that no observation is without a draw
      inside it.
    - The prior is inside the average over draws, as in the equations of the authors.
      Their code adds its mean instead.
    - q starts as NPE instead of untrained, and sees statistics beyond three standard
      deviations on a logarithmic scale.
    - A tenth of the observations are held out, and the epoch with the best bound on
      these is kept. Of fewer than five observations none is held out.
    - In the code the penalty is on the spread of the errors, too, and off in most of
      the experiments. Its weight here is that of the authors' documentation.
    - Statistics are the embedding of NPE, instead of one that is trained to maximise
      its mutual information with the parameters.

    The paper has two error models, the default here and RVNP-G, which is
    ``depends_on_theta=False``. The offset, ``shift=True``, is part of what the code
    calls its primary method. Whatever its penalty, an offset can be taken for other
    parameters, so that it helps only where the prior tells the two apart.

    References:
        | Robust Variational Neural Posterior Estimation for Simulation-Based Inference
          (O'Callaghan et al., 2025)
        | https://arxiv.org/abs/2509.05724

    Args:
        prior: A torch distribution over parameters of shape ``(d,)``.
        density_estimator: A name, or what sbi's ``posterior_nn(...)`` returns. An
            embedding net inside it is copied, never trained in place.
        noise_on: What the statistics are: the ``"embedding"`` of NPE, which is kept as
            it is, or the ``"input"``, whose shape must be ``(l,)`` then.
        shift: Whether errors have an offset, :math:`\mu + \mu(\theta)`.
        depends_on_theta: Whether :math:`\mu(\theta)` and :math:`\sigma(\theta)` are
            networks; otherwise :math:`\mu(\theta)` is zero and :math:`\sigma` constant.
        shrinkage: :math:`\lambda`, of no effect without an offset.
        num_draws: K, two or more.
        npe_training: How NPE is trained; ``Training()`` if None.
        surrogate_training: How :math:`p(s \mid \theta)` is trained; ``Training()`` if
            None.
        training: How errors and posterior are trained, in batches of observations; at
            most 200 epochs in batches of 50 if None.
        device: Where to train; data on other devices is moved there.

    Raises:
        InvalidInputError: If sbi knows no estimator of that name, an option is outside
            its range, or, in ``train``, no statistic varies or one is missing (NaN).
        UnsupportedPosteriorError: In ``train``, if the estimator has no density.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> prior = BoxUniform(torch.zeros(1), torch.ones(1))
        >>> theta, theta_o = prior.sample((200,)), prior.sample((30,))
        >>> once = Training(max_num_epochs=1)
        >>> method = RVNP(
        ...     prior, "mdn", npe_training=once, surrogate_training=once, training=once
        ... )
        >>> method = method.append_simulations(theta, theta)
        >>> method = method.append_observations(theta_o + 0.3)
        >>> posterior = method.train(seed=0, show_progress_bars=False).build_posterior()
        >>> posterior.sample((5,), x=torch.ones(1), show_progress_bars=False).shape
        torch.Size([5, 1])
    """

    sees = frozenset({"simulations", "observations"})
    starts_from_npe = True
    trains_on_statistics = True

    def __init__(
        self,
        prior: Any,
        density_estimator: str | EstimatorBuilder = "nsf",
        *,
        noise_on: NoiseOn = "embedding",
        shift: bool = False,
        depends_on_theta: bool = True,
        shrinkage: float = 0.1,
        num_draws: int = 32,
        npe_training: Training | None = None,
        surrogate_training: Training | None = None,
        training: Training | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        check("noise_on", noise_on, Literal["embedding", "input"])
        check("shift", shift, bool)
        check("depends_on_theta", depends_on_theta, bool)
        check("shrinkage", shrinkage, NotNegative)
        check("num_draws", num_draws, Annotated[int, Range(2)])
        check("surrogate_training", surrogate_training, Training | None)
        check("training", training, Training | None)
        npe = StartingNPE(density_estimator, npe_training)
        super().__init__(prior, npe=npe, device=device)
        self.noise_on: NoiseOn = noise_on
        self.shift = shift
        self.depends_on_theta = depends_on_theta
        self.shrinkage = shrinkage
        self.num_draws = num_draws
        self.surrogate_training = (
            Training() if surrogate_training is None else surrogate_training
        )
        self.training = DEFAULT_TRAINING if training is None else training

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        npe, _ = self._trained_npe(show_progress_bars=show_progress_bars)
        estimator = copy.deepcopy(estimator_of(npe)).requires_grad_()
        net, _ = split_at_statistics(estimator, self.noise_on)
        theta, x = self._data.simulations
        simulated, observed = embed(net, x), embed(net, self._data.observations)
        standardise = standardisation_of_statistics(simulated)
        observed = as_batch("statistics of x_o", observed)
        clip = SoftClip(simulated)
        density, estimator = with_clip(estimator, clip, self.noise_on)
        s = standardise(simulated)
        surrogate = fit_surrogate(
            theta,
            s,
            training=self.surrogate_training,
            show_progress_bars=show_progress_bars,
        )
        errors = ErrorModel(
            theta,
            s.shape[1],
            shift=self.shift,
            depends_on_theta=self.depends_on_theta,
        )
        bound = Bound(density, errors, surrogate, self._prior, self.num_draws)
        history = self._train(
            bound,
            observed,
            standardise(observed),
            show_progress_bars=show_progress_bars,
        )
        return posterior_from(npe, estimator.eval()), history

    def _train(
        self, bound: Bound, statistics: Tensor, y: Tensor, *, show_progress_bars: bool
    ) -> History:
        size = self.training.training_batch_size
        train, held_out = split_pairs(
            torch.arange(len(y)), self.training.validation_fraction
        )
        scored = held_out if len(held_out) else train

        def batches(epoch: int) -> Any:
            return zip(shuffled(train, size), strict=True)

        def loss(rows: Tensor) -> Tensor:
            terms = bound(statistics[rows], y[rows])
            mean = (terms.cross_entropy - terms.log_evidence).mean()
            return mean + self.shrinkage * terms.squared_shift

        def validation_loss() -> Tensor:
            # The same random numbers for all epochs, so that they can be compared.
            with seeded(0):
                evidence = [
                    bound(statistics[rows], y[rows]).log_evidence
                    for rows in scored.split(size)
                ]
            return -torch.cat(evidence).mean()

        [history] = fit(
            bound,
            batches,
            loss,
            self.training,
            validation_loss=validation_loss,
            in_training_mode=False,
            label="RVNP",
            show_progress_bars=show_progress_bars,
        )
        return history
