"""The coupling of real observations with simulations, by optimal transport."""

import math
import warnings
from dataclasses import dataclass, field, replace
from typing import Literal

import ot
import torch
from torch import Tensor

from sbi_rope._validation import (
    check_batch,
    check_choice,
    check_positive,
    check_positive_integer,
    check_tensor,
    check_unit_interval,
)
from sbi_rope.errors import CouplingError, InvalidInputError, warn_user

__all__ = ["Coupling", "SinkhornCoupler"]

# Below this many observations the balance of the coupling is the balance of a handful.
SMALL_BATCH = 20
# Pairwise distances of so many simulations are enough for their median.
MAX_FOR_MEDIAN = 2000
# POT rebuilds its kernel at every call, which costs about ten iterations.
FIRST_BURST, LAST_BURST = 16, 256


@dataclass(frozen=True, eq=False)
class Coupling:
    r"""How much of each simulation stands behind each real observation.

    Row i holds the mixture weights of observation i (RoPE, eq. 5). They are a softmax
    of the simulation-side log-potential :math:`w`,

    .. math:: \alpha_{ij} = \operatorname{softmax}_j (w_j - C_{ij} / \gamma),

    so the rows sum to one whatever solver found :math:`w`, and however well.

    Attributes:
        weights: :math:`\alpha`, shape ``(n_o, n_s)``, float64, rows sum to one.
        potential: :math:`w`, shape ``(n_s,)``, float64, with mean zero.
        marginal_error: :math:`\lVert q - q^*(w) \rVert_1` with :math:`q` the mean of
            the rows and :math:`q^*_j \propto b_j e^{-w_j (1 - \tau) / \tau}` what the
            optimality conditions ask of it; 0 at a solution, at most 2.
        num_iterations: Sinkhorn iterations, over all solvers used.
        converged: Whether ``marginal_error`` reached the tolerance.
        solver: The solver that had the last word: ``"pot"``, ``"log"``, or ``"none"``
            at tau = 0, which needs no iteration. A coupler set to ``"pot"`` that
            reports ``"log"`` was helped out by the log-domain solver, where POT over-
            or underflowed or made no progress.
        gamma: The entropic regularisation in units of the embeddings, that is after
            ``cost_scale``.
        tau: The trust in the prior.
        simulated: The embeddings of the simulations, shape ``(n_s, l)``, float64.
    """

    weights: Tensor
    potential: Tensor
    marginal_error: float
    num_iterations: int
    converged: bool
    solver: Literal["pot", "log", "none"]
    gamma: float
    tau: float
    simulated: Tensor = field(repr=False)

    @property
    def effective_sample_size(self) -> Tensor:
        r""":math:`1 / \sum_j \alpha_{ij}^2` of each row, shape ``(n_o,)``."""
        return 1.0 / self.weights.square().sum(dim=1)

    def rows(self, real: Tensor) -> Tensor:
        r"""Return the weights of other observations under the same potential.

        A good stand-in for coupling again where the effective sample size of the new
        row is large; at an effective sample size of a few it is another estimator.

        Args:
            real: Embeddings of the new observations, shape ``(n, l)``.

        Returns:
            Weights of shape ``(n, n_s)``, float64; rows sum to one.

        Raises:
            InvalidInputError: If the shape does not fit or a value is not finite.
        """
        real = check_batch("real", real, self.simulated.shape[1:])
        cost = _distances(real.to(self.simulated), self.simulated)
        return torch.softmax(self.potential - cost / self.gamma, dim=1)

    def to(self, device: str | torch.device) -> "Coupling":
        """Return the same coupling on another device."""
        return replace(
            self,
            weights=self.weights.to(device),
            potential=self.potential.to(device),
            simulated=self.simulated.to(device),
        )


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

    and returns the rows :math:`\alpha_{ij} = n_o P^\star_{ij}`. Real observations keep
    their weight exactly; simulations may lose some if ``tau < 1``.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
          Calibration (Wehenkel et al., 2025), eqs. 2 and 5
        | https://arxiv.org/abs/2405.08719

    Args:
        gamma: Entropic regularisation, positive, in units of the cost. Small values
            give sharp posteriors, large values the prior. Default 0.5, as in the
            paper.
        tau: Trust in the prior, in [0, 1]. 1 (the default) uses all simulations
            equally, as a well-specified prior asks for; 0 lets every observation
            choose its simulations alone.
        cost_scale: ``"none"`` takes the distances as they are, as in the paper.
            ``"simulated"`` divides them by the median distance between simulations, so
            that a gamma means the same whatever the units of the embedding net.
        solver: ``"pot"`` is POT's ``sinkhorn_unbalanced``, with a log-domain solver
            taking over where its scaling form over- or underflows; ``"log"`` is that
            solver alone.
        tolerance: Largest ``marginal_error`` called converged.
        max_iterations: Iterations after which to stop and say so.

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

    gamma: float = 0.5
    tau: float = 1.0
    cost_scale: Literal["none", "simulated"] = "none"
    solver: Literal["pot", "log"] = "pot"
    tolerance: float = 1e-6
    max_iterations: int = 10_000

    def __post_init__(self) -> None:
        """Check the ranges of all fields."""
        check_positive("gamma", self.gamma)
        check_unit_interval("tau", self.tau)
        check_choice("cost_scale", self.cost_scale, ("none", "simulated"))
        check_choice("solver", self.solver, ("pot", "log"))
        check_positive("tolerance", self.tolerance)
        check_positive_integer("max_iterations", self.max_iterations)

    def couple(self, real: Tensor, simulated: Tensor) -> Coupling:
        """Couple the embeddings of real observations with those of simulations.

        Args:
            real: :math:`g(x_o)`, shape ``(n_o, l)``.
            simulated: :math:`h(x_s)`, shape ``(n_s, l)``; n_s may differ from n_o.

        Returns:
            The coupling with the evidence of its convergence, in float64 on the device
            of the embeddings. ``converged`` is False if the tolerance was not met.

        Raises:
            InvalidInputError: If the shapes do not fit, a set is empty, or a value is
                not finite.
            CouplingError: If ``cost_scale="simulated"`` and the median distance
                between simulations is zero.
        """
        real = check_tensor("real", real)
        simulated = check_tensor("simulated", simulated)
        if real.device != simulated.device:
            raise InvalidInputError(
                "Expected `real` and `simulated` on the same device; got "
                f"{real.device} and {simulated.device}."
            )
        if simulated.ndim != 2:
            raise InvalidInputError(
                f"Expected `simulated` of shape (n_s, l); got {tuple(simulated.shape)}."
            )
        simulated = check_batch("simulated", simulated, simulated.shape[1:])
        real = check_batch("real", real, simulated.shape[1:])
        if real.shape[0] < SMALL_BATCH:
            self._warn_small_batch(real.shape[0])

        simulated = simulated.detach().double()
        gamma = self.gamma * self._scale(simulated)
        cost = _distances(real.detach().double(), simulated)
        if not torch.isfinite(cost).all():
            raise CouplingError(
                "The distances between embeddings overflow. Check the scale of the "
                "observations and of the embedding net's outputs."
            )
        # A constant added to a row of C changes no softmax of it. With the smallest
        # entry of every row at zero the kernel exp(-C / gamma) cannot vanish in a row.
        cost -= cost.min(dim=1, keepdim=True).values
        cost /= gamma

        potential, iterations, solver = self._solve(cost)
        weights, error = _weights_and_error(cost, potential, self.tau)
        return Coupling(
            weights=weights,
            potential=potential,
            marginal_error=error,
            num_iterations=iterations,
            converged=error <= self.tolerance,
            solver=solver,
            gamma=gamma,
            tau=self.tau,
            simulated=simulated,
        )

    def _warn_small_batch(self, n_o: int) -> None:
        consequence = (
            "its row is uniform and the posterior is the prior. "
            if n_o == 1 and self.tau == 1.0
            else "the coupling balances the prior over these few observations. "
        )
        warn_user(
            f"Coupling a batch of {n_o} real observation(s), tau={self.tau}: "
            + consequence
            + f"Use a batch of at least {SMALL_BATCH}, a smaller tau, or the rows of a "
            "posterior built for a larger batch (`unseen='extend'`)."
        )

    def _scale(self, simulated: Tensor) -> float:
        if self.cost_scale == "none":
            return 1.0
        subset = simulated[:MAX_FOR_MEDIAN]
        median = torch.nn.functional.pdist(subset).median() if len(subset) > 1 else 0.0
        if float(median) == 0.0:
            raise CouplingError(
                "cost_scale='simulated' needs simulations whose embeddings differ, but "
                f"the median distance between {len(subset)} of them is zero. Use more "
                "simulations, cost_scale='none', or check the embedding net."
            )
        return float(median)

    def _solve(self, cost: Tensor) -> tuple[Tensor, int, Literal["pot", "log", "none"]]:
        """Return the potential, the iterations made, and the last solver used."""
        potential = cost.new_zeros(cost.shape[1])
        if self.tau == 0.0:
            return potential, 0, "none"
        iterations = 0
        if self.solver == "pot":
            potential, iterations, healthy = self._solve_pot(cost)
            if healthy:
                return potential, iterations, "pot"
        potential, more = _solve_log(
            cost,
            potential,
            tau=self.tau,
            tolerance=self.tolerance,
            max_iterations=self.max_iterations - iterations,
        )
        return potential, iterations + more, "log"

    def _solve_pot(self, cost: Tensor) -> tuple[Tensor, int, bool]:
        """Run POT in bursts until our own error is met; healthy=False asks for help.

        POT's own stopping rule watches the scalings u and v, whose common factor does
        not affect the rows and converges slowest. Ours sees only what matters.
        """
        n_o, n_s = cost.shape
        a, b = cost.new_full((n_o,), 1 / n_o), cost.new_full((n_s,), 1 / n_s)
        # reg is 1 because the cost is already divided by gamma; rho is in its units.
        rho = math.inf if self.tau == 1.0 else self.tau / (1.0 - self.tau)
        best, best_error = cost.new_zeros(n_s), math.inf
        start, iterations, burst = None, 0, FIRST_BURST
        while iterations < self.max_iterations:
            burst = min(burst, self.max_iterations - iterations)
            with warnings.catch_warnings():
                # What POT warns of is caught below, by looking at what it returned.
                warnings.simplefilter("ignore")
                _, log = ot.unbalanced.sinkhorn_unbalanced(
                    a,
                    b,
                    cost,
                    reg=1.0,
                    reg_m=(math.inf, rho),
                    method="sinkhorn",
                    reg_type="kl",
                    warmstart=start,
                    numItermax=burst,
                    stopThr=0.0,
                    log=True,
                )
            done = len(log["err"])
            iterations += done
            log_u, log_v = log["logu"], log["logv"]
            if not (log_u.isfinite().all() and log_v.isfinite().all()):
                return best, iterations, False
            potential = log_v - log_v.mean()
            error = _weights_and_error(cost, potential, self.tau)[1]
            if error <= self.tolerance:
                return potential, iterations, True
            # If the error stays, POT has lost entries of the kernel to underflow, or
            # the problem is one where iterations hardly help; the log-domain solver
            # is safe in both. If POT made fewer iterations than asked, it met
            # infinities.
            if done < burst or error > 0.999 * best_error:
                return best, iterations, False
            best, best_error = potential, error
            # The scalings are defined up to a factor: keep both in range.
            shift = (log_u.mean() - log_v.mean()) / 2
            start = (log_u - shift, log_v + shift)
            burst = min(2 * burst, LAST_BURST)
        return best, iterations, True


