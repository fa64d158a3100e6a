"""The light tunnel's images: two models, recorded images, and a posterior from them."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
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
from tests.tasks import all_recorded

SIZE = 64
WriteData = Callable[..., Path]


def draw_inputs(n: int) -> Tensor:
    """Draw colours and angles as the protocol of the uniform experiment does."""
    colours = torch.randint(0, 255, (n, 3)).double()
    angles = torch.randint(-1800, 1800, (n, 2)).double() / 10
    return torch.cat([colours, angles], dim=1)


def pixels_of(row: int, size: int = SIZE) -> Tensor:
    """Return the recorded image of a row of the fixture, (3, size, size)."""
    generator = torch.Generator().manual_seed(row)
    return torch.randint(256, (3, size, size), generator=generator, dtype=torch.uint8)


@pytest.fixture
def write_data(tmp_path: Path) -> WriteData:
    """Write a small experiment in the official layout, and return the root."""
    image_module = pytest.importorskip("PIL.Image")

    def write(
        num_rows: int = 12,
        *,
        experiment: str = UNIFORM,
        size: int = SIZE,
        offset: int = 0,
    ) -> Path:
        folder = tmp_path / DATASET / experiment
        images = folder / f"images_{size}"
        images.mkdir(parents=True)
        columns = ["timestamp", *INPUTS, "image_file"]
        lines = [",".join(columns)]
        for i in range(offset, offset + num_rows):
            row = {
                "timestamp": i,
                "red": i,
                "green": 2 * i,
                "blue": 254,
                "pol_1": -10.0,
                "pol_2": 2.5 * i,
                "image_file": f"img_{i}.png",
            }
            lines.append(",".join(str(row[column]) for column in columns))
            content = pixels_of(i, size).permute(1, 2, 0).contiguous().numpy()
            image = image_module.frombytes("RGB", (size, size), content.tobytes())
            image.save(images / f"img_{i}.png")
        (folder / f"{experiment}.csv").write_text("\n".join(lines) + "\n")
        return tmp_path

    return write


# The models --------------------------------------------------------------------------


def package() -> object:
    """Return causalchamber's models, or skip."""
    return pytest.importorskip("causalchamber.models.image_capture")


@pytest.mark.filterwarnings("ignore:Arrays of 2-dimensional:DeprecationWarning")
def test_the_mask_is_that_of_causalchamber() -> None:
    for size in (10, 63, 64, 100, 500):
        expected = package().hexagon_mask(0.5, 0.5, 0.22, 0, size)  # type: ignore[attr-defined]
        assert torch.equal(hexagon_mask(size).bool(), torch.as_tensor(expected))


def test_the_mask_has_the_known_number_of_pixels() -> None:
    found = {size: int(hexagon_mask(size).sum()) for size in (64, 100, 500)}
    assert found == {64: 525, 100: 1277, 500: 31489}


@pytest.mark.filterwarnings("ignore:Arrays of 2-dimensional:DeprecationWarning")
@pytest.mark.parametrize("size", [64, 100])
def test_simulator_is_model_f1_of_causalchamber(size: int) -> None:
    np = pytest.importorskip("numpy")
    inputs = draw_inputs(30)
    inputs[0, 3:], inputs[1, 3:] = 0.0, torch.tensor([45.0, -45.0])
    first, second = np.deg2rad(inputs[:, 3].numpy()), np.deg2rad(inputs[:, 4].numpy())
    # NumPy's cosine, as its last bit decides at which integer a level is cut off.
    alpha = torch.as_tensor(np.cos(first - second) ** 2).unsqueeze(1)
    theta = torch.cat([inputs[:, :3], alpha], dim=1)
    images = HexagonSimulator(image_size=size)(theta)
    for row, image in zip(inputs.tolist(), images, strict=True):
        expected = package().model_f1(*row, 0.5, 0.5, 0.22, 0, size)  # type: ignore[attr-defined]
        assert torch.equal(
            image * 255, torch.as_tensor(expected).permute(2, 0, 1) * 1.0
        )


