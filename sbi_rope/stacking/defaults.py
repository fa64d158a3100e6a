"""The candidates of a stack, unless the user passes others."""

import itertools
from collections.abc import Sequence
from typing import Any

from torch import Tensor

from sbi_rope._validation import check_numbers
from sbi_rope.errors import warn_user
from sbi_rope.mixture import PriorPosterior
from sbi_rope.rope import RoPE
from sbi_rope.settings import check
from sbi_rope.stacking.candidates import (
    AmortisedCandidate,
    Candidate,
    CouplingCandidate,
    DensityCandidate,
)
from sbi_rope.stacking.trained_candidates import (
    DiscrepancyCandidate,
    FinetunedCandidate,
    RehearsedCandidate,
)
from sbi_rope.stacking.unlabelled_candidates import (
    MAX_STATISTICS,
    MIN_OBSERVATIONS,
    RVNPCandidate,
)
from sbi_rope.stacking.workbench import NUM_FOLDS, Workbench

__all__ = ["default_candidates"]

# Chosen on calibration data, see benchmarks/choices.md.
GAMMAS = (0.02, 0.05, 0.1, 0.4)
TAUS = (1.0, 0.5, 0.0)
REHEARSAL = 1.0


def default_candidates(
    rope: RoPE | None = None,
    x_o: Tensor | None = None,
    *,
    learn_prior: bool = True,
    couplings: bool = False,
    gammas: Sequence[float] = GAMMAS,
    taus: Sequence[float] = TAUS,
    rehearsal: float | None = REHEARSAL,
) -> tuple[Candidate, ...]:
    """Return the prior, NPE, fine-tuned NPE, discrepancy models, and RVNP with x_o.

    NPE is fine-tuned on the pairs alone, and from discrepancy models, and on pairs and
    simulations together.

    Args:
        rope: A RoPE with its calibration pairs. Candidates that these data do not
            allow or need are left out, as in :func:`stack`. None returns all.
        x_o: Real observations without labels, shape ``(n_o, *event)``, other than those
            of the pairs. They add RVNP, which learns errors from them. With a rope, it
            is left out if there are fewer than a hundred observations, or more than 20
            statistics: these are x if it is a short vector and NPE has an embedding
            net, and the embedding otherwise.
        learn_prior: Whether candidates may learn from the pairs how parameters are
            distributed. They should if the pairs are drawn like the observations to be
            inferred. With False, discrepancy models keep the prior of NPE.
            Fine-tuned candidates cannot keep it, and are left out.
        couplings: Whether to add RoPE and OT-only over a grid of gamma and tau, and
            tuning-only. They are for the stack of a batch of observations.
        gammas: Values of gamma, in units of the median distance between simulated
            embeddings.
        taus: Values of tau, the trust in the prior. With 0 every observation is
            coupled by itself.
        rehearsal: The rehearsal of a second RoPE over the same grid, which is tuned
            with it, see :class:`~sbi_rope.CalibrationFinetuner`. None leaves this RoPE
            out.

    Returns:
        The candidates, couplings first.

    Raises:
        InvalidInputError: If ``rope`` is not a RoPE, or ``learn_prior`` not a bool.
        InvalidInputError: If a gamma, a tau or the rehearsal is outside its range, or,
            with a rope, x_o has the wrong shape or device, is empty or not finite.
        NotReadyError: If ``rope`` has fewer than two calibration pairs.
    """
    gammas, taus = check_numbers("gammas", gammas), check_numbers("taus", taus)
    check("learn_prior", learn_prior, bool)
    amortised: tuple[AmortisedCandidate, ...] = (
        DensityCandidate(name="prior", build=_prior, fixed=True),
        DensityCandidate(name="NPE", build=_npe, fixed=True),
        FinetunedCandidate(),
        DiscrepancyCandidate(space="embedding", learn_prior=learn_prior),
        DiscrepancyCandidate(space="input", learn_prior=learn_prior),
        DiscrepancyCandidate(space="tuned", learn_prior=learn_prior),
        FinetunedCandidate(space="embedding"),
        FinetunedCandidate(space="input"),
        FinetunedCandidate(space="tuned"),
        RehearsedCandidate(),
    )
    if not learn_prior:
        amortised = tuple(one for one in amortised if one.fixed or not one.learns_prior)
    if rope is not None:
        check("rope", rope, RoPE)
        x_o = None if x_o is None else rope.checked_observations(x_o)
    if x_o is not None:
        amortised += (RVNPCandidate(x_o), RVNPCandidate(x_o, space="input"))
    if rope is not None:
        bench = Workbench(rope, num_folds=NUM_FOLDS, seed=0, show_progress_bars=False)
        amortised = tuple(one for one in amortised if one.applies_to(bench))
        with_rvnp = any(isinstance(one, RVNPCandidate) for one in amortised)
        if x_o is not None and not couplings and not with_rvnp:
            warn_user(
                f"`x_o` adds no candidate: RVNP needs {MIN_OBSERVATIONS} observations, "
                f"of which there are {len(x_o)}, and at most {MAX_STATISTICS} "
                "statistics, some of which differ between simulations."
            )
    if not couplings:
        return amortised
    rehearsed = [] if rehearsal is None else [{"rehearsal": rehearsal}]
    nets: list[dict[str, Any]] = [{"tuned": True}, *rehearsed, {"tuned": False}]
    coupled = [
        CouplingCandidate(gamma=gamma, tau=tau, **net)
        for net, gamma, tau in itertools.product(nets, gammas, taus)
    ]
    tuned = DensityCandidate(name="tuning-only", build=_tuning_only, learns_prior=False)
    return (*coupled, *amortised, tuned)


# These are functions and not lambdas, so that a stack can be pickled.


def _prior(rope: RoPE, seed: int) -> PriorPosterior:
    return PriorPosterior(rope.npe.prior)


def _npe(rope: RoPE, seed: int) -> Any:
    return rope.npe


def _tuning_only(rope: RoPE, seed: int) -> Any:
    return rope.tuned_posterior()
