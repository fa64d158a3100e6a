r"""Task C: a damped pendulum, and a simulator without friction."""

import math
from dataclasses import dataclass
from pathlib import Path

import torch
from sbi.utils import BoxUniform
from torch import Tensor, nn

from sbi_rope.tasks.base import Task
from sbi_rope.tasks.distributions import box
from sbi_rope.tasks.networks import SeriesEmbedding, light_series_embedding
from sbi_rope.tasks.settings import PaperSettings
from sbi_rope.tasks.splits import DrawnPairs, Part
from sbi_rope.tasks.variants import COMMON_VARIANTS
from sbi_rope.utils.settings import NotNegative, Settings
from sbi_rope.utils.tensors import as_batch

NUM_STEPS = 200
DURATION = 10.0  # s


@dataclass(frozen=True, kw_only=True)
class PendulumSimulator(Settings):
    r"""Noisy positions of a pendulum at 200 times from 0 to 10 s.

    .. math:: x(t) = e^{-\alpha t} A \cos(\omega_0 t + \varphi) + \varepsilon_t,
        \quad \varphi \sim \mathcal{U}(-\pi, \pi),
        \quad \alpha \sim \mathcal{U}(0, \alpha_{\max}),
        \quad \varepsilon_t \sim \mathcal{N}(0, \sigma^2).

    The simulator has :math:`\alpha_{\max} = 0`. The real process has friction.

    Args:
        noise_std: The sensor's standard deviation :math:`\sigma`, in units of A.
        max_damping: The largest damping rate :math:`\alpha_{\max}`, in 1/s.

    Example:
        >>> PendulumSimulator()(torch.tensor([[1.0, 2.0], [3.0, 0.5]])).shape
        torch.Size([2, 200])
    """

    noise_std: NotNegative = 0.1
    max_damping: NotNegative = 0.0

    def __call__(self, theta: Tensor) -> Tensor:
        """Simulate ``theta`` of shape ``(n, 2)``, to shape ``(n, 200)``."""
        theta = as_batch("theta", theta, (2,), empty=True)
        phase = math.pi * (2 * torch.rand_like(theta[:, :1]) - 1)
        damping = self.max_damping * torch.rand_like(theta[:, :1])
        position = self.position(theta, phase=phase, damping=damping)
        return position + self.noise_std * torch.randn_like(position)

    def position(self, theta: Tensor, *, phase: Tensor, damping: Tensor) -> Tensor:
        """Return the positions ``(n, 200)`` without noise, differentiable.

        Phases at time 0 are in radians, damping rates in 1/s, both ``(n, 1)``.
        """
        frequency, amplitude = theta[:, :1], theta[:, 1:]
        time = torch.linspace(
            0.0, DURATION, NUM_STEPS, dtype=theta.dtype, device=theta.device
        )
        swing = torch.cos(frequency * time + phase)
        return torch.exp(-damping * time) * amplitude * swing


class Pendulum(Task):
    r"""Task C of the paper: frequency and amplitude of a swing with unknown friction.

    The parameters are the angular frequency :math:`\omega_0` and the amplitude
    :math:`A`, with prior :math:`\mathcal{U}[0, 3] \times \mathcal{U}[0.5, 10]`. The
    simulator knows no friction (see :class:`PendulumSimulator`), the real process is
    damped at a rate :math:`\alpha \sim \mathcal{U}(0, 1)`.

    In the variant ``"misspecified_prior"`` the real parameters, those of the
    calibration set included, come from a mixture of the prior and
    :math:`\mathcal{U}[1, 2] \times \mathcal{U}[3, 6]`.

    Args:
        variant, root, label_noise: See :class:`~sbi_rope.tasks.Task`.
        misspecification_weight: Weight of the tighter distribution in the mixture, in
            [0, 1]. It is 0.5 unless given, and only for ``"misspecified_prior"``.
        noise_std: Standard deviation of the noise on simulated and real positions, in
            units of A.
        max_damping: Largest damping rate of the real process, in 1/s. At 0 the
            simulator is exact.

    Example:
        >>> theta, x_o = Pendulum().get_calibration_set(50)
        >>> theta.shape, x_o.shape
        (torch.Size([50, 2]), torch.Size([50, 200]))
    """

    name = "pendulum"
    parameter_names = ("omega_0", "A")
    parameter_units = ("rad/s", "1")
    x_shape = (NUM_STEPS,)
    z_score_x = "structured"
    misspecification = "the real swing is damped by friction"
    variants = COMMON_VARIANTS | {
        "misspecified_prior": "the real parameters come from a mixture of the prior "
        "and a tighter box, with `misspecification_weight`",
    }
    shifted_region = {"omega_0": (1.5, 3.0), "A": (0.5, 5.25)}  # noqa: RUF012
    paper_settings = PaperSettings(
        learning_rate=1e-4,
        finetuning_learning_rate=1e-5,
        finetuning_steps=5000,
        joint_epoch_size=50_000,
    )

    def __init__(
        self,
        *,
        variant: str | None = None,
        root: str | Path | None = None,
        label_noise: float | None = None,
        misspecification_weight: float | None = None,
        noise_std: float = 0.1,
        max_damping: float = 1.0,
    ) -> None:
        super().__init__(variant=variant, root=root, label_noise=label_noise)
        self.noise_std = noise_std
        self.misspecification_weight = self._strength(
            "misspecification_weight",
            misspecification_weight,
            0.5,
            variant="misspecified_prior",
        )
        self._real = PendulumSimulator(noise_std=noise_std, max_damping=max_damping)

    def get_prior(self) -> BoxUniform:
        """Return the uniform prior on [0, 3] x [0.5, 10], whose density is 1 / 28.5."""
        return box((0.0, 0.5), (3.0, 10.0))

    def get_simulator(self) -> PendulumSimulator:
        """Return the simulator without friction."""
        return PendulumSimulator(noise_std=self.noise_std)

    def get_embedding_net(self, *, light: bool = False) -> nn.Module:
        """Return the paper's convolutional network or a light one, with ten outputs."""
        if light:
            return light_series_embedding(num_steps=NUM_STEPS, output_dim=10)
        return SeriesEmbedding(num_steps=NUM_STEPS, output_dim=10)

    def _real_process(self, part: Part) -> DrawnPairs:
        return DrawnPairs(draw_theta=self._draw_theta, observe=self._real)

    def _draw_theta(self, n: int) -> Tensor:
        theta = self.get_prior().sample((n,))
        tight = box((1.0, 3.0), (2.0, 6.0)).sample((n,))
        chance = torch.rand(n, 1, dtype=theta.dtype)
        return torch.where(chance < self.misspecification_weight, tight, theta)
