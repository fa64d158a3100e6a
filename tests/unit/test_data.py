"""Calibration pairs: groups are held out together, and count once."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sbi_rope.data.pairs import (
    EPOCHS_WITHOUT_HOLDOUT,
    MIN_PAIRS_FOR_HOLDOUT,
    Pairs,
    epochs_on_pairs,
    groups_of,
    one_of_each_group,
    split_pairs,
)
from sbi_rope.utils.errors import RoPEWarning

NAN = math.nan


def pairs_of(theta: Tensor) -> Pairs:
    return Pairs.exact(theta, theta + 1)


def test_rows_of_the_same_parameters_share_a_number() -> None:
    theta = torch.tensor([[2.0, 1.0], [1.0, 2.0], [2.0, 1.0], [0.0, 0.0]])
    assert groups_of(theta).tolist() == [0, 1, 0, 2]
    assert groups_of(theta[:, 0]).tolist() == [0, 1, 0, 2]
    assert groups_of(["b", 2, "b"]).tolist() == [0, 1, 0]
    pairs = pairs_of(theta)
    assert pairs.group.tolist() == [0, 1, 0, 2]
    assert pairs.num_groups == 3
    assert pairs.shared_weight.tolist() == [0.5, 1.0, 0.5, 1.0]
    assert str(pairs) == "4 exact labels in 3 groups"


def test_labels_are_equal_if_all_that_was_measured_is() -> None:
    y = torch.tensor([[0.0, NAN], [1.0, 2.0], [0.0, NAN], [0.0, 3.0]])
    pairs = replace(pairs_of(y), x=y)
    assert pairs.label.tolist() == [0, 1, 0, 2]
    assert pairs.is_exact.tolist() == [False, True, False, True]
    noisy = replace(pairs, std=torch.tensor([0.0, 0, 1, 0]).double()[:, None])
    assert noisy.label.tolist() == [0, 1, 2, 3]
    std = noisy.std.expand(4, 2)
    assert (pairs + replace(noisy, std=std)).label.tolist() == [0, 1, 0, 2, 0, 1, 3, 2]
    draws = torch.randn(4, 3, 2)[[0, 1, 1, 2]]
    drawn = pairs_of(draws.mean(dim=1))
    drawn = replace(drawn, theta=draws, std=torch.full_like(std, NAN))
    assert drawn.label.tolist() == [0, 1, 1, 2]
    assert drawn.are_drawn
    assert not drawn.is_exact.any()


@pytest.mark.parametrize(
    ("num_pairs", "fraction", "count"),
    [(4, 0.5, 0), (5, 0.01, 1), (20, 0.2, 4), (7, 0.5, 4)],
)
def test_a_split_is_a_cut_through_a_permutation(
    num_pairs: int, fraction: float, count: int
) -> None:
    theta = torch.randn(num_pairs, 2)
    torch.manual_seed(3)
    train, held_out = split_pairs(theta, fraction)
    torch.manual_seed(3)
    order = torch.randperm(num_pairs)
    assert torch.equal(held_out, order[:count])
    assert torch.equal(train, order[count:])


def test_a_group_larger_than_what_is_held_out_is_trained_on() -> None:
    groups = torch.tensor([0] * 60 + [1] * 10 + [2] * 10 + [3] * 10 + [4] * 10)
    assert all(len(split_pairs(groups, 0.2)[1]) == 20 for _ in range(20))
    # All are larger than twice the two rows asked for: the smallest is held out.
    groups = torch.arange(5).repeat_interleave(torch.tensor([20, 20, 7, 20, 20]))
    assert groups[split_pairs(groups, 0.02)[1]].tolist() == [2] * 7


def test_of_few_groups_none_is_held_out() -> None:
    theta = torch.randn(MIN_PAIRS_FOR_HOLDOUT - 1, 2).repeat(10, 1)
    train, held_out = split_pairs(theta, 0.2)
    assert (len(train), len(held_out)) == (40, 0)
    match = r"Only 4 different parameters \(or groups\) among 40 calibration pairs"
    with pytest.warns(RoPEWarning, match=match):
        assert epochs_on_pairs(theta, held_out, 80) == EPOCHS_WITHOUT_HOLDOUT


def test_folds_keep_groups_whole_and_have_rows_alike() -> None:
    sizes = torch.tensor([9, 1, 1, 4, 2, 3, 6, 1, 1, 2])
    groups = torch.arange(10).repeat_interleave(sizes)[torch.randperm(30)]
    folds = pairs_of(groups[:, None].float()).folds(3)
    assert sorted(torch.cat(folds).tolist()) == list(range(30))
    assert [len(fold) for fold in folds] == [10, 10, 10]
    of_fold = [set(groups[fold].tolist()) for fold in folds]
    assert sum(map(len, of_fold)) == 10
    two_groups = pairs_of(torch.tensor([0.0, 0, 0, 1, 1])[:, None])
    assert sorted(map(len, two_groups.folds(4))) == [2, 3]
    alone = pairs_of(torch.randn(11, 2)).folds(5)
    assert sorted(map(len, alone)) == [2, 2, 2, 2, 3]


def test_one_row_of_each_group_is_chosen_at_random() -> None:
    groups = torch.tensor([3, 0, 3, 3, 1, 0])
    seen = torch.stack([one_of_each_group(groups, seed=seed) for seed in range(50)])
    for chosen in seen:
        assert groups[chosen].sort().values.tolist() == [0, 1, 3]
    assert seen.any(dim=0).all()
