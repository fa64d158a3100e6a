r"""Recordings of stored beats: eight seconds from a random start, with noise."""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from sbi_rope.utils.settings import NotNegative, Settings

SAMPLE_RATE = 125.0  # Hz
NUM_STEPS = 1000  # eight seconds
# What "global" normalisation subtracts and divides by, in mmHg: a usual mean arterial
# pressure and half of a usual pulse pressure, for all records alike.
GLOBAL_SCALE = (95.0, 25.0)

Normalisation = Literal["per_record", "global"]


@dataclass(frozen=True, kw_only=True)
class Recorder(Settings):
    r"""Turns beats into normalised, noisy recordings that begin at any time.

    With a beat :math:`p` of period :math:`T`, repeated for ever,

    .. math:: x_k = \frac{p\left((t_0 + k / 125~\mathrm{Hz}) \bmod T\right) - m}{s}
        + \sigma \varepsilon_k, \quad t_0 \sim \mathcal{U}(0, T),
        \quad \varepsilon_k \sim \mathcal{N}(0, 1), \quad k = 0, \dots, 999,

    where :math:`m` and :math:`s` are the mean and the standard deviation of this
    record before the noise (``"per_record"``), or 95 and 25 mmHg (``"global"``). The
    beat is interpolated linearly.

    Args:
        noise_std: Standard deviation :math:`\sigma` of the noise, after normalisation.
        normalisation: How records are normalised.

    Example:
        >>> pressure = 90 + 20 * torch.sin(torch.arange(256) * torch.pi / 128)
        >>> Recorder()(pressure.expand(3, -1), torch.full((3,), 0.8)).shape
        torch.Size([3, 1000])
    """

    noise_std: NotNegative = 0.05
    normalisation: Normalisation = "per_record"

    def __call__(
        self, beat: Tensor, period: Tensor, *, generator: torch.Generator | None = None
    ) -> Tensor:
        """Record each beat once.

        Args:
            beat: Pressures over one period in mmHg, end excluded, shape ``(n, m)``.
            period: Lengths of the beats in s, shape ``(n,)``.
            generator: Source of starts and noise, torch's global one if None.

        Returns:
            Recordings, shape ``(n, 1000)``, with the dtype of ``beat``.
        """
        like = {"dtype": beat.dtype, "device": beat.device}
        start = torch.rand((len(beat),), generator=generator, **like)
        noise = torch.randn((len(beat), NUM_STEPS), generator=generator, **like)
        clean = self._normalised(play(beat, period, start=start))
        return clean + self.noise_std * noise

    def _normalised(self, pressure: Tensor) -> Tensor:
        if self.normalisation == "global":
            mean, scale = GLOBAL_SCALE
            return (pressure - mean) / scale
        centred = pressure - pressure.mean(dim=1, keepdim=True)
        return centred / centred.square().mean(dim=1, keepdim=True).sqrt()


def play(beat: Tensor, period: Tensor, *, start: Tensor) -> Tensor:
    """Repeat beats ``(n, m)`` for eight seconds at 125 Hz, to shape ``(n, 1000)``.

    Periods are in s, and starts shares of the period, both of shape ``(n,)``.
    """
    num_phases = beat.shape[1]
    # float64: eight seconds are many periods, whose whole number is taken away.
    time = torch.arange(NUM_STEPS, dtype=torch.float64, device=beat.device)
    time = time / SAMPLE_RATE
    phase = start.double().unsqueeze(1) + time / period.double().unsqueeze(1)
    place = (phase - phase.floor()) * num_phases
    before = place.long().clamp(max=num_phases - 1)
    weight = (place - before).to(beat.dtype)
    after = (before + 1) % num_phases
    return torch.lerp(beat.gather(1, before), beat.gather(1, after), weight)
