"""The wind tunnel: model, closed-form posterior, recorded data and stand-in."""

from pathlib import Path

import numpy as np
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
from tests.tasks import all_recorded, write_csv


def known_timing() -> Tensor:
    """The shift of an impulse at its usual time."""
    return torch.zeros(1, dtype=torch.float64)


def test_pressure_at_known_timing_is_that_of_causalchamber() -> None:
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


@pytest.mark.medium
def test_simulations_follow_the_closed_form_posterior() -> None:
    theta, x = WindTunnel(onset_jitter=0.0).get_simulations(20_000)
    # At known timing x is k(H) s(t) + N(0, 0.2^2): least squares give the hatch, and
    # the posterior is a normal law around it, truncated to [0, 45].
    ratio = pressure_ratio(known_timing())[0]
    per_degree = -74.82473949999999 * 0.15 / 45
    scale = x.double() @ ratio / ratio.square().sum()
    estimate = (scale - 74.82473949999999 * (1 - 0.75)) / per_degree
    law = Normal(estimate, 0.2 / abs(per_degree) / float(ratio.norm()))
    low, high = (law.cdf(torch.tensor(end)) for end in (0.0, 45.0))
    levels = ((law.cdf(theta[:, 0].double()) - low) / (high - low)).sort().values
    distance = (levels - torch.linspace(0, 1, 20_000)).abs().max()
    assert distance < 1.63 / 20_000**0.5  # the 1 % point of Kolmogorov's test


def test_each_whole_impulse_becomes_a_hatch_and_a_curve(tmp_path: Path) -> None:
    def written(hatches: list[float], cut: slice) -> WindTunnel:
        rows = [
            {
                "flag": i // 50,
                "hatch": hatches[i // 50],
                "pressure_downwind": 95_742.9 + i / 97,
                "pressure_ambient": 95_742.9,
            }
            for i in range(50 * len(hatches))
        ]
        write_csv(tmp_path / DATASET / f"{EXPERIMENT}.csv", rows[cut])
        return WindTunnel(root=tmp_path)

    # The first impulse has lost its beginning, the last one its end.
    hatches = [0.0, 12.5, 45.0, 3.1, 7.7, 20.0]
    theta, x = all_recorded(written(hatches, slice(8, -3)), 4)
    order = [theta.flatten().tolist().index(torch.tensor(h)) for h in hatches[1:5]]
    expected = torch.arange(50, 250).reshape(4, 50) / 97
    torch.testing.assert_close(x[order], expected, rtol=0.0, atol=1e-6)
    with pytest.raises(InvalidInputError, match="support of the prior"):
        written([50.0, 1.0, 2.0], slice(None)).get_test_set(1)
