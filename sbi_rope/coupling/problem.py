"""Two sets of embeddings, ready to be coupled at any gamma and tau."""

import torch
from torch import Tensor

from sbi_rope.coupling.cost import Cost, Distances
from sbi_rope.coupling.kernel import Kernel
from sbi_rope.errors import CouplingError

__all__ = ["Problem", "median_distance"]

# The median distance is computed from this many simulations at most.
MAX_FOR_MEDIAN = 2000
# If exponents C / gamma are larger than this, rounding hides the differences between
# them.
LARGEST_EXPONENT = 1e12
# If distances / gamma are larger than this, the rounding of a matrix product would show
# in the weights.
LARGEST_BY_PRODUCT = 1e3


class Problem:
    """The distances of observations from simulations.

    Args:
        real: Embeddings of the observations, shape ``(n_o, l)``, float64.
        simulated: Embeddings of the simulations, shape ``(n_s, l)``, float64.
        blocked: Whether to hold no matrix of size n_o x n_s.
        stored: Whether to store the distances, because they are used more than once.
        smallest_gamma: The smallest gamma to solve for, in units of the embeddings.

    Attributes:
        cost: The distances.
        direct: Whether distances are computed without a matrix product.

    Raises:
        CouplingError: If the distances overflow.
    """

    def __init__(
        self,
        real: Tensor,
        simulated: Tensor,
        *,
        blocked: bool,
        stored: bool,
        smallest_gamma: float,
    ) -> None:
        bound = Distances(simulated).bound(real)
        if not bound < 0.1 * torch.finfo(torch.double).max ** 0.5:
            raise CouplingError(
                f"The distances between embeddings overflow (up to {bound:.0e}); check "
                "the scale of the embedding net's outputs."
            )
        self.direct = bound > LARGEST_BY_PRODUCT * smallest_gamma
        self.blocked = blocked
        self.cost = Cost(real, simulated, stored=stored, direct=self.direct)
        self._kernel: tuple[float, Kernel] | None = None

    def zero_potential(self) -> Tensor:
        """Return a potential of zeros to start from."""
        return self.cost.simulated.new_zeros(self.cost.shape[1])

    def kernel(self, gamma: float) -> Kernel:
        """Return the kernel of a gamma in units of the embeddings, and keep it."""
        if self._kernel is None or self._kernel[0] != gamma:
            self._kernel = None  # frees its memory before the next one is made
            self._kernel = (gamma, Kernel(self.cost, gamma, stored=not self.blocked))
        return self._kernel[1]


def median_distance(simulated: Tensor) -> float:
    """Return the median distance between the embeddings of simulations.

    Raises:
        CouplingError: If it is zero, or there is a single simulation.
    """
    subset = simulated[:MAX_FOR_MEDIAN]
    median = torch.nn.functional.pdist(subset).median() if len(subset) > 1 else 0.0
    if float(median) == 0.0:
        raise CouplingError(
            "Expected simulations whose embeddings differ for cost_scale='simulated'; "
            f"got a median distance of zero between {len(subset)} of them."
        )
    return float(median)
