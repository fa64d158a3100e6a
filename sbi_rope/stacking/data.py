"""What the candidates of a stack are trained on: pairs, their folds, simulations."""

import copy
from collections.abc import Hashable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_rope.data.labels import nodes_of
from sbi_rope.data.pairs import Nodes
from sbi_rope.data.simulate import Moments, moments
from sbi_rope.density.base import Density
from sbi_rope.discrepancy.correction import Space, tuning_targets
from sbi_rope.discrepancy.model import DiscrepancyModel
from sbi_rope.discrepancy.report import DiscrepancyReport, report_discrepancy
from sbi_rope.npe.sbi import embed, has_parameters
from sbi_rope.rope.rope import RoPE
from sbi_rope.utils.errors import NotReadyError
from sbi_rope.utils.seeds import seeded

# Simulations from the prior that the corrected candidates are trained on, and
# simulations at the parameters of each pair.
NUM_SIMULATIONS, SIMULATIONS_PER_PAIR = 10_000, 100
# A vector x with more entries is not treated as a list of summaries.
MAX_SUMMARIES = 20
# Samples of a density at each label that is not exact, from which nodes are placed.
NUM_SAMPLES = 200
# Folds of the calibration pairs, and parts of a single fold, a net without each of
# which is trained.
NUM_FOLDS, NUM_INNER_FOLDS = 5, 5


def draw_seeds(seed: int | None, count: int) -> list[int]:
    """Return seeds that follow from one seed, or from torch's state if it is None."""
    with seeded(seed):
        return torch.randint(2**31, (count,)).tolist()


