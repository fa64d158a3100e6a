"""Data of a user become tensors of the expected shape, or are refused."""

import re
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from sbi.utils import BoxUniform
from torch import Tensor

from sbi_rope.errors import InvalidInputError
from sbi_rope.tensors import (
    as_array,
    as_batch,
    as_numbers,
    check_in_support,
    column_names,
    rows_with,
)
from tests.refusals import assert_refused

X = torch.tensor([[0.1, 0.9], [0.2, 0.8], [0.3, 0.7]])


@pytest.mark.parametrize(
    "value",
    [
        X.tolist(),
        X.numpy(),
        X.double().numpy()[::-1][::-1],
        X.numpy().astype(">f8"),
        np.asfortranarray(X.numpy()),
        list(X),
        pd.DataFrame(X.numpy()),
        X.clone().requires_grad_(),
    ],
    ids=lambda value: type(value).__name__,
)
def test_numbers_in_any_container_become_a_tensor_of_float32(value: Any) -> None:
    found = as_batch("x", value, (2,), rows=3, device=torch.device("cpu"))
    assert found.dtype == torch.float32
    assert not found.requires_grad
    assert torch.equal(found, X)


def test_floating_point_tensors_keep_their_dtype_and_other_numbers_do_not() -> None:
    assert as_batch("x", X.double()).dtype == torch.float64
    for value in (X > 0.5, X.long(), X.numpy() > 0.5, [[1, 2], [3, 4]]):
        assert as_batch("x", value, (2,)).dtype == torch.float32


def test_what_holds_no_real_numbers_is_refused() -> None:
    frame = pd.DataFrame({"speed": [1.0, 2.0], "mouse": ["a", "b"]})
    complex_x = X.to(torch.complex64)
    for value in (
        *(None, "1", ["a"], {}, [[1.0], [1.0, 2.0]], [X, X[:2]], frame),
        *(complex_x, complex_x.numpy(), list(X.clone().requires_grad_())),
    ):
        match = "^Expected `x` to be a tensor, an array, a table or a list of numbers"
        assert_refused(match, as_numbers, "x", value, error=InvalidInputError)


def test_a_change_of_the_result_does_not_change_the_array_of_the_user() -> None:
    array = np.ones((3, 2), dtype=np.float32)
    as_batch("x", array, (2,)).zero_()
    assert array.all()


def test_masked_numbers_and_missing_ones_of_a_table_are_nan() -> None:
    masked = np.ma.masked_equal([[1, -9], [3, 4]], -9)
    assert np.isnan(as_array(masked)).tolist() == [[False, True], [False, False]]
    frame = pd.DataFrame({"a": [1.0, 3.0], "b": pd.array([None, 4], dtype="Float64")})
    for value in (masked, frame.astype(float)):
        found = as_batch("x", value, (2,), finite=False)
        assert torch.equal(found.nan_to_num(-9), torch.tensor([[1.0, -9], [3, 4]]))
        assert_refused(
            r"NaN or Inf in 1 of 2 rows \(first: \[0\]\)", as_batch, "x", value
        )


def test_numbers_beyond_float32_are_infinite_in_it() -> None:
    large = X.double() * 1e39
    assert_refused("finite", as_batch, "x", large.numpy())
    assert torch.equal(as_batch("x", large), large)


def test_a_table_in_another_order_is_put_in_order() -> None:
    table = pd.DataFrame(X.numpy(), columns=["a", "b"])
    for given in (table, table[["b", "a"]]):
        assert torch.equal(as_batch("x", given, (2,), names=("a", "b")), X)
    # Other names are not known to be of other columns.
    for names in (None, (), ("a", "c"), ("a", "b", "c")):
        assert torch.equal(as_batch("x", table, (2,), names=names), X)
    assert torch.equal(as_batch("x", X, (2,), names=("a", "b")), X)


def test_names_of_columns_are_different_strings() -> None:
    assert column_names(pd.DataFrame(X.numpy(), columns=["b", "a"])) == ("b", "a")
    for names in (["a", "a"], [0, 1], ["a", 1]):
        assert column_names(pd.DataFrame(X.numpy(), columns=names)) is None
    assert column_names(X) is None


@pytest.mark.parametrize(
    ("value", "options", "words"),
    [
        (X, {"event_shape": (3,)}, "of shape (n, 3); got (3, 2)."),
        (X, {"event_shape": (2,), "rows": 4}, "of shape (4, 2); got (3, 2)."),
        (X, {"event_shape": ()}, "of shape (n,); got (3, 2)."),
        (X[:, 0], {"event_shape": (), "rows": 4}, "of shape (4,); got (3,)."),
        (X, {"rows": 4}, "of shape (4, 2); got (3, 2)."),
        (X[:0], {"event_shape": (2,)}, "with at least one number; got shape (0, 2)."),
        (X[:, :0], {"empty": True}, "with at least one number; got shape (3, 0)."),
        (X, {"device": torch.device("meta")}, "on meta; got cpu."),
    ],
)
def test_a_batch_that_does_not_fit_is_refused(
    value: Tensor, options: dict[str, Any], words: str
) -> None:
    assert_refused(
        f"^Expected `x` {re.escape(words)}$", as_batch, "x", value, **options
    )


def test_an_empty_batch_is_accepted_where_it_means_something() -> None:
    assert as_batch("x", X[:0], (2,), empty=True).shape == (0, 2)


@pytest.mark.parametrize(
    ("shape", "event", "hint"),
    [
        ((8, 6), (8, 6), "x[None]"),
        ((), (), "x[None]"),
        ((5,), (1,), "x[:, None]"),
        ((5, 48), (1, 8, 6), "x.reshape(-1, 1, 8, 6)"),
        ((5, 40, 1), (40,), "x.reshape(-1, 40)"),
    ],
)
def test_the_hint_mends_the_shape(
    shape: tuple[int, ...], event: tuple[int, ...], hint: str
) -> None:
    x = torch.zeros(shape)
    assert_refused(re.escape(f"pass `{hint}`"), as_batch, "x", x, event)
    as_batch("x", eval(hint, {"x": x}), event)


def test_parameters_outside_the_prior_are_counted() -> None:
    prior = BoxUniform(torch.zeros(2), torch.ones(2))
    theta = torch.cat([X, -X])
    check_in_support("theta", X, prior)
    check_in_support("theta", X[:0], prior)
    check_in_support("theta", theta, prior, rows=torch.arange(6) < 3)
    match = r"`theta` inside the support.*3 of 6 rows \(first: \[3, 4, 5\]\)"
    assert_refused(match, check_in_support, "theta", theta, prior)


def test_rows_are_counted_once_and_the_first_five_are_named() -> None:
    bad = torch.zeros(9, 2, 2, dtype=torch.bool)
    bad[1:, 0] = True
    assert rows_with(bad) == "8 of 9 rows (first: [1, 2, 3, 4, 5])"