def _solve_log(
    cost: Tensor,
    potential: Tensor,
    *,
    tau: float,
    tolerance: float,
    max_iterations: int,
) -> tuple[Tensor, int]:
    r"""Iterate :math:`w \leftarrow \tau (w + \log b - \log q)` in the log domain.

    ``cost`` is in units of gamma. Slower than POT, but it never over- or underflows.
    """
    n_o, n_s = cost.shape
    for iteration in range(max_iterations):
        logits = potential - cost
        log_q = torch.logsumexp(
            logits - torch.logsumexp(logits, dim=1, keepdim=True), dim=0
        ) - math.log(n_o)
        if _marginal_error(log_q, potential, tau) <= tolerance:
            return potential, iteration
        potential = tau * (potential - math.log(n_s) - log_q)
        potential = potential - potential.mean()
    return potential, max_iterations


def _weights_and_error(
    cost: Tensor, potential: Tensor, tau: float
) -> tuple[Tensor, float]:
    weights = torch.softmax(potential - cost, dim=1)
    return weights, _marginal_error(weights.mean(dim=0).log(), potential, tau)


def _marginal_error(log_q: Tensor, potential: Tensor, tau: float) -> float:
    r""":math:`\lVert q - q^*(w) \rVert_1`, blind to a constant added to w."""
    if tau == 0.0:
        return 0.0  # nothing is asked of the column marginal
    target = torch.softmax(-potential * (1.0 - tau) / tau, dim=0)
    return float((log_q.exp() - target).abs().sum())


def _distances(real: Tensor, simulated: Tensor) -> Tensor:
    # Not through the matrix product, which loses half of the digits of close points.
    return torch.cdist(real, simulated, compute_mode="donot_use_mm_for_euclid_dist")
