"""The README's example runs as it stands."""

import re
from pathlib import Path

import pytest
import torch

from tests.stacks import quick

ROOT = Path(__file__).resolve().parents[2]


def example(page: str) -> str:
    text = (ROOT / page).read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    return code


@pytest.mark.slow
def test_the_example_stands_alone_and_repairs_a_posterior() -> None:
    # With fewer simulations and epochs, for speed. `.ci/package` runs it as it is.
    code = example("README.md").replace("(2000,)", "(200,)")
    code = code.replace(".train()", ".train(max_num_epochs=20)")
    names: dict[str, object] = {}
    with quick():
        exec(code, names)
    samples = names["samples"]
    assert isinstance(samples, torch.Tensor)
    assert samples.shape == (1000, 5, 2)
    assert torch.isfinite(samples).all()


def test_the_first_page_of_the_site_has_the_same_example() -> None:
    assert example("docs/start/five_minutes.md") == example("README.md")


def test_the_readme_is_short() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(re.findall(r"\w\S*", text)) <= 1000
