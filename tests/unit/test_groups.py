"""Pairs that belong together are held out together."""

import pytest
import torch

from sbi_rope.data import MIN_PAIRS_FOR_HOLDOUT, groups_of, split_groups, split_pairs
from sbi_rope.errors import RoPEWarning
from sbi_rope.fit import EPOCHS_WITHOUT_HOLDOUT, epochs_on_pairs


class TestSplitPairs:
    def test_each_pair_is_on_one_side(self) -> None:
        for num_pairs, fraction, held_out in [
            (1, 0.2, 0),
            (4, 0.5, 0),
            (5, 0.2, 1),
            (5, 0.01, 1),
            (20, 0.2, 4),
            (7, 0.5, 4),
        ]:
            train, other = split_pairs(torch.arange(num_pairs), fraction)
            assert len(other) == held_out
            assert sorted([*train.tolist(), *other.tolist()]) == list(range(num_pairs))

    def test_it_is_drawn_at_random(self) -> None:
        torch.manual_seed(0)
        first = split_pairs(torch.arange(50), 0.2)
        second = split_pairs(torch.arange(50), 0.2)
        torch.manual_seed(0)
        again = split_pairs(torch.arange(50), 0.2)
        assert not torch.equal(first[1], second[1])
        assert torch.equal(first[1], again[1])

    def test_of_different_parameters_it_is_a_cut_through_a_permutation(self) -> None:
        for n, held_out in [(3, 0), (5, 1), (50, 10), (51, 10)]:
            theta = torch.randn(n, 2)
            torch.manual_seed(3)
            train, other = split_pairs(theta, 0.2)
            after = torch.rand(())
            torch.manual_seed(3)
            order = torch.randperm(n)
            assert torch.equal(other, order[:held_out])
            assert torch.equal(train, order[held_out:])
            assert torch.rand(()) == after

    def test_pairs_of_the_same_parameters_are_on_the_same_side(self) -> None:
        for seed in range(5):
            torch.manual_seed(seed)
            theta = torch.randn(12, 2).repeat(5, 1)[torch.randperm(60)]
            train, other = split_pairs(theta, 0.25)
            assert sorted([*train.tolist(), *other.tolist()]) == list(range(60))
            assert len(other) == 15
            assert not {*map(tuple, theta[train].tolist())} & {
                *map(tuple, theta[other].tolist())
            }
            by_group = split_pairs(groups_of(theta), 0.25)
            assert len(by_group[1]) == 15

    def test_a_group_larger_than_what_is_held_out_is_trained_on(self) -> None:
        groups = torch.tensor([0] * 60 + [1] * 10 + [2] * 10 + [3] * 10 + [4] * 10)
        for _ in range(20):
            assert len(split_pairs(groups, 0.2)[1]) == 20
        # All are larger than twice the two rows asked for: the smallest is held out.
        groups = torch.arange(5).repeat_interleave(torch.tensor([20, 20, 7, 20, 20]))
        assert groups[split_pairs(groups, 0.02)[1]].tolist() == [2] * 7

    def test_of_few_different_parameters_none_is_held_out(self) -> None:
        theta = torch.randn(MIN_PAIRS_FOR_HOLDOUT - 1, 2).repeat(10, 1)
        train, other = split_pairs(theta, 0.2)
        assert (len(train), len(other)) == (40, 0)
        with pytest.warns(
            RoPEWarning, match=r"Only 4 different parameters \(or groups\) among 40"
        ):
            assert epochs_on_pairs(theta, other, 80) == EPOCHS_WITHOUT_HOLDOUT
        with pytest.warns(RoPEWarning, match=r"Only 4 calibration pair\(s\)"):
            assert epochs_on_pairs(theta[:4], other, 30) == 30
        assert epochs_on_pairs(theta, train, 80) == 80


class TestGroups:
    def test_rows_of_the_same_parameters_share_a_number(self) -> None:
        theta = torch.tensor([[2.0, 1.0], [1.0, 2.0], [2.0, 1.0], [0.0, 0.0]])
        assert groups_of(theta).tolist() == [0, 1, 0, 2]
        assert groups_of(theta[:, 0]).tolist() == [0, 1, 0, 2]
        assert groups_of(torch.randn(30, 3)).tolist() == list(range(30))
        assert groups_of(theta[:0]).tolist() == []

    def test_folds_of_different_parameters_are_cut_from_a_permutation(self) -> None:
        for n, num_folds in [(10, 3), (11, 5), (4, 6)]:
            torch.manual_seed(1)
            folds = split_groups(torch.arange(n), num_folds)
            torch.manual_seed(1)
            expected = torch.randperm(n).tensor_split(min(n, num_folds))
            for fold, other in zip(folds, expected, strict=True):
                assert torch.equal(fold, other)

    def test_folds_keep_groups_whole_and_have_rows_alike(self) -> None:
        sizes = torch.tensor([9, 1, 1, 4, 2, 3, 6, 1, 1, 2])
        groups = torch.arange(10).repeat_interleave(sizes)[torch.randperm(30)]
        folds = split_groups(groups, 3)
        assert sorted(torch.cat(folds).tolist()) == list(range(30))
        assert [len(fold) for fold in folds] == [10, 10, 10]
        of_fold = [set(groups[fold].tolist()) for fold in folds]
        assert sum(map(len, of_fold)) == 10
        again = split_groups(groups, 3)
        assert [set(groups[fold].tolist()) for fold in again] != of_fold

    def test_there_are_at_most_as_many_folds_as_groups(self) -> None:
        folds = split_groups(torch.tensor([0, 0, 0, 1, 1]), 4)
        assert sorted(map(len, folds)) == [2, 3]
