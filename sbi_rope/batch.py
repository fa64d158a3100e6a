"""A batch of real observations and the simulations that it is coupled with."""

import copy
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal

from torch import Tensor, nn

from sbi_rope._npe import TrainedNPE
from sbi_rope._validation import KnownColumns
from sbi_rope.coupling import Coupling, SinkhornCoupler
from sbi_rope.errors import CouplingError
from sbi_rope.mixture import (
    CoupledEmbeddings,
    CoupledNet,
    MixtureEstimator,
    MixturePosterior,
    Part,
)

__all__ = ["EmbeddedBatch", "check_converged", "parameters_named"]


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
        columns: The names of columns of "theta" and "x" in orders that are known.
    """

    x_o: Tensor
    real: Tensor
    theta: Tensor
    simulated: Tensor
    npe: TrainedNPE
    embedding_net: nn.Module
    columns: Mapping[str, KnownColumns] = field(default_factory=dict)

    def couple(self, coupler: SinkhornCoupler, *, seed: int | None = None) -> Coupling:
        """Couple the observations with the simulations.

        Args:
            coupler: Settings of the transport.
            seed: As in :meth:`SinkhornCoupler.couple
                <sbi_rope.SinkhornCoupler.couple>`.

        Raises:
            CouplingError: If the embeddings cannot be coupled. It names the parameters
                of the simulations that are to blame.
        """
        with parameters_named(self.theta):
            return coupler.couple(self.real, self.simulated, seed=seed)

    def posterior(
        self,
        coupling: Coupling,
        *,
        unseen: Literal["raise", "extend"] = "raise",
        tail_mass: float = 1e-3,
    ) -> MixturePosterior:
        """Return the mixture of simulated posteriors that a coupling gives.

        Args:
            coupling: What :meth:`couple` returned.
            unseen: As in :meth:`~sbi_rope.RoPE.build_posterior`.
            tail_mass: As in :meth:`~sbi_rope.RoPE.build_posterior`.
        """
        # Each posterior has copies of its own of net and density. Moving one to another
        # device then leaves the others where they are.
        net = CoupledNet(copy.deepcopy(self.embedding_net), [coupling])
        mixing = CoupledEmbeddings(self.simulated, self.x_o, [net], unseen=unseen)
        mixture = MixtureEstimator(
            [Part(self.npe.density(), mixing)], [1.0], tail_mass=tail_mass
        )
        posterior = MixturePosterior(
            mixture,
            copy.deepcopy(self.npe.prior),
            enable_transform=self.npe.enable_transform,
        )
        posterior.parameter_names = self.npe.parameter_names
        posterior.columns = dict(self.columns)
        return posterior


@contextmanager
def parameters_named(theta: Tensor) -> Iterator[None]:
    """Rephrase errors of a coupling in the terms that a user of RoPE knows.

    Users do not know the rows of the simulations, because RoPE has drawn them. The
    error names their parameters instead.

    Args:
        theta: The parameters of the simulations, shape ``(n_s, d)``.
    """
    try:
        yield
    except CouplingError as error:
        reason = error.reason.replace("`real`", "`x_o`")
        reason = reason.replace("`simulated`", "the simulations")
        if error.simulated_rows:
            rows = list(error.simulated_rows[:5])
            reason += f" Their parameters are {theta[rows].tolist()}."
        raise CouplingError(reason) from error


def check_converged(coupling: Coupling, coupler: SinkhornCoupler) -> None:
    """Raise a CouplingError unless a coupling has converged."""
    if coupling.converged:
        return
    raise CouplingError(
        f"The coupling has not converged: marginal error {coupling.marginal_error:.1e} "
        f"after {coupling.num_iterations} iterations, tolerance "
        f"{coupler.tolerance:.1e}. Use a larger gamma (now {coupler.gamma}), tau < 1 "
        f"(now {coupler.tau}), more max_iterations, or accept it with "
        "require_convergence=False."
    )
