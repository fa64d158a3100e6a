"""The code on the pages of the documentation runs as it stands."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from sbi_rope import RoPE
from tests import problems, stacks

ROOT = Path(__file__).resolve().parents[2]
START = [ROOT / "docs/index.md", ROOT / "docs/start/in_and_out.md"]
PAGES = [
    page
    for page in START + sorted(ROOT.glob("docs/howto/*.md"))
    if "```python" in page.read_text(encoding="utf-8")
]

# As many readings as parameters, because a page simulates both in one shape.
DIM = 3


@pytest.fixture(scope="module")
def known() -> dict[str, Any]:
    """Return what `docs/howto/index.md` says that the names mean."""
    npe_posterior, simulator = problems.npe_posterior("mdn", dim=DIM), problems.simulate
    with torch.random.fork_rng():
        torch.manual_seed(0)
        theta = problems.box(DIM).sample((1000,))
        x = simulator(theta)
    theta_cal, x_cal = stacks.problem(10, seed=1, dim=DIM)
    theta_o, x_o = stacks.problem(30, seed=2, dim=DIM)
    rope = RoPE(npe_posterior, simulator=simulator)
    rope.append_calibration(theta_cal, x_cal)
    npe = SimpleNamespace(build_posterior=lambda: npe_posterior)
    names = {"npe": npe, "simulator": simulator, "theta": theta, "x": x}
    names |= {"theta_cal": theta_cal, "x_cal": x_cal, "theta_o": theta_o, "x_o": x_o}
    return {**names, "rope": rope, "posterior": stacks.stacked(rope)}


@pytest.mark.docs
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_code_of_a_page_runs(
    page: Path,
    known: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)  # for what pages save
    text = page.read_text(encoding="utf-8")
    names = dict(known)
    with stacks.quick():
        for block in re.findall(r"^```python\n(.*?)^```", text, flags=re.S | re.M):
            exec(block, names)
