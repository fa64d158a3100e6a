"""Checks of input: what is accepted, what is refused, and in which words."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_rope._validation import (
    LARGEST_SETTING,
    as_float32,
    check_batch,
    check_choice,
    check_device,
    check_finite,
    check_in_support,
    check_integer,
    check_mapping,
    check_names,
    check_not_nan,
    check_not_negative,
    check_number,
    check_path,
    check_positive,
    check_tensor,
    check_unit_interval,
    check_weights,
)
from sbi_rope.errors import InvalidInputError, InvalidTypeError, shown

X = torch.tensor([[0.1, 0.9], [0.2, 0.8], [0.3, 0.7]])
HUGE = 10**5000


# No number at all, whatever is asked for.
class _Thing:
    def __repr__(self) -> str:
        return "a thing"  # without an address, which changes from run to run


THING = _Thing()
NO_NUMBERS = [
    *(None, "1", b"1", True, 1 + 1j, [1.0], {}, THING, HUGE, -HUGE),
    *(np.array([1.0, 2.0]), torch.tensor(1.0), float("nan"), float("inf")),
]


@pytest.mark.parametrize(
    "value",
    [
        X,
        X.double(),
        X.half(),
        X.bfloat16(),
        X.long(),
        X.byte(),
        X.clone().requires_grad_(),
    ],
    ids=lambda value: str(value.dtype),
)
def test_tensors_of_numbers_are_returned_as_they_came(value: torch.Tensor) -> None:
    assert check_tensor("x", value) is value


@pytest.mark.parametrize(
    ("value", "match"),
    [
        *((value, "torch.Tensor") for value in (None, 3, "x", X.tolist(), X.numpy())),
        (X.to(torch.complex64), "complex64"),
        (X > 0, "torch.bool"),
        (X.to(torch.float8_e4m3fn), "float8"),
        (X.to(torch.uint16), "uint16"),
        (torch.quantize_per_tensor(X, 0.1, 0, torch.qint8), "qint8"),
        (X.to_sparse(), "sparse_coo.*to_dense"),
        (X.to_sparse_csr(), "sparse_csr.*to_dense"),
    ],
    ids=str,
)
@pytest.mark.filterwarnings("ignore:Sparse CSR")
def test_what_is_no_dense_tensor_of_numbers_is_refused(value: Any, match: str) -> None:
    with pytest.raises(InvalidTypeError, match=rf"`x`.*{match}"):
        check_tensor("x", value)


@pytest.mark.parametrize(
    "check", [check_finite, check_not_nan, lambda name, x: check_batch(name, x, (2,))]
)
def test_a_tensor_without_numbers_is_not_looked_into(check: Callable) -> None:
    with pytest.raises(InvalidInputError, match="'meta'"):
        check("x", X.to("meta"))


def test_rows_without_a_number_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="at least one number in each row"):
        check_batch("x", X[:, :0], (0,))


def test_numbers_that_float32_has_not_are_refused() -> None:
    large = X.double()
    assert torch.equal(as_float32("x", large), X)
    large[1, 1] = -1e39
    with pytest.raises(InvalidInputError, match=r"`x`.*float32.*1 of 3.*\[1\]"):
        as_float32("x", large)


def test_another_device_is_named_with_what_lives_there() -> None:
    with pytest.raises(InvalidInputError, match="on meta, where `theta` is; got cpu"):
        check_device("x", X, torch.device("meta"), where="`theta`")


def test_an_empty_batch_is_in_every_support() -> None:
    check_in_support("x", X[:0], BoxUniform(torch.zeros(2), torch.ones(2)))


# Numbers -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "check",
    [
        check_number,
        check_positive,
        check_not_negative,
        check_unit_interval,
        check_integer,
    ],
)
@pytest.mark.parametrize("value", NO_NUMBERS, ids=shown)
def test_what_is_no_number_is_refused(check: Callable, value: object) -> None:
    with pytest.raises(InvalidInputError, match=r"`a`.*got") as error:
        check("a", value)
    assert len(str(error.value)) < 400


@pytest.mark.parametrize("value", [1, 1.0, np.float32(1), np.float64(1), np.int8(1)])
def test_numbers_of_python_and_numpy_are_accepted(value: float) -> None:
    for check in (
        check_number,
        check_positive,
        check_not_negative,
        check_unit_interval,
    ):
        check("a", value)


def test_a_number_may_have_a_largest_size() -> None:
    for check in (check_number, check_positive, check_not_negative):
        check("a", 1e300)
        check("a", 1e30, maximum=LARGEST_SETTING)
        with pytest.raises(InvalidInputError, match=r"at most 1e\+30; got 1e\+39"):
            check("a", 1e39, maximum=LARGEST_SETTING)


@pytest.mark.parametrize("value", [3, np.int64(3), np.uint8(3)])
def test_integers_of_python_and_numpy_are_accepted(value: int) -> None:
    check_integer("n", value, maximum=3)
    with pytest.raises(InvalidInputError, match=r"from 1 to 2; got .*3"):
        check_integer("n", value, maximum=2)


def test_an_integer_is_one_that_torch_holds_unless_any_is_asked_for() -> None:
    with pytest.raises(InvalidInputError, match=f"from 1 to {2**63 - 1}"):
        check_integer("n", 2**63)
    check_integer("n", HUGE, maximum=None)


@pytest.mark.parametrize(
    "value",
    [
        *([0.25, 0.75], (0.25, 0.75), np.array([0.25, 0.75], dtype=np.float32)),
        torch.tensor([0.25, 0.75], requires_grad=True),
    ],
    ids=shown,
)
def test_weights_may_come_in_any_container(value: Any) -> None:
    assert check_weights("w", value, 2) == [0.25, 0.75]


def test_weights_keep_their_digits() -> None:
    assert check_weights("w", [0.3, 0.7], 2) == [0.3, 0.7]


@pytest.mark.parametrize(
    "value",
    [
        *(None, 3, "ab", b"ab", {0.5, 0.6}, {}, THING, [0.5, None], [0.5, "a"]),
        *([0.5 + 0j, 0.5], [True, False], [HUGE, 1], [[0.5], [0.5, 0.5]], [[0.5, 0.5]]),
        *([float("nan"), 1.0], [1.5, -0.5], [0.5, 0.6], X, X[0].to_sparse()),
        *(X[0].to("meta"), np.array([0.5, 0.6]), np.array(["a", "b"])),
    ],
    ids=shown,
)
def test_what_are_no_weights_is_refused(value: Any) -> None:
    with pytest.raises((InvalidInputError, InvalidTypeError), match="`w`"):
        check_weights("w", value, 2)


# Words -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "choices"),
    [
        *(("a", ("a", "b")), (np.str_("a"), ("a",)), (None, (None, "a"))),
        *((64, (64, 100)), (np.int64(64), (64,)), (False, (None, True, False))),
        (torch.float32, (torch.float64, torch.float32)),
    ],
)
def test_choices_are_accepted(value: Any, choices: tuple) -> None:
    check_choice("kind", value, choices)


@pytest.mark.parametrize("choices", [("a", "b"), (64, 1), (None, True)])
@pytest.mark.parametrize(
    "value",
    [
        *("c", 64.0, ["a"], {}, b"a", THING, float("nan"), HUGE),
        *(np.array(["a", "b"]), np.array([64, 1]), np.array("a"), X, torch.tensor(64)),
    ],
    ids=shown,
)
def test_what_is_no_choice_is_refused(value: Any, choices: tuple) -> None:
    with pytest.raises(InvalidInputError, match=r"`kind` to be one of \[.*got"):
        check_choice("kind", value, choices)


def test_true_is_not_taken_for_one() -> None:
    with pytest.raises(InvalidInputError, match="got True"):
        check_choice("size", True, (1, 2))
    with pytest.raises(InvalidInputError, match="got 1"):
        check_choice("blocked", 1, (None, True))


def test_names_are_a_list_of_strings() -> None:
    assert check_names("names", ("a", "b"), 2) == ["a", "b"]
    assert check_names("names", np.array(["a", "b"])) == ["a", "b"]
    with pytest.raises(InvalidInputError, match="length 2; got 1"):
        check_names("names", ["a"], 2)
    for value in ("ab", b"ab", None, 3, [1, 2], ["a", None], {"a": 1}, THING):
        with pytest.raises(InvalidTypeError, match="`names` to be a list of strings"):
            check_names("names", value)


def test_a_mapping_has_entries_with_names() -> None:
    check_mapping("samples", {"a": 1}, like="samples")
    with pytest.raises(InvalidInputError, match="at least one entry"):
        check_mapping("samples", {}, like="samples")
    for value in (None, 3, "a", [1], X, {1: X}):
        with pytest.raises(InvalidTypeError, match="samples"):
            check_mapping("samples", value, like="samples")


def test_a_path_is_a_string_or_a_path() -> None:
    assert check_path("root", "~/a") == Path("~/a").expanduser()
    assert check_path("root", None, optional=True) is None
    for value in (None, 3, b"a", ["a"], THING):
        with pytest.raises(InvalidTypeError, match="`root` to be a path; got"):
            check_path("root", value)
    for text in ("a\0b", "~nobody_of_this_name/a"):
        with pytest.raises(InvalidInputError, match="`root` to be a path"):
            check_path("root", text)


@pytest.mark.parametrize(
    "value", [HUGE, "a" * 10**6, np.zeros(10**4), [0] * 10**4], ids=type
)
def test_a_value_is_shown_in_a_few_words(value: Any) -> None:
    assert len(shown(value)) < 250
