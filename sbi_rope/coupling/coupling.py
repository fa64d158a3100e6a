"""Semi-balanced entropic optimal transport: its settings and its result."""

from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from torch import Tensor

from sbi_rope.coupling.sinkhorn import (
    Kernel,
    Solution,
    blocks,
    distances,
    solve,
    solve_pot,
)
from sbi_rope.utils.errors import CouplingError, warn_user
from sbi_rope.utils.settings import Count, Positive, Settings, UnitInterval
from sbi_rope.utils.tensors import as_batch

# With fewer observations than this, few of them decide how the coupling is balanced.
SMALL_BATCH = 20
# The median distance is computed from this many simulations at most.
MAX_FOR_MEDIAN = 2000


@dataclass(frozen=True, eq=False, kw_only=True)
class Coupling:
    r"""The weights of the simulations for each real observation.

    Row i holds the mixture weights of observation i (RoPE, eq. 5), a softmax of the
    simulation-side log-potential :math:`w`,

    .. math:: \alpha_{ij} = \operatorname{softmax}_j (w_j - C_{ij} / \gamma).

    Rows are computed when they are asked for.

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
        num_iterations: Sinkhorn iterations; 0 at tau = 0, which needs none.
        converged: Whether ``marginal_error`` reached the tolerance.
    """

    potential: Tensor = field(repr=False)
    real: Tensor = field(repr=False)
    simulated: Tensor = field(repr=False)
    gamma: float
    tau: float
    marginal_error: float
    num_iterations: int
    converged: bool

    @property
    def weights(self) -> Tensor:
        r""":math:`\alpha`, shape ``(n_o, n_s)``; rows sum to one."""
        return self.rows(self.real)

    @property
    def effective_sample_size(self) -> Tensor:
        r""":math:`1 / \sum_j \alpha_{ij}^2` of each row, shape ``(n_o,)``."""
        parts = blocks(self.real, len(self.simulated))
        return torch.cat([1 / self.rows(part).square().sum(dim=1) for part in parts])

    def rows(self, real: Tensor) -> Tensor:
        r"""Return the weights of any observations under the same potential.

        A new row is nearly what coupling again would give if its effective sample size
        is large, not if it is only a few.

        Args:
            real: Embeddings of the observations, shape ``(n, l)``.

        Returns:
            Weights of shape ``(n, n_s)``; rows sum to one.
        """
        real, n_s = real.to(self.simulated), len(self.simulated)
        weights = real.new_empty(len(real), n_s)
        for part, out in zip(blocks(real, n_s), blocks(weights, n_s), strict=True):
            exponents = distances(part, self.simulated).mul_(-1 / self.gamma)
            torch.softmax(exponents.add_(self.potential), dim=1, out=out)
        return weights

    def to(self, device: str | torch.device) -> "Coupling":
        """Return the same coupling on another device."""
        names = ("potential", "real", "simulated")
        return replace(self, **{name: getattr(self, name).to(device) for name in names})


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
            acceleration. ``"pot"`` is POT's ``sinkhorn_unbalanced``, whose scalings
            over- or underflow if gamma is small.
        tolerance: The largest ``marginal_error`` that counts as converged.
        max_iterations: The largest number of iterations. If they are not enough, there
            is a warning, and ``converged`` is False.

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
            real: :math:`g(x_o)`, shape ``(n_o, l)``. There is a warning if n_o is below
                20.
            simulated: :math:`h(x_s)`, shape ``(n_s, l)``; n_s may differ from n_o.

        Raises:
            CouplingError: If with ``cost_scale="simulated"`` the median distance
                between simulations is zero.
        """
        simulated = as_batch("simulated", simulated)
        real = as_batch("real", real, simulated.shape[1:], device=simulated.device)
        real, simulated = real.double(), simulated.double()
        gamma = self.gamma
        if self.cost_scale == "simulated":
            gamma *= _median_distance(simulated)
        if self.tau == 0.0:  # no observation depends on the others
            found = Solution(real.new_zeros(len(simulated)), 0.0, 0)
        else:
            _warn_of_small_batch(len(real), self.tau)
            found = (solve if self.solver == "own" else solve_pot)(
                Kernel(real, simulated, gamma),
                tau=self.tau,
                tolerance=self.tolerance,
                max_iterations=self.max_iterations,
            )
        converged = found.marginal_error <= self.tolerance
        if not converged:
            warn_user(
                "The coupling has not converged: marginal error "
                f"{found.marginal_error:.1e} after {found.num_iterations} iterations, "
                f"tolerance {self.tolerance:.1e}. Use a larger gamma, "
                + ("more max_iterations." if self.solver == "own" else "solver='own'.")
            )
        return Coupling(
            **found._asdict(),
            real=real,
            simulated=simulated,
            gamma=gamma,
            tau=self.tau,
            converged=converged,
        )


def _warn_of_small_batch(n_o: int, tau: float) -> None:
    if n_o >= SMALL_BATCH:
        return
    consequence = "these few decide how much weight each simulation gets"
    if n_o == 1 and tau == 1.0:
        consequence = "its row is uniform and the posterior is the prior"
    warn_user(
        f"Coupling a batch of {n_o} real observation(s), tau={tau}: {consequence}. Use "
        f"at least {SMALL_BATCH} observations, a smaller tau, or `stack`."
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