@pytest.mark.filterwarnings("ignore:Arrays of 2-dimensional:DeprecationWarning")
def test_stand_in_without_noise_is_model_f3_of_causalchamber() -> None:
    np = pytest.importorskip("numpy")
    response = np.array(
        [
            [0.29958, 0.06920, 0.02816],
            [0.04017, 0.92099, 0.31265],
            [0.00217, 0.20716, 0.75763],
        ]
    )
    constants = {
        "S": response,
        "w_r": 2.65625,
        "w_g": 1.0,
        "w_b": 1.77344,
        "exposure": 2.5,
        "Tp": np.array([[0.29, 0.35, 0.33]]).T,
        "Tc": np.array([[0.02, 0.08, 0.18]]).T,
        "center_x": 0.5,
        "center_y": 0.5,
        "radius": 0.22,
        "offset": 0,
        "image_size": SIZE,
    }
    inputs = draw_inputs(30)
    theta = torch.cat([inputs[:, :3], malus(inputs[:, 3:])], dim=1)
    images = CameraSimulator(image_size=SIZE).image(theta)
    assert (images == 1).any()
    for row, image in zip(inputs.tolist(), images, strict=True):
        expected = package().model_f3(*row, **constants)  # type: ignore[attr-defined]
        torch.testing.assert_close(image, torch.as_tensor(expected).permute(2, 0, 1))


def test_dequantised_simulations_are_uniform_within_their_levels() -> None:
    theta = torch.tensor([[200.0, 101.0, 255.0, 1.0]]).expand(20, -1)
    plain = 255 * HexagonSimulator(image_size=SIZE)(theta)
    spread = 256 * HexagonSimulator(image_size=SIZE, dequantise=True)(theta)
    share = (spread - plain.round()).flatten()
    assert share.min() >= 0.0
    assert share.max() <= 1.0
    levels = torch.linspace(0.05, 0.95, 10)
    torch.testing.assert_close(
        share[:200_000].quantile(levels), levels, atol=0.01, rtol=0.0
    )
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


# The prior and the protocols ---------------------------------------------------------


def test_crowded_parameters_are_beta_binomial() -> None:
    stats = pytest.importorskip("scipy.stats")
    theta = draw_crowded(20_000)
    colours = stats.betabinom(255, 5, 5)
    assert torch.equal(theta[:, :3], theta[:, :3].round())
    for colour in theta[:, :3].T:
        grid = torch.arange(0, 256, 16)
        shares = (colour.unsqueeze(1) <= grid).float().mean(dim=0)
        expected = torch.as_tensor(colours.cdf(grid)).float()
        torch.testing.assert_close(shares, expected, atol=0.015, rtol=0.0)
    angles = stats.betabinom(360, 5, 5).rvs((2, 20_000), random_state=0) - 180.0
    alpha = malus(torch.as_tensor(angles).T).flatten()
    levels = torch.linspace(0.05, 0.95, 10)
    torch.testing.assert_close(
        theta[:, 3].quantile(levels),
        alpha.quantile(levels.double()).float(),
        atol=0.02,
        rtol=0.0,
    )
    assert theta.dtype == torch.float32


# Recorded images ---------------------------------------------------------------------


def test_rows_of_a_file_become_parameters_and_images(write_data: WriteData) -> None:
    task = LightTunnel(root=write_data(), image_size=SIZE)
    theta, x = all_recorded(task, 12)
    assert sorted(theta[:, 0].tolist()) == list(range(12))
    i = theta[:, 0]
    alpha = torch.deg2rad(10 + 2.5 * i).cos() ** 2
    expected = torch.stack([i, 2 * i, torch.full((12,), 254.0), alpha], dim=1)
    torch.testing.assert_close(theta, expected)
    assert x.dtype == torch.float32
    for row, image in zip(i.tolist(), x, strict=True):
        assert torch.equal(image, pixels_of(int(row)) / 255)


@pytest.mark.parametrize(
    ("variant", "calibration", "test"),
    [
        (None, UNIFORM, UNIFORM),
        ("biased_calibration", BETA_BINOMIAL, UNIFORM),
        ("misspecified_prior", BETA_BINOMIAL, BETA_BINOMIAL),
    ],
)
def test_each_variant_takes_its_sets_from_its_experiments(
    write_data: WriteData, variant: str | None, calibration: str, test: str
) -> None:
    write_data()
    # The second experiment has other rows, and parameters far from the middle.
    root = write_data(24, experiment=BETA_BINOMIAL, offset=50)
    task = LightTunnel(root=root, image_size=SIZE, variant=variant)
    assert task.required_files == tuple(
        Path(DATASET, name, f"{name}.csv")
        for name in dict.fromkeys((calibration, test))
    )
    assert task.has_data
    for experiment, draw, num_rows in (
        (calibration, task.get_calibration_set, {UNIFORM: 4, BETA_BINOMIAL: 8}),
        (test, task.get_test_set, {UNIFORM: 8, BETA_BINOMIAL: 16}),
    ):
        # All rows of the part are there: nothing is rejected.
        theta, _ = draw(num_rows[experiment])
        assert ((theta[:, 0] >= 50) == (experiment == BETA_BINOMIAL)).all()
