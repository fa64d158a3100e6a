"""Semi-balanced entropic optimal transport, with its settings."""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from sbi_rope.coupling.cost import Cost, Distances
from sbi_rope.coupling.fixed_point import Solution, solve_fixed_point
from sbi_rope.coupling.kernel import Kernel
from sbi_rope.coupling.pot import solve_pot
from sbi_rope.coupling.result import Coupling
from sbi_rope.errors import CouplingError, warn_user
from sbi_rope.settings import Count, Positive, Settings, UnitInterval
from sbi_rope.tensors import as_batch

__all__ = ["SinkhornCoupler"]

# With fewer observations than this, few of them decide how the coupling is balanced.
SMALL_BATCH = 20
# The largest number of distances to store: 0.4 GB in float64, and as much again for the
# kernel.
MAX_STORED = 50_000_000
# The median distance is computed from this many simulations at most.
MAX_FOR_MEDIAN = 2000
# If exponents C / gamma are larger than this, rounding hides the differences between
# them.
LARGEST_EXPONENT = 1e12
# If distances / gamma are larger than this, the rounding of a matrix product would show
# in the weights.
LARGEST_BY_PRODUCT = 1e3


@dataclass(frozen=True, kw_only=True)
class SinkhornCoupler(Settings):
    r"""Semi-balanced entropic optimal transport between two sets of embeddings.

    With :math:`C_{ij} = \lVert g(x_{o,i}) - h(x_{s,j}) \rVert_2` it solves

    .. math::
        P^\star = \arg\min_{P \ge 0,\; P \mathbf{1} = \mathbf{1}/n_o}
        \langle P, C \rangle
        + \rho\, \mathrm{KL}(P^\top \mathbf{1} \,\|\, \mathbf{1}/n_s)
        + \gamma\, \langle P, \log P \rangle,
        \qquad \rho = \frac{\gamma \tau}{1 - \tau},

    and returns the rows :math:`\alpha_{ij} = n_o P^\star_{ij}`. Every real observation
    has the same weight. With ``tau < 1``, some simulations may have less weight than
    others.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
          Calibration (Wehenkel et al., 2025), eqs. 2 and 5
        | https://arxiv.org/abs/2405.08719

    Args:
        gamma: Entropic regularisation, positive. A small value gives sharp posteriors,
            and a large one gives the prior. Its unit is that of ``cost_scale``. The
            paper's value is 0.5 with ``cost_scale="none"``.
        tau: Trust in the prior, in [0, 1]. With 1 (the default) all simulations are
            used equally, which is right if the prior is well specified. With 0 every
            observation chooses its simulations without regard to the others.
        cost_scale: ``"simulated"`` (the default) divides the distances by the median
            distance between simulated embeddings, so that a gamma means the same
            whatever the units of the embedding net. ``"none"`` takes the distances as
            they are, as the paper does.
        solver: ``"own"`` (the default) iterates the simulation-side potential with
            Anderson acceleration. ``"pot"`` is POT's ``sinkhorn_unbalanced``; our own
            solver takes over where its scalings over- or underflow.
        tolerance: The largest ``marginal_error`` that counts as converged.
        max_iterations: The largest number of iterations. If they are not enough,
            ``converged`` is False.

    Raises:
        InvalidInputError: If an argument is outside its range.

    Example:
        >>> simulated = torch.tensor([[0.0], [10.0]])
        >>> real = simulated.repeat(10, 1)
        >>> coupling = SinkhornCoupler(gamma=0.1).couple(real, simulated)
        >>> coupling.weights[:2].round(decimals=3)
        tensor([[1., 0.],
                [0., 1.]], dtype=torch.float64)
        >>> coupling.converged
        True
    """

    gamma: Positive = 0.1
    tau: UnitInterval = 1.0
    cost_scale: Literal["none", "simulated"] = "simulated"
    solver: Literal["own", "pot"] = "own"
    tolerance: Positive = 1e-6
    max_iterations: Count = 10_000

    def couple(self, real: Tensor, simulated: Tensor) -> Coupling:
        """Couple the embeddings of real observations with those of simulations.

        Args:
            real: :math:`g(x_o)`, shape ``(n_o, l)``.
            simulated: :math:`h(x_s)`, shape ``(n_s, l)``; n_s may differ from n_o.

        Returns:
            The coupling, on the device of the embeddings. Its ``converged`` is False if
            the tolerance was not met.

        Raises:
            InvalidInputError: If the shapes do not fit, a set is empty, or a value is
                not finite.
            CouplingError: If the distances overflow, gamma is too small for the digits
                of float64, or with ``cost_scale="simulated"`` the median distance
                between simulations is zero.
        """
        simulated = as_batch("simulated", simulated)
        real = as_batch("real", real, simulated.shape[1:], device=simulated.device)
        self._warn_of_small_batch(len(real))
        real, simulated = real.double(), simulated.double()
        scaled = self.cost_scale == "simulated"
        gamma = self.gamma * (_median_distance(simulated) if scaled else 1.0)
        bound = Distances(simulated).bound(real)
        if not bound < 0.1 * torch.finfo(torch.double).max ** 0.5:
            raise CouplingError(
                f"The distances between embeddings overflow (up to {bound:.0e}); check "
                "the scale of the embedding net's outputs."
            )
        smallest = max(bound / LARGEST_EXPONENT, torch.finfo(torch.double).tiny)
        if gamma < smallest:
            raise CouplingError(
                f"Expected a gamma of at least {smallest:.1e} in units of the "
                f"embeddings, so that float64 tells distances apart; got {gamma:.1e}."
            )
        direct = bound > LARGEST_BY_PRODUCT * gamma
        # Our own solver needs the distances about once.
        cost = Cost(real, simulated, stored=self.solver == "pot", direct=direct)
        solution, solver = self._solution(cost, gamma)
        return Coupling(
            potential=solution.potential,
            real=real,
            simulated=simulated,
            gamma=gamma,
            tau=self.tau,
            marginal_error=solution.marginal_error,
            num_iterations=solution.num_iterations,
            converged=solution.marginal_error <= self.tolerance,
            solver=solver,
            direct=direct,
            blocked=math.prod(cost.shape) > MAX_STORED,
        )

    def _warn_of_small_batch(self, n_o: int) -> None:
        # With a tau of 0, no observation depends on the others.
        if n_o >= SMALL_BATCH or self.tau == 0.0:
            return
        consequence = "these few decide how much weight each simulation gets"
        if n_o == 1 and self.tau == 1.0:
            consequence = "its row is uniform and the posterior is the prior"
        warn_user(
            f"Coupling a batch of {n_o} real observation(s), tau={self.tau}: "
            f"{consequence}. Use at least {SMALL_BATCH} observations, a smaller "
            "tau, or the rows of a larger batch (`unseen='extend'`)."
        )

    def _solution(
        self, cost: Cost, gamma: float
    ) -> tuple[Solution, Literal["own", "pot", "none"]]:
        start, made = cost.simulated.new_zeros(cost.shape[1]), 0
        if self.tau == 0.0:
            return Solution(start, 0.0, 0), "none"
        blocked = self.solver == "own" and math.prod(cost.shape) > MAX_STORED
        kernel = Kernel(cost, gamma, stored=not blocked)
        if self.solver == "pot":
            solution, healthy = solve_pot(
                cost,
                gamma,
                kernel,
                start,
                tau=self.tau,
                tolerance=self.tolerance,
                max_iterations=self.max_iterations,
            )
            if healthy:
                return solution, "pot"
            start, made = solution.potential, solution.num_iterations
        solution = solve_fixed_point(
            kernel,
            start,
            tau=self.tau,
            tolerance=self.tolerance,
            max_iterations=self.max_iterations - made,
        )
        iterations = made + solution.num_iterations
        return solution._replace(num_iterations=iterations), "own"


def _median_distance(simulated: Tensor) -> float:
    """Return the median distance between the embeddings of simulations."""
    subset = simulated[:MAX_FOR_MEDIAN]
    median = torch.nn.functional.pdist(subset).median() if len(subset) > 1 else 0.0
    if float(median) == 0.0:
        raise CouplingError(
            "Expected simulations whose embeddings differ for cost_scale='simulated'; "
            f"got a median distance of zero between {len(subset)} of them."
        )
    return float(median)
