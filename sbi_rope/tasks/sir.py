r"""Task B: an epidemic, of which the reports of a weekend come in part on Monday."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from sbi_rope.tasks.base import Task
from sbi_rope.tasks.distributions import UniformTriangle
from sbi_rope.tasks.networks import fully_connected
from sbi_rope.tasks.settings import STATISTICS_SETTINGS
from sbi_rope.tasks.splits import DrawnPairs, Part
from sbi_rope.utils.settings import Count, NotNegative, Settings, UnitInterval
from sbi_rope.utils.tensors import as_batch

STATISTICS = (
    "log_mean",
    "log_median",
    "log_max",
    "log_day_of_max",
    "log_day_of_half",
    "autocorrelation",
)
NUM_DAYS = 365
POPULATION = 100_000
INFECTED_AT_START = 0.001  # as a fraction of the population
REVERSION = 0.05  # of the reproduction number to its mean, in 1/day
# Day 0 is a Friday; 52 of each.
SATURDAYS, SUNDAYS, MONDAYS = (slice(day, None, 7) for day in (1, 2, 3))
CHUNK_SIZE = 1000  # series that are simulated together, in the CPU's cache


@dataclass(frozen=True, kw_only=True)
class SIRSimulator(Settings):
    r"""Six statistics of the numbers of infected people on 365 days.

    Susceptible and infected fractions :math:`s, i` of the population follow

    .. math::
        \mathrm{d}s = -\gamma R s i \, \mathrm{d}t, \quad
        \mathrm{d}i = (\gamma R s - \gamma) i \, \mathrm{d}t, \quad
        \mathrm{d}R = \eta \left( \tfrac{\beta}{\gamma} - R \right) \mathrm{d}t
            + \sigma \sqrt{|R|} \, \mathrm{d}W,

    from :math:`s = 0.999`, :math:`i = 0.001`, :math:`R = \beta / \gamma`, with
    :math:`\eta = 0.05` per day and a reproduction number :math:`R` that is the only
    noisy one. A report delay may then move infections of the weekend
    (:func:`delay_weekend_reports`), before :func:`summarise`. Under one seed, the
    simulator and the real process have the same epidemics.

    The Euler-Maruyama scheme runs in float64, in terms of :math:`b = \gamma R`, for
    which nothing is divided by :math:`\gamma`:

    .. math:: \mathrm{d}b = \eta (\beta - b) \, \mathrm{d}t
        + \sigma \sqrt{\gamma |b|} \, \mathrm{d}W.

    Args:
        steps_per_day: Steps of the scheme in a day.
        volatility: The factor :math:`\sigma`, in :math:`\mathrm{day}^{-1/2}`.
        reported_fraction: Fraction of the weekend's infections that is reported on
            the day itself, and not on Monday.

    Example:
        >>> SIRSimulator()(torch.tensor([[0.4, 0.1], [0.2, 0.1]])).shape
        torch.Size([2, 6])
    """

    steps_per_day: Count = 10
    volatility: NotNegative = 0.05
    reported_fraction: UnitInterval = 1.0

    def __call__(self, theta: Tensor) -> Tensor:
        """Simulate ``theta`` of shape ``(n, 2)``, to shape ``(n, 6)``."""
        theta = as_batch("theta", theta, (2,), empty=True)
        infected = self.infections(theta)
        reported = delay_weekend_reports(infected, self.reported_fraction)
        return summarise(reported).to(theta)

    def infections(self, theta: Tensor) -> Tensor:
        """Return the numbers of infected people, before any delay of reports.

        Args:
            theta: Infection and recovery rates, in 1/day, shape ``(n, 2)``.

        Returns:
            One number a day, shape ``(n, 365)``, float64.
        """
        chunks = theta.double().cpu().split(CHUNK_SIZE)
        infected = torch.cat([self._infections(chunk) for chunk in chunks])
        return infected.to(theta.device)

    def _infections(self, theta: Tensor) -> Tensor:
        shape = self.steps_per_day, len(theta)
        noise = (
            torch.randn(shape, dtype=theta.dtype, device="cpu").numpy()
            for _ in range(NUM_DAYS - 1)
        )
        days = integrate(theta.T.numpy(), noise, volatility=self.volatility)
        return torch.from_numpy(np.stack(list(days), axis=1))


def integrate(
    theta: np.ndarray, noise: Iterable[np.ndarray], *, volatility: float
) -> Iterator[np.ndarray]:
    """Integrate the equations of :class:`SIRSimulator`.

    NumPy's calls cost a fraction of torch's on arrays this small. From rates in 1/day,
    shape ``(2, n)``, and standard normal numbers ``(steps, n)`` of each day but the
    last, it yields the numbers of infected people ``(n,)`` on one day after the other.
    """
    infection, recovery = theta
    infected = INFECTED_AT_START + 0 * infection
    susceptible = 1 - infected
    rate = 1 * infection  # gamma times the reproduction number
    yield POPULATION * infected
    for normal in noise:
        dt = 1 / len(normal)
        pull, stay = REVERSION * dt * infection, 1 - dt * recovery
        for kick in normal * (volatility * (dt * recovery) ** 0.5):
            # All updates use the state before the step.
            new_fraction = dt * rate * susceptible
            kick *= abs(rate) ** 0.5
            rate *= 1 - REVERSION * dt
            rate += pull
            rate += kick
            susceptible -= new_fraction * infected
            infected *= stay + new_fraction
        yield POPULATION * infected


def delay_weekend_reports(infections: Tensor, reported_fraction: float) -> Tensor:
    """Report a part of Saturday's and Sunday's infections on the Monday after.

    Args:
        infections: Numbers of infected people, shape ``(n, 365)``. The first
            Saturday is entry 1.
        reported_fraction: Fraction of the weekend's numbers that stays.

    Returns:
        Reported numbers of the same shape, with the same total.
    """
    reported = infections.clone()
    reported[:, SATURDAYS] *= reported_fraction
    reported[:, SUNDAYS] *= reported_fraction
    weekend = infections[:, SATURDAYS] + infections[:, SUNDAYS]
    reported[:, MONDAYS] += (1 - reported_fraction) * weekend
    return reported


def summarise(series: Tensor) -> Tensor:
    r"""Return the six statistics of daily numbers.

    They are the logarithms of the mean, the median, the maximum, the day of the
    maximum (from 1), and the first day (from 0) by whose end more than half of the
    year's total is reached, and the correlation of neighbouring days.

    Args:
        series: Positive daily numbers, shape ``(n, days)``.

    Returns:
        Statistics, shape ``(n, 6)``. A series that reaches half its total on the
        first day has :math:`-\infty` among them.
    """
    reached = series.cumsum(dim=1) > 0.5 * series.sum(dim=1, keepdim=True)
    before, after = series[:, :-1], series[:, 1:]
    before = before - before.mean(dim=1, keepdim=True)
    after = after - after.mean(dim=1, keepdim=True)
    maximum, day_of_max = series.max(dim=1)
    return torch.stack(
        [
            series.mean(dim=1).log(),
            series.median(dim=1).values.log(),
            maximum.log(),
            (day_of_max + 1).to(series).log(),
            reached.byte().argmax(dim=1).to(series).log(),
            torch.cosine_similarity(before, after, dim=1, eps=0.0),
        ],
        dim=1,
    )


class SIR(Task):
    r"""Task B of the paper: rates of an epidemic from a year of daily numbers.

    The parameters are the infection rate :math:`\beta` and the recovery rate
    :math:`\gamma`, uniform on the triangle :math:`0 < \gamma < \beta < 0.5`. An
    observation is six statistics of the daily numbers (see :class:`SIRSimulator`). In
    the real process 5 % of each weekend's infections are reported on Monday only.
    This lowers the correlation of neighbouring days, by about three standard
    deviations, and leaves the other statistics almost as they are.

    References:
        | Robust Neural Posterior Estimation and Statistical Model Criticism
          (Ward et al., 2022), https://github.com/danielward27/rnpe

    Args:
        variant, root, label_noise: See :class:`~sbi_rope.tasks.Task`.
        reported_fraction: Fraction of a real weekend's infections that is reported on
            the day itself, in [0, 1]. At 1 the simulator is exact.

    Example:
        >>> theta, x_o = SIR().get_calibration_set(50)
        >>> theta.shape, x_o.shape
        (torch.Size([50, 2]), torch.Size([50, 6]))
    """

    name = "sir"
    parameter_names = ("infection_rate", "recovery_rate")
    parameter_units = ("1/day", "1/day")
    x_shape = (len(STATISTICS),)
    x_names = STATISTICS
    misspecification = "a part of the real infections of a weekend is reported late"
    shifted_region = {"infection_rate": (0.25, 0.5), "recovery_rate": (0.0, 0.125)}  # noqa: RUF012
    paper_settings = STATISTICS_SETTINGS

    def __init__(
        self,
        *,
        variant: str | None = None,
        root: str | Path | None = None,
        label_noise: float | None = None,
        reported_fraction: float = 0.95,
    ) -> None:
        super().__init__(variant=variant, root=root, label_noise=label_noise)
        self._real = SIRSimulator(reported_fraction=reported_fraction)

    def get_prior(self) -> UniformTriangle:
        """Return the uniform prior on the triangle, whose density is 8."""
        return UniformTriangle(torch.tensor(0.5, dtype=torch.float32))

    def prior_quantiles(self, theta: Tensor) -> Tensor:
        r"""Return :math:`4 \beta^2` and :math:`1 - (1 - 2 \gamma)^2`, ``(n, 2)``."""
        infection, recovery = (2 * theta.clamp(0.0, 0.5)).unbind(dim=1)
        return torch.stack([infection**2, 1 - (1 - recovery) ** 2], dim=1)

    def get_simulator(self) -> SIRSimulator:
        """Return the simulator that reports all infections on the day."""
        return SIRSimulator()

    def get_embedding_net(self, *, light: bool = False) -> nn.Module:
        """Return the paper's network, which is light already and has six outputs."""
        return fully_connected(len(STATISTICS), (8, 32, 32, 24, 6))

    def _real_process(self, part: Part) -> DrawnPairs:
        return replace(self._simulated_process(), observe=self._real)
