"""What a coupling returns: weights on request, and the evidence of convergence."""

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Literal

import torch
from torch import Tensor

from sbi_rope._validation import check_batch, check_rows, usable_device
from sbi_rope.coupling.cost import Distances, row_blocks
from sbi_rope.errors import InvalidInputError

__all__ = ["Coupling"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Coupling:
    r"""How much of each simulation stands behind each real observation.

    Row i holds the mixture weights of observation i (RoPE, eq. 5). They are a softmax
    of the simulation-side log-potential :math:`w`,

    .. math:: \alpha_{ij} = \operatorname{softmax}_j (w_j - C_{ij} / \gamma),

    so the rows sum to one whatever solver found :math:`w`, and however well. What is
    kept is :math:`w` and the embeddings; rows are computed when asked for.

    Attributes:
        potential: :math:`w`, shape ``(n_s,)``, float64, with mean zero.
        real: The embeddings of the observations, shape ``(n_o, l)``.
        simulated: The embeddings of the simulations, shape ``(n_s, l)``.
        gamma: The entropic regularisation in units of the embeddings, that is after
            ``cost_scale``.
        tau: The trust in the prior.
        marginal_error: :math:`\lVert q - q^*(w) \rVert_1` with :math:`q` the mean of
            the rows and :math:`q^*_j \propto b_j e^{-w_j (1 - \tau) / \tau}` what the
            optimality conditions ask of it; 0 at a solution, at most 2. Over the
            observations the potential was fitted to.
        batch_error: The same over all observations: what it costs to fit the potential
            to some of them only.
        num_fitted: The number of observations the potential was fitted to.
        num_iterations: Sinkhorn iterations, over all solvers used.
        converged: Whether ``marginal_error`` reached the tolerance.
        solver: The solver that had the last word: ``"own"``, ``"pot"``, or ``"none"``
            at tau = 0, which needs no iteration. A coupler set to ``"pot"`` that
            reports ``"own"`` was helped out, where POT over- or underflowed or made no
            progress.
        blocked: Whether no matrix of size n_o x n_s is held, so that ``weights`` is
            computed at every request: after a solution in blocks, and for more than 50
            million weights.
        direct: Whether distances are computed without a matrix product, as a gamma
            needs that is small against them.
    """

    potential: Tensor = field(repr=False)
    real: Tensor = field(repr=False)
    simulated: Tensor = field(repr=False)
    gamma: float
    tau: float
    marginal_error: float
    batch_error: float
    num_fitted: int
    num_iterations: int
    converged: bool
    solver: Literal["own", "pot", "none"]
    blocked: bool = False
    direct: bool = False

    @property
    def weights(self) -> Tensor:
        r""":math:`\alpha`, shape ``(n_o, n_s)``, in the dtype of the coupling.

        Computed at the first request and kept; a blocked coupling computes it
        at every request. Rows sum to one. Not to be written to.
        """
        return self._rows(self.real) if self.blocked else self._kept_weights

    @cached_property
    def _kept_weights(self) -> Tensor:
        return self._rows(self.real)

    @property
    def effective_sample_size(self) -> Tensor:
        r""":math:`1 / \sum_j \alpha_{ij}^2` of each row, shape ``(n_o,)``."""
        sizes = self.real.new_empty(len(self.real))
        for rows in row_blocks(self.real, len(self.simulated)):
            sizes[rows] = 1 / self._row_block(self.real[rows]).square().sum(dim=1)
        return sizes

    def __getstate__(self) -> dict[str, Any]:
        # Without weights and distances that were kept, of up to 400 MB.
        return {entry.name: getattr(self, entry.name) for entry in fields(self)}

    def distances(self, real: Tensor) -> Tensor:
        r"""Return :math:`C`, which couplings of the same embeddings share.

        Args:
            real: Embeddings of the observations, shape ``(n, l)``.

        Returns:
            Shape ``(n, n_s)``. They are the same for another coupling with the same
            ``simulated`` and ``direct``.

        Raises:
            InvalidInputError: If the shape does not fit, or a value is not finite.
        """
        real = check_batch("real", real, self.simulated.shape[1:])
        return self._distances(real.to(self.simulated))

    def rows(self, real: Tensor, *, distances: Tensor | None = None) -> Tensor:
        r"""Return the weights of other observations under the same potential.

        A good stand-in for coupling again where the effective sample size of the new
        row is large; at an effective sample size of a few it is another estimator.
        Rows of the batch itself, ``coupling.rows(coupling.real[10:20])``, are rows of
        ``weights``.

        Args:
            real: Embeddings of the observations, shape ``(n, l)``.
            distances: What :meth:`distances` returns for them, if it is known.

        Returns:
            Weights of shape ``(n, n_s)``; rows sum to one.

        Raises:
            InvalidInputError: If the shape does not fit, a value is not finite, or an
                observation is so far away that all its distances are the same.
        """
        real = check_batch("real", real, self.simulated.shape[1:]).to(self.simulated)
        if distances is None:
            farthest = self._distances.bound(real)
        else:
            farthest = float(distances.max())
        limit = 0.1 * self.gamma / torch.finfo(real.dtype).eps
        if not farthest < limit:
            raise InvalidInputError(
                f"Expected `real` at most {limit:.1e} away from the simulations, where "
                f"{real.dtype} still tells their distances apart; got {farthest:.1e}. "
                "Such an observation is like no simulation: look at its values."
            )
        return self._rows(real) if distances is None else self._softmax(distances)

    def restricted_to(self, rows: Tensor) -> "Coupling":
        """Return the coupling of some observations of the batch, by their numbers.

        What it says of its own convergence stays that of the batch.

        Raises:
            InvalidInputError: If a row is not the number of an observation.
        """
        check_rows("rows", rows, len(self.real))
        return replace(self, real=self.real[rows])

    def to(self, device: str | torch.device) -> "Coupling":
        """Return the same coupling on another device.

        Raises:
            InvalidInputError: If there is no such device.
        """
        device = usable_device(device)
        return replace(
            self,
            potential=self.potential.to(device),
            real=self.real.to(device),
            simulated=self.simulated.to(device),
        )

    def _rows(self, real: Tensor) -> Tensor:
        weights = real.new_empty(len(real), len(self.simulated))
        for rows in row_blocks(real, len(self.simulated)):
            weights[rows] = self._row_block(real[rows])
        return weights

    def _row_block(self, real: Tensor) -> Tensor:
        return self._softmax(self._distances(real))

    def _softmax(self, distances: Tensor) -> Tensor:
        w = self.potential.to(distances)
        return torch.softmax(torch.add(w, distances, alpha=-1 / self.gamma), dim=1)

    @cached_property
    def _distances(self) -> Distances:
        return Distances(self.simulated, direct=self.direct)
