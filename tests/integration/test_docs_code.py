"""The code of README and on the pages of the documentation runs as it stands."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from sbi_rope import RoPE
from tests import problems, stacks

ROOT = Path(__file__).resolve().parents[2]
README = ROOT / "README.md"
START = [ROOT / "docs/index.md", ROOT / "docs/start/in_and_out.md"]


def blocks(page: Path) -> list[str]:
    text = page.read_text(encoding="utf-8")
    return re.findall(r"^```python\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)


PAGES = [page for page in START + sorted(ROOT.glob("docs/howto/*.md")) if blocks(page)]
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
    page: Path, known: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # for what pages save
    names = dict(known)
    with stacks.quick():
        for block in blocks(page):
            exec(block, names)


@pytest.mark.slow
def test_the_example_of_the_readme_stands_alone() -> None:
    # With fewer simulations and epochs, for speed. `.ci/package` runs it as it is.
    code = blocks(README)[0].replace("(2000,)", "(200,)")
    names: dict[str, Any] = {}
    with stacks.quick():
        exec(code.replace(".train()", ".train(max_num_epochs=20)"), names)
    assert names["samples"].shape == (1000, 5, 2)
    assert torch.isfinite(names["samples"]).all()


def test_the_readme_is_short_and_the_first_page_has_its_example() -> None:
    assert blocks(ROOT / "docs/start/five_minutes.md") == blocks(README)
    assert len(re.findall(r"\w\S*", README.read_text(encoding="utf-8"))) <= 1000
