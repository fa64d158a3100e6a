"""Tuned copies of an embedding net, and the embeddings of pairs they have not seen."""

import torch
from torch import Tensor, nn

from sbi_rope._groups import groups_of, split_groups
from sbi_rope._sbi import embed
from sbi_rope.errors import InvalidInputError
from sbi_rope.finetuning import CalibrationFinetuner
from sbi_rope.simulate import Moments

__all__ = ["TUNING", "cross_fitted_nets"]

# With rehearsal, g embeds simulations as h does, so that the density can interpret
# them. The rate and the patience take an eighth of the time of the finetuner's defaults
# and did not increase the distances on calibration data.
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

    A net embeds the pairs that it was tuned on too close to their simulations. Only
    other pairs show the discrepancy that remains.

    Args:
        h: The embedding net of NPE.
        pairs: Parameters, shape ``(n, d)``, and real observations, ``(n, *event)``.
        moments: The moments of simulations at these parameters, embedded by h.
        simulations: Simulations from the prior, for rehearsal.
        finetuner: How a copy is tuned.
        num_folds: Number of copies. There are at most as many as different parameters.
        show_progress_bars: Whether to show the losses during training.

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
            "Expected calibration pairs of different parameters with space='tuned'; "
            f"all {len(theta)} have the same. Use space='embedding'."
        )
    folds = split_groups(groups, num_folds)
    targets = moments.mean.to(x)
    # The simulations may be sorted, and rehearsal takes the first ones.
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