class StackData:
    """NPE, its simulations, and the calibration pairs in folds.

    What is drawn for some rows has a seed that follows from these rows, and no line
    depends on what was asked for before. What candidates share is ``kept``, by keys
    that say what it depends on.
    """

    def __init__(
        self, rope: RoPE, *, num_folds: int, seed: int, show_progress_bars: bool
    ) -> None:
        self.rope, self.npe, self.show = rope, rope.npe, show_progress_bars
        self.estimator, self.source = rope.npe.estimator, rope.source
        self.prior, self.pairs = rope.npe.prior, rope.pairs
        self.model, self.embedding_net = DiscrepancyModel(), copy.deepcopy(rope.npe.h)
        labels = len(self.pairs.label.unique())
        if (count := min(self.pairs.num_groups, labels)) < 2:
            raise NotReadyError(
                "Expected at least 2 calibration pairs with different parameters and "
                f"groups, from `append_calibration`; got {count}."
            )
        of_folds, self.seed = draw_seeds(seed, 2)
        self.folds = self.pairs.folds(num_folds, seed=of_folds)
        self.every = torch.cat(self.folds)
        # Whether x is a vector of few entries, and neither a series nor an image.
        x = self.pairs.x
        self.is_short = x.ndim == 2 and x.shape[1] <= MAX_SUMMARIES
        self.kept: dict[Hashable, Any] = {}

    def __len__(self) -> int:
        return len(self.pairs)

    # --- rows of pairs ---

    def without(self, fold: int, num_folds: int | None = None) -> Tensor:
        """Return the rows of the folds that follow one; of all others if None."""
        count = len(self.folds)
        used = sorted((fold + 1 + j) % count for j in range(num_folds or count - 1))
        return torch.cat([self.folds[number] for number in used])

    def holdouts(self, rows: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return the rows to train on and those held out, for each part in turn.

        The parts are folds. A single fold is divided further by groups, and a single
        group leaves nothing to hold out.
        """
        parts = [fold for fold in self.folds if torch.isin(fold, rows).all()]
        if len(parts) < 2:
            inner = self.pairs[rows].folds(NUM_INNER_FOLDS, seed=self.seed_of(rows))
            parts = [rows[part] for part in inner]
        if len(parts) < 2:
            return []
        return [(rows[~torch.isin(rows, part)], part) for part in parts]

    def place(self, rows: Tensor) -> Tensor:
        """Return the place of each pair among some rows, 0 for others, ``(n,)``."""
        place = torch.zeros_like(self.every)
        place[rows] = torch.arange(len(rows), device=rows.device)
        return place

    def seed_of(self, rows: Tensor) -> int:
        """Return the seed of what is drawn for some rows."""
        key = rows.sort().values.tolist()
        sequence = np.random.SeedSequence(self.seed, spawn_key=key)
        return int(sequence.generate_state(1)[0])

    # --- simulations ---

    @cached_property
    def simulations(self) -> tuple[Tensor, Tensor]:
        """Parameters from the prior, and a simulation of each."""
        return self.source.from_prior(NUM_SIMULATIONS, seed=0, progress=self.show)

    @cached_property
    def embedded(self) -> Tensor:
        """The embeddings h(x) of :attr:`simulations`, shape ``(n_s, l)``."""
        return embed(self.embedding_net, self.simulations[1])

    def moments(self, rows: Tensor, space: Space) -> Moments:
        """Return moments of simulations at some pairs: of x with "input", else h(x)."""
        used = [k for k, fold in enumerate(self.folds) if torch.isin(fold, rows).any()]
        parts = [self._moments(k, of_x=space == "input") for k in used]
        found = Moments(
            means=torch.cat([part.means for part in parts]),
            covariance=torch.cat([part.covariance for part in parts]),
        )
        if self.is_short:
            width = self.embedded.shape[1]
            both = slice(0, width), slice(width, None)
            found = found.columns(both[space == "input"])
        return found[self.place(torch.cat([self.folds[k] for k in used]))[rows]]

    def _moments(self, fold: int, *, of_x: bool) -> Moments:
        """Return moments at a fold: of h(x) and x side by side if x is short."""
        h, rows = self.embedding_net, self.folds[fold]

        def represent(x: Tensor) -> Tensor:
            if self.is_short:  # so that both are of the same simulations
                return torch.cat([embed(h, x), x], dim=1)
            return x if of_x else embed(h, x)

        key = "moments", fold, of_x and not self.is_short
        if key not in self.kept:
            what = self.source, self.pairs[rows], SIMULATIONS_PER_PAIR, represent
            with seeded(self.seed_of(rows)):
                self.kept[key] = moments(*what, progress=self.show)
        return self.kept[key]

    @cached_property
    def compares_entries(self) -> bool:
        """Whether x is a short vector without missing entries, simulated or real."""
        # Missing entries (NaN) can be embedded, but not corrected.
        every = self.pairs.x, self.simulations[1]
        return self.is_short and all(bool(torch.isfinite(x).all()) for x in every)

    @property
    def reads_summaries(self) -> bool:
        """Whether entries of x can be corrected, and NPE has an embedding net.

        Without a net to lose information, errors in x are those in h(x).
        """
        return has_parameters(self.embedding_net) and self.compares_entries

    # --- labels ---

    def targets(self, rows: Tensor) -> Tensor:
        """Return targets of tuning for all pairs, computed from some pairs alone."""
        of_rows, pairs = self.moments(rows, "embedding"), self.pairs[rows]
        found = of_rows.mean.to(self.embedded)
        if not self.pairs.are_exact:
            z, seed = embed(self.embedding_net, pairs.x), self.seed_of(rows)
            found = tuning_targets(pairs, z, of_rows, self.embedded, seed=seed)
        return found.new_zeros(len(self), found.shape[1]).index_copy(0, rows, found)

    @torch.no_grad()
    def nodes(self, rows: Tensor, near: Sequence[Density], num_nodes: int) -> Nodes:
        """Return nodes to compute the density of labels at, near samples of densities.

        They also spread as far as the prior does. Of exact labels there is one node.
        """
        x, size = self.pairs.x[rows], torch.Size((NUM_SAMPLES,))
        if self.pairs.are_exact:
            return Nodes.exact(self.pairs.mean[rows])
        with seeded(self.seed_of(rows)):
            samples = [one.sample(size, x) for one in near]
            return nodes_of(self.pairs[rows], samples, self.prior, num_nodes=num_nodes)

    def discrepancy(self) -> DiscrepancyReport:
        """Return what all pairs say about each entry of x, which is a short vector."""
        return report_discrepancy(
            self.pairs.x,
            self.moments(self.every.sort().values, "input"),
            self.simulations[1],
            model=self.model,
            weights=self.pairs.weight,
            groups=self.pairs.group,
        )


def key_of(versions: Sequence[Tensor]) -> Hashable:
    """Return a key for what is trained on some rows in each version."""
    return tuple(tuple(rows.tolist()) for rows in versions)
