"""Seeded blocks draw their own numbers and leave the caller's as they were."""

import random

import numpy as np
import pytest
import torch

from sbi_rope.utils.seeds import seeded


def draws() -> list[float]:
    return [
        float(torch.rand(())),
        float(np.random.uniform()),  # noqa: NPY002
        random.random(),
    ]


def test_blocks_can_be_nested_and_give_the_same_numbers_again() -> None:
    with seeded(1):
        expected = [draws(), draws()]
    with seeded(1):
        first = draws()
        with seeded(2):
            inner = draws()
        assert [first, draws()] == expected
    with seeded(2):
        assert draws() == inner
    assert inner != first


def test_the_state_of_the_caller_is_restored_also_after_an_error() -> None:
    torch.manual_seed(3)
    np.random.seed(3)  # noqa: NPY002
    random.seed(3)
    expected = draws()
    torch.manual_seed(3)
    np.random.seed(3)  # noqa: NPY002
    random.seed(3)
    with pytest.raises(ZeroDivisionError), seeded(1):
        1 / (torch.rand(()).item() * 0)
    with seeded(None):
        assert draws() == expected
