"""The light tunnel's sensors: law, prior and recorded data."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from sbi_rope.tasks.light_tunnel_sensors import (
    INPUTS,
    OUTPUTS,
    LightTunnelSensors,
    LightTunnelSimulator,
)
from tests.tasks import all_recorded


def test_law_is_that_of_causalchamber() -> None:
    pandas = pytest.importorskip("pandas")
    sensors = pytest.importorskip("causalchamber.simulators.lt")
    law = sensors.Deterministic(
        S=np.array(
            [[4.34165202, 2.8594438, 1.91565691], [0.89410569, 1.58679242, 2.68477163]]
        ),
        d1=0.1,
        d2=0.17,
        d3=0.25,
        Ts=np.array([0.42685688, 0.41231782, 0.46652526]),
        Tp=np.array([0.2909342, 0.29624314, 0.30526271]),
        Tc=np.array([0.00431032, 0.01447611, 0.02041075]),
        Q=np.array([0.12834946, 0.12870338, 0.13078523]),
        C0=58.13307318503893,
        A=1.42261211,
        a1=506.8049747171294,
        a2=510.98343062774353,
    )
    colour = 85 * torch.rand(50, 3, dtype=torch.float64)
    positions = 40 * torch.rand(50, 2, dtype=torch.float64) - 15
    inputs = pandas.DataFrame(
        torch.cat([colour, positions], dim=1).numpy(), columns=list(INPUTS)
    )
    for sensor in ("1", "2", "3"):
        inputs[f"diode_ir_{sensor}"], inputs[f"diode_vis_{sensor}"] = 2, 1
        inputs[f"t_ir_{sensor}"], inputs[f"t_vis_{sensor}"] = 3, 3
    inputs["v_c"] = inputs["v_angle_1"] = inputs["v_angle_2"] = 5.0
    outputs = law.simulate_from_inputs(inputs)[: len(OUTPUTS)]
    expected = torch.stack([torch.as_tensor(output) for output in outputs], dim=1)
    angle = (positions[:, :1] - positions[:, 1:]).abs()
    readings = LightTunnelSimulator().readings(torch.cat([colour, angle], dim=1))
    torch.testing.assert_close(readings, expected, rtol=1e-9, atol=0.0)


def test_noise_is_relative_on_light_and_additive_on_the_current() -> None:
    theta = torch.tensor([[50.0, 20.0, 70.0, 10.0]]).expand(20_000, -1)
    x = LightTunnelSimulator(relative_noise=0.03, current_noise_std=4.0)(theta)
    readings = LightTunnelSimulator().readings(theta[:1])
    light, current = x[:, :6].expm1() / readings[:, :6], x[:, 6]
    torch.testing.assert_close(light.mean(dim=0), torch.ones(6), atol=1e-3, rtol=0.0)
    torch.testing.assert_close(
        light.std(dim=0), torch.full((6,), 0.03), rtol=0.03, atol=0.0
    )
    assert current.mean() == pytest.approx(float(readings[0, 6]), abs=0.1)
    assert current.std() == pytest.approx(4.0, rel=0.03)


def test_the_recorded_readings_are_the_published_ones_and_smaller_than_the_law(
    chamber_extract: Path,
) -> None:
    theta, x = all_recorded(LightTunnelSensors(root=chamber_extract), 450)
    # The first row of the file: its colours, angles and readings as published.
    first = [72.0, 18.0, 60.0, 5.962499618530273 + 2.0250000953674316]
    (row,) = (theta == torch.tensor(first)).all(dim=1).nonzero().flatten().tolist()
    readings = torch.tensor([14377.0, 3598.0, 1767.0, 465.0, 567.0, 159.0])
    torch.testing.assert_close(x[row, :6], readings.log1p())
    assert x[row, 6] == 72.0
    measured = x[:, :6].expm1().mean(dim=0)
    ratios = LightTunnelSimulator().readings(theta)[:, :6].mean(dim=0) / measured
    expected = torch.tensor([1.23, 1.24, 1.24, 1.26, 1.26, 1.34])
    torch.testing.assert_close(ratios, expected, atol=0.02, rtol=0.0)


def test_strong_variants_have_one_colour_above_170_or_angles_of_42_to_118_degrees(
    chamber_extract: Path,
) -> None:
    task = LightTunnelSensors(root=chamber_extract, variant="strong_colours")
    for theta, _ in (task.get_calibration_set(30), task.get_test_set(60)):
        assert ((theta[:, :3] >= 171).sum(dim=1) == 1).all()
        assert (theta[:, :3] >= 171).any(dim=0).all()
    task = LightTunnelSensors(root=chamber_extract, variant="strong_angles")
    theta = torch.cat([task.get_calibration_set(20)[0], task.get_test_set(40)[0]])
    assert theta[:, 3].min() == pytest.approx(44, abs=5.0)
    assert theta[:, 3].max() == pytest.approx(116, abs=5.0)


def test_sensor_settings_change_the_test_set_only(chamber_extract: Path) -> None:
    task = LightTunnelSensors(root=chamber_extract, variant="sensor_settings")
    standard = LightTunnelSensors(root=chamber_extract)
    sets = (some.get_calibration_set(100) for some in (task, standard))
    assert all(torch.equal(a, b) for a, b in zip(*sets, strict=True))

    def darker(theta: Tensor, x: Tensor) -> Tensor:
        law = LightTunnelSimulator().readings(theta)[:, :6].log1p()
        return (x[:, :6] - law < -1.5).double().mean(dim=0)

    # An exposure time of 0 instead of 3 is an eighth of the light, at another of the
    # six diodes in six of the seven experiments.
    assert darker(*task.get_calibration_set(100)).mean() <= 0.05
    share = darker(*task.get_test_set(140))
    expected = torch.full_like(share, 1 / 7)
    torch.testing.assert_close(share, expected, atol=0.09, rtol=0.0)
