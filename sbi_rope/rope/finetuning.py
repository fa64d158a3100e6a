"""Fine-tuning the embedding net on real observations with known parameters."""

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import torch
from torch import Tensor, nn

from sbi_rope.data.pairs import Nodes, epochs_on_pairs, split_pairs
from sbi_rope.density.flow import Flow
from sbi_rope.npe.sbi import embed, has_parameters
from sbi_rope.training.ensemble import Ensemble, embedded
from sbi_rope.training.fit import History, Training, fit
from sbi_rope.utils.errors import warn_user
from sbi_rope.utils.progress import is_shown
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import Count, NotNegative, Positive, Range, Settings, check
from sbi_rope.utils.tensors import as_batch

# The number of simulations to rehearse with, and how many of them each epoch uses.
NUM_REHEARSED = 2000
REHEARSED_IN_EPOCH = 50


@dataclass(frozen=True, eq=False)
class FinetuneResult:
    """The tuned embedding net, in evaluation mode, and the course of its training."""

    embedding_net: nn.Module
    history: History


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
    the paper, so that g does not forget how h embeds simulations. It helps if a large
    net is tuned on few pairs (``docs/background/benchmark.md``). The loss on the
    held-out pairs does not contain it.

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
        resample_targets: Whether to draw new simulations in every epoch, as the paper
            does, instead of once before the first.
        num_neighbors: With stored simulations, the expectation is estimated by the mean
            over this many simulations with the nearest parameters.
        validation_fraction: The share of the pairs that is held out, at most 0.5.
        rehearsal: :math:`\lambda`, not negative. The default is 0, as in the paper.
    """

    learning_rate: Positive | tuple[Positive, ...] = (1e-4, 1e-3)
    max_num_epochs: Count = 1000
    stop_after_epochs: Count = 200
    simulations_per_target: Count = 100
    resample_targets: bool = False
    num_neighbors: Count = 1
    validation_fraction: Annotated[float, Range(0, 0.5)] = 0.2
    rehearsal: NotNegative = 0.0

    def finetune(
        self,
        embedding_net: nn.Module,
        x: Tensor,
        draw_targets: Callable[[int], Tensor],
        *,
        draw_simulations: Callable[[int], Tensor] | None = None,
        groups: Tensor | None = None,
        weights: Tensor | None = None,
        seed: int | None = None,
        show_progress_bars: bool | None = None,
    ) -> FinetuneResult:
        """Tune a copy of the embedding net; the net itself does not change.

        Args:
            embedding_net: h, a module from ``(n, *event)`` to ``(n, l)``.
            x: Real observations of the calibration set, shape ``(n_c, *event)``.
            draw_targets: A function of a number k that returns the mean embedding of k
                simulations for each pair, shape ``(n_c, l)``.
            draw_simulations: A function of a number k that returns up to k simulations
                from the prior, shape ``(k, *event)``, for ``rehearsal``.
            groups: A number for each pair, shape ``(n_c,)``. Pairs with the same number
                are held out together. None if all pairs have different parameters.
            weights: How many pairs each pair counts as, shape ``(n_c,)``; one if None.
            seed: Seed of the split and of the simulations; None uses torch's state.
            show_progress_bars: Whether to show the losses during training. None does so
                in a terminal or a notebook, but not in a file.
        """
        check("embedding_net", embedding_net, nn.Module)
        x = as_batch("x", x, finite=False)
        groups = torch.arange(len(x)) if groups is None else groups
        groups = as_batch("groups", groups, (), rows=len(x))
        if weights is not None:
            weights = as_batch("weights", weights, (), rows=len(x)).to(x)
        show = is_shown(show_progress_bars)
        with seeded(seed):
            z = as_batch("x", embed(embedding_net, x))

            def new_targets() -> Tensor:
                targets = draw_targets(self.simulations_per_target)
                return as_batch("targets", targets, z.shape[1:], rows=len(x))

            nets, [history] = self.tuned(
                embedding_net,
                x,
                [new_targets()],
                [torch.arange(len(x))],
                groups=groups,
                weights=weights,
                draw_simulations=draw_simulations,
                draw_targets=new_targets if self.resample_targets else None,
                show_progress_bars=show,
            )
        return FinetuneResult(nets.member(0), history)

    def tuned(
        self,
        h: nn.Module,
        x: Tensor,
        targets: Sequence[Tensor],
        sets: Sequence[Tensor],
        *,
        groups: Tensor,
        weights: Tensor | None = None,
        draw_simulations: Callable[[int], Tensor] | None = None,
        draw_targets: Callable[[], Tensor] | None = None,
        show_progress_bars: bool = False,
    ) -> tuple[Ensemble, list[History]]:
        """Tune a copy of h on each of several sets of pairs, all at once.

        Of each copy, ``targets`` has the targets at all pairs, shape ``(n, l)``, and
        ``sets`` the rows of the pairs that it may see. If targets are drawn anew in
        every epoch, ``draw_targets`` does so. Other arguments are as in
        :meth:`finetune`.
        """
        kept = None
        if self.rehearsal:
            check("draw_simulations", draw_simulations, Callable)
            simulations = draw_simulations(NUM_REHEARSED).to(x.dtype)  # type: ignore[misc]
            simulated = as_batch("embeddings of simulations", embed(h, simulations))
            kept = (simulations, simulated)
        splits = []
        for rows in sets:
            parts = split_pairs(groups[rows.cpu()], self.validation_fraction)
            splits.append(tuple(rows[part.to(rows.device)] for part in parts))
        fewest = min(splits, key=lambda split: len(split[1]))
        max_num_epochs = epochs_on_pairs(
            groups[fewest[0].cpu()], fewest[1], self.max_num_epochs
        )
        rates = self.learning_rate
        rates = list(rates) if isinstance(rates, tuple) else [rates]
        if not len(fewest[1]):
            # The careful rate for a net, the larger for an affine map.
            rates = [min(rates) if has_parameters(h) else max(rates)]
            splits = [(rows, rows[:0]) for rows in sets]
        count, num_nets = len(rates), len(rates) * len(sets)
        nets = Ensemble([trainable_copy(h, targets[0])] * num_nets, embedded, (x[:3],))
        fixed = torch.stack([one for one in targets for _ in rates])
        newest, every = fixed, [split for split in splits for _ in rates]
        train, held_out = (
            Padded.of(some, weights) for some in zip(*every, strict=True)
        )

        def distances(x: Tensor, targets: Tensor) -> Tensor:
            z = nets.answer(embedded, x.flatten(0, 1)).unflatten(0, x.shape[:2])
            return torch.linalg.vector_norm(z - targets, dim=2)

        def mean_distance(rows: Padded, targets: Tensor) -> Tensor:
            return rows.mean(distances(x[rows.index], rows.of_each(targets)))

        def batches(epoch: int) -> list[tuple[Any, ...]]:
            nonlocal newest
            if draw_targets is not None and epoch:
                newest = draw_targets().expand_as(fixed)
            if kept is None:
                return [(train, newest)]
            some = torch.randint(len(kept[0]), (num_nets, REHEARSED_IN_EPOCH))
            return [(train, newest, some.to(x.device))]

        def loss(rows: Padded, targets: Tensor, some: Tensor | None = None) -> Tensor:
            found = mean_distance(rows, targets)
            if kept is None:
                return found
            rehearsed = distances(kept[0][some], kept[1][some]).mean(dim=1)
            return found + self.rehearsal * rehearsed

        training = Training(
            stop_after_epochs=self.stop_after_epochs, clip_max_norm=None
        )
        histories = fit(
            nets,
            batches,
            loss,
            training,
            validation_loss=mean_distance if len(held_out) else None,
            held_out=(held_out, fixed),
            learning_rates=rates * len(sets),
            max_num_epochs=max_num_epochs,
            in_training_mode=False,
            label="Fine-tuning",
            show_progress_bars=show_progress_bars,
        )
        best = best_rates(histories, count)
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
    network = flow.densities if only_densities else flow
    fixed = flow.embed(x)[:, 0] if only_densities else None
    different = list({id(one): one for one in labels}.values())
    place = torch.tensor(
        [[one is other for other in different].index(True) for one in labels]
    )
    theta = torch.stack([one.theta for one in different])
    log_weights = torch.stack([one.log_weights for one in different])
    place = place[:, None].to(x.device)

    def losses(rows: Tensor, place: Tensor) -> Tensor:
        """Return the negative log densities of labels, ``(E, B)`` to ``(E, B)``."""
        nodes, of_nodes = theta[place, rows], log_weights[place, rows]
        z = flow.embeddings(x[rows]) if fixed is None else fixed[rows]
        count = nodes.shape[2]
        log_q = -flow.losses_given(
            nodes.flatten(1, 2), z.repeat_interleave(count, dim=1)
        )
        log_q = log_q.unflatten(1, (-1, count)).double()
        terms = torch.where(torch.isneginf(of_nodes), of_nodes, log_q + of_nodes)
        return math.log(count) - terms.logsumexp(dim=2)

    split = [
        _with_density(partial(losses, place=place), rows)
        for rows in zip(*splits, strict=True)
    ]
    train, held_out = (Padded.of(rows, weights) for rows in split)

    def mean_loss(rows: Padded, place: Tensor) -> Tensor:
        return rows.mean(losses(rows.index, place))

    def batches(epoch: int) -> Iterator[tuple[Any, ...]]:
        if rehearsed is None:
            for some in train.shuffled(training.training_batch_size):
                yield some, place
            return
        for _ in range(STEPS_IN_EPOCH):
            pairs = train.drawn(PAIRS_IN_BATCH)
            some = torch.randint(len(rehearsed[0]), pairs.index.shape)
            yield pairs, place, some.to(x.device)

    def loss(rows: Padded, place: Tensor, some: Tensor | None = None) -> Tensor:
        found = mean_loss(rows, place)
        if rehearsed is None:
            return found
        theta_s, x_s = (one[some] for one in rehearsed)
        return 0.5 * found + 0.5 * flow.losses(theta_s, x_s).mean(dim=1)

    return fit(
        network,
        batches,
        loss,
        training,
        validation_loss=mean_loss if len(held_out) else None,
        held_out=(held_out, place),
        learning_rates=learning_rates,
        max_num_epochs=max_num_epochs,
        in_training_mode=False,
        label="Fine-tuning NPE",
        show_progress_bars=show_progress_bars,
    )


@torch.no_grad()
def _with_density(
    losses: Callable[[Tensor], Tensor], rows: Sequence[Tensor]
) -> list[Tensor]:
    """Return the rows of each flow whose loss is finite; warn of the others."""
    padded = Padded.of(rows, None)
    if not len(padded):
        return list(rows)
    parts = [losses(some) for some in padded.index.split(100, dim=1)]
    finite = torch.isfinite(torch.cat(parts, dim=1)) | (padded.share == 0)
    if not finite.all():
        lost = padded.index[~finite].unique()
        warn_user(
            f"{len(lost)} calibration pair(s) have no density under NPE, and are left "
            "out of this training. Are they exactly on a bound of the prior?"
        )
    kept = [one[ok[: len(one)]] for one, ok in zip(rows, finite, strict=True)]
    return [some if len(some) else one for some, one in zip(kept, rows, strict=True)]


@dataclass(frozen=True, eq=False)
class Padded:
    """Rows of pairs for each member of an ensemble, side by side.

    Attributes:
        index: The rows, shape ``(E, m)``; members with fewer repeat their first.
        share: The share of each in the mean of its member, which is zero for repeated
            ones, shape ``(E, m)``.
    """

    index: Tensor
    share: Tensor

    @classmethod
    def of(cls, rows: Sequence[Tensor], weights: Tensor | None) -> "Padded":
        """Put rows side by side, with shares in proportion to the weights of pairs."""
        most = max(map(len, rows))
        index = torch.stack(
            [torch.cat([one, one[:1].expand(most - len(one))]) for one in rows]
        )
        share = torch.ones_like(index, dtype=torch.double)
        if weights is not None:
            share = weights[index].double()
        for number, one in enumerate(rows):
            share[number, len(one) :] = 0.0
        return cls(index, share)

    def __len__(self) -> int:
        return self.index.shape[1]

    def __getitem__(self, members: Tensor) -> "Padded":
        return Padded(self.index[members], self.share[members])

    def mean(self, values: Tensor) -> Tensor:
        """Return the weighted mean of each member, ``(E, m)`` to ``(E,)``."""
        share = self.share.to(values)
        values = values.where(share > 0, 0.0)  # a repeated one may not be finite
        return (share * values).sum(dim=1) / share.sum(dim=1).clamp_min(1e-30)

    def of_each(self, values: Tensor) -> Tensor:
        """Return the values of the rows of each member, ``(E, n, ...)``."""
        return values[torch.arange(len(self.index))[:, None], self.index]

    def shuffled(self, size: int) -> "Iterator[Padded]":
        """Pass over the rows of all members in random order, in batches."""
        if len(self) <= size:
            yield self
            return
        order = torch.rand(self.index.shape).argsort(dim=1).to(self.index.device)
        for some in order.split(size, dim=1):
            yield Padded(self.index.gather(1, some), self.share.gather(1, some))

    def drawn(self, size: int) -> "Padded":
        """Draw rows of each member, with replacement."""
        counts = (self.share > 0).sum(dim=1, keepdim=True)
        some = (torch.rand(len(self.index), size).to(counts.device) * counts).long()
        return Padded(self.index.gather(1, some), self.share.gather(1, some))


def trainable_copy(embedding_net: nn.Module, embeddings: Tensor) -> nn.Module:
    """Copy a net so that all of it can be trained; without parameters, add a layer."""
    net = copy.deepcopy(embedding_net).requires_grad_()
    if not has_parameters(net):
        width = embeddings.shape[1]
        affine = nn.Linear(width, width).to(embeddings)
        with torch.no_grad():
            affine.weight.copy_(torch.eye(width))
            affine.bias.zero_()
        net = nn.Sequential(net, affine)
    return net.eval()
