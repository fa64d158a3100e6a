"""Settings, tensors, seeds and progress bars, which all rooms use."""

import math
import random
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
import pytest
import torch

from sbi_rope import RoPE, stack
from sbi_rope.utils.errors import InvalidInputError
from sbi_rope.utils.progress import is_shown
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import (
    Count,
    Level,
    Number,
    Positive,
    Range,
    Seed,
    UnitInterval,
    check,
    one_of,
)
from sbi_rope.utils.tensors import as_batch, as_numbers
from tests import baselines, gaussian
from tests.refusals import assert_refused
from tests.stacks import BOX, NPE, PRIOR, QUICK, quick

NO_NUMBERS = (None, "1", True, 1j, [1.0], np.ones(2), torch.tensor(1.0), math.nan)


@pytest.mark.parametrize(
    ("kind", "good", "bad"),
    [
        (Number, (-1e300, np.float32(2)), (*NO_NUMBERS, math.inf)),
        (Positive, (1e-300, 1), (*NO_NUMBERS, 0, -1.0, math.inf)),
        (UnitInterval, (0, 0.5, 1), (*NO_NUMBERS, -0.1, 1.1)),
        (Level, (1e-9, 0.5), (*NO_NUMBERS, 0, 1)),
        (Count, (1, np.int64(3), 10**400), (*NO_NUMBERS, 0, -1, 1.0)),
        (Seed, (None, 0, 2**70), (*NO_NUMBERS[1:], -1, 1.5)),
        (Annotated[int, Range(2, 5)], (2, 5), (1, 6, math.inf)),
        (bool, (True, False), (0, 1, None, "True")),
        (Literal["own", "pot"], ("own", np.str_("pot")), ("x", None, ["own"], 1)),
        (one_of((64, 100)), (64, np.int64(100)), (65, "64", True, np.array([64]))),
        (RoPE | None, (None,), (RoPE, 1)),
        (Callable[..., Any], (print, int), (None, "print")),
        (Sequence[Positive], ([1, 2.0], (0.5,)), ([], 1.0, "12", [1, -1], [True])),
    ],
)
def test_values_fit_their_hints(
    kind: Any, good: tuple[Any, ...], bad: tuple[Any, ...]
) -> None:
    for value in good:
        check("setting", value, kind)
    for value in bad:
        assert_refused("`setting` to be .*; got", check, "setting", value, kind)


X = torch.tensor([[0.1, 0.9], [0.2, 0.8], [0.3, 0.7]])


@pytest.mark.parametrize(
    "value",
    [
        X.tolist(),
        X.double().numpy(),
        list(X),
        pd.DataFrame(X.numpy()),
        X.clone().requires_grad_(),
    ],
    ids=lambda value: type(value).__name__,
)
def test_numbers_in_any_container_become_a_tensor_of_float32(value: Any) -> None:
    found = as_batch("x", value, (2,), rows=3, device=torch.device("cpu"))
    assert found.dtype == as_batch("x", X.long()).dtype == torch.float32
    assert not found.requires_grad
    assert torch.equal(found, X)
    assert as_batch("x", X.double()).dtype == torch.float64


def test_what_holds_no_real_numbers_is_refused() -> None:
    frame = pd.DataFrame({"speed": [1.0, 2.0], "mouse": ["a", "b"]})
    complex_x = X.to(torch.complex64)
    for value in (None, ["a"], [[1.0], [1.0, 2.0]], frame, complex_x):
        match = "^Expected `x` to be a tensor, an array, a table or a list of numbers"
        assert_refused(match, as_numbers, "x", value, error=InvalidInputError)


def test_masked_numbers_and_missing_ones_of_a_table_are_nan() -> None:
    masked = np.ma.masked_equal([[1, -9], [3, 4]], -9)
    frame = pd.DataFrame({"a": [1.0, 3.0], "b": pd.array([None, 4], dtype="Float64")})
    for value in (masked, frame.astype(float)):
        found = as_batch("x", value, (2,), finite=False)
        assert torch.equal(found.nan_to_num(-9), torch.tensor([[1.0, -9], [3, 4]]))
        match = r"NaN or Inf in 1 of 2 rows \(first: \[0\]\)"
        assert_refused(match, as_batch, "x", value)


def draws() -> list[float]:
    numbers = float(torch.rand(())), float(np.random.uniform()), random.random()  # noqa: NPY002
    return list(numbers)


def test_blocks_give_the_same_numbers_again_and_restore_the_state_around_them() -> None:
    with seeded(1):
        expected = [draws(), draws()]
    with seeded(1):
        first = draws()
        with suppress(ArithmeticError), seeded(2):
            assert draws() != first
            raise ArithmeticError
        with seeded(None):
            assert [first, draws()] == expected


def test_bars_are_shown_by_default_where_they_can_be_redrawn(
    terminal: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert is_shown(None)
    monkeypatch.setattr(type(sys.stderr), "isatty", lambda self: False)
    assert not is_shown(None)
    assert is_shown(True)
    monkeypatch.setattr("sys.stderr", None)  # as of a program without a console
    assert not is_shown(None)


def work(*, show: bool) -> None:
    """Call what a user calls."""
    options: Any = {"show_progress_bars": show}
    x_o = gaussian.labelled(30)[1]
    rope = RoPE(gaussian.posterior(), simulator=gaussian.simulator, finetuner=QUICK)
    rope.append_calibration(*gaussian.labelled(10)).train(**options)
    posterior = rope.build_posterior(x_o, **options)
    posterior.sample_batched((10,), x=x_o, **options)
    posterior[0].sample((10,), **options)
    with quick():
        stack(rope, candidates=(PRIOR, NPE, BOX), num_folds=2, **options)
    method = baselines.make("tuning_only", "linear_gaussian")
    data = baselines.data_of("linear_gaussian")
    baselines.feed(method, data).train(**options).build_posterior()


@pytest.mark.filterwarnings("ignore")
def test_bars_are_shown_on_stderr_if_and_only_if_they_are_asked_for(
    terminal: pytest.CaptureFixture[str],
) -> None:
    work(show=False)
    assert terminal.readouterr() == ("", "")
    work(show=True)
    printed = terminal.readouterr()
    assert printed.out == ""
    for bar in ("Fine-tuning", "Sampling", "Epochs trained: 3"):
        assert bar in printed.err
