"""Semi-balanced entropic optimal transport: its settings and its result."""

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Literal

import torch
from torch import Tensor

from sbi_rope.coupling.sinkhorn import (
    Distances,
    Kernel,
    Solution,
    row_blocks,
    solve_fixed_point,
    solve_pot,
)
from sbi_rope.utils.errors import CouplingError, warn_user
from sbi_rope.utils.settings import Count, Positive, Settings, UnitInterval
from sbi_rope.utils.tensors import as_batch

# With fewer observations than this, few of them decide how the coupling is balanced.
SMALL_BATCH = 20
# The largest number of distances to store: 0.4 GB in float64, and as much again for the
# kernel.
MAX_STORED = 50_000_000
# The median distance is computed from this many simulations at most.
MAX_FOR_MEDIAN = 2000
# Exponents C / gamma above this differ by no more than rounding, and above the second
# number the rounding of a matrix product would show in the weights.
LARGEST_EXPONENT, LARGEST_BY_PRODUCT = 1e12, 1e3


@dataclass(frozen=True, eq=False, kw_only=True)
class Coupling:
    r"""The weights of the simulations for each real observation.

    Row i holds the mixture weights of observation i (RoPE, eq. 5), a softmax of the
    simulation-side log-potential :math:`w`,

    .. math:: \alpha_{ij} = \operatorname{softmax}_j (w_j - C_{ij} / \gamma).

    The coupling keeps :math:`w` and the embeddings, and computes rows when they are
    asked for.

    Attributes:
        potential: :math:`w`, shape ``(n_s,)``, float64, with mean zero.
        real: The embeddings of the observations, shape ``(n_o, l)``.
        simulated: The embeddings of the simulations, shape ``(n_s, l)``.
        gamma: The entropic regularisation in units of the embeddings, that is after
            ``cost_scale``.
        tau: The trust in the prior.
        marginal_error: :math:`\lVert q - q^*(w) \rVert_1`, where :math:`q` is the mean
            of the rows, and :math:`q^*_j \propto b_j e^{-w_j (1 - \tau) / \tau}` at the
            optimum.
        num_iterations: Sinkhorn iterations, over all solvers that were used.
        converged: Whether ``marginal_error`` reached the tolerance.
        solver: The solver that finished: ``"own"``, ``"pot"``, or ``"none"`` at tau =
            0, which needs no iteration.
        direct: Whether distances are computed without a matrix product, because gamma
            is small compared to them.
    """

    potential: Tensor = field(repr=False)
    real: Tensor = field(repr=False)
    simulated: Tensor = field(repr=False)
    gamma: float
    tau: float
    marginal_error: float
    num_iterations: int
    converged: bool
    solver: Literal["own", "pot", "none"]
    direct: bool = False

    @property
    def weights(self) -> Tensor:
        r""":math:`\alpha`, shape ``(n_o, n_s)``; rows sum to one."""
        return self._rows(self.real)

    @property
    def effective_sample_size(self) -> Tensor:
        r""":math:`1 / \sum_j \alpha_{ij}^2` of each row, shape ``(n_o,)``."""
        sizes = self.real.new_empty(len(self.real))
        for rows in row_blocks(self.real, len(self.simulated)):
            sizes[rows] = 1 / self._rows(self.real[rows]).square().sum(dim=1)
        return sizes

    def __getstate__(self) -> dict[str, Any]:
        # What distances are computed from would be saved twice.
        return {entry.name: getattr(self, entry.name) for entry in fields(self)}

    def rows(self, real: Tensor) -> Tensor:
        r"""Return the weights of other observations under the same potential.

        A new row is nearly what coupling again would give if its effective sample size
        is large, not if it is only a few.

        Args:
            real: Embeddings of the observations, shape ``(n, l)``.

        Returns:
            Weights of shape ``(n, n_s)``; rows sum to one.
        """
        real = as_batch("real", real, self.simulated.shape[1:]).to(self.simulated)
        return self._rows(real)

    def to(self, device: str | torch.device) -> "Coupling":
        """Return the same coupling on another device."""
        names = ("potential", "real", "simulated")
        return replace(self, **{name: getattr(self, name).to(device) for name in names})

    def _rows(self, real: Tensor) -> Tensor:
        weights = real.new_empty(len(real), len(self.simulated))
        # Blocks of this size stay in the cache.
        for block in row_blocks(real, len(self.simulated)):
            cost = self._distances(real[block])
            exponents = torch.add(self.potential, cost, alpha=-1 / self.gamma)
            weights[block] = torch.softmax(exponents, dim=1)
        return weights

    @cached_property
    def _distances(self) -> Distances:
        return Distances(self.simulated, direct=self.direct)


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
    has the same weight; with ``tau < 1`` simulations need not.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
          Calibration (Wehenkel et al., 2025), eqs. 2 and 5
        | https://arxiv.org/abs/2405.08719

    Args:
        gamma: Entropic regularisation, positive. A small value gives sharp posteriors,
            and a large one gives the prior. The paper's value is 0.5 with
            ``cost_scale="none"``.
        tau: Trust in the prior, in [0, 1]. With 1 all simulations are used equally.
            With 0 every observation chooses simulations without regard to the others.
        cost_scale: ``"simulated"`` divides the distances by the median distance between
            simulated embeddings, so that gamma does not depend on their units.
            ``"none"`` takes the distances as they are, as the paper does.
        solver: ``"own"`` iterates the simulation-side potential with Anderson
            acceleration. ``"pot"`` is POT's ``sinkhorn_unbalanced``; our own solver
            takes over where its scalings over- or underflow.
        tolerance: The largest ``marginal_error`` that counts as converged.
        max_iterations: The largest number of iterations. If they are not enough,
            ``converged`` is False.

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

        Raises:
            CouplingError: If gamma is too small for the digits of float64, or with
                ``cost_scale="simulated"`` the median distance between simulations is
                zero.
        """
        simulated = as_batch("simulated", simulated)
        real = as_batch("real", real, simulated.shape[1:], device=simulated.device)
        self._warn_of_small_batch(len(real))
        real, simulated = real.double(), simulated.double()
        scaled = self.cost_scale == "simulated"
        gamma = self.gamma * (_median_distance(simulated) if scaled else 1.0)
        distances = Distances(simulated)
        bound = distances.bound(real)
        smallest = bound / LARGEST_EXPONENT
        if gamma < smallest:
            raise CouplingError(
                f"Expected a gamma of at least {smallest:.1e} in units of the "
                f"embeddings, so that float64 tells distances apart; got {gamma:.1e}."
            )
        distances.direct = bound > LARGEST_BY_PRODUCT * gamma
        found, solver = self._solution(real, distances, gamma)
        return Coupling(
            potential=found.potential,
            real=real,
            simulated=simulated,
            gamma=gamma,
            tau=self.tau,
            marginal_error=found.marginal_error,
            num_iterations=found.num_iterations,
            converged=found.marginal_error <= self.tolerance,
            solver=solver,
            direct=distances.direct,
        )

    def _solution(
        self, real: Tensor, distances: Distances, gamma: float
    ) -> tuple[Solution, Literal["own", "pot", "none"]]:
        start, made = real.new_zeros(len(distances)), 0
        if self.tau == 0.0:
            return Solution(start, 0.0, 0), "none"
        stored = self.solver == "pot" or len(real) * len(distances) <= MAX_STORED
        kernel = Kernel(real, distances, gamma, stored=stored)
        goal = {"tau": self.tau, "tolerance": self.tolerance}
        if self.solver == "pot":
            found, healthy = solve_pot(
                kernel, start, **goal, max_iterations=self.max_iterations
            )
            if healthy:
                return found, "pot"
            start, made = found.potential, found.num_iterations
        left = self.max_iterations - made
        found = solve_fixed_point(kernel, start, **goal, max_iterations=left)
        made += found.num_iterations
        return found._replace(num_iterations=made), "own"

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
