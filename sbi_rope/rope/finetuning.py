"""Fine-tuning on real observations with known parameters, of a net and of NPE."""

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from sbi_rope.data.pairs import Nodes, epochs_on_pairs, split_pairs
from sbi_rope.density.flow import Flow
from sbi_rope.npe.sbi import embed, has_parameters
from sbi_rope.training.ensemble import Ensemble, embedded
from sbi_rope.training.fit import History, Training, fit
from sbi_rope.utils.errors import warn_user
from sbi_rope.utils.settings import Count, NotNegative, Positive, Range, Settings

# The number of simulations to rehearse with, and how many of them each epoch uses.
NUM_REHEARSED = 2000
REHEARSED_IN_EPOCH = 50


@dataclass(frozen=True, kw_only=True)
class CalibrationFinetuner(Settings):
    r"""Tunes a copy g of the embedding net h on calibration pairs.

    It minimises, with the norm not squared,

    .. math::
        \mathcal{L}(g) = \sum_{i=1}^{n_c} \Bigl\lVert g(x_{o,i})
        - \mathbb{E}_{\varepsilon}\bigl[h(S(\theta_i, \varepsilon))\bigr]
        \Bigr\rVert_2,

    starting from g = h, with Adam on all training pairs at once. A fifth of the pairs
    is held out, groups as a whole. Of all epochs, including the start, the g with the
    smallest loss on the held-out pairs is kept.

    With ``rehearsal`` :math:`\lambda > 0` it also minimises, over simulations from the
    prior, :math:`\lambda\, \mathbb{E} \lVert g(x_s) - h(x_s) \rVert_2`, which is not in
    the paper. It helps if a large net is tuned on few pairs. The loss on the held-out
    pairs does not contain it.

    The net is tuned in evaluation mode (no dropout, fixed batch statistics). If h has
    no trainable parameters, because NPE was trained without an embedding net, g is h
    followed by an affine map that starts as the identity.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
          Calibration (Wehenkel et al., 2025), eq. 6 and Algorithm 1, step 2
        | https://arxiv.org/abs/2405.08719
        | Learning without Forgetting (Li and Hoiem, 2016), for the distillation
        | https://arxiv.org/abs/1606.09282

    Args:
        learning_rate: The step size of Adam. Of several, the one with the smallest loss
            on the held-out pairs is kept. With too few pairs for a hold-out, an
            embedding net is tuned with the smallest and an affine map with the largest.
        max_num_epochs: The largest number of epochs. Each is one gradient step over all
            training pairs.
        stop_after_epochs: Training stops after this many epochs without a smaller loss
            on the held-out pairs.
        simulations_per_target: The number of simulations in the mean that estimates
            each expectation. With 1, as in the paper, g is pulled towards the noise of
            single simulations.
        validation_fraction: The share of the pairs that is held out, at most 0.5.
        rehearsal: :math:`\lambda`, not negative. The default is 0, as in the paper.
    """

    learning_rate: Positive | tuple[Positive, ...] = (1e-4, 1e-3)
    max_num_epochs: Count = 1000
    stop_after_epochs: Count = 200
    simulations_per_target: Count = 100
    validation_fraction: Annotated[float, Range(0, 0.5)] = 0.2
    rehearsal: NotNegative = 0.0

    def tuned(
        self,
        h: nn.Module,
        x: Tensor,
        targets: Sequence[Tensor],
        sets: Sequence[Tensor],
        *,
        groups: Tensor,
        weights: Tensor | None = None,
        draw_simulations: Callable[[int], Tensor],
        show_progress_bars: bool = False,
    ) -> tuple[Ensemble, list[History]]:
        """Tune a copy of h on each of several sets of pairs, all at once.

        Of each copy, ``targets`` has the targets at all pairs, shape ``(n_c, l)``, and
        ``sets`` the rows of the pairs x, ``(n_c, *event)``, that it may see. There is a
        group and a weight of each pair, ``(n_c,)``. ``draw_simulations`` returns up to
        k simulations from the prior, ``(k, *event)``. Return the nets and their losses.
        """
        splits = []
        for rows in sets:
            parts = split_pairs(groups[rows], self.validation_fraction)
            splits.append(tuple(rows[part] for part in parts))
        seen, fewest = min(splits, key=lambda split: len(split[1]))
        max_num_epochs = epochs_on_pairs(groups[seen], fewest, self.max_num_epochs)
        rates = self.learning_rate
        rates = list(rates) if isinstance(rates, tuple) else [rates]
        if not len(fewest):
            # The careful rate for a net, the larger for an affine map.
            rates = [min(rates) if has_parameters(h) else max(rates)]
            splits = [(rows, rows[:0]) for rows in sets]
        every = [split for split in splits for _ in rates]
        train, held_out = (
            side_by_side(rows, weights) for rows in zip(*every, strict=True)
        )
        aims = torch.stack([one for one in targets for _ in rates])
        net = trainable_copy(h, targets[0])
        nets = Ensemble([net] * len(every), embedded, (x[:3],))
        kept: tuple[Tensor, ...] = ()
        if self.rehearsal:
            x_s = draw_simulations(NUM_REHEARSED).to(x.dtype)
            kept = x_s, embed(h, x_s)

        def distances(x: Tensor, targets: Tensor) -> Tensor:
            z = nets.answer(embedded, x.flatten(0, 1)).unflatten(0, x.shape[:2])
            return torch.linalg.vector_norm(z - targets, dim=2)

        def distance(index: Tensor, share: Tensor, targets: Tensor) -> Tensor:
            own = targets[torch.arange(len(index))[:, None], index]
            return weighted_mean(distances(x[index], own), share)

        def batches(epoch: int) -> list[tuple[Tensor, ...]]:
            if not kept:
                return [(*train, aims)]
            some = torch.randint(len(kept[0]), (len(every), REHEARSED_IN_EPOCH))
            return [(*train, aims, *(one[some.to(x.device)] for one in kept))]

        def loss(index: Tensor, share: Tensor, aims: Tensor, *kept: Tensor) -> Tensor:
            found = distance(index, share, aims)
            if kept:
                found = found + self.rehearsal * distances(*kept).mean(dim=1)
            return found

        histories = fit(
            nets,
            batches,
            loss,
            Training(stop_after_epochs=self.stop_after_epochs, clip_max_norm=None),
            validation_loss=distance if len(fewest) else None,
            held_out=(*held_out, aims),
            learning_rates=rates * len(sets),
            max_num_epochs=max_num_epochs,
            in_training_mode=False,
            label="Fine-tuning",
            show_progress_bars=show_progress_bars,
        )
        best = best_rates(histories, len(rates))
        return nets[best], [histories[k] for k in best]


