"""Recorded experiments in the official layout, made by the stand-ins.

What they hold is synthetic; folders, names, columns and kinds of files are those of
the published data sets.
"""

from pathlib import Path

import pytest
import torch

from sbi_rope.tasks.light_tunnel import BETA_BINOMIAL, UNIFORM
from sbi_rope.tasks.light_tunnel_models import CameraSimulator, draw_crowded, malus
from sbi_rope.tasks.wind_tunnel_model import SAMPLE_TIMES, WindTunnelSimulator

AMBIENT = 95_742.9


def write_camera_experiments(root: Path, *, num_rows: int, size: int = 64) -> None:
    """Write the two experiments of task E below ``root/lt_camera_v1``."""
    image_module = pytest.importorskip("PIL.Image")
    camera = CameraSimulator(image_size=size)
    for experiment in (UNIFORM, BETA_BINOMIAL):
        folder = root / "lt_camera_v1" / experiment
        (folder / f"images_{size}").mkdir(parents=True)
        colours = torch.randint(0, 255, (num_rows, 3)).double()
        angles = torch.randint(-1800, 1800, (num_rows, 2)) / 10
        if experiment == BETA_BINOMIAL:
            colours = draw_crowded(num_rows)[:, :3].double()
            angles = 360 * (torch.rand(num_rows, 2, 9).median(dim=2).values - 0.5)
        theta = torch.cat([colours, malus(angles.double())], dim=1)
        levels = (255 * camera(theta)).round().byte().permute(0, 2, 3, 1)
        lines = ["timestamp,counter,red,green,blue,pol_1,pol_2,image_file"]
        for i in range(num_rows):
            name = f"image_{i:05d}.png"
            red, green, blue = colours[i].tolist()
            lines.append(
                f"{i},{i},{red},{green},{blue},{angles[i, 0]},{angles[i, 1]},{name}"
            )
            content = levels[i].contiguous().numpy().tobytes()
            image = image_module.frombytes("RGB", (size, size), content)
            image.save(folder / f"images_{size}" / name, compress_level=1)
        (folder / f"{experiment}.csv").write_text("\n".join(lines) + "\n")


def write_impulses(root: Path, *, num_impulses: int) -> None:
    """Write the experiment of task F below ``root/wt_intake_impulse_v1``."""
    folder = root / "wt_intake_impulse_v1"
    folder.mkdir()
    hatch = (450 * torch.rand(num_impulses, 1)).round() / 10
    pressure = WindTunnelSimulator(exhaust_offset=20.0)(hatch.double())
    lines = ["timestamp,flag,hatch,load_in,load_out,pressure_downwind,pressure_ambient"]
    for i in range(num_impulses):
        for k, time in enumerate(SAMPLE_TIMES):
            lines.append(
                f"{10 * i + time},{i},{hatch[i, 0]:.1f},{1.0 if 5 <= k < 25 else 0.01},"
                f"0.5,{AMBIENT + pressure[i, k]:.6f},{AMBIENT}"
            )
    (folder / "load_out_0.5_osr_downwind_4.csv").write_text("\n".join(lines) + "\n")
