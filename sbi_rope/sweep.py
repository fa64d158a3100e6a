"""Posteriors of RoPE at many settings of the coupling."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Literal

from torch import Tensor

from sbi_rope._standardisation import warn_of_far_entries
from sbi_rope._validation import check_numbers
from sbi_rope.batch import check_converged
from sbi_rope.coupling import SinkhornCoupler
from sbi_rope.mixture import MixturePosterior
from sbi_rope.rope import RoPE
from sbi_rope.settings import check

__all__ = ["sweep"]


def sweep(
    rope: RoPE,
    x_o: Tensor,
    *,
    gammas: Sequence[float],
    taus: Sequence[float],
    coupler: SinkhornCoupler | None = None,
    num_simulations: int | None = None,
    seed: int | None = None,
    unseen: Literal["raise", "extend"] = "raise",
    require_convergence: bool = True,
    show_progress_bars: bool | None = None,
) -> Iterator[MixturePosterior]:
    """Couple a batch at every gamma and every tau, with the same simulations.

    The posteriors are those of :meth:`~sbi_rope.RoPE.build_posterior` at each setting,
    up to the tolerance of the coupler, but take less time. The simulations are drawn
    and embedded once, the masses of their posteriors inside the prior's support are
    estimated once, and each coupling starts from its neighbour
    (:meth:`SinkhornCoupler.sweep <sbi_rope.SinkhornCoupler.sweep>`).

    Args:
        rope: A trained RoPE, or one without calibration pairs. It does not change.
        x_o: The batch, shape ``(n_o, *event)``.
        gammas: Values of gamma. If they descend, each posterior is ready at once.
        taus: Values of tau.
        coupler: Settings other than gamma and tau; those of ``rope`` if None.
        num_simulations: As in :meth:`~sbi_rope.RoPE.build_posterior`.
        seed: As in :meth:`~sbi_rope.RoPE.build_posterior`.
        unseen: As in :meth:`~sbi_rope.RoPE.build_posterior`.
        require_convergence: As in :meth:`~sbi_rope.RoPE.build_posterior`.
        show_progress_bars: As in :meth:`~sbi_rope.RoPE.build_posterior`.

    Returns:
        An iterator over the posteriors. It returns all taus of the first gamma, then of
        the second, and so on.

    Raises:
        InvalidInputError: If there is no gamma or tau, one is outside its range, or as
            in :meth:`~sbi_rope.RoPE.build_posterior`.
        NotReadyError: As in :meth:`~sbi_rope.RoPE.build_posterior`.
        CouplingError: When the iteration reaches a coupling that has not converged.
        SimulationError: If the simulator fails.
    """
    check("rope", rope, RoPE)
    settings = rope.coupler if coupler is None else coupler
    check("coupler", settings, SinkhornCoupler)
    gammas, taus = check_numbers("gammas", gammas), check_numbers("taus", taus)
    check("unseen", unseen, Literal["raise", "extend"])
    batch = rope.embed(
        x_o,
        num_simulations=num_simulations,
        seed=seed,
        show_progress_bars=show_progress_bars,
    )
    warn_of_far_entries("x_o", batch.x_o, batch.npe.h)
    couplings = batch.sweep(settings, gammas=gammas, taus=taus, seed=seed)

    def posteriors() -> Iterator[MixturePosterior]:
        # Moving a posterior to another device gives it a dictionary of its own.
        shared: dict[int, Tensor] = {}
        pairs = itertools.product(gammas, taus)
        for (gamma, tau), coupling in zip(pairs, couplings, strict=True):
            if require_convergence:
                check_converged(coupling, replace(settings, gamma=gamma, tau=tau))
            yield batch.posterior(coupling, unseen=unseen, shared=shared)

    return posteriors()