# The rate and the patience take an eighth of the time of the finetuner's defaults and
# did not increase the distances on calibration data.
TUNING = CalibrationFinetuner(rehearsal=1.0, learning_rate=3e-3, stop_after_epochs=50)


def best_rates(histories: Sequence[History], count: int) -> list[int]:
    """Return which of each ``count`` networks has the lowest loss on its hold-out."""
    loss = [history.kept_validation_loss for history in histories]
    return [
        min(range(start, start + count), key=loss.__getitem__)
        for start in range(0, len(loss), count)
    ]


# How NPE is fine-tuned on pairs, chosen on calibration data: see benchmarks/choices.md.
FINETUNING = Training(
    training_batch_size=100,
    validation_fraction=0.2,
    stop_after_epochs=50,
    max_num_epochs=500,
)
# Of training NPE with rehearsal: pairs in a batch, as many simulations as pairs, and
# steps in an epoch, after each of which the held-out part is scored.
PAIRS_IN_BATCH, STEPS_IN_EPOCH = 50, 100


def finetune_flow(
    flow: Flow,
    labels: Sequence[Nodes],
    x: Tensor,
    splits: Sequence[tuple[Tensor, Tensor]],
    *,
    training: Training,
    learning_rates: Sequence[float] | None = None,
    max_num_epochs: int | None = None,
    weights: Tensor | None = None,
    rehearsed: tuple[Tensor, Tensor] | None = None,
    only_densities: bool = False,
    show_progress_bars: bool = False,
) -> list[History]:
    r"""Train flows in place on pairs, all at once, each until its hold-out says stop.

    .. math::
        \min_q \; \sum_{i \in \text{train}} -\log q(\theta_i \mid x_i)
        \quad\text{until}\quad
        \sum_{i \in \text{held out}} -\log q(\theta_i \mid x_i)
        \quad\text{does not fall any more}

    For each flow there are the nodes of all labels, of whose densities the mean is
    taken, and the rows that it is trained on and holds out. All see the same x,
    ``(n, *event)``. With ``only_densities`` the net, which all flows share, stays as it
    is. A large net that keeps seeing ``rehearsed`` simulations (theta, x) learns more
    from the pairs before it overfits; both means count half then.
    """
    theta = torch.stack([one.theta for one in labels])
    log_weights = torch.stack([one.log_weights for one in labels])
    member = torch.arange(len(labels), device=x.device)[:, None]
    fixed = flow.embed(x)[:, 0] if only_densities else None

    def losses(rows: Tensor, member: Tensor) -> Tensor:
        """Return the negative log densities of labels, ``(E, B)`` to ``(E, B)``."""
        nodes = theta[member, rows]
        z = flow.embeddings(x[rows]) if fixed is None else fixed[rows]
        z = z.repeat_interleave(nodes.shape[2], dim=1)
        log_q = -flow.losses_given(nodes.flatten(1, 2), z).reshape(-1, nodes.shape[2])
        of_nodes = log_weights[member, rows].flatten(0, 1)
        flat = Nodes(theta=nodes.flatten(0, 1), log_weights=of_nodes)
        return -flat.log_mean(log_q).reshape(rows.shape)

    train, held_out = (
        side_by_side(_with_density(partial(losses, member=member), rows), weights)
        for rows in zip(*splits, strict=True)
    )

    def mean_loss(index: Tensor, share: Tensor, member: Tensor) -> Tensor:
        return weighted_mean(losses(index, member), share)

    def batches(epoch: int) -> Iterator[tuple[Tensor, ...]]:
        index, share = train
        size = training.training_batch_size
        if rehearsed is not None:
            counts = (share > 0).sum(dim=1, keepdim=True)
            for _ in range(STEPS_IN_EPOCH):
                uniform = torch.rand(len(index), PAIRS_IN_BATCH).to(index.device)
                some = (uniform * counts).long()
                pairs = index.gather(1, some), share.gather(1, some)
                simulations = torch.randint(len(rehearsed[0]), some.shape)
                yield *pairs, member, simulations.to(x.device)
        elif index.shape[1] <= size:
            yield index, share, member
        else:
            order = torch.rand(index.shape).argsort(dim=1).to(index.device)
            for some in order.split(size, dim=1):
                yield index.gather(1, some), share.gather(1, some), member

    def loss(*batch: Tensor) -> Tensor:
        found = mean_loss(*batch[:3])
        if rehearsed is None:
            return found
        theta_s, x_s = (one[batch[3]] for one in rehearsed)
        return 0.5 * found + 0.5 * flow.losses(theta_s, x_s).mean(dim=1)

    return fit(
        flow.densities if only_densities else flow,
        batches,
        loss,
        training,
        validation_loss=mean_loss if held_out[0].numel() else None,
        held_out=(*held_out, member),
        learning_rates=learning_rates,
        max_num_epochs=max_num_epochs,
        in_training_mode=False,
        label="Fine-tuning NPE",
        show_progress_bars=show_progress_bars,
    )


