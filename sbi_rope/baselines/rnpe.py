"""Robust neural posterior estimation: denoise the statistics, then condition."""

from typing import Annotated, Any

import torch
from torch import Tensor, nn

from sbi_rope.baselines.error_model import BOUND, SpikeAndSlab, denoise
from sbi_rope.baselines.statistics import (
    NoiseOn,
    OverDraws,
    fit_with_jitter,
    split_at_statistics,
    statistics_of,
)
from sbi_rope.methods.base import Method
from sbi_rope.methods.training import EstimatorBuilder
from sbi_rope.npe.sbi import (
    ConditionalDensityEstimator,
    build_zuko_unconditional_flow,
    direct_posterior,
    estimator_of,
)
from sbi_rope.npe.standardisation import Standardisation
from sbi_rope.training.fit import History, Training
from sbi_rope.utils.errors import warn_user
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import Count, Range, check
from sbi_rope.utils.tensors import as_batch

# Chains that disagree by more have not converged.
MAX_R_HAT = 1.1
# Simulations among which chains look for a start.
NUM_STARTS = 5000
# Hidden units and transforms of the marginal density. A single spline transform is
# evaluated in half the time of two, and the denoising does little else.
HIDDEN, NUM_TRANSFORMS = 64, 1
# Of the outputs of its networks at the start.
SHRINKAGE = 0.01


class Denoised(OverDraws):
    r"""A density that is averaged over the statistics that may be behind x.

    .. math::
        \tfrac1M \sum_m q(\theta \mid s_m), \qquad s_m \sim p(s \mid y)

    An observation is denoised when it is first asked for and known by its values from
    then on, so that density and samples belong together. ``statistics`` are simulated
    ones, and ``chains`` the options of :func:`denoise`.
    """

    starts: Tensor

    def __init__(
        self,
        density: ConditionalDensityEstimator,
        net: nn.Module,
        marginal: Any,
        statistics: Tensor,
        *,
        event_shape: torch.Size,
        error_model: SpikeAndSlab,
        chains: dict[str, int],
        seed: int,
    ) -> None:
        super().__init__(net, density, chains["num_draws"], event_shape)
        self.marginal = marginal
        self.standardisation = Standardisation(statistics)
        self.register_buffer("starts", self.standardisation(statistics[:NUM_STARTS]))
        self.error_model = error_model
        self.chains = chains
        self.seed = seed
        self._denoised: dict[bytes, Tensor] = {}

    def embed(self, x: Tensor) -> Tensor:
        """Return the draws of s of each observation, ``(n, num_denoised, l)``."""
        x = as_batch("x", x, self.condition_shape).to(self.starts)
        keys = [row.tobytes() for row in (x.detach().cpu() + 0.0).numpy()]
        # Equal observations are denoised once.
        new = {key: i for i, key in enumerate(keys) if key not in self._denoised}
        if new:
            draws = self._denoise(x[list(new.values())])
            self._denoised |= zip(new, draws, strict=True)
        return torch.stack([self._denoised[key] for key in keys]).to(self.starts)

    def _denoise(self, x: Tensor) -> Tensor:
        y = self.standardisation(super().embed(x)[:, 0]).clamp(-BOUND, BOUND)
        with seeded(self.seed):
            draws, r_hats = denoise(
                y,
                log_density=lambda s: self.marginal.log_prob(s[None])[0],
                simulated=self.starts,
                error_model=self.error_model,
                **self.chains,
            )
        if bad := int((~(r_hats <= MAX_R_HAT)).sum()):
            warn_user(
                f"RNPE: the chains of {bad} of {len(y)} observations have not "
                f"converged (split-R-hat up to {float(r_hats.max()):.2f}, above "
                f"{MAX_R_HAT}); their posteriors depend on chance. Raise `warmup` and "
                "`thin`, or use fewer statistics."
            )
        return self.standardisation.undo(draws).cpu()


