"""A batch of real observations and the simulations that it is coupled with."""

import copy
from dataclasses import dataclass
from typing import Literal

from torch import Tensor, nn

from sbi_rope._npe import TrainedNPE
from sbi_rope.coupling import Coupling, SinkhornCoupler
from sbi_rope.density import Coupled, MixturePosterior
from sbi_rope.errors import CouplingError

__all__ = ["EmbeddedBatch", "check_converged"]


@dataclass(frozen=True, eq=False, kw_only=True)
class EmbeddedBatch:
    r"""The embeddings of real observations and of simulations.

    :meth:`RoPE.embed <sbi_rope.RoPE.embed>` returns it, and it can be coupled.

    Attributes:
        x_o: The observations, shape ``(n_o, *event)``.
        real: Their embeddings :math:`g(x_o)`, shape ``(n_o, l)``.
        theta: The parameters of the simulations, shape ``(n_s, d)``.
        simulated: The embeddings :math:`h(x_s)` of the simulations, shape ``(n_s, l)``.
        npe: The NPE that the embeddings belong to.
        embedding_net: g, or h if nothing was tuned.
    """

    x_o: Tensor
    real: Tensor
    theta: Tensor
    simulated: Tensor
    npe: TrainedNPE
    embedding_net: nn.Module

    def couple(self, coupler: SinkhornCoupler) -> Coupling:
        """Couple the observations with the simulations.

        Args:
            coupler: Settings of the transport.

        Raises:
            CouplingError: If the embeddings cannot be coupled.
        """
        return coupler.couple(self.real, self.simulated)

    def posterior(
        self,
        coupling: Coupling,
        *,
        unseen: Literal["raise", "extend"] = "raise",
    ) -> MixturePosterior:
        """Return the mixture of simulated posteriors that a coupling gives.

        Args:
            coupling: What :meth:`couple` returned.
            unseen: As in :meth:`~sbi_rope.RoPE.build_posterior`.
        """
        # Each posterior has copies of its own of net and density. Moving one to another
        # device then leaves the others where they are.
        net = copy.deepcopy(self.embedding_net)
        density = Coupled(
            self.npe.density(), self.simulated, self.x_o, net, coupling, unseen=unseen
        )
        posterior = MixturePosterior(
            density,
            copy.deepcopy(self.npe.prior),
            enable_transform=self.npe.enable_transform,
        )
        posterior.parameter_names = self.npe.parameter_names
        posterior.x_names = self.npe.x_names
        return posterior


def check_converged(coupling: Coupling, coupler: SinkhornCoupler) -> None:
    """Raise a CouplingError unless a coupling has converged."""
    if coupling.converged:
        return
    raise CouplingError(
        f"The coupling has not converged: marginal error {coupling.marginal_error:.1e} "
        f"after {coupling.num_iterations} iterations, tolerance "
        f"{coupler.tolerance:.1e}. Use a larger gamma, more max_iterations, or "
        "require_convergence=False."
    )
