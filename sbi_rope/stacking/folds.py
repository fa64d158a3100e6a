"""The pairs that one version of all candidates may learn from."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor, nn

from sbi_rope._groups import split_groups
from sbi_rope._labels import Nodes, nodes_of, reference_of
from sbi_rope._random import seeded
from sbi_rope._sbi import embed, estimator_of
from sbi_rope._training import without_warning_of_few_pairs
from sbi_rope.discrepancy.correction import Space, correct_npe, network_of
from sbi_rope.discrepancy.parameters import learn_parameters
from sbi_rope.discrepancy.training import IN_A_STACK
from sbi_rope.finetuning import CalibrationFinetuner
from sbi_rope.rope import RoPE
from sbi_rope.stacking.workbench import Workbench

__all__ = ["Corrected", "Fold"]

# Samples of an estimator that is trained on labels that are not exact, and the nodes at
# which their density is computed.
NUM_SAMPLES, NUM_NODES = 200, 64
# A single fold is divided into so many parts, and a net is tuned without each.
NUM_INNER_FOLDS = 5


@dataclass(frozen=True, eq=False, kw_only=True)
class Corrected:
    """An estimator trained on corrected simulations, and nets for real observations.

    Attributes:
        estimator: The estimator.
        nets: The nets that embed real observations; the density is averaged over them.
            There is none with ``space="input"``, where the estimator has its own.
    """

    estimator: Any
    nets: tuple[nn.Module, ...]


class Fold:
    """The pairs that one version of all candidates may learn from.

    Args:
        bench: What all folds share.
        used: The numbers of the folds to learn from.
    """

    def __init__(self, bench: Workbench, used: Sequence[int]) -> None:
        self.bench = bench
        self.used = frozenset(used)
        self.rows = bench.rows_of(self.used)
        self.seed = bench.seed_of(self.used)
        self._corrected: dict[tuple[Space, bool], Corrected] = {}

    @cached_property
    def parts(self) -> dict[int, Tensor]:
        """Rows of the parts that are held out in turn; nets learn from the others.

        These are the folds. A single fold is divided further, unless all of its pairs
        have the same parameters.
        """
        if len(self.used) > 1:
            return {number: self.bench.folds[number] for number in sorted(self.used)}
        with seeded(self.seed):
            split = split_groups(self.bench.groups[self.rows.cpu()], NUM_INNER_FOLDS)
        found = [self.rows[part.to(self.rows.device)] for part in split]
        return dict(enumerate(found))

    def rows_without(self, part: int) -> Tensor:
        """Return the rows of all parts but one."""
        return torch.cat([rows for k, rows in self.parts.items() if k != part])

    @cached_property
    def rope(self) -> RoPE:
        """RoPE, tuned on these pairs."""
        return self.tuned(self.bench.rope.finetuner)

    def tuned(self, finetuner: CalibrationFinetuner) -> RoPE:
        """Return RoPE, tuned on these pairs with the settings of a finetuner."""
        bench, targets = self.bench, None
        if bench.has_targets_of(finetuner):
            targets = bench.targets(self.rows, self.seed)
        part = bench.rope.with_pairs(self.rows, targets=targets, finetuner=finetuner)
        with without_warning_of_few_pairs():
            return part.train(seed=self.seed, show_progress_bars=False)

    @torch.no_grad()
    def nodes(self, start: Any) -> Nodes:
        """Return nodes to compute the density of the labels of these pairs at.

        An estimator that is trained may move away from where it starts, so that the
        nodes spread as far as the prior does.

        Args:
            start: The estimator that the training starts from.
        """
        bench = self.bench
        with seeded(self.seed):
            samples = start.sample(torch.Size((NUM_SAMPLES,)), bench.x[self.rows])
            return nodes_of(
                bench.labels[self.rows],
                [reference_of(samples)],
                bench.npe.prior,
                num_nodes=NUM_NODES,
            )

    def corrected(self, space: Space, *, learn_prior: bool) -> Corrected:
        """Return NPE trained on simulations that are corrected as these pairs tell."""
        key = (space, learn_prior)
        if key not in self._corrected:
            with seeded(self.seed):
                self._corrected[key] = self._correct(space, learn_prior=learn_prior)
        return self._corrected[key]

    def _correct(self, space: Space, *, learn_prior: bool) -> Corrected:
        bench, x = self.bench, self.bench.x[self.rows]
        theta_s, x_s = bench.simulations
        probabilities = None
        if learn_prior:
            draws = bench.rope.labelled_parameters[self.rows].draws
            probabilities = learn_parameters(
                draws, theta_s, weights=bench.parameter_weights(self.rows)
            ).probabilities
        estimator = estimator_of(bench.npe)
        if space == "tuned":
            nets, z = self._cross_fitted()
        else:
            # All versions share the same h, because none of them changes it.
            nets = [] if space == "input" else [bench.embedding_net]
            z = embed(network_of(estimator, space), x)
        correction = correct_npe(
            estimator,
            (theta_s, x_s if space == "input" else bench.embedded),
            z,
            bench.moments(space)[self.rows],
            space=space,
            model=bench.model,
            weights=bench.pair_weights(self.rows),
            groups=bench.groups[self.rows.cpu()],
            probabilities=probabilities,
            min_gain=IN_A_STACK,
        )
        return Corrected(
            estimator=correction.estimator,
            nets=tuple(nn.Sequential(net, correction.constants) for net in nets),
        )

    def _cross_fitted(self) -> tuple[list[nn.Module], Tensor]:
        """Return tuned nets, and the pairs embedded by nets that have not seen them."""
        bench, nets = self.bench, []
        z = bench.embedded.new_empty(len(bench.x), bench.embedded.shape[1])
        for number, rows in self.parts.items():
            net = self._tuned_without(number)
            z[rows] = embed(net, bench.x[rows])
            nets.append(net)
        return nets, z[self.rows]

    def _tuned_without(self, part: int) -> nn.Module:
        """Return a net tuned on the pairs, except for a part."""
        bench = self.bench
        if len(self.used) > 1:
            return bench.tuned_net(self.used - {part})
        if len(self.parts) == 1:  # one person: there are no other pairs to tune on
            return bench.embedding_net
        return bench.tune(self.rows_without(part), self.seed)
