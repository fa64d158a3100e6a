"""What all candidates of a stack share: folds, simulations, moments and tuned nets."""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from sbi_rope._groups import split_groups
from sbi_rope._labels import labelled_moments
from sbi_rope._random import seeded
from sbi_rope._sbi import embed
from sbi_rope._standardisation import Standardisation
from sbi_rope._training import without_warning_of_few_pairs
from sbi_rope.discrepancy.correction import Space
from sbi_rope.discrepancy.model import DiscrepancyModel
from sbi_rope.discrepancy.parameters import learn_parameters
from sbi_rope.discrepancy.report import DiscrepancyReport, report_discrepancy
from sbi_rope.discrepancy.targets import tuning_targets
from sbi_rope.discrepancy.tuning import TUNING
from sbi_rope.errors import NotReadyError
from sbi_rope.finetuning import CalibrationFinetuner
from sbi_rope.rope import RoPE
from sbi_rope.simulate import Moments, Simulator

__all__ = ["Workbench", "check_pairs", "draw_seeds"]

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


def draw_seeds(seed: int | None, count: int) -> list[int]:
    """Return seeds that follow from one seed, or from torch's state if it is None."""
    with seeded(seed):
        return torch.randint(2**31, (count,)).tolist()


def check_pairs(count: int) -> None:
    """Raise unless there are enough pairs, or groups of pairs, to hold some out."""
    if count < MIN_PAIRS:
        raise NotReadyError(
            f"Expected at least {MIN_PAIRS} calibration pairs with different "
            f"parameters (or groups), to hold some out; got {count}. Append "
            f"{'more' if count else 'some'} with `append_calibration(theta, x)` first."
        )


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
        NotReadyError: If there are fewer than two pairs.
    """

    def __init__(
        self,
        rope: RoPE,
        *,
        num_folds: int,
        seed: int,
        show_progress_bars: bool,
    ) -> None:
        check_pairs(len(rope.calibration[0]))
        self.rope = rope
        self.show = show_progress_bars
        self.theta, self.x = rope.calibration
        self.labels = rope.labels
        self.groups = self.labels.groups
        self.model = DiscrepancyModel()
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

    def has_targets_of(self, finetuner: CalibrationFinetuner) -> bool:
        """Whether the moments of the pairs hold the targets of a finetuner.

        Of exact labels, RoPE computes its own targets with stored simulations, and with
        another number of simulations.
        """
        if not self.labels.are_exact:
            return True
        is_usual = finetuner.simulations_per_target == SIMULATIONS_PER_PAIR
        return isinstance(self.rope.source, Simulator) and is_usual

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


def _of_rows(weights: Tensor | None, rows: Tensor) -> Tensor | None:
    return None if weights is None else weights[rows]
