"""A permutation test of whether some numbers depend on others."""

from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["PermutationTest", "permutation_test"]

NUM_PERMUTATIONS = 1000
# So many are made at a time, which takes memory for as many copies of the outcomes.
AT_A_TIME = 100


@dataclass(frozen=True, kw_only=True)
class PermutationTest:
    """What a linear regression explains, and how often permutations explain as much.

    Attributes:
        p_value: The share of permutations that explain as much, the data themselves
            included.
        explained: The sum of squares that the regression explains.
        num_features: The number of features that are linearly independent.
    """

    p_value: float
    explained: float
    num_features: int


def permutation_test(outcomes: Tensor, features: Tensor) -> PermutationTest:
    """Test whether rows of outcomes depend linearly on rows of features.

    The statistic is the sum of squares that a linear regression with an intercept
    explains. If the rows of the outcomes are exchangeable given the features, the
    p-value is below any level at most as often as the level says. Permutations come
    from torch's random state.

    Args:
        outcomes: Shape ``(n, l)``, in comparable units.
        features: Shape ``(n, p)``.
    """
    features = features - features.mean(dim=0)
    vectors, values, _ = torch.linalg.svd(features, full_matrices=False)
    basis = vectors[:, values > 1e-9 * values.max()]
    centred = outcomes - outcomes.mean(dim=0)
    explained = float((basis.T @ centred).square().sum())
    permuted = torch.cat(
        [
            (basis.T @ centred[_permutations(len(centred))]).square().sum(dim=(1, 2))
            for _ in range(NUM_PERMUTATIONS // AT_A_TIME)
        ]
    )
    # A permutation that is equal up to rounding counts.
    reached = int((permuted >= explained * (1 - 1e-12)).sum())
    return PermutationTest(
        p_value=(1 + reached) / (1 + NUM_PERMUTATIONS),
        explained=explained,
        num_features=basis.shape[1],
    )


def _permutations(n: int) -> Tensor:
    return torch.stack([torch.randperm(n) for _ in range(AT_A_TIME)])
