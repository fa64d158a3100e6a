"""The README's example runs as it stands."""

import re
from pathlib import Path

import pytest
import torch

from tests.stacks import quick

README = Path(__file__).resolve().parents[2] / "README.md"


@pytest.mark.slow
def test_the_example_stands_alone_and_repairs_a_posterior() -> None:
    text = README.read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    # With fewer simulations and epochs, for speed. `.ci/package` runs it as it is.
    for usual, fewer in (
        ("(2000,)", "(200,)"),
        (".train()", ".train(max_num_epochs=20)"),
    ):
        assert usual in code
        code = code.replace(usual, fewer)
    names: dict[str, object] = {}
    with quick():
        exec(code, names)
    samples = names["samples"]
    assert isinstance(samples, torch.Tensor)
    assert samples.shape == (1000, 5, 2)
    assert torch.isfinite(samples).all()


def test_the_readme_is_short() -> None:
    words = re.findall(r"\w\S*", README.read_text(encoding="utf-8"))
    assert len(words) <= 1000
