"""The wind tunnel: model, closed-form posterior, recorded data and stand-in."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.distributions import Normal

from sbi_rope.tasks.wind_tunnel import DATASET, EXPERIMENT, WindTunnel
from sbi_rope.tasks.wind_tunnel_model import (
    SAMPLE_TIMES,
    WindTunnelSimulator,
    pressure_ratio,
)
from sbi_rope.utils.errors import InvalidInputError
from tests.tasks import all_recorded

# The published columns around those that are read.
HEADER = (
    "timestamp,counter,flag,intervention,hatch,load_in,load_out,osr_downwind,"
    "pressure_downwind,pressure_upwind,pressure_ambient"
)
AMBIENT = 95_742.9

WriteImpulses = Callable[..., Path]


def known_timing() -> Tensor:
    """The shift of an impulse at its usual time."""
    return torch.zeros(1, dtype=torch.float64)


class Oracle:
    """The exact posterior at known timing, from k(H) s(t) + N(0, 0.2^2)."""

    def __init__(self) -> None:
        self.ratio = pressure_ratio(known_timing())[0]
        self.at_zero = 74.82473949999999 * (1 - 0.75)
        self.per_degree = -74.82473949999999 * 0.15 / 45
        self.std = 0.2 / abs(self.per_degree) / float(self.ratio.norm())

    def estimate(self, x: Tensor) -> Tensor:
        """The hatch of least squares, shape (n,)."""
        scale = x.double() @ self.ratio / self.ratio.square().sum()
        return (scale - self.at_zero) / self.per_degree

    def quantile(self, theta: Tensor, x: Tensor) -> Tensor:
        """Distribution function of the posterior, truncated to [0, 45]."""
        law = Normal(self.estimate(x), self.std)
        low, high = law.cdf(torch.tensor(0.0)), law.cdf(torch.tensor(45.0))
        return (law.cdf(theta[:, 0].double()) - low) / (high - low)

    def log_prob(self, theta: Tensor, x: Tensor) -> Tensor:
        law = Normal(self.estimate(x), self.std)
        mass = law.cdf(torch.tensor(45.0)) - law.cdf(torch.tensor(0.0))
        return law.log_prob(theta[:, 0].double()) - mass.log()


@pytest.fixture
def write_impulses(tmp_path: Path) -> WriteImpulses:
    """Write a small file in the official layout, and return its root."""

    def write(
        hatches: tuple[float, ...] = (0.0, 12.5, 45.0),
        *,
        pressures: Tensor | None = None,
        edit: Callable[[list[str]], list[str]] = list,
    ) -> Path:
        if pressures is None:
            pressures = torch.arange(50 * len(hatches)).reshape(-1, 50) / 97
        rows = []
        for impulse, hatch in enumerate(hatches):
            for i, pressure in enumerate(pressures[impulse].tolist()):
                load = 1.0 if 5 <= i < 25 else 0.01
                rows.append(
                    f"{1.7e9 + 8 * impulse + SAMPLE_TIMES[i]},{len(rows)},{impulse},0,"
                    f"{hatch},{load},0.5,4,{AMBIENT + pressure!r},95740.0,{AMBIENT}"
                )
        folder = tmp_path / DATASET
        folder.mkdir(exist_ok=True)
        path = folder / f"{EXPERIMENT}.csv"
        path.write_text("\n".join(edit([HEADER, *rows])) + "\n")
        return tmp_path

    return write


# The model ---------------------------------------------------------------------------


def test_pressure_at_known_timing_is_that_of_causalchamber() -> None:
    np = pytest.importorskip("numpy")
    models = pytest.importorskip("causalchamber.models")
    max_speed = 3000 * np.pi / 30
    full_torque = 0.05 * (0.27 - 0.166)
    for hatch in (0.0, 0.1, 17.3, 45.0):
        pressure, *_ = models.simulator_a2_c3(
            load_in=[0.01] * 5 + [1.0] * 20 + [0.01] * 25,
            load_out=[0.5] * 50,
            hatch=hatch,
            P_amb=0.0,
            I=0.5 * 0.059**2 * 0.02,
            tau=lambda load: full_torque * np.maximum(load, 0.1) ** 3,
            C=full_torque / max_speed**2,
            timestamps=SAMPLE_TIMES,
            omega_in_0=0.1 * max_speed,
            omega_out_0=0.5 * max_speed,
            S_max=74.82473949999999,
            omega_max=max_speed,
            Q_max=186.7 / 3600,
            r_0=0.75,
            beta=0.15,
            barometer_error=0.0,
            barometer_precision=0.0,
        )
        theta = torch.tensor([[hatch]], dtype=torch.float64)
        for jitter in (0.0, 0.3):
            simulator = WindTunnelSimulator(onset_jitter=jitter)
            x = simulator.pressure(theta, onset_shift=known_timing())
            torch.testing.assert_close(
                x[0], torch.as_tensor(pressure), rtol=0, atol=1e-9
            )


def test_pressure_is_linear_in_the_hatch_with_the_published_factor() -> None:
    theta = torch.linspace(0, 45, 10, dtype=torch.float64).unsqueeze(1)
    shift = torch.full((10,), 0.123, dtype=torch.float64)
    x = WindTunnelSimulator().pressure(theta, onset_shift=shift)
    s = pressure_ratio(shift)
    expected = (18.706184875 - 0.249415798333 * theta) * s
    torch.testing.assert_close(x, expected, rtol=0.0, atol=2e-5)
    # Exactly linear, whatever the error of interpolation.
    middle = (x[0] + x[-1]) / 2
    torch.testing.assert_close((x[4] + x[5]) / 2, middle, rtol=0.0, atol=1e-12)


def test_noise_has_the_deviation_and_correlation_asked_for() -> None:
    theta = torch.full((20_000, 1), 20.0, dtype=torch.float64)
    for correlation in (0.0, 0.6):
        simulator = WindTunnelSimulator(
            noise_std=0.5, onset_jitter=0.0, noise_correlation=correlation
        )
        noise = simulator(theta) - simulator.pressure(
            theta[:1], onset_shift=known_timing()
        )
        lag = (torch.arange(50) - torch.arange(50).unsqueeze(1)).abs()
        expected = 0.25 * torch.tensor(correlation, dtype=torch.float64) ** lag
        torch.testing.assert_close(noise.T.cov(), expected, rtol=0.0, atol=0.012)


# The posterior at known timing -------------------------------------------------------


@pytest.mark.medium
def test_simulations_follow_the_closed_form_posterior() -> None:
    theta, x = WindTunnel(onset_jitter=0.0).get_simulations(20_000)
    oracle = Oracle()
    levels = oracle.quantile(theta, x).sort().values
    distance = (levels - torch.linspace(0, 1, 20_000)).abs().max()
    assert distance < 1.63 / 20_000**0.5  # the 1 % point of Kolmogorov's test
    assert float(oracle.log_prob(theta, x).mean()) == pytest.approx(-0.444, abs=0.03)


# Recorded data -----------------------------------------------------------------------


def test_each_impulse_becomes_a_hatch_and_a_curve(
    write_impulses: WriteImpulses,
) -> None:
    hatches = (0.0, 12.5, 45.0, 3.1, 7.7, 20.0)
    theta, x = all_recorded(WindTunnel(root=write_impulses(hatches)), 6)
    order = [theta.flatten().tolist().index(torch.tensor(h)) for h in hatches]
    expected = torch.arange(300).reshape(6, 50) / 97
    torch.testing.assert_close(x[order], expected, rtol=0.0, atol=1e-6)


def test_impulses_that_a_recording_cuts_are_left_out(
    write_impulses: WriteImpulses,
) -> None:
    # The first impulse has lost its beginning, the last one its end.
    root = write_impulses(tuple(range(5)), edit=lambda rows: rows[:1] + rows[9:-3])
    theta, x = all_recorded(WindTunnel(root=root), 3)
    assert sorted(theta.flatten().tolist()) == [1.0, 2.0, 3.0]
    first = x[theta.flatten().tolist().index(1.0)]
    expected = torch.arange(50, 100) / 97
    torch.testing.assert_close(first, expected, rtol=0.0, atol=1e-6)
    task = WindTunnel(root=write_impulses((50.0, 1.0, 2.0)))
    with pytest.raises(InvalidInputError, match="support of the prior"):
        task.get_test_set(1)
