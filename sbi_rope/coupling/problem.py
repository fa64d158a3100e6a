"""Two sets of embeddings, checked and ready to be coupled at any gamma and tau."""

import torch
from torch import Tensor

from sbi_rope.coupling.cost import Cost, Distances, widest
from sbi_rope.coupling.kernel import Kernel
from sbi_rope.errors import CouplingError, InvalidInputError
from sbi_rope.tensors import as_batch, as_numbers

__all__ = ["Problem", "checked_embeddings", "median_distance"]

# The median distance is computed from this many simulations at most.
MAX_FOR_MEDIAN = 2000
# If exponents C / gamma are larger than this, rounding hides the differences between
# them.
LARGEST_EXPONENT = {torch.float64: 1e12, torch.float32: 1e5}
# If distances / gamma are larger than this, the rounding of a matrix product would show
# in the weights.
LARGEST_BY_PRODUCT = 1e3
# An error message names rows that are this many times as far from the centre as the
# median simulation.
EXTREME = 1e3


class Problem:
    """The distances of some or all observations from all simulations.

    Args:
        real: Embeddings of the observations, shape ``(n_o, l)``.
        simulated: Embeddings of the simulations, shape ``(n_s, l)``.
        fitted: Numbers of the observations to fit to; None for all.
        blocked: Whether to hold no matrix of size n_o x n_s.
        stored: Whether to store the distances, because they are used more than once.
        smallest_gamma: The smallest gamma to solve for, in units of the embeddings.

    Attributes:
        cost: The distances of the observations to fit to.
        all_fitted: Whether these are all observations.
        direct: Whether distances are computed without a matrix product.

    Raises:
        CouplingError: If the distances overflow.
    """

    def __init__(
        self,
        real: Tensor,
        simulated: Tensor,
        *,
        fitted: Tensor | None,
        blocked: bool,
        stored: bool,
        smallest_gamma: float,
    ) -> None:
        bound = Distances(simulated).bound(real)
        if not bound < 0.1 * torch.finfo(real.dtype).max ** 0.5:
            raise _error(
                "The distances between embeddings overflow.",
                real,
                simulated,
                otherwise="Check the scale of the embedding net's outputs.",
            )
        # In float32 the rounding of a matrix product always shows.
        in_float64 = widest(real.device) == torch.float64
        self.direct = not in_float64 or bound > LARGEST_BY_PRODUCT * smallest_gamma
        self.real = real
        self.simulated = simulated
        self.blocked = blocked
        self.all_fitted = fitted is None
        self.cost = Cost(
            real if fitted is None else real[fitted],
            simulated,
            stored=stored,
            direct=self.direct,
        )
        self._kernel: tuple[float, Kernel] | None = None

    @property
    def size(self) -> int:
        """The number of distances of all observations from all simulations."""
        return len(self.real) * len(self.simulated)

    def zero_potential(self) -> Tensor:
        """Return a potential of zeros to start from."""
        dtype = widest(self.simulated.device)
        return self.simulated.new_zeros(len(self.simulated), dtype=dtype)

    def check_gamma(self, gamma: float) -> None:
        """Check that gamma is not too small for the digits of the dtype.

        Raises:
            CouplingError: If gamma, in units of the embeddings, is too small.
        """
        smallest = max(
            self.cost.bound / LARGEST_EXPONENT[self.real.dtype],
            torch.finfo(self.real.dtype).tiny,
        )
        if gamma < smallest:
            raise _error(
                f"Expected a gamma of at least {smallest:.1e} in units of the "
                f"embeddings, below which {self.real.dtype} has too few digits for "
                f"distances / gamma; got {gamma:.1e}.",
                self.real,
                self.simulated,
                otherwise="Use a larger gamma, or dtype=torch.float64.",
            )

    def kernel(self, gamma: float) -> Kernel:
        """Return the kernel of a gamma in units of the embeddings, and keep it."""
        if self._kernel is None or self._kernel[0] != gamma:
            self._kernel = None  # frees its memory before the next one is made
            kernel = Kernel(self.cost, gamma, stored=not self.blocked)
            self._kernel = (gamma, kernel)
        return self._kernel[1]

    def kernel_of_all(self, gamma: float) -> Kernel:
        """Return a kernel over all observations, also those that are not fitted to."""
        cost = Cost(self.real, self.simulated, stored=False, direct=self.direct)
        return Kernel(cost, gamma, stored=False)


def _error(
    problem: str, real: Tensor, simulated: Tensor, *, otherwise: str
) -> CouplingError:
    """Return an error that names the rows far from all others, if there are any."""
    # float64 holds the squares of all float32 numbers.
    real, simulated = real.cpu().double(), simulated.cpu().double()
    centre = simulated.median(dim=0).values
    distance = torch.linalg.vector_norm(simulated - centre, dim=1)
    limit = EXTREME * float(distance.median())
    of_real = torch.linalg.vector_norm(real - centre, dim=1)
    rows = {
        name: (values > limit).nonzero().flatten().tolist()
        for name, values in (("real", of_real), ("simulated", distance))
    }
    blamed = []
    if 0 < len(rows["real"]) < max(2, len(real) / 2):
        blamed.append(f"{len(rows['real'])} of `real` (first: {rows['real'][:5]})")
    if rows["simulated"]:
        blamed.append(f"{len(rows['simulated'])} of `simulated`")
    if not blamed:
        return CouplingError(f"{problem} {otherwise}")
    return CouplingError(
        f"{problem} Some rows are more than {EXTREME:.0f} times as far from the centre "
        f"of the simulations as a typical simulation: {' and '.join(blamed)}. "
        "Remove or repair them.",
        simulated_rows=rows["simulated"],
    )


def checked_embeddings(real: Tensor, simulated: Tensor) -> tuple[Tensor, Tensor]:
    """Check two sets of embeddings.

    Raises:
        InvalidInputError: If one is not a tensor of numbers.
        InvalidInputError: If shapes or devices do not fit, a set is empty, or a value
            is not finite.
    """
    real = as_numbers("real", real)
    simulated = as_numbers("simulated", simulated)
    if real.device != simulated.device:
        raise InvalidInputError(
            "Expected `real` and `simulated` on the same device; got "
            f"{real.device} and {simulated.device}."
        )
    if simulated.ndim != 2:
        raise InvalidInputError(
            f"Expected `simulated` of shape (n_s, l); got {tuple(simulated.shape)}."
        )
    simulated = as_batch("simulated", simulated, simulated.shape[1:])
    real = as_batch("real", real, simulated.shape[1:])
    return real.detach(), simulated.detach()


def median_distance(simulated: Tensor) -> float:
    """Return the median distance between the embeddings of simulations.

    Raises:
        CouplingError: If it is zero, or there is a single simulation.
    """
    subset = simulated[:MAX_FOR_MEDIAN]
    if widest(subset.device) != torch.float64:
        subset = subset.cpu()  # which has float64, and pdist
    subset = subset.double()
    median = torch.nn.functional.pdist(subset).median() if len(subset) > 1 else 0.0
    if float(median) == 0.0:
        raise CouplingError(
            "cost_scale='simulated' needs simulations whose embeddings differ, but "
            f"the median distance between {len(subset)} of them is zero. Use more "
            "simulations, cost_scale='none', or check the embedding net."
        )
    return float(median)
