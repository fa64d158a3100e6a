"""Noisy neural posterior estimation: NPE trained on statistics with errors."""

from typing import Any

from torch import Tensor

from sbi_rope.baselines.error_model import SpikeAndSlab
from sbi_rope.baselines.statistics import NoiseOn, clipped_statistics
from sbi_rope.methods.base import Method
from sbi_rope.methods.training import (
    EstimatorBuilder,
    SimulationTrainer,
    train_on_simulations,
)
from sbi_rope.npe.sbi import embed, posterior_from
from sbi_rope.training.fit import History, Training
from sbi_rope.utils.settings import check


class NNPE(Method):
    r"""NPE trained on simulated statistics with the errors real ones may have.

    .. math::
        \min_q\; \mathbb{E}_{p(\theta, s)\, p(y \mid s)}
        \bigl[-\log q(\theta \mid y)\bigr], \qquad
        y_d = s_d + \varepsilon_d, \quad
        \varepsilon_d \sim \tfrac12 \mathcal{N}(0, 0.01^2)
        + \tfrac12 \mathrm{Cauchy}(0, 0.25)

    in units of each statistic's standard deviation over the simulations. The statistics
    are the embedding h(x) of NPE, which is kept as it is, or the entries of x; then the
    embedding net is trained on too. Training starts from NPE, and the noise is drawn
    anew for every batch. A real observation is conditioned on directly.

    It sees simulations, also when it starts from a trained NPE. It assumes that
    statistics err independently of each other, any of them, and by a few standard
    deviations rather than by many. It is never as sharp as NPE where the simulator is
    right.

    References:
        | Robust Neural Posterior Estimation and Statistical Model Criticism
          (Ward et al., 2022), section 4, NNPE
        | https://arxiv.org/abs/2210.06564

    Args:
        prior, density_estimator, npe_training, device: See
            :class:`~sbi_rope.methods.Method`.
        noise_on: Where the noise goes: ``"embedding"`` or ``"input"``.
        error_model: The noise; ``SpikeAndSlab()`` if None.
        training: How training goes on with noise; ``Training()`` if None.
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
        **options: Any,
    ) -> None:
        check("noise_on", noise_on, NoiseOn)
        super().__init__(prior, density_estimator, **options)
        self.noise_on: NoiseOn = noise_on
        self.error_model = error_model or SpikeAndSlab()

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        npe, _ = self._trained_npe(show_progress_bars=show_progress_bars)
        theta, x = self._data.simulations
        net, clip, density, estimator = clipped_statistics(npe, self.noise_on, x)
        error_model = self.error_model

        class Trainer(SimulationTrainer):
            def _loss(self, theta: Tensor, x: Tensor, *args: Any, **kw: Any) -> Tensor:
                # The noise is drawn anew in every batch.
                noise = clip.std * error_model.sample_like(x)
                return super()._loss(theta, x + noise, *args, **kw)

        trained, history = train_on_simulations(
            self._prior,
            # sbi tries it on the CPU, and moves it to the data's device.
            lambda theta, x: density.cpu(),
            theta,
            embed(net, x),
            training=self.training,
            show_progress_bars=show_progress_bars,
            trainer=Trainer,
        )
        # It shares its parameters with the estimator, on whatever device.
        density.load_state_dict(trained.state_dict())
        estimator = estimator.to(self._device)
        return posterior_from(npe, estimator.eval()), history
