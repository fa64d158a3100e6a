"""Pairs that share no observation."""

import pytest
import torch
from torch import Tensor

from sbi_rope.tasks.splits import (
    MAX_SEED,
    DrawnPairs,
    Part,
    RecordedPairs,
    stream_of,
)
from sbi_rope.utils.errors import InvalidInputError, RoPEWarning

SEEDS = [0, 1, 2, 3, 100, MAX_SEED - 2, MAX_SEED - 1]


def drawn() -> DrawnPairs:
    return DrawnPairs(
        draw_theta=lambda n: torch.rand(n, 2),
        observe=lambda theta: theta[:, :1] + torch.zeros(len(theta), 3),
    )


def recorded(num_rows: int) -> RecordedPairs:
    theta = torch.arange(float(num_rows)).unsqueeze(1)
    return RecordedPairs(theta=theta, read_x=lambda rows: theta[rows] * 10)


def first_half(theta: Tensor) -> Tensor:
    return (theta[:, 0] < 0.5).double()


# Drawn pairs -------------------------------------------------------------------------


def test_streams_of_all_seeds_and_uses_differ() -> None:
    uses = ("calibration", "test", "simulation", "labels")
    streams = {stream_of(seed, use) for seed in SEEDS for use in uses}
    assert len(streams) == 4 * len(SEEDS)
    assert all(0 <= stream < 2**32 for stream in streams)


def test_kept_pairs_follow_the_chances_and_begin_a_larger_set() -> None:
    sets = []
    for n in (10, 250):
        theta, x = drawn().take(n, seed=0, part="test", keep=first_half)
        assert len(theta) == n
        assert (theta[:, 0] < 0.5).all()
        assert torch.equal(theta[:, 0], x[:, 0])
        sets.append(theta)
    assert torch.equal(sets[0], sets[1][:10])


def test_a_chance_between_0_and_1_thins_out_drawn_pairs() -> None:
    theta, _ = drawn().take(
        2000, seed=0, part="test", keep=lambda theta: theta[:, 0].double()
    )
    # The density 2 t has mean 2/3 and variance 1/18.
    assert theta[:, 0].mean() == pytest.approx(2 / 3, abs=4 * (1 / 18 / 2000) ** 0.5)


def test_pairs_with_nan_are_replaced_jointly_and_counted() -> None:
    pairs = DrawnPairs(
        draw_theta=lambda n: torch.rand(n, 2),
        observe=lambda theta: torch.where(theta[:, :1] < 0.1, torch.nan, theta),
    )
    with pytest.warns(RoPEWarning, match=r"Replaced \d+ of \d+ drawn pairs"):
        theta, x = pairs.take(500, seed=0, part="test")
    assert theta.shape == (500, 2)
    assert torch.equal(theta, x)
    assert (theta[:, 0] >= 0.1).all()


# Recorded pairs ----------------------------------------------------------------------


def test_parts_are_a_partition_that_does_not_depend_on_the_seed() -> None:
    def rows(n: int, seed: int, part: Part) -> set[float]:
        theta, _ = recorded(20).take(n, seed=seed, part=part)
        return set(theta.flatten().tolist())

    calibration = rows(6, 0, "calibration")
    assert calibration | rows(14, 1, "test") == set(range(20))
    assert calibration == rows(6, 2, "calibration")


def test_the_split_does_not_follow_the_order_of_the_file() -> None:
    rows = torch.tensor(recorded(3000).rows_of("calibration"))
    assert rows.double().mean() == pytest.approx(1500, abs=100)
    assert rows.double().std() == pytest.approx(3000 / 12**0.5, rel=0.05)


def test_asking_for_more_rows_than_there_are_names_their_number() -> None:
    parts: tuple[tuple[Part, int], ...] = (("calibration", 3), ("test", 7))
    for part, size in parts:
        match = f"at most {size}, .*got {size + 1}"
        with pytest.raises(InvalidInputError, match=match):
            recorded(10).take(size + 1, seed=0, part=part)
