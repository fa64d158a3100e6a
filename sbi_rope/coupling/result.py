"""The result of a coupling: weights on request, and how well it has converged."""

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Literal

import torch
from torch import Tensor

from sbi_rope.coupling.cost import Distances, row_blocks
from sbi_rope.errors import InvalidInputError
from sbi_rope.tensors import as_batch

__all__ = ["Coupling"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Coupling:
    r"""The weights of the simulations for each real observation.

    Row i holds the mixture weights of observation i (RoPE, eq. 5). They are a softmax
    of the simulation-side log-potential :math:`w`,

    .. math:: \alpha_{ij} = \operatorname{softmax}_j (w_j - C_{ij} / \gamma),

    so the rows always sum to one, also if :math:`w` has not converged. The coupling
    keeps :math:`w` and the embeddings, and computes rows when they are asked for.

    Attributes:
        potential: :math:`w`, shape ``(n_s,)``, float64, with mean zero.
        real: The embeddings of the observations, shape ``(n_o, l)``.
        simulated: The embeddings of the simulations, shape ``(n_s, l)``.
        gamma: The entropic regularisation in units of the embeddings, that is after
            ``cost_scale``.
        tau: The trust in the prior.
        marginal_error: :math:`\lVert q - q^*(w) \rVert_1`, where :math:`q` is the mean
            of the rows, and :math:`q^*_j \propto b_j e^{-w_j (1 - \tau) / \tau}` is
            what it should be by the optimality conditions. It is 0 at a
            solution and at most 2.
        num_iterations: Sinkhorn iterations, over all solvers that were used.
        converged: Whether ``marginal_error`` reached the tolerance.
        solver: The solver that finished: ``"own"``, ``"pot"``, or ``"none"`` at tau =
            0, which needs no iteration. A coupler set to ``"pot"`` reports ``"own"`` if
            POT over- or underflowed or made no progress, and our own solver went on.
        blocked: Whether no matrix of size n_o x n_s is held, so that ``weights`` is
            computed at every request. That is so after a solution in blocks, and for
            more than 50 million weights.
        direct: Whether distances are computed without a matrix product. It is needed if
            gamma is small compared to them.
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
    blocked: bool = False
    direct: bool = False

    @property
    def weights(self) -> Tensor:
        r""":math:`\alpha`, shape ``(n_o, n_s)``, in the dtype of the coupling.

        Rows sum to one. The weights are computed at the first request and kept; a
        blocked coupling computes them at every request. Do not write to them.
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
        # The weights and distances that are kept would take up to 400 MB.
        return {entry.name: getattr(self, entry.name) for entry in fields(self)}

    def distances(self, real: Tensor) -> Tensor:
        r"""Return the distances :math:`C` of observations from the simulations.

        Args:
            real: Embeddings of the observations, shape ``(n, l)``.

        Returns:
            Shape ``(n, n_s)``. Another coupling with the same ``simulated`` and
            ``direct`` has the same distances.
        """
        return self._distances(real.to(self.simulated))

    def rows(self, real: Tensor, *, distances: Tensor | None = None) -> Tensor:
        r"""Return the weights of other observations under the same potential.

        If the effective sample size of a new row is large, the row is nearly what
        coupling again would give. If it is only a few, it is not. For observations of
        the batch, as in ``coupling.rows(coupling.real[10:20])``, the result is their
        rows of ``weights``.

        Args:
            real: Embeddings of the observations, shape ``(n, l)``.
            distances: The result of :meth:`distances` for them. Computed if None.

        Returns:
            Weights of shape ``(n, n_s)``; rows sum to one.

        Raises:
            InvalidInputError: If the shape does not fit, a value is not finite, or an
                observation is so far away that its distances cannot be told apart.
        """
        real = as_batch("real", real, self.simulated.shape[1:]).to(self.simulated)
        if distances is None:
            farthest = self._distances.bound(real)
        else:
            farthest = float(distances.max())
        limit = 0.1 * self.gamma / torch.finfo(real.dtype).eps
        if not farthest < limit:
            raise InvalidInputError(
                f"Expected `real` at most {limit:.1e} away from the simulations, so "
                f"that {real.dtype} can tell its distances apart; got {farthest:.1e}. "
                "Such an observation is unlike all simulations. Check its values."
            )
        return self._rows(real) if distances is None else self._softmax(distances)

    def restricted_to(self, rows: Tensor) -> "Coupling":
        """Return the coupling of some observations of the batch, by their numbers.

        Its errors and ``converged`` remain those of the whole batch.
        """
        return replace(self, real=self.real[rows])

    def to(self, device: str | torch.device) -> "Coupling":
        """Return the same coupling on another device."""
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
