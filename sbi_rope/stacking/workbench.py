"""The folds of a stack, and what is simulated and trained for them once."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from sbi_rope._groups import split_groups
from sbi_rope._labels import Nodes, labelled_moments, nodes_of, reference_of
from sbi_rope._random import seeded
from sbi_rope._sbi import embed, estimator_of
from sbi_rope._standardisation import Standardisation
from sbi_rope._training import without_warning_of_few_pairs
from sbi_rope.discrepancy.correction import Space, correct_npe, network_of
from sbi_rope.discrepancy.model import DiscrepancyModel
from sbi_rope.discrepancy.parameters import learn_parameters
from sbi_rope.discrepancy.report import DiscrepancyReport, report_discrepancy
from sbi_rope.discrepancy.targets import tuning_targets
from sbi_rope.discrepancy.training import IN_A_STACK
from sbi_rope.discrepancy.tuning import TUNING
from sbi_rope.errors import NotReadyError
from sbi_rope.rope import RoPE
from sbi_rope.simulate import Moments, Simulator

__all__ = ["Corrected", "Fold", "Workbench", "draw_seeds"]

# Simulations from the prior that the corrected candidates are trained on.
NUM_SIMULATIONS = 20_000
# Simulations at the parameters of each pair.
SIMULATIONS_PER_PAIR = 100
# A vector x with more entries is not treated as a list of summaries.
MAX_SUMMARIES = 20
# Fewest pairs: one to train on and one to score.
MIN_PAIRS = 2
# Folds of the calibration pairs.
NUM_FOLDS = 5
# Draws of the prior that the parameters of the pairs are compared with.
NUM_FROM_PRIOR = 10_000
# Samples of an estimator that is trained on labels that are not exact, and the nodes at
# which their density is computed.
NUM_SAMPLES, NUM_NODES = 200, 64
# A single fold is divided into so many parts, and a net is tuned without each.
NUM_INNER_FOLDS = 5


def draw_seeds(seed: int | None, count: int) -> list[int]:
    """Return seeds that follow from one seed, or from torch's state if it is None."""
    with seeded(seed):
        return torch.randint(2**31, (count,)).tolist()


