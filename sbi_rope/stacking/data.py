"""What the candidates of a stack are trained on: pairs, their folds, simulations."""

from collections.abc import Hashable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from sbi_rope.data.labels import nodes_of, reference_of
from sbi_rope.data.pairs import Nodes
from sbi_rope.data.simulate import Moments, moments
from sbi_rope.density.base import Density
from sbi_rope.discrepancy.correction import Space, tuning_targets
from sbi_rope.discrepancy.model import DiscrepancyModel
from sbi_rope.discrepancy.report import DiscrepancyReport, report_discrepancy
from sbi_rope.npe.sbi import embed, has_parameters
from sbi_rope.npe.standardisation import Standardisation
from sbi_rope.rope.rope import RoPE
from sbi_rope.utils.errors import NotReadyError
from sbi_rope.utils.seeds import seeded

# Simulations from the prior that the corrected candidates are trained on, and
# simulations at the parameters of each pair.
NUM_SIMULATIONS, SIMULATIONS_PER_PAIR = 10_000, 100
# A vector x with more entries is not treated as a list of summaries.
MAX_SUMMARIES = 20
# Samples of an estimator that is trained on labels that are not exact, and the nodes at
# which their density is computed.
NUM_SAMPLES, NUM_NODES = 200, 64
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

    Args:
        rope: RoPE with all calibration pairs, of at least two groups.
        num_folds: Number of folds. There are at most as many as groups of pairs.
        seed: Seed of everything random.
        show_progress_bars: Whether to show the progress of trainings and simulations.
    """

    def __init__(
        self, rope: RoPE, *, num_folds: int, seed: int, show_progress_bars: bool
    ) -> None:
        self.rope, self.npe, self.show = rope, rope.npe, show_progress_bars
        self.estimator, self.source = rope.npe.estimator, rope.source
        self.prior, self.pairs = rope.npe.prior, rope.pairs
        self.model = DiscrepancyModel()
        labels = len(self.pairs.label.group.unique())
        if (count := min(self.pairs.num_groups, labels)) < 2:
            raise NotReadyError(
                "Expected at least 2 calibration pairs with different parameters and "
                f"groups, from `append_calibration`; got {count}."
            )
        of_folds, self.seed = draw_seeds(seed, 2)
        self.folds = self.pairs.folds(num_folds, seed=of_folds)
        self.kept: dict[Hashable, Any] = {}

    def __len__(self) -> int:
        return len(self.pairs)

    # --- rows of pairs ---

    def without(self, fold: int, num_folds: int | None = None) -> Tensor:
        """Return the rows of the folds that follow one; of all others if None."""
        count = len(self.folds)
        num_folds = count - 1 if num_folds is None else num_folds
        used = sorted((fold + 1 + j) % count for j in range(num_folds))
        return torch.cat([self.folds[number] for number in used])

    @property
    def every(self) -> Tensor:
        """The rows of all folds."""
        return torch.cat(self.folds)

    def parts(self, rows: Tensor) -> list[Tensor]:
        """Cut rows into folds, of which one alone is divided further by groups."""
        folds = [fold for fold in self.folds if torch.isin(fold, rows).all()]
        if len(folds) > 1:
            return folds
        inner = self.pairs[rows].folds(NUM_INNER_FOLDS, seed=self.seed_of(rows))
        return [rows[part] for part in inner]

    def holdouts(self, rows: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return the rows to train on and those held out, for each part in turn."""
        parts = self.parts(rows)
        if len(parts) < 2:
            return []
        return [(rows[~torch.isin(rows, part)], part) for part in parts]

    def seed_of(self, rows: Tensor) -> int:
        """Return the seed of what is drawn for some rows."""
        key = rows.sort().values.tolist()
        sequence = np.random.SeedSequence(self.seed, spawn_key=key)
        return int(sequence.generate_state(1)[0])

    # --- simulations ---

    @cached_property
    def embedding_net(self) -> nn.Module:
        """The embedding net h of NPE."""
        return self.rope.embedding_net

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
        parts = [self._moments(number, space) for number in used]
        found = Moments(
            means=torch.cat([part.means for part in parts]),
            covariance=torch.cat([part.covariance for part in parts]),
        )
        of_found = torch.cat([self.folds[number] for number in used])
        place = torch.zeros(len(self), dtype=torch.long, device=rows.device)
        place[of_found] = torch.arange(len(of_found), device=rows.device)
        return found[place[rows]]

    def _moments(self, fold: int, space: Space) -> Moments:
        h, rows = self.embedding_net, self.folds[fold]
        of_x = space == "input"

        def represent(x: Tensor) -> Tensor:
            # Side by side if x is short, so that both are of the same simulations.
            parts = [embed(h, x)] * (self.is_short or not of_x)
            return torch.cat(parts + [x] * (self.is_short or of_x), dim=1)

        key = "moments", fold, self.is_short or of_x
        if key not in self.kept:
            with seeded(self.seed_of(rows)):
                self.kept[key] = moments(
                    self.source,
                    self.pairs[rows],
                    SIMULATIONS_PER_PAIR,
                    represent,
                    progress=self.show,
                )
        width = self.embedded.shape[1]
        if of_x:
            return self.kept[key].columns(slice(width if self.is_short else 0, None))
        return self.kept[key].columns(slice(0, width))

    # --- what x is like ---

    @property
    def is_short(self) -> bool:
        """Whether x is a vector of few entries, and neither a series nor an image."""
        return self.pairs.x.ndim == 2 and self.pairs.x.shape[1] <= MAX_SUMMARIES

    @cached_property
    def compares_entries(self) -> bool:
        """Whether x is a short vector without missing entries, simulated or real."""
        # Missing entries (NaN) can be embedded, but not corrected.
        return (
            self.is_short
            and bool(torch.isfinite(self.pairs.x).all())
            and bool(torch.isfinite(self.simulations[1]).all())
        )

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
            found = tuning_targets(
                embed(self.embedding_net, pairs.x),
                of_rows,
                Standardisation(self.embedded.double()),
                pairs.weight,
                pairs.group,
                seed=self.seed_of(rows),
            )
        targets = found.new_zeros(len(self), found.shape[1])
        targets[rows] = found
        return targets

    @torch.no_grad()
    def nodes(self, rows: Tensor, start: Density) -> Nodes:
        """Return nodes to compute the density of labels at, of use for these rows only.

        The density that is trained may move away from its ``start``, so that the nodes
        spread as far as the prior does.
        """
        if self.pairs.are_exact:
            return Nodes.exact(self.pairs.mean)
        with seeded(self.seed_of(rows)):
            samples = start.sample(torch.Size((NUM_SAMPLES,)), self.pairs.x[rows])
            found = nodes_of(
                self.pairs.label[rows],
                [reference_of(samples)],
                self.prior,
                num_nodes=NUM_NODES,
            )
        theta = found.theta[:1].expand(len(self), -1, -1).clone()
        log_weights = found.log_weights[:1].expand(len(self), -1).clone()
        theta[rows], log_weights[rows] = found.theta, found.log_weights
        return Nodes(theta=theta, log_weights=log_weights)

    def discrepancy(self) -> DiscrepancyReport:
        """Return what all pairs say about each entry of x, which is a short vector.

        It needs no simulations beyond those of the candidates.
        """
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
