"""Groups of pairs that belong together: recordings of one person or specimen.

They are held out together, because a network can learn by heart the people it has met.
Whether it does well is seen on recordings of others.
"""

import torch
from torch import Tensor

from sbi_rope._random import seeded

__all__ = [
    "MIN_PAIRS_FOR_HOLDOUT",
    "groups_of",
    "groups_to_hold_out",
    "one_of_each_group",
    "split_groups",
    "split_pairs",
    "too_few_pairs",
]

# Fewer pairs of different parameters than this leave nothing to hold out.
MIN_PAIRS_FOR_HOLDOUT = 5


def groups_of(theta: Tensor) -> Tensor:
    """Number rows by their parameters, so that those that share them share a number.

    Args:
        theta: Parameters, shape ``(n, d)``, or any numbers of groups, shape ``(n,)``.

    Returns:
        Numbers from 0 in the order of first appearance, on the CPU, shape ``(n,)``.
    """
    different, of_row = theta.detach().cpu().unique(dim=0, return_inverse=True)
    num_rows = len(of_row)
    first = of_row.new_full((len(different),), num_rows)
    first = first.scatter_reduce(0, of_row, torch.arange(num_rows), "amin")
    return first.argsort().argsort()[of_row]


def one_of_each_group(groups: Tensor, *, seed: int) -> Tensor:
    """Choose a row of each group at random.

    Args:
        groups: The numbers of the groups, from 0 to G - 1, shape ``(n,)``.
        seed: Seed of the choice.

    Returns:
        Whether each row was chosen, shape ``(n,)``.

    Example:
        >>> one_of_each_group(torch.tensor([0, 1, 2]), seed=0)
        tensor([True, True, True])
    """
    with seeded(seed):
        order = torch.randperm(len(groups), device=groups.device)
    chosen = torch.zeros(len(groups), dtype=torch.bool, device=groups.device)
    # Of rows that write to the same place, an order decides, and not torch.
    place = groups.new_full((int(groups.max()) + 1,), len(groups))
    place = place.scatter_reduce(0, groups[order], order.argsort()[order], "amin")
    chosen[order[place]] = True
    return chosen


def split_pairs(
    theta_or_groups: Tensor, validation_fraction: float
) -> tuple[Tensor, Tensor]:
    """Return the rows to train on and those held out, at random.

    Rows that share their parameters are on the same side. Held out are the groups, in
    random order, that bring their rows nearer to the fraction asked for, or else the
    smallest. Of fewer than five groups none is held out.

    Args:
        theta_or_groups: What :func:`groups_of` takes.
        validation_fraction: Share of the rows to hold out.
    """
    groups = groups_of(theta_or_groups)
    num_groups = _num_groups(groups)
    order = torch.randperm(num_groups)
    # Without shared parameters this is `order` itself.
    rows = order.argsort()[groups].argsort(stable=True)
    is_held_out = torch.zeros(num_groups, dtype=torch.bool)
    if num_groups >= MIN_PAIRS_FOR_HOLDOUT:
        wanted = max(1, round(validation_fraction * len(groups)))
        sizes = torch.bincount(groups)[order].tolist()
        is_held_out[order[groups_to_hold_out(wanted, sizes)]] = True
    held_out = is_held_out[groups[rows]]
    return rows[~held_out], rows[held_out]


def split_groups(groups: Tensor, num_folds: int) -> list[Tensor]:
    """Cut rows into folds at random, with the rows of a group in the same fold.

    The folds have as many rows as each other, as far as the groups allow.

    Args:
        groups: What :func:`groups_of` takes.
        num_folds: Number of folds. If there are fewer groups, there are as many folds
            as groups.

    Returns:
        The rows of each fold.
    """
    # Not by scikit-learn's GroupKFold: it refuses fewer groups than folds, and in which
    # order it takes groups of equal size depends on its version. Stored results depend
    # on who was in which fold.
    groups = groups_of(groups)
    order = torch.randperm(_num_groups(groups))
    if len(order) == len(groups):
        return list(order.tensor_split(min(num_folds, len(order))))
    sizes = torch.bincount(groups)
    fold_of, num_rows = torch.empty_like(order), [0] * min(num_folds, len(order))
    # The largest first, each to the fold with the fewest rows so far.
    for group in order[sizes[order].argsort(descending=True, stable=True)].tolist():
        fold = num_rows.index(min(num_rows))
        fold_of[group] = fold
        num_rows[fold] += int(sizes[group])
    return [(fold_of[groups] == fold).nonzero()[:, 0] for fold in range(len(num_rows))]


def groups_to_hold_out(wanted: int, sizes: list[int]) -> list[int]:
    """Choose the groups that bring the rows held out nearer to a number wanted.

    Args:
        wanted: The number of rows.
        sizes: The rows of each group, in random order.

    Returns:
        Indices of the groups chosen: some, but not all. If all groups are too large,
        it is the smallest.
    """
    chosen, total = [], 0
    for index, size in enumerate(sizes):
        if total + size - wanted <= wanted - total:
            chosen.append(index)
            total += size
        if total >= wanted:
            break
    return chosen[: len(sizes) - 1] or [sizes.index(min(sizes))]


def too_few_pairs(theta_or_groups: Tensor) -> str:
    """Say in words, for a warning, that these pairs are too few to hold some out."""
    groups = groups_of(theta_or_groups)
    if _num_groups(groups) == len(groups):
        return f"Only {len(groups)} calibration pair(s)"
    return (
        f"Only {_num_groups(groups)} different parameters (or groups) among "
        f"{len(groups)} calibration pairs"
    )


def _num_groups(groups: Tensor) -> int:
    return int(groups.max()) + 1 if len(groups) else 0
