"""Whether the calibration pairs differ from the prior as the batch does."""

from collections.abc import Sequence

import torch
from torch import Tensor

from sbi_rope._npe import TrainedNPE
from sbi_rope.data import Counts
from sbi_rope.diagnosis.implied import Implied, couple_by_itself, implied_by
from sbi_rope.diagnosis.prior_shift import PriorShift
from sbi_rope.diagnosis.simulations import Simulations
from sbi_rope.rope import RoPE

__all__ = ["also_in_pairs", "implied_by_pairs"]


def implied_by_pairs(rope: RoPE, npe: TrainedNPE, simulations: Simulations) -> Implied:
    """Return what the calibration pairs imply where the batch is coupled.

    Their labels are not used: an observation is drawn to the prior, and moves the
    parameters that are confounded. Those of the pairs do so as those of the batch do.

    Args:
        rope: A trained RoPE with its calibration pairs.
        npe: Its NPE.
        simulations: The simulations that the batch is coupled with.

    Returns:
        One row for each person or specimen.
    """
    x, group = rope.pairs.x, rope.pairs.group
    embedded = npe.embed("x", x, rope.tuned_embedding_net).detach().cpu().double()
    found = implied_by(couple_by_itself(simulations), embedded, simulations)
    people = Counts(torch.ones(len(x)), group.cpu())
    return Implied(
        weights=found.weights,
        functions=people.of_groups(found.functions)[0],
        means=people.of_groups(found.means)[0],
    )


def also_in_pairs(
    shift: PriorShift, pairs: Implied, names: Sequence[str]
) -> tuple[str, ...]:
    """Return the names of findings about the prior that the pairs show as well.

    A batch is shifted as the pairs are if its parameters are closer to those of the
    pairs than to the prior, in the Kolmogorov-Smirnov distance of the finding. It is as
    narrow as the pairs if the same is true of its spread, by ratios.

    Args:
        shift: What the batch and simulations imply.
        pairs: What :func:`implied_by_pairs` returns.
        names: One name for each parameter.
    """
    batch, prior = shift.batch, shift.expected[0]
    is_shifted = _distance(batch, pairs) < _distance(batch, prior)
    is_narrow = torch.zeros_like(is_shifted)
    if len(batch.means) > 1 and len(pairs.means) > 1:
        is_narrow = _log_ratio(batch, pairs) < _log_ratio(batch, prior)
    return tuple(
        f"{what}: {name}"
        for what, found in (
            ("prior shift", is_shifted),
            ("narrower than the prior", is_narrow),
        )
        for name, is_found in zip(names, found.tolist(), strict=True)
        if is_found
    )


def _distance(a: Implied, b: Implied) -> Tensor:
    return (a.functions.mean(dim=0) - b.functions.mean(dim=0)).abs().amax(dim=-1)


def _log_ratio(a: Implied, b: Implied) -> Tensor:
    logs = [
        one.means.std(dim=0).clamp_min(torch.finfo(one.means.dtype).tiny).log()
        for one in (a, b)
    ]
    return (logs[0] - logs[1]).abs()
