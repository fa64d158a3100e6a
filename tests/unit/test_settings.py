"""Settings accept what fits their type hints, and say what they expected."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import pytest
import torch

from sbi_rope import RoPE
from sbi_rope.utils.errors import InvalidInputError
from sbi_rope.utils.settings import (
    Count,
    Level,
    NotNegative,
    Number,
    Positive,
    Range,
    Seed,
    Settings,
    UnitInterval,
    check,
    one_of,
)
from tests.refusals import assert_refused

NO_NUMBERS = (None, "1", True, 1j, [1.0], np.ones(2), torch.tensor(1.0), math.nan)


@pytest.mark.parametrize(
    ("kind", "good", "bad"),
    [
        (Number, (-1e300, np.float32(2)), (*NO_NUMBERS, math.inf)),
        (Positive, (1e-300, 1), (*NO_NUMBERS, 0, -1.0, math.inf)),
        (NotNegative, (0, 1e300), (*NO_NUMBERS, -1e-300, math.inf)),
        (UnitInterval, (0, 0.5, 1), (*NO_NUMBERS, -0.1, 1.1)),
        (Level, (1e-9, 0.5), (*NO_NUMBERS, 0, 1)),
        (Count, (1, np.int64(3), 10**400), (*NO_NUMBERS, 0, -1, 1.0)),
        (Seed, (None, 0, 2**70), (*NO_NUMBERS[1:], -1, 1.5)),
        (Annotated[int, Range(2, 5)], (2, 5), (1, 6, math.inf)),
        (bool, (True, False), (0, 1, None, "True")),
        (Literal["own", "pot"], ("own", np.str_("pot")), ("x", None, ["own"], 1)),
        (Literal[64, 100], (64, np.int64(100)), (65, "64", True, np.array([64]))),
        (one_of((True, None)), (True, None), (False, 1, "None")),
        (RoPE | None, (None,), (RoPE, 1)),
        (Positive | Literal["auto"], (2.0, "auto"), (0, "x", None)),
        (Callable[..., Any], (print, int), (None, "print")),
        (Sequence[Positive], ([1, 2.0], (0.5,)), ([], 1.0, "12", [1, -1], [True])),
        (tuple[Count, ...], ((1, 2),), ([1, 2], (), (0,), (1.5,))),
        (Any, (None, 1, "a"), ()),
    ],
)
def test_values_fit_their_hints(
    kind: Any, good: tuple[Any, ...], bad: tuple[Any, ...]
) -> None:
    for value in good:
        check("setting", value, kind)
    for value in bad:
        assert_refused("`setting` to be .*; got", check, "setting", value, kind)


def test_a_message_says_what_was_expected_in_words() -> None:
    for value, kind, words in (
        (0, Positive, "a number above 0; got 0"),
        (math.inf, Number, "a number that is finite; got inf"),
        (-1, Seed, "an integer of at least 0 or None; got -1"),
        (9, Annotated[int, Range(2, 5)], "an integer from 2 to 5; got 9"),
        ("x", Literal["own", None], r"one of \['own', None\]; got 'x'"),
        (3, RoPE | None, "a RoPE or None; got 3"),
    ):
        message = f"^Expected `a` to be {words}.$"
        assert_refused(message, check, "a", value, kind, error=InvalidInputError)


@dataclass(frozen=True)
class Kernel(Settings):
    width: Positive
    solver: Literal["own", "pot"] = "own"


@dataclass(frozen=True)
class Kernels(Kernel):
    num_steps: Count | None = None


def test_a_class_of_settings_checks_its_fields_and_those_of_its_base() -> None:
    assert Kernels(0.5, num_steps=3) == Kernels(0.5, "own", 3)
    assert_refused("`width`.*above 0; got 0", Kernels, 0)
    assert_refused("`solver`.*got 'x'", Kernels, 0.5, "x")
    assert_refused("`num_steps`.*got 0", Kernels, 0.5, num_steps=0)
