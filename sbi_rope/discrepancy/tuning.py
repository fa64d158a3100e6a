"""Tuned copies of an embedding net, and what they say of pairs they have not seen."""

import torch
from torch import Tensor, nn

from sbi_rope._sbi import embed
from sbi_rope._simulations import Moments
from sbi_rope._training import groups_of, split_groups
from sbi_rope.errors import InvalidInputError
from sbi_rope.finetuning import CalibrationFinetuner

__all__ = ["TUNING", "cross_fitted_nets"]

# Rehearsal keeps simulations where h puts them, where the density knows them. The rate
# and the patience take an eighth of the time of the finetuner's defaults and leave no
# larger distances, see benchmarks/README.md.
TUNING = CalibrationFinetuner(rehearsal=1.0, learning_rate=3e-3, stop_after_epochs=50)


def cross_fitted_nets(
    h: nn.Module,
    pairs: tuple[Tensor, Tensor],
    moments: Moments,
    simulations: Tensor,
    *,
    finetuner: CalibrationFinetuner,
    num_folds: int,
    show_progress_bars: bool,
) -> tuple[list[nn.Module], Tensor]:
    """Tune a copy of h without each fold of the pairs, and embed the fold with it.

    A net puts the pairs that it was tuned on too close to their simulations. What is
    left of a discrepancy can be seen at other pairs only.

    Args:
        h: The embedding net of NPE.
        pairs: Parameters, shape ``(n, d)``, and real observations, ``(n, *event)``.
        moments: Of simulations at these parameters, embedded by h.
        simulations: Simulations from the prior, to keep where h puts them.
        finetuner: How a copy is tuned.
        num_folds: Number of copies, at most as many as there are different parameters.
        show_progress_bars: Whether to show the course of the losses.

    Returns:
        The copies, and the embedding of each pair by the copy that has not seen it,
        shape ``(n, l)``.

    Raises:
        InvalidInputError: If all pairs have the same parameters.
    """
    theta, x = pairs
    groups = groups_of(theta)
    if int(groups.max()) == 0:
        raise InvalidInputError(
            "Expected calibration pairs of different parameters with space='tuned', "
            f"to hold some out; all {len(theta)} have the same. Use "
            "space='embedding'."
        )
    folds = [rows for rows in split_groups(groups, num_folds) if len(rows)]
    targets = moments.mean.to(x)
    # They may be in some order.
    simulations = simulations[torch.randperm(len(simulations)).to(simulations.device)]
    nets, z = [], torch.empty_like(targets)
    for held_out in folds:
        used = torch.ones(len(x), dtype=torch.bool)
        used[held_out] = False
        net = finetuner.finetune(
            h,
            x[used],
            lambda count, used=used: targets[used],
            draw_simulations=lambda count: simulations[:count],
            groups=groups[used],
            show_progress_bars=show_progress_bars,
        ).embedding_net
        z[held_out] = embed(net, x[held_out])
        nets.append(net)
    return nets, z
