"""Sets that share no observation."""

from typing import get_args

import pytest
import torch
from torch import Tensor

from sbi_rope.errors import InvalidInputError
from sbi_rope.tasks.splits import BLOCK_SIZE, MAX_SEED, Part, draw_rows, select_rows


def draw(n: int) -> tuple[Tensor, Tensor]:
    theta = torch.rand(n, 2)
    return theta, torch.randn(n, 3)


def test_streams_of_all_seeds_and_parts_differ() -> None:
    seeds = [0, 1, 2, 3, 100, MAX_SEED - 2, MAX_SEED - 1]
    first = [
        tuple(draw_rows(draw, 1, seed=seed, part=part)[0].flatten().tolist())
        for seed in seeds
        for part in get_args(Part)
    ]
    assert len(set(first)) == 2 * len(seeds)


@pytest.mark.parametrize("n", [1, BLOCK_SIZE, BLOCK_SIZE + 1])
def test_drawn_rows_are_as_many_as_asked(n: int) -> None:
    theta, x = draw_rows(draw, n, seed=0, part="test")
    assert theta.shape == (n, 2)
    assert x.shape == (n, 3)


def test_blocks_differ() -> None:
    theta, _ = draw_rows(draw, 2 * BLOCK_SIZE, seed=0, part="test")
    assert not torch.equal(theta[:BLOCK_SIZE], theta[BLOCK_SIZE:])


def test_rows_are_drawn_on_the_cpu_whatever_the_default_device() -> None:
    with torch.device("meta"):
        theta, _ = draw_rows(draw, 3, seed=0, part="test")
    assert theta.device.type == "cpu"


def test_the_random_state_survives_an_error() -> None:
    def fail(n: int) -> tuple[Tensor, Tensor]:
        torch.rand(n)
        raise ZeroDivisionError

    before = torch.get_rng_state()
    with pytest.raises(ZeroDivisionError):
        draw_rows(fail, 3, seed=0, part="test")
    assert torch.equal(before, torch.get_rng_state())


def test_parts_are_a_partition_that_does_not_depend_on_the_seed() -> None:
    calibration = set(select_rows(20, 6, seed=0, part="calibration"))
    test = set(select_rows(20, 14, seed=1, part="test"))
    assert calibration | test == set(range(20))
    assert calibration == set(select_rows(20, 6, seed=2, part="calibration"))


def test_the_seed_picks_rows_within_a_part() -> None:
    first, second = (
        select_rows(300, 10, seed=seed, part="calibration") for seed in (0, 1)
    )
    assert set(first) != set(second)


def test_the_split_is_not_that_of_the_file_order() -> None:
    rows = torch.tensor(select_rows(3000, 1000, seed=0, part="calibration"))
    assert rows.double().mean() == pytest.approx(1500, abs=100)
    assert rows.double().std() == pytest.approx(3000 / 12**0.5, rel=0.05)


@pytest.mark.parametrize(("part", "size"), [("calibration", 3), ("test", 7)])
def test_asking_for_more_rows_than_there_are_names_their_number(
    part: Part, size: int
) -> None:
    with pytest.raises(InvalidInputError, match=f"at most {size}, .*got {size + 1}"):
        select_rows(10, size + 1, seed=0, part=part)
