"""The README's example runs as it stands."""

import re
from pathlib import Path

import torch

from tests.stacks import quick

README = Path(__file__).resolve().parents[2] / "README.md"


def test_the_example_stands_alone_and_repairs_a_posterior() -> None:
    text = README.read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    # With fewer simulations, for speed. `.ci/package` runs it as it is.
    assert "prior.sample((2000,))" in code
    names: dict[str, object] = {}
    with quick():
        exec(code.replace("prior.sample((2000,))", "prior.sample((200,))"), names)
    samples = names["samples"]
    assert isinstance(samples, torch.Tensor)
    assert samples.shape == (1000, 5, 2)
    assert torch.isfinite(samples).all()


def test_the_readme_is_short() -> None:
    words = re.findall(r"\w\S*", README.read_text(encoding="utf-8"))
    assert len(words) <= 1000
