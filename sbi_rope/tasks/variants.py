r"""The variants that every task has, besides those of its own.

They change who is observed (the parameters of the two sets), how well the calibration
parameters are known, or remove the misspecification.
"""

import torch
from sbi.utils import within_support
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope.tasks.splits import stream_of

COMMON_VARIANTS = {
    "prior_shift": "all real parameters come from a part of the prior's support, "
    "`shifted_region`",
    "biased_calibration": "the first parameters of the calibration set, three at "
    "most, crowd in the middle of the prior, those of the test set do not",
    "noisy_labels": "the parameters of the calibration set are known up to Gaussian "
    "noise of `label_noise` prior standard deviations, cut at the prior's support",
    "well_specified": "the real process is the simulator",
}
# The rejection behind a biased set would accept next to nothing with more.
NUM_BIASED = 3
BLOCK_SIZE = 100


def inside_region(
    theta: Tensor, names: tuple[str, ...], region: dict[str, tuple[float, float]]
) -> Tensor:
    """Return 1 for rows whose named parameters lie in an interval each, else 0."""
    inside = torch.ones(len(theta), dtype=torch.bool)
    for name, (low, high) in region.items():
        value = theta[:, names.index(name)]
        inside &= (value >= low) & (value <= high)
    return inside.double()


def beta_shaped(quantiles: Tensor) -> Tensor:
    r"""Return a chance that lets parameters near the middle of the prior stay.

    .. math:: \prod_{k \le 3} \left( 4 u_k (1 - u_k) \right)^2,

    the density of Beta(3, 3) over its maximum, in the first three parameters. Where
    parameters are independent in the prior, Beta(3, 3) is the law of the quantiles
    that stay.

    Quantiles are values of the prior's distribution functions, shape ``(n, d)``.
    """
    u = quantiles[:, :NUM_BIASED].double()
    return ((4 * u * (1 - u)) ** 2).prod(dim=1)


def with_label_noise(
    theta: Tensor, std: Tensor, prior: Distribution, *, seed: int
) -> Tensor:
    """Add independent Gaussian noise, drawn anew where it leaves the prior's support.

    Parameters have shape ``(n, d)``, standard deviations ``(d,)``. The noise of a row
    depends on the seed of the set and on its position only.
    """
    seeds = torch.Generator().manual_seed(stream_of(seed, "labels"))
    noisy = theta.clone()
    for rows in torch.arange(len(theta)).split(BLOCK_SIZE):
        # One generator a block: rows drawn anew in one leave the next as they are.
        block_seed = int(torch.randint(2**32, (), generator=seeds, device="cpu"))
        generator = torch.Generator().manual_seed(block_seed)
        left = rows
        while len(left):
            # Whole blocks, so that a small set is the beginning of a larger one.
            noise = torch.randn(
                (BLOCK_SIZE, theta.shape[1]), dtype=theta.dtype, generator=generator
            )
            drawn = theta[left] + std * noise[left - rows[0]]
            inside = within_support(prior, drawn)
            noisy[left[inside]] = drawn[inside]
            left = left[~inside]
    return noisy