@torch.no_grad()
def _with_density(
    losses: Callable[[Tensor], Tensor], rows: Sequence[Tensor]
) -> Sequence[Tensor]:
    """Return the rows of each flow whose loss is finite; warn of the others."""
    index, share = side_by_side(rows)
    if not index.numel():
        return rows
    parts = [losses(some) for some in index.split(100, dim=1)]
    finite = torch.isfinite(torch.cat(parts, dim=1)) | (share == 0)
    if not finite.all():
        warn_user(
            f"{len(index[~finite].unique())} calibration pair(s) have no density under "
            "NPE, and are left out of this training. Are they exactly on a bound of "
            "the prior?"
        )
    kept = [one[ok[: len(one)]] for one, ok in zip(rows, finite, strict=True)]
    return [some if len(some) else one for some, one in zip(kept, rows, strict=True)]


def side_by_side(
    rows: Sequence[Tensor], weights: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return the rows of pairs of E networks, and their weights, ``(E, m)`` each.

    Networks with fewer rows than others repeat their first, with a weight of zero.
    """
    index = pad_sequence(list(rows), batch_first=True, padding_value=-1)
    is_row = index >= 0
    index = index.where(is_row, index[:, :1])
    share = is_row.double()
    return index, share if weights is None else share * weights[index]


def weighted_mean(values: Tensor, share: Tensor) -> Tensor:
    """Return the weighted mean of each network, ``(E, m)`` to ``(E,)``."""
    share = share.to(values)
    values = values.where(share > 0, 0.0)  # a repeated one may not be finite
    return (share * values).sum(dim=1) / share.sum(dim=1).clamp_min(1e-30)


def trainable_copy(embedding_net: nn.Module, embeddings: Tensor) -> nn.Module:
    """Copy a net so that all of it can be trained; without parameters, add a layer."""
    net = copy.deepcopy(embedding_net).requires_grad_()
    if not has_parameters(net):
        width = embeddings.shape[1]
        affine = nn.Linear(width, width).to(embeddings)
        nn.init.eye_(affine.weight)
        nn.init.zeros_(affine.bias)
        net = nn.Sequential(net, affine)
    return net.eval()
