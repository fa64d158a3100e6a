"""Data of a user become tensors of the expected shape, or are refused."""

from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_rope.npe.prior import check_in_support
from sbi_rope.utils.errors import InvalidInputError
from sbi_rope.utils.tensors import as_batch, as_numbers
from tests.refusals import assert_refused

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


def test_masked_numbers_and_missing_ones_of_a_table_are_nan() -> None:
    masked = np.ma.masked_equal([[1, -9], [3, 4]], -9)
    frame = pd.DataFrame({"a": [1.0, 3.0], "b": pd.array([None, 4], dtype="Float64")})
    for value in (masked, frame.astype(float)):
        found = as_batch("x", value, (2,), finite=False)
        assert torch.equal(found.nan_to_num(-9), torch.tensor([[1.0, -9], [3, 4]]))
        assert_refused(
            r"NaN or Inf in 1 of 2 rows \(first: \[0\]\)", as_batch, "x", value
        )


def test_parameters_outside_the_prior_are_counted() -> None:
    prior = BoxUniform(torch.zeros(2), torch.ones(2))
    theta = torch.cat([X, -X])
    check_in_support("theta", X, prior)
    check_in_support("theta", X[:0], prior)
    check_in_support("theta", theta, prior, rows=torch.arange(6) < 3)
    match = r"`theta` inside the support.*3 of 6 rows \(first: \[3, 4, 5\]\)"
    assert_refused(match, check_in_support, "theta", theta, prior)