class Workbench:
    """What all candidates share: folds, simulations, moments and tuned nets.

    The labels of a fold only affect what is drawn or trained for that fold. It has a
    seed of its own, so that nothing drawn for other folds changes with these labels.

    Args:
        rope: RoPE with all calibration pairs.
        num_folds: Number of folds. There are at most as many as groups of pairs.
        seed: Seed of everything random.
        show_progress_bars: Whether to show the progress of slow simulations.

    Raises:
        NotReadyError: If there are fewer than two groups of pairs.
    """

    def __init__(
        self,
        rope: RoPE,
        *,
        num_folds: int,
        seed: int,
        show_progress_bars: bool,
    ) -> None:
        self.rope = rope
        self.show = show_progress_bars
        self.theta, self.x = rope.calibration
        self.labels = rope.labels
        self.groups = self.labels.groups
        self.model = DiscrepancyModel()
        if (count := len(self.groups.unique())) < MIN_PAIRS:
            raise NotReadyError(
                f"Expected at least {MIN_PAIRS} calibration pairs with different "
                f"parameters or groups; got {count}."
            )
        seeds = draw_seeds(seed, 2)
        with seeded(seeds[0]):
            split = split_groups(self.groups, num_folds)
        self.folds = [rows.to(self.theta.device) for rows in split]
        self._seed = seeds[1]
        self._nets: dict[frozenset[int], nn.Module] = {}

    def seed_of(self, folds: frozenset[int]) -> int:
        """Return the seed of everything drawn for, or trained on, some folds."""
        sequence = np.random.SeedSequence(self._seed, spawn_key=sorted(folds))
        return int(sequence.generate_state(1)[0])

    def rows_of(self, folds: frozenset[int]) -> Tensor:
        """Return the rows of some folds."""
        return torch.cat([self.folds[number] for number in sorted(folds)])

    @cached_property
    def npe(self) -> Any:
        """The posterior of NPE."""
        return self.rope.npe

    @cached_property
    def simulations(self) -> tuple[Tensor, Tensor]:
        """Parameters from the prior, and a simulation of each."""
        return self.rope.source.kept(NUM_SIMULATIONS, progress=self.show)

    @cached_property
    def embedded(self) -> Tensor:
        """The embeddings h(x) of :attr:`simulations`, shape ``(n_s, l)``."""
        return embed(self.embedding_net, self.simulations[1])

    @cached_property
    def embedding_net(self) -> nn.Module:
        """The embedding net h of NPE."""
        return self.rope.embedding_net

    @property
    def is_short(self) -> bool:
        """Whether x is a vector of few entries, and neither a series nor an image."""
        return self.x.ndim == 2 and self.x.shape[1] <= MAX_SUMMARIES

    @cached_property
    def has_summaries(self) -> bool:
        """Whether x is a vector of so few entries that it can be corrected itself."""
        # Missing entries (NaN) can be embedded, but not corrected.
        return self.is_short and bool(torch.isfinite(self.x).all())

    @cached_property
    def compares_entries(self) -> bool:
        """Whether x is a short vector without missing entries, simulated or real."""
        return self.has_summaries and bool(torch.isfinite(self.simulations[1]).all())

    @cached_property
    def reads_summaries(self) -> bool:
        """Whether entries of x can be corrected, and NPE has an embedding net.

        Without a net to lose information, errors in x are those in h(x).
        """
        has_net = any(True for _ in self.embedding_net.parameters())
        return has_net and self.compares_entries

    @cached_property
    def _moments(self) -> Moments:
        # Embeddings and summaries x are put side by side, so that both have moments
        # from the same simulations.
        h = self.embedding_net
        if not self.has_summaries:
            return self._simulated_moments(lambda x: embed(h, x))
        return self._simulated_moments(lambda x: torch.cat([embed(h, x), x], dim=1))

    @cached_property
    def _moments_of_x(self) -> Moments:
        return self._simulated_moments(lambda x: x)

    def _simulated_moments(self, represent: Callable[[Tensor], Tensor]) -> Moments:
        parts = []
        for number, rows in enumerate(self.folds):
            with seeded(self.seed_of(frozenset([number]))):
                parts.append(
                    labelled_moments(
                        self.rope.source,
                        self.rope.labelled_parameters[rows],
                        SIMULATIONS_PER_PAIR,
                        represent,
                        progress=self.show,
                    )
                )
        return Moments.joined(parts)[torch.cat(self.folds).argsort()]

    def moments(self, space: Space) -> Moments:
        """Return moments at all pairs: of x with "input", of h(x) otherwise."""
        if space == "input" and not self.has_summaries:
            return self._moments_of_x
        width = self.embedded.shape[1]
        columns = slice(width, None) if space == "input" else slice(0, width)
        return self._moments.columns(columns)

    def discrepancy(self) -> DiscrepancyReport:
        """Return what all pairs say about each entry of x, which is a short vector.

        It needs no simulations beyond those of the candidates.
        """
        return report_discrepancy(
            self.x,
            self.moments("input"),
            self.simulations[1],
            model=self.model,
            weights=self.labels.pair_weights,
            groups=self.groups,
        )

    def pair_weights(self, rows: Tensor) -> Tensor | None:
        """Return how many pairs each of some counts as; None if all pairs are one."""
        return _of_rows(self.labels.pair_weights, rows)

    def parameter_weights(self, rows: Tensor) -> Tensor | None:
        """Return how many draws of parameters each of some pairs counts as."""
        return _of_rows(self.labels.parameter_weights, rows)

    def probability_of_prior(self) -> float:
        """Return the probability that the parameters of all pairs follow the prior.

        It needs no simulations, so that a stack without corrections makes none.
        """
        with seeded(self.seed_of(frozenset())):
            theta = self.npe.prior.sample(torch.Size((NUM_FROM_PRIOR,)))
        return learn_parameters(
            self.rope.labelled_parameters.draws,
            theta.to(self.theta.device),
            weights=self.labels.parameter_weights,
        ).probability_of_prior

    def targets(self, rows: Tensor, seed: int) -> Tensor:
        """Return the targets of tuning on some pairs, computed from these alone."""
        moments = self.moments("embedding")[rows]
        if self.labels.are_exact:
            return moments.mean.to(self.embedded)
        return tuning_targets(
            embed(self.embedding_net, self.x[rows]),
            moments,
            Standardisation(self.embedded.double()),
            weights=self.pair_weights(rows),
            groups=self.groups[rows.cpu()],
            seed=seed,
        )

    def tuned_net(self, folds: frozenset[int]) -> nn.Module:
        """Return an embedding net tuned on some folds, with rehearsal."""
        if folds not in self._nets:
            self._nets[folds] = self.tune(self.rows_of(folds), self.seed_of(folds))
        return self._nets[folds]

    def tune(self, rows: Tensor, seed: int) -> nn.Module:
        """Return an embedding net tuned on some pairs, with rehearsal."""
        _, simulated = self.simulations
        targets = self.targets(rows, seed)
        with without_warning_of_few_pairs():
            return TUNING.finetune(
                self.embedding_net,
                self.x[rows],
                lambda count: targets,
                draw_simulations=lambda count: simulated[:count],
                groups=self.groups[rows.cpu()],
                weights=self.pair_weights(rows),
                seed=seed,
                show_progress_bars=False,
            ).embedding_net


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
        bench, targets = self.bench, None
        # RoPE computes its own targets of exact labels with stored simulations, and
        # with another number of simulations.
        is_usual = bench.rope.finetuner.simulations_per_target == SIMULATIONS_PER_PAIR
        simulates = isinstance(bench.rope.source, Simulator)
        if not bench.labels.are_exact or (simulates and is_usual):
            targets = bench.targets(self.rows, self.seed)
        part = bench.rope.with_pairs(self.rows, targets=targets)
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


def _of_rows(weights: Tensor | None, rows: Tensor) -> Tensor | None:
    return None if weights is None else weights[rows]