class RNPE(Method):
    r"""NPE averaged over the statistics a simulator may have had behind real ones.

    .. math::
        p(\theta \mid y) = \int q(\theta \mid s)\, p(s \mid y)\, ds, \qquad
        p(s \mid y) \propto q(s) \prod_d \bigl[\tfrac12 \mathcal{N}(y_d; s_d, 0.01^2)
        + \tfrac12 \mathrm{Cauchy}(y_d; s_d, 0.25)\bigr]

    in units of each statistic's standard deviation over the simulations. The density
    q(s) is a neural spline flow. For every observation, statistics are drawn by sbi's
    slice sampler and kept with the posterior. Chains that disagree are warned of.

    It sees simulations. It assumes that statistics err independently of each other, any
    of them. A sweep moves one statistic at a time, so that chains are slow on strongly
    correlated ones. Prefer it to NNPE with a few statistics, each with a meaning, and
    ``noise_on="input"``.

    References:
        | Robust Neural Posterior Estimation and Statistical Model Criticism
          (Ward et al., 2022), section 3
        | https://arxiv.org/abs/2210.06564

    Args:
        prior, density_estimator, npe_training, device: See
            :class:`~sbi_rope.methods.Method`.
        noise_on: What the statistics are: the ``"embedding"`` of NPE, or the
            ``"input"``, whose shape must be ``(l,)`` then.
        error_model: The errors; ``SpikeAndSlab()`` if None.
        num_denoised: Draws of the statistics kept of each observation.
        num_chains: Chains behind them, at least two.
        warmup: Sweeps over the statistics that each chain starts with.
        thin: Sweeps for every draw kept.
        training: How q(s) is trained; ``Training()`` if None.
    """

    sees = frozenset({"simulations"})
    starts_from_npe = True
    trains_on_statistics = True
    default_training = Training()

    def __init__(
        self,
        prior: Any,
        density_estimator: str | EstimatorBuilder = "nsf",
        *,
        noise_on: NoiseOn = "embedding",
        error_model: SpikeAndSlab | None = None,
        num_denoised: int = 100,
        num_chains: int = 4,
        warmup: int = 50,
        thin: int = 4,
        **options: Any,
    ) -> None:
        check("noise_on", noise_on, NoiseOn)
        check("num_chains", num_chains, Annotated[int, Range(2)])
        # Halves of chains need two draws for a variance.
        check("num_denoised", num_denoised, Annotated[int, Range(4 * num_chains)])
        check("warmup", warmup, Count)
        check("thin", thin, Count)
        super().__init__(prior, density_estimator, **options)
        self.noise_on: NoiseOn = noise_on
        self.error_model = error_model or SpikeAndSlab()
        self.chains = {
            "num_draws": num_denoised,
            "num_chains": num_chains,
            "warmup": warmup,
            "thin": thin,
        }

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        npe, _ = self._trained_npe(show_progress_bars=show_progress_bars)
        net, density = split_at_statistics(estimator_of(npe), self.noise_on)
        _, x = self._data.simulations
        statistics = statistics_of(net, x)
        marginal, history = fit_marginal(
            Standardisation(statistics)(statistics),
            jitter=self.error_model.spike_std,
            training=self.training,
            show_progress_bars=show_progress_bars,
        )
        denoised = Denoised(
            density,
            net,
            marginal,
            statistics,
            event_shape=x.shape[1:],
            error_model=self.error_model,
            chains=self.chains,
            seed=int(torch.randint(2**31, ())),
        )
        return direct_posterior(denoised.eval(), self._prior), history


def fit_marginal(s: Tensor, *, training: Training, **options: Any) -> Any:
    r"""Fit a neural spline flow :math:`q(s)` to standardised simulated statistics.

    It starts as a standard normal density and stays like it where there are no
    simulations, which is where misspecified statistics are.
    """
    flow: Any = build_zuko_unconditional_flow(
        "NSF",
        s.cpu(),
        z_score_x="none",
        hidden_features=[HIDDEN, HIDDEN],
        num_transforms=NUM_TRANSFORMS,
    )
    # At zero outputs of its networks the spline is the identity. Of a single statistic
    # it has parameters instead of a network.
    for module in flow.modules():
        is_network = isinstance(module, nn.Sequential)
        if is_network or isinstance(module, nn.ParameterList):
            for parameter in (module[-1] if is_network else module).parameters():
                parameter.data.mul_(SHRINKAGE)
    flow, label = flow.to(s.device), "Density of the statistics"
    return flow, fit_with_jitter(flow, s, training=training, label=label, **options)
