r"""Robust variational neural posterior estimation (RVNP)."""

from typing import Any

import torch
import torch.nn.functional as F
from sbi.neural_nets import likelihood_nn
from torch import Tensor, nn
from torch.distributions import (
    Categorical,
    Distribution,
    MixtureSameFamily,
    MultivariateNormal,
)

from sbi_rope.baselines.networks import fit_rows
from sbi_rope.baselines.statistics import (
    NoiseOn,
    clipped_statistics,
    fit_with_jitter,
    statistics_of,
)
from sbi_rope.data.pairs import split_pairs
from sbi_rope.methods.base import Method
from sbi_rope.methods.training import EstimatorBuilder
from sbi_rope.npe.sbi import posterior_from
from sbi_rope.npe.standardisation import Standardisation
from sbi_rope.training.fit import History, Training
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import check

# K, the share of the draws that come from the prior, and lambda.
NUM_DRAWS, SHARE_OF_PRIOR, SHRINKAGE = 32, 0.25, 0.1
# What sbi adds to the precision of each Gaussian that it mixes.
SMALLEST_PRECISION = 1e-4
# Units of each hidden layer, and Gaussians that the density of statistics mixes.
HIDDEN, NUM_COMPONENTS = 128, 5
# Standard deviations: of errors before training and at least, and of noise on s.
START, SMALLEST, JITTER = 0.5, 1e-3, 0.01


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

    with K = 32 and :math:`\lambda = 0.1`, while the posterior q, which starts as NPE,
    follows the weighted draws, by minimising :math:`-\sum_k w_k \log q(\theta_k \mid
    y)` with :math:`w_k = v_k / \sum_j v_j`.

    It sees simulations and observations without labels. It assumes that the parameters
    of the observations follow the prior: an error is seen only by what it does to the
    distribution of all observations. An error that leaves this distribution as it is,
    such as an offset that a shift of all parameters would explain as well, is not
    found. It also assumes Gaussian errors, and at least some tens of observations.

    References:
        | Robust Variational Neural Posterior Estimation for Simulation-Based Inference
          (O'Callaghan et al., 2025)
        | https://arxiv.org/abs/2509.05724

    Args:
        prior, density_estimator, npe_training, device: See
            :class:`~sbi_rope.methods.Method`.
        noise_on: What the statistics are: the ``"embedding"`` of NPE, which is kept as
            it is, or the ``"input"``, whose shape must be ``(l,)`` then.
        shift: Whether errors have an offset, :math:`\mu + \mu(\theta)`.
        depends_on_theta: Whether :math:`\mu(\theta)` and :math:`\sigma(\theta)` are
            networks; otherwise (RVNP-G) :math:`\mu(\theta)` is zero and
            :math:`\sigma` constant.
        surrogate_training: How :math:`p(s \mid \theta)` is trained; ``Training()`` if
            None.
        training: How errors and posterior are trained, in batches of observations; at
            most 200 epochs in batches of 50 if None.

    Raises:
        InvalidInputError: In ``train``, if no statistic varies or one is missing (NaN).
    """

    sees = frozenset({"simulations", "observations"})
    starts_from_npe = True
    trains_on_statistics = True
    default_training = Training(
        training_batch_size=50,
        learning_rate=1e-3,
        stop_after_epochs=20,
        max_num_epochs=200,
        clip_max_norm=10.0,
    )

    def __init__(
        self,
        prior: Any,
        density_estimator: str | EstimatorBuilder = "nsf",
        *,
        noise_on: NoiseOn = "embedding",
        shift: bool = False,
        depends_on_theta: bool = True,
        surrogate_training: Training | None = None,
        **options: Any,
    ) -> None:
        check("noise_on", noise_on, NoiseOn)
        super().__init__(prior, density_estimator, **options)
        self.noise_on: NoiseOn = noise_on
        self.shift = shift
        self.depends_on_theta = depends_on_theta
        self.surrogate_training = surrogate_training or Training()

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        npe, _ = self._trained_npe(show_progress_bars=show_progress_bars)
        theta, x = self._data.simulations
        net, _, density, estimator = clipped_statistics(npe, self.noise_on, x)
        simulated = statistics_of(net, x)
        observed = statistics_of(net, self._data.observations[0])
        standardise = Standardisation(simulated)
        s, y = standardise(simulated), standardise(observed)
        surrogate = fit_surrogate(
            theta,
            s,
            training=self.surrogate_training,
            show_progress_bars=show_progress_bars,
        )
        errors = ErrorModel(
            theta, s.shape[1], shift=self.shift, depends_on_theta=self.depends_on_theta
        )
        bound = Bound(density, errors, surrogate, self._prior)

        def loss(rows: Tensor) -> Tensor:
            evidence, cross_entropy, squared_shift = bound(observed[rows], y[rows])
            return (cross_entropy - evidence).mean() + SHRINKAGE * squared_shift

        size = self.training.training_batch_size
        train, held_out = split_pairs(
            torch.arange(len(y)), self.training.validation_fraction
        )

        def validation_loss(held_out: Tensor) -> Tensor:
            # The same random numbers for all epochs, so that they can be compared.
            with seeded(0):
                parts = [bound(observed[r], y[r])[0] for r in held_out.split(size)]
            return -torch.cat(parts).mean()

        history = fit_rows(
            bound,
            loss,
            (train, held_out if len(held_out) else train),
            self.training,
            validation_loss=validation_loss,
            in_training_mode=False,
            label="RVNP",
            show_progress_bars=show_progress_bars,
        )
        return posterior_from(npe, estimator.eval()), history


class Bound(nn.Module):
    r"""The bound on the evidence of real statistics, with weighted draws of theta.

    The mean of the logarithm is never above :math:`\log p(y)`. The density q and the
    error model are trained; ``num_draws`` is K.
    """

    def __init__(
        self,
        q: Any,
        errors: "ErrorModel",
        surrogate: Any,
        prior: Distribution,
        num_draws: int = NUM_DRAWS,
    ) -> None:
        super().__init__()
        self.q = q
        self.errors = errors
        self.surrogate = surrogate
        self.prior = prior
        self.num_of_prior = max(1, round(SHARE_OF_PRIOR * num_draws))
        self.num_of_q = num_draws - self.num_of_prior

    def forward(self, statistics: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        r"""Return bounds and what trains q and the shift.

        The statistics ``(n, *)`` are y if standardised. The bounds have the shape
        ``(n,)``, as has :math:`-\sum_k w_k \log q(\theta_k \mid y)`. The third is the
        mean of :math:`\lVert \mu(\theta) \rVert^2` over all draws.
        """
        with torch.no_grad():
            of_q = self.q.sample(torch.Size((self.num_of_q,)), statistics)
            shape = torch.Size((self.num_of_prior, len(statistics)))
            theta = torch.cat([of_q, self.prior.sample(shape).to(of_q)])
        log_q = self.q.log_prob(theta, statistics).double()
        log_prior = self.prior.log_prob(theta).double()
        log_lik, of_mean = log_likelihood(
            self.surrogate, self.errors, y.repeat(len(theta), 1), theta.flatten(0, 1)
        )
        shares = torch.tensor([self.num_of_q, self.num_of_prior]).to(log_q)
        # K times r. The draws are given, so that no gradient passes through it.
        log_r = torch.logaddexp(
            log_q.detach() + shares[0].log(), log_prior + shares[1].log()
        )
        log_v = log_lik.unflatten(0, theta.shape[:2]) + log_prior - log_r
        weights = log_v.detach().softmax(dim=0)
        cross_entropy = -(weights * log_q).sum(dim=0)
        squared_shift = of_mean.square().sum(dim=1).mean()
        return log_v.logsumexp(dim=0), cross_entropy, squared_shift


class ErrorModel(nn.Module):
    r"""By what a real statistic differs from a simulated one, given the parameters.

    It starts without an offset, with errors of half a standard deviation of the
    simulated statistics; :math:`\Lambda` is strictly lower triangular. Parameters of
    simulations tell the units of theta; ``size`` is the number l of statistics.
    """

    def __init__(
        self, theta: Tensor, size: int, *, shift: bool, depends_on_theta: bool
    ) -> None:
        super().__init__()
        self.size = size
        self.offset = nn.Parameter(torch.zeros(size), requires_grad=shift)
        start = torch.full((size,), START)
        self.scale = nn.Parameter(start.expm1().log())  # of which softplus is START
        self.below = nn.Parameter(torch.zeros(size, size))
        self.shift = shift
        self.net: nn.Module | None = None
        if depends_on_theta:
            unit, last = Standardisation(theta), nn.Linear(HIDDEN, 2 * size)
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)
            self.net = nn.Sequential(
                unit,
                nn.Linear(int(unit.varies.sum()), HIDDEN),
                nn.Tanh(),
                nn.Linear(HIDDEN, HIDDEN),
                nn.Tanh(),
                last,
            )
        self.to(theta)

    def forward(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        r"""Return mean, :math:`\mu(\theta)` and covariance of the errors.

        At parameters ``(n, d)`` these are ``(n, l)``, ``(n, l)`` and ``(n, l, l)``.
        """
        none = theta.new_zeros(len(theta), 2 * self.size)
        changes = none if self.net is None else self.net(theta)
        of_mean, of_scale = changes.chunk(2, dim=1)
        of_mean = of_mean if self.shift else torch.zeros_like(of_mean)
        scale = F.softplus(self.scale + of_scale) + SMALLEST
        factor = self.below.tril(diagonal=-1) + torch.diag_embed(scale)
        return self.offset + of_mean, of_mean, factor @ factor.mT


def fit_surrogate(
    theta: Tensor, s: Tensor, *, training: Training, show_progress_bars: bool
) -> Any:
    r"""Fit a mixture density network :math:`p(s \mid \theta)` to standardised s."""
    build = likelihood_nn("mdn", z_score_x="none", num_components=NUM_COMPONENTS)
    surrogate = build(theta.cpu(), s.cpu()).to(s.device)
    fit_with_jitter(
        surrogate,
        s,
        theta,
        jitter=JITTER,
        training=training,
        label="Likelihood of the statistics",
        show_progress_bars=show_progress_bars,
    )
    return surrogate


def log_likelihood(
    surrogate: Any, errors: ErrorModel, y: Tensor, theta: Tensor
) -> tuple[Tensor, Tensor]:
    r"""Return the log density of real statistics given parameters.

    .. math::
        p(y \mid \theta) = \sum_c \pi_c\, \mathcal{N}\bigl(y;\,
        m_c + \mu + \mu(\theta),\, S_c + L(\theta) L(\theta)^\top\bigr)

    with :math:`\pi_c, m_c, S_c` the weights, means and covariances of the surrogate.
    The standardised y is ``(n, l)``, and theta ``(n, d)``. The log densities are
    ``(n,)``; :math:`\mu(\theta)`, ``(n, l)``, comes second.
    """
    logits, means, covariances = gaussians_of(surrogate, theta)
    mean, of_mean, covariance = errors(theta)
    # Errors that are no numbers any more make the loss no number, and training stops.
    factor, _ = torch.linalg.cholesky_ex(covariances + covariance[:, None].double())
    law = MixtureSameFamily(
        Categorical(logits=logits, validate_args=False),
        MultivariateNormal(
            means + mean[:, None], scale_tril=factor, validate_args=False
        ),
        validate_args=False,
    )
    return law.log_prob(y.double()), of_mean


def gaussians_of(network: Any, condition: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the Gaussians that sbi's mixture density network mixes, in float64.

    Given conditions ``(n, k)``, these are log weights up to a constant, ``(n, c)``,
    means, ``(n, c, l)``, and covariances. The network does not standardise.
    """
    mixture = network.get_uncorrected_mog(condition)
    # In float32 a narrow covariance would not be positive definite after rounding.
    factors = mixture.precision_factors.double()
    identity = torch.eye(factors.shape[-1]).to(factors)
    precision = factors.mT @ factors + SMALLEST_PRECISION * identity
    covariances = torch.cholesky_inverse(torch.linalg.cholesky(precision))
    return mixture.logits.double(), mixture.means.double(), covariances
