"""The README's code runs as it stands."""

import re
from pathlib import Path

import torch

from tests import gaussian
from tests.stacks import quick

README = Path(__file__).resolve().parents[2] / "README.md"


class TrainedNPE:
    """Stands for the user's `npe`, whose posterior is known here."""

    def build_posterior(self) -> object:
        return gaussian.posterior()


def test_the_lines_repair_a_posterior() -> None:
    code = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)
    assert len(code) == 3
    theta_cal, x_cal = gaussian.labelled(3)  # three folds, for speed
    names = {
        "npe": TrainedNPE(),
        "simulator": gaussian.simulator,
        "theta_cal": theta_cal,
        "x_cal": x_cal,
        "x_o": gaussian.labelled(30)[1],
    }
    with quick():
        exec(code[0], names)
    assert names["samples"].shape == (1000, 30, 2)
    assert torch.isfinite(names["samples"]).all()
    # The other blocks are about a fixed setting and another method, by the same names.
    for block in code[1:]:
        exec(block, names)
        samples = names["posterior"].sample_batched((10,), x=names["x_o"])
        assert torch.isfinite(samples).all()
