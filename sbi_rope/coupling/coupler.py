"""Semi-balanced entropic optimal transport, with its settings."""

from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from sbi_rope._random import seeded
from sbi_rope.coupling.cost import widest
from sbi_rope.coupling.fixed_point import Solution, solve_fixed_point
from sbi_rope.coupling.kernel import marginal_error
from sbi_rope.coupling.pot import solve_pot
from sbi_rope.coupling.problem import Problem, checked_embeddings, median_distance
from sbi_rope.coupling.result import Coupling
from sbi_rope.errors import InvalidInputError, warn_user, without_warning
from sbi_rope.settings import Count, Positive, UnitInterval, Whole, check, one_of

__all__ = ["SMALL_BATCH", "SinkhornCoupler", "without_warning_of_small_batch"]

# With fewer observations than this, few of them decide how the coupling is balanced.
SMALL_BATCH = 20
# The largest number of distances to store: 0.4 GB in float64, and as much again for the
# kernel.
MAX_STORED = 50_000_000


def without_warning_of_small_batch() -> AbstractContextManager[None]:
    """Couple a batch whose size the user did not choose."""
    return without_warning("Coupling a batch of")


@dataclass(frozen=True, kw_only=True)
class SinkhornCoupler:
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
        dtype: ``torch.float64`` (the default) or ``torch.float32``, which takes half
            the memory and less time. Devices without float64 (MPS) need
            ``torch.float32``.
        blocked: Whether to compute the distances again in every iteration, block by
            block. That is slower, but no matrix of size n_o x n_s is ever held. None
            (the default) does so for more than 50 million distances (7,000 observations
            and as many simulations).
        num_fitted: The number of observations, chosen at random, that the potential is
            fitted to; None (the default) fits it to all. ``batch_error`` of the
            coupling tells how far off it then is over the whole batch.
        anderson_memory: The number of last steps that Anderson acceleration combines; 0
            switches it off.

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

    gamma: float = 0.1
    tau: float = 1.0
    cost_scale: Literal["none", "simulated"] = "simulated"
    solver: Literal["own", "pot"] = "own"
    tolerance: float = 1e-6
    max_iterations: int = 10_000
    dtype: torch.dtype = torch.float64
    blocked: bool | None = None
    num_fitted: int | None = None
    anderson_memory: int = 5

    def __post_init__(self) -> None:
        """Check the ranges of all fields."""
        check("gamma", self.gamma, Positive)
        check("tau", self.tau, UnitInterval)
        check("cost_scale", self.cost_scale, Literal["none", "simulated"])
        check("solver", self.solver, Literal["own", "pot"])
        check("tolerance", self.tolerance, Positive)
        check("max_iterations", self.max_iterations, Count)
        check("dtype", self.dtype, one_of((torch.float64, torch.float32)))
        check("blocked", self.blocked, one_of((None, True, False)))
        if self.num_fitted is not None:
            check("num_fitted", self.num_fitted, Count)
        check("anderson_memory", self.anderson_memory, Whole)
        if self.solver == "pot" and self.blocked:
            raise InvalidInputError(
                "Expected `blocked` to be None or False with solver='pot', which needs "
                "all distances at once; got True. Use solver='own'."
            )

    def couple(
        self, real: Tensor, simulated: Tensor, *, seed: int | None = None
    ) -> Coupling:
        """Couple the embeddings of real observations with those of simulations.

        Args:
            real: :math:`g(x_o)`, shape ``(n_o, l)``.
            simulated: :math:`h(x_s)`, shape ``(n_s, l)``; n_s may differ from n_o.
            seed: Seed of the choice of ``num_fitted`` observations; None uses torch's
                state.

        Returns:
            The coupling, on the device of the embeddings. Its ``converged`` is False if
            the tolerance was not met.

        Raises:
            InvalidInputError: If the shapes do not fit, a set is empty, a value is
                not finite, or the device of the embeddings has no float64 but
                ``dtype`` asks for it.
            CouplingError: If the distances overflow, gamma is too small for the digits
                of the dtype, or with ``cost_scale="simulated"`` the median distance
                between simulations is zero.
        """
        # Our own solver needs the distances about once for a single solution.
        problem, scale = self._set_up(
            real,
            simulated,
            seed,
            gamma=self.gamma,
            tau=self.tau,
            reused=self.solver == "pot",
        )
        return self._solve(problem, self.gamma * scale, problem.zero_potential())

    def _set_up(
        self,
        real: Tensor,
        simulated: Tensor,
        seed: int | None,
        *,
        gamma: float,
        tau: float,
        reused: bool,
    ) -> tuple[Problem, float]:
        real, simulated = checked_embeddings(real, simulated)
        if self.dtype == torch.float64 and widest(real.device) != torch.float64:
            raise InvalidInputError(
                f"float64 is not available on {real.device.type}; pass "
                "SinkhornCoupler(dtype=torch.float32) or move the posterior to the CPU."
            )
        num_fitted = min(len(real), self.num_fitted or len(real))
        # With a tau of 0, no observation depends on the others.
        if num_fitted < SMALL_BATCH and tau > 0.0:
            self._warn_small_batch(num_fitted, len(real), tau)
        real, simulated = real.to(self.dtype), simulated.to(self.dtype)
        fitted = None
        if num_fitted < len(real):
            with seeded(seed):
                fitted = torch.randperm(len(real))[:num_fitted].to(real.device)
        blocked = self.blocked
        if blocked is None:
            blocked = self.solver == "own" and num_fitted * len(simulated) > MAX_STORED
        scale = 1.0 if self.cost_scale == "none" else median_distance(simulated)
        problem = Problem(
            real,
            simulated,
            fitted=fitted,
            blocked=blocked,
            stored=reused and not blocked,
            smallest_gamma=gamma * scale,
        )
        return problem, scale

    def _warn_small_batch(self, num_fitted: int, n_o: int, tau: float) -> None:
        if num_fitted < n_o:
            warn_user(
                f"The coupling is fitted to num_fitted={num_fitted} of {n_o} real "
                "observations. These few decide how much weight each simulation gets. "
                f"Use a num_fitted of at least {SMALL_BATCH}, or None for all."
            )
            return
        consequence = (
            "its row is uniform and the posterior is the prior. "
            if n_o == 1 and tau == 1.0
            else "these few decide how much weight each simulation gets. "
        )
        warn_user(
            f"Coupling a batch of {n_o} real observation(s), tau={tau}: "
            + consequence
            + f"Use a batch of at least {SMALL_BATCH}, a smaller tau, or the rows of a "
            "posterior built for a larger batch (`unseen='extend'`)."
        )

    def _solve(self, problem: Problem, gamma: float, start: Tensor) -> Coupling:
        """Solve at this coupler's tau and a gamma in units of the embeddings."""
        problem.check_gamma(gamma)
        solution, solver = self._solution(problem, gamma, start)
        batch_error = solution.marginal_error
        if not problem.all_fitted:
            log_q = problem.kernel_of_all(gamma)(solution.potential)
            batch_error = marginal_error(log_q, solution.potential, self.tau)
        return Coupling(
            potential=solution.potential,
            real=problem.real,
            simulated=problem.simulated,
            gamma=gamma,
            tau=self.tau,
            marginal_error=solution.marginal_error,
            batch_error=batch_error,
            num_fitted=problem.cost.shape[0],
            num_iterations=solution.num_iterations,
            converged=solution.marginal_error <= self.tolerance,
            solver=solver,
            direct=problem.direct,
            blocked=problem.blocked or problem.size > MAX_STORED,
        )

    def _solution(
        self, problem: Problem, gamma: float, start: Tensor
    ) -> tuple[Solution, Literal["own", "pot", "none"]]:
        if self.tau == 0.0:
            return Solution(torch.zeros_like(start), 0.0, 0), "none"
        kernel = problem.kernel(gamma)
        made = 0
        if self.solver == "pot":
            solution, healthy = solve_pot(
                problem.cost,
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
            memory=self.anderson_memory,
            eps=torch.finfo(self.dtype).eps,
        )
        iterations = made + solution.num_iterations
        return solution._replace(num_iterations=iterations), "own"
