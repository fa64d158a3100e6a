"""Each check accepts good input and refuses bad input with a helpful message."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_rope._validation import (
    LARGEST_SETTING,
    as_float32,
    as_numbers,
    check_batch,
    check_choice,
    check_columns,
    check_device,
    check_finite,
    check_in_support,
    check_integer,
    check_mapping,
    check_names,
    check_not_nan,
    check_not_negative,
    check_not_swapped,
    check_number,
    check_path,
    check_positive,
    check_tensor,
    check_unit_interval,
    check_weights,
    column_names,
)
from sbi_rope.errors import InvalidInputError, shown
from tests.refusals import assert_refused

X = torch.tensor([[0.1, 0.9], [0.2, 0.8], [0.3, 0.7]])
HUGE = 10**5000


class _Thing:
    def __repr__(self) -> str:
        return "a thing"


THING = _Thing()
NO_NUMBERS = [
    *(None, "1", b"1", True, 1 + 1j, [1.0], {}, THING, HUGE, -HUGE),
    *(np.array([1.0, 2.0]), torch.tensor(1.0), float("nan"), float("inf")),
]
CHECKS_OF_NUMBERS = (
    check_number,
    check_positive,
    check_not_negative,
    check_unit_interval,
)


def test_tensors_of_numbers_are_returned_unchanged() -> None:
    same = (X, X.double(), X.half(), X.bfloat16(), X.long(), X.byte())
    for value in (*same, X.clone().requires_grad_()):
        assert check_tensor("x", value) is value, value.dtype


@pytest.mark.filterwarnings("ignore:Sparse CSR")
def test_what_is_no_dense_tensor_of_real_numbers_is_refused() -> None:
    for value in (None, 3, "x", X.tolist(), X.numpy()):
        assert_refused(
            "`x`.*torch.Tensor", check_tensor, "x", value, error=InvalidInputError
        )
    for value, match in (
        (X.to(torch.complex64), "complex64"),
        (X > 0, "torch.bool"),
        (X.to(torch.float8_e4m3fn), "float8"),
        (X.to(torch.uint16), "uint16"),
        (torch.quantize_per_tensor(X, 0.1, 0, torch.qint8), "qint8"),
        (X.to_sparse(), "sparse_coo.*to_dense"),
        (X.to_sparse_csr(), "sparse_csr.*to_dense"),
    ):
        assert_refused(
            f"`x`.*{match}", check_tensor, "x", value, error=InvalidInputError
        )


def test_a_tensor_without_numbers_is_refused() -> None:
    assert_refused("'meta'", check_finite, "x", X.to("meta"))
    assert_refused("'meta'", check_not_nan, "x", X.to("meta"))
    assert_refused("'meta'", check_batch, "x", X.to("meta"), (2,))
    match = "at least one number in each row"
    assert_refused(match, check_batch, "x", X[:, :0], (0,))


def test_a_batch_has_rows_unless_it_may_be_empty() -> None:
    assert_refused("n >= 1; got an empty batch", check_batch, "x", X[:0], (2,))
    assert check_batch("x", X[:0], (2,), allow_empty=True).shape == (0, 2)


def test_rows_that_are_not_finite_are_counted_and_named() -> None:
    bad = X.clone()
    bad[1, 0] = torch.inf
    assert_refused(
        r"NaN or Inf in 1 of 3 rows \(first: \[1\]\)", check_finite, "x", bad
    )
    check_not_nan("x", bad)
    assert_refused("without NaN; got 1 among 6", check_not_nan, "x", bad - bad)


def test_numbers_that_are_too_large_for_float32_are_refused() -> None:
    large = X.double()
    assert torch.equal(as_float32("x", large), X)
    large[1, 1] = -1e39
    assert_refused(r"`x`.*float32.*1 of 3.*\[1\]", as_float32, "x", large)


def test_the_error_about_a_device_says_where_other_tensors_are() -> None:
    match = "on meta, where `theta` is; got cpu"
    assert_refused(match, check_device, "x", X, torch.device("meta"), where="`theta`")


def test_arrays_and_lists_of_numbers_are_converted_without_loss() -> None:
    values = X.double().numpy()
    locked = values.copy()
    locked.flags.writeable = False
    for value in (values, locked, values[::-1], values.astype(">f8"), values.tolist()):
        converted = as_numbers("x", value)
        assert converted.dtype == torch.float64
        assert np.array_equal(converted.numpy(), np.asarray(value))
    converted = as_numbers("x", values)
    converted.zero_()
    assert values.all()  # the user's array is not changed
    assert as_numbers("x", [1, 2]).tolist() == [1.0, 2.0]
    assert as_numbers("x", list(X)).shape == X.shape
    bad = (None, "1", ["a"], [None], [True], np.array([1j]), np.array([THING]), {})
    for value in bad:
        match = "`x` to be a tensor, an array or a list of numbers; got"
        assert_refused(match, as_numbers, "x", value, error=InvalidInputError)
    for value in ([[1.0], [1.0, 2.0]], [np.ones(1), np.ones(2)], [X, X[:2]]):
        match = "rows of . to . entries.*pad them with NaN"
        assert_refused(match, as_numbers, "x", value, error=InvalidInputError)


def test_columns_of_a_dataframe_that_are_no_numbers_are_named() -> None:
    numbers = pd.DataFrame({"speed": [1.0, 2.0], "count": [3, np.nan]})
    expected = torch.tensor(numbers.to_numpy())
    assert torch.equal(as_numbers("x", numbers).nan_to_num(), expected.nan_to_num())
    frame = numbers.assign(mouse=["a", "b"], reading=pd.array([1, None], dtype="Int64"))
    match = r"column\(s\) 'mouse' \(.*\), 'reading' \(Int64\) cannot be read.*astype"
    assert_refused(match, as_numbers, "x", frame, error=InvalidInputError)
    converted = as_numbers("x", frame[["speed", "reading"]].astype("float64"))
    assert converted.isnan().tolist() == [[False, False], [False, True]]


def table(*names: Any) -> pd.DataFrame:
    return pd.DataFrame(np.arange(2.0 * len(names)).reshape(2, -1), columns=names)


def test_known_columns_in_another_order_are_refused_and_the_hint_mends_them() -> None:
    known = {("b", "a", "c"): "`parameter_names`"}
    df = table("a", "b", "c")
    match = re.escape(
        "`theta` with its columns in the order of `parameter_names`, ['b', 'a', 'c']; "
        "got ['a', 'b', 'c']. Pass `df[['b', 'a', 'c']]`"
    )
    assert_refused(match, check_columns, "theta", df, known)
    assert check_columns("theta", df[["b", "a", "c"]], known) == known
    assert_refused("order of `param", check_columns, "theta_std", df.std(), known)
    many = [f"pixel {k}" for k in range(400)]
    swapped = table(*many[:7], many[8], many[7], *many[9:])
    known = {tuple(many): "the earlier table `x`"}
    match = "the earlier table `x`; got 'pixel 8' in column 7, where 'pixel 7' is .*"
    assert_refused(match + r"`df\[names\]`", check_columns, "x_o", swapped, known)
    assert check_columns("x_o", swapped[many], known) == known


def test_columns_of_which_nothing_is_known_are_accepted_and_remembered() -> None:
    known = {("a", "b"): "`parameter_names`"}
    others = [("B", "A"), ("b", "B"), ("b", "a", "c"), (1, 0), ("b", "b"), ("b", 1)]
    for names in others:
        assert check_columns("theta", table(*names), known) == {
            **known,
            names: "the earlier table `theta`",
        }
    for value in (X, X.numpy(), X.tolist(), None, 0.1, "ba"):
        assert column_names(value) == ()
        assert check_columns("theta", value, known) == known
    # The parameters are not named after numbers, or after a name that two have.
    assert column_names(table("B", "A")) == ("B", "A")
    for names in others[3:]:
        assert column_names(table(*names)) == ()


def test_a_shape_that_does_not_fit_is_mended_by_the_hint() -> None:
    image, series = (1, 8, 6), (40,)
    for shape, event, hint in (
        ((8, 6), (8, 6), "x[None]"),
        ((5,), (1,), "x[:, None]"),
        ((5, 8, 6), image, "x[:, None]"),
        ((5, 8, 6, 3), (3, 8, 6), "x.movedim(-1, 1)"),
        ((5, 48), image, "x.reshape(-1, 1, 8, 6)"),
        ((5, 40, 1), series, "x.reshape(-1, 40)"),
    ):
        x = torch.zeros(shape)
        assert_refused(re.escape(f"pass `{hint}`"), check_batch, "x", x, event)
        check_batch("x", eval(hint, {"x": x}), event)
    no_hint = ((5, 30), series), ((5, 8, 7), image), ((), series), ((5, 7, 3), (4, 2))
    for shape, event in no_hint:
        assert_refused(
            r"\(\d*(, \d+)*,?\)\.$", check_batch, "x", torch.zeros(shape), event
        )


def test_trials_of_another_number_are_padded_if_the_net_reads_nan() -> None:
    x = torch.zeros(5, 3, 2)
    for count, reads, hint in (
        (4, True, "Pad with NaN to 4 trials"),
        (2, True, "trained on 2 trials"),
        (4, False, "one number of trials only"),
    ):
        assert_refused(hint, check_batch, "x", x, (count, 2), reads_missing=reads)


def test_theta_and_x_that_were_swapped_are_told_from_other_shapes() -> None:
    theta, x = torch.zeros(5, 2), np.zeros((5, 3))
    check_not_swapped(theta, x, (2,), (3,))
    check_not_swapped(x, x, (2,), (3,))
    check_not_swapped(theta, theta, (2,), (2,))
    check_not_swapped(theta.tolist(), None, (2,), (3,))
    match = r"`theta` of shape \(n, 2\) and `x` of shape \(n, 3\); got \(5, 3\).*swap"
    assert_refused(match, check_not_swapped, x, theta, (2,), (3,))


def test_an_empty_batch_is_inside_any_support() -> None:
    check_in_support("x", X[:0], BoxUniform(torch.zeros(2), torch.ones(2)))


# Numbers -----------------------------------------------------------------------------


def test_what_is_no_number_is_refused_in_a_short_message() -> None:
    for check in (*CHECKS_OF_NUMBERS, check_integer):
        for value in NO_NUMBERS:
            short = r"(?s)^(?=.{,399}$).*`a`.*got"
            assert_refused(short, check, "a", value, error=InvalidInputError)


def test_numbers_of_python_and_numpy_are_accepted() -> None:
    for check in CHECKS_OF_NUMBERS:
        for value in (1, 1.0, np.float32(1), np.float64(1), np.int8(1)):
            check("a", value)


def test_a_number_may_have_a_largest_size() -> None:
    for check in (check_number, check_positive, check_not_negative):
        check("a", 1e300)
        check("a", 1e30, maximum=LARGEST_SETTING)
        match = r"at most 1e\+30; got 1e\+39"
        assert_refused(match, check, "a", 1e39, maximum=LARGEST_SETTING)


def test_numbers_outside_their_range_are_refused() -> None:
    assert_refused("positive; got 0", check_positive, "a", 0)
    assert_refused("at least 0; got -1", check_not_negative, "a", -1)
    assert_refused(r"in \[0, 1\]; got 1.5", check_unit_interval, "a", 1.5)


def test_integers_of_python_and_numpy_are_accepted_within_their_range() -> None:
    for value in (3, np.int64(3), np.uint8(3)):
        check_integer("n", value, maximum=3)
        assert_refused(r"from 1 to 2; got .*3", check_integer, "n", value, maximum=2)
    assert_refused("of at least 1; got 0", check_integer, "n", 0)


def test_an_integer_fits_into_torch_unless_any_size_is_allowed() -> None:
    assert_refused(f"from 1 to {2**63 - 1}", check_integer, "n", 2**63)
    check_integer("n", HUGE, maximum=None)


def test_weights_may_come_in_any_container_and_keep_their_digits() -> None:
    same = ([0.25, 0.75], (0.25, 0.75), np.array([0.25, 0.75], dtype=np.float32))
    for value in (*same, torch.tensor([0.25, 0.75], requires_grad=True)):
        assert check_weights("w", value, 2) == [0.25, 0.75], type(value)
    assert check_weights("w", [0.3, 0.7], 2) == [0.3, 0.7]


def test_weights_that_are_no_probabilities_are_refused() -> None:
    for value in (
        *(None, 3, "ab", b"ab", {0.5, 0.6}, {}, THING, [0.5, None], [0.5, "a"]),
        *([0.5 + 0j, 0.5], [True, False], [HUGE, 1], [[0.5], [0.5, 0.5]], [[0.5, 0.5]]),
        *([float("nan"), 1.0], [1.5, -0.5], [0.5, 0.6], X, X[0].to_sparse()),
        *(X[0].to("meta"), np.array([0.5, 0.6]), np.array(["a", "b"])),
    ):
        assert_refused("`w`", check_weights, "w", value, 2)


# Words -------------------------------------------------------------------------------


def test_choices_are_accepted() -> None:
    cases: tuple[tuple[Any, tuple], ...] = (
        *(("a", ("a", "b")), (np.str_("a"), ("a",)), (None, (None, "a"))),
        *((64, (64, 100)), (np.int64(64), (64,)), (False, (None, True, False))),
        (torch.float32, (torch.float64, torch.float32)),
    )
    for value, choices in cases:
        check_choice("kind", value, choices)


def test_what_is_no_choice_is_refused_with_the_choices() -> None:
    for value in (
        *("c", 64.0, ["a"], {}, b"a", THING, float("nan"), HUGE),
        *(np.array(["a", "b"]), np.array([64, 1]), np.array("a"), X, torch.tensor(64)),
    ):
        for choices in (("a", "b"), (64, 1), (None, True)):
            match, error = r"`kind` to be one of \[.*got", InvalidInputError
            assert_refused(match, check_choice, "kind", value, choices, error=error)


def test_true_is_not_taken_for_the_number_one() -> None:
    assert_refused("got True", check_choice, "size", True, (1, 2))
    assert_refused("got 1", check_choice, "blocked", 1, (None, True))


def test_names_are_a_list_of_strings() -> None:
    assert check_names("names", ("a", "b"), 2) == ["a", "b"]
    assert check_names("names", np.array(["a", "b"])) == ["a", "b"]
    assert_refused("length 2; got 1", check_names, "names", ["a"], 2)
    for value in ("ab", b"ab", None, 3, [1, 2], ["a", None], {"a": 1}, THING):
        match, error = "`names` to be a list of strings", InvalidInputError
        assert_refused(match, check_names, "names", value, error=error)


def test_a_dictionary_has_entries_with_names() -> None:
    check_mapping("samples", {"a": 1}, like="samples")
    assert_refused("at least one entry", check_mapping, "samples", {}, like="samples")
    for value in (None, 3, "a", [1], X, {1: X}):
        assert_refused("samples", check_mapping, "samples", value, like="samples")


def test_a_path_is_a_string_or_a_path() -> None:
    assert check_path("root", "~/a") == Path("~/a").expanduser()
    assert check_path("root", None, optional=True) is None
    match = "`root` to be a path"
    for value in (None, 3, b"a", ["a"], THING):
        assert_refused(match, check_path, "root", value, error=InvalidInputError)
    for value in ("a\0b", "~nobody_of_this_name/a"):
        assert_refused(match, check_path, "root", value, error=InvalidInputError)


def test_a_long_value_is_shortened_in_a_message() -> None:
    for value in (HUGE, "a" * 10**6, np.zeros(10**4), [0] * 10**4):
        assert len(shown(value)) < 250, type(value)
