"""The light tunnel's images: two models, recorded images, and a posterior from them."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import betabinom
from torch import Tensor

from sbi_rope.tasks.light_tunnel import (
    BETA_BINOMIAL,
    DATASET,
    INPUTS,
    UNIFORM,
    LightTunnel,
)
from sbi_rope.tasks.light_tunnel_models import (
    CameraSimulator,
    HexagonSimulator,
    draw_crowded,
    hexagon_mask,
    malus,
)
from tests.tasks import all_recorded, write_csv

SIZE = 64


def draw_inputs(n: int) -> Tensor:
    """Draw colours and angles as the protocol of the uniform experiment does."""
    colours = torch.randint(0, 255, (n, 3)).double()
    angles = torch.randint(-1800, 1800, (n, 2)).double() / 10
    return torch.cat([colours, angles], dim=1)


def pixels_of(row: int) -> Tensor:
    """Return the recorded image of a row, (3, size, size)."""
    generator = torch.Generator().manual_seed(row)
    return torch.randint(256, (3, SIZE, SIZE), generator=generator, dtype=torch.uint8)


def write_experiment(root: Path, experiment: str, rows: range) -> None:
    """Write a small experiment in the official layout."""
    image_module = pytest.importorskip("PIL.Image")
    folder = root / DATASET / experiment
    table = [
        dict(zip(INPUTS, (i, 2 * i, 254, -10.0, 2.5 * i), strict=True))
        | {"image_file": f"img_{i}.png"}
        for i in rows
    ]
    write_csv(folder / f"{experiment}.csv", table)
    (folder / f"images_{SIZE}").mkdir()
    for i in rows:
        content = pixels_of(i).permute(1, 2, 0).contiguous().numpy().tobytes()
        image = image_module.frombytes("RGB", (SIZE, SIZE), content)
        image.save(folder / f"images_{SIZE}" / f"img_{i}.png")


@pytest.mark.filterwarnings("ignore:Arrays of 2-dimensional:DeprecationWarning")
@pytest.mark.parametrize("size", [10, 63, 64, 100])
def test_simulator_is_model_f1_of_causalchamber(size: int) -> None:
    models = pytest.importorskip("causalchamber.models.image_capture")
    inputs = draw_inputs(30)
    inputs[0, 3:], inputs[1, 3:] = 0.0, torch.tensor([45.0, -45.0])
    first, second = np.deg2rad(inputs[:, 3].numpy()), np.deg2rad(inputs[:, 4].numpy())
    # NumPy's cosine, as its last bit decides at which integer a level is cut off.
    alpha = torch.as_tensor(np.cos(first - second) ** 2).unsqueeze(1)
    theta = torch.cat([inputs[:, :3], alpha], dim=1)
    images = HexagonSimulator(image_size=size)(theta)
    for row, image in zip(inputs.tolist(), images, strict=True):
        expected = torch.as_tensor(models.model_f1(*row, 0.5, 0.5, 0.22, 0, size))
        assert torch.equal(image * 255, expected.permute(2, 0, 1) * 1.0)


@pytest.mark.filterwarnings("ignore:Arrays of 2-dimensional:DeprecationWarning")
def test_stand_in_without_noise_is_model_f3_of_causalchamber() -> None:
    models = pytest.importorskip("causalchamber.models.image_capture")
    red, green = (0.29958, 0.06920, 0.02816), (0.04017, 0.92099, 0.31265)
    constants = {
        "S": np.array([red, green, (0.00217, 0.20716, 0.75763)]),
        **{"w_r": 2.65625, "w_g": 1.0, "w_b": 1.77344, "exposure": 2.5},
        "Tp": np.array([[0.29, 0.35, 0.33]]).T,
        "Tc": np.array([[0.02, 0.08, 0.18]]).T,
        **{"center_x": 0.5, "center_y": 0.5, "radius": 0.22, "offset": 0},
        "image_size": SIZE,
    }
    inputs = draw_inputs(30)
    theta = torch.cat([inputs[:, :3], malus(inputs[:, 3:])], dim=1)
    images = CameraSimulator(image_size=SIZE).image(theta)
    assert (images == 1).any()
    for row, image in zip(inputs.tolist(), images, strict=True):
        expected = models.model_f3(*row, **constants)
        torch.testing.assert_close(image, torch.as_tensor(expected).permute(2, 0, 1))


def test_dequantised_simulations_are_uniform_within_their_levels() -> None:
    theta = torch.tensor([[200.0, 101.0, 255.0, 1.0]]).expand(20, -1)
    plain = 255 * HexagonSimulator(image_size=SIZE)(theta)
    spread = 256 * HexagonSimulator(image_size=SIZE, dequantise=True)(theta)
    share = (spread - plain.round()).flatten()
    assert 0.0 <= share.min() < share.max() <= 1.0
    levels = torch.linspace(0.05, 0.95, 10)
    found = share[:200_000].quantile(levels)
    torch.testing.assert_close(found, levels, atol=0.01, rtol=0.0)
    assert spread[0].ne(spread[1]).all()


def test_camera_adds_noise_before_it_rounds_to_8_bit() -> None:
    theta = torch.tensor([[120.0, 60.0, 60.0, 0.5]]).expand(100, -1)
    camera = CameraSimulator(image_size=SIZE, sensor_noise=5 / 255)
    levels = 255 * camera(theta)
    torch.testing.assert_close(levels, levels.round(), rtol=0.0, atol=1e-4)
    inside = hexagon_mask(SIZE).bool()
    noise = (levels - 255 * camera.image(theta))[:, :, inside]
    assert noise.mean() == pytest.approx(0.0, abs=0.05)
    # Rounding adds the variance of a uniform error.
    assert noise.std() == pytest.approx(math.sqrt(25 + 1 / 12), rel=0.01)
    # Half of the noise on black is cut off.
    assert (levels[:, :, ~inside] == 0).float().mean() == pytest.approx(0.54, abs=0.01)


def test_crowded_parameters_are_beta_binomial() -> None:
    theta = draw_crowded(20_000)
    levels = betabinom(255, 5, 5).cdf(np.arange(0, 256, 16))
    for colour in theta[:, :3].T.numpy():
        shares = (colour[:, None] <= np.arange(0, 256, 16)).mean(axis=0)
        np.testing.assert_allclose(shares, levels, atol=0.015)
    angles = betabinom(360, 5, 5).rvs((20_000, 2), random_state=0) - 180.0
    alpha = malus(torch.as_tensor(angles)).flatten()
    steps = np.linspace(0.05, 0.95, 10)
    found, expected = np.quantile(theta[:, 3], steps), np.quantile(alpha, steps)
    np.testing.assert_allclose(found, expected, atol=0.02)


def test_rows_of_a_file_become_parameters_and_images(tmp_path: Path) -> None:
    write_experiment(tmp_path, UNIFORM, range(12))
    task = LightTunnel(root=tmp_path, image_size=SIZE)
    theta, x = all_recorded(task, 12)
    i = theta[:, 0]
    assert sorted(i.tolist()) == list(range(12))
    alpha = torch.deg2rad(10 + 2.5 * i).cos() ** 2
    expected = torch.stack([i, 2 * i, torch.full((12,), 254.0), alpha], dim=1)
    torch.testing.assert_close(theta, expected)
    images = torch.stack([pixels_of(int(row)) / 255 for row in i])
    assert torch.equal(x, images)


@pytest.mark.parametrize(
    ("variant", "calibration", "test"),
    [
        (None, UNIFORM, UNIFORM),
        ("biased_calibration", BETA_BINOMIAL, UNIFORM),
        ("misspecified_prior", BETA_BINOMIAL, BETA_BINOMIAL),
    ],
)
def test_each_variant_takes_its_sets_from_its_experiments(
    tmp_path: Path, variant: str | None, calibration: str, test: str
) -> None:
    # The second experiment has other rows, and parameters far from the middle.
    write_experiment(tmp_path, UNIFORM, range(12))
    write_experiment(tmp_path, BETA_BINOMIAL, range(50, 74))
    task = LightTunnel(root=tmp_path, image_size=SIZE, variant=variant)
    assert {path.stem for path in task.required_files} == {calibration, test}
    assert task.has_data
    for experiment, draw, share in (
        (calibration, task.get_calibration_set, 1),
        (test, task.get_test_set, 2),
    ):
        # All rows of the part are there: nothing is rejected.
        theta, _ = draw(share * (8 if experiment == BETA_BINOMIAL else 4))
        assert ((theta[:, 0] >= 50) == (experiment == BETA_BINOMIAL)).all()
