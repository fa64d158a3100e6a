"""Train the candidates of a stack, fold by fold, and have them scored."""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from torch import Tensor

from sbi_rope._progress import is_shown, progress_bar
from sbi_rope._sbi import check_density, estimator_of
from sbi_rope._standardisation import warn_of_far_entries
from sbi_rope._validation import check_default_dtype, check_path, check_prior
from sbi_rope.coupling.coupler import SMALL_BATCH
from sbi_rope.discrepancy import DiscrepancyReport
from sbi_rope.discrepancy.correction import network_of
from sbi_rope.errors import (
    InvalidInputError,
    warn_user,
)
from sbi_rope.mixture import Part
from sbi_rope.recalibration import Recalibration
from sbi_rope.rope import RoPE
from sbi_rope.settings import Count, NotNegative, Range, check
from sbi_rope.stacking.candidates import (
    AmortisedCandidate,
    Candidate,
    CouplingCandidate,
    check_candidates,
)
from sbi_rope.stacking.checkpoints import Checkpoints
from sbi_rope.stacking.couplings import FittedCouplings, fit_couplings
from sbi_rope.stacking.cross_validation import CrossValidation, fold_weights
from sbi_rope.stacking.defaults import default_candidates
from sbi_rope.stacking.folds import Fold
from sbi_rope.stacking.recalibrating import pairs_of_folds, recalibration_of
from sbi_rope.stacking.scoring import score_versions
from sbi_rope.stacking.trained_candidates import (
    DiscrepancyCandidate,
    FinetunedCandidate,
)
from sbi_rope.stacking.unlabelled_candidates import RVNPCandidate
from sbi_rope.stacking.versions import Versions, train_version
from sbi_rope.stacking.workbench import NUM_FOLDS, Workbench, check_pairs, draw_seeds
from sbi_rope.stacking.workers import check_sendable, train_versions
from sbi_rope.tensors import as_batch

__all__ = ["StackTrainer"]

# A recalibration leaves out candidates with a smaller weight in all folds.
MIN_WEIGHT = 0.01


class StackTrainer:
    """Trains and scores all candidates. The arguments are those of :func:`stack`."""

    def __init__(
        self,
        rope: RoPE,
        x_o: Tensor | None,
        *,
        candidates: Sequence[Candidate] | None,
        num_folds: int | None,
        num_simulations: int | None,
        pseudo_count: float,
        require_convergence: bool,
        seed: int | None,
        num_workers: int,
        checkpoints: str | Path | None,
        show_progress_bars: bool | None,
        unseen: Literal["raise", "extend"] = "raise",
        tail_mass: float = 1e-3,
    ) -> None:
        check_default_dtype()
        check("rope", rope, RoPE)
        if num_folds is not None:
            check("num_folds", num_folds, Annotated[int, Range(2)])
        if num_simulations is not None:
            check("num_simulations", num_simulations, Count)
        check("pseudo_count", pseudo_count, NotNegative)
        check("require_convergence", require_convergence, bool)
        check("num_workers", num_workers, Annotated[int, Range(1, 1000)])
        if checkpoints is not None and seed is None:
            raise InvalidInputError(
                "Expected a `seed` together with `checkpoints`, so that the same call "
                "finds again what it has trained; got None. Pass a number, such as "
                "seed=0."
            )
        self.x_o = None if x_o is None else _checked_observations(x_o, rope)
        self.show = is_shown(show_progress_bars)
        self.seeds = draw_seeds(seed, 3)
        self.bench = Workbench(
            rope,
            num_folds=NUM_FOLDS if num_folds is None else num_folds,
            seed=self.seeds[0],
            show_progress_bars=self.show,
        )
        check_pairs(len(self.bench.folds))
        check_prior(self.prior)
        check_density(
            estimator_of(self.bench.npe),
            what="a RoPE of a posterior",
            because="candidates are scored by the density of held-out parameters",
        )
        self.candidates = self._chosen(candidates)
        if self.x_o is not None:
            _warn_of_small_batch(len(self.x_o), len(self.bench.x))
        if num_workers > 1:
            check_sendable(_amortised(self.candidates), self.bench)
        self._folder = check_path("checkpoints", checkpoints, optional=True)
        self.num_simulations = num_simulations
        self.pseudo_count = pseudo_count
        self.require_convergence = require_convergence
        self.num_workers = num_workers
        self.unseen: Literal["raise", "extend"] = unseen
        self.tail_mass = tail_mass

    @property
    def prior(self) -> Any:
        """The prior NPE was trained with."""
        return self.bench.npe.prior

    def _chosen(self, candidates: Sequence[Candidate] | None) -> tuple[Candidate, ...]:
        if candidates is None:
            chosen = default_candidates(x_o=self.x_o, couplings=self.x_o is not None)
            return tuple(
                candidate
                for candidate in chosen
                if not isinstance(candidate, AmortisedCandidate)
                or candidate.applies_to(self.bench)
            )
        chosen = check_candidates(candidates)
        corrected = [
            candidate
            for candidate in chosen
            if isinstance(
                candidate, DiscrepancyCandidate | FinetunedCandidate | RVNPCandidate
            )
        ]
        if any(candidate.space == "input" for candidate in corrected):
            # Raises for images and series, before any candidate is trained.
            network_of(estimator_of(self.bench.npe), "input")
            as_batch("x", self.bench.x)
            as_batch("x of simulations", self.bench.simulations[1])
        coupled = any(isinstance(c, CouplingCandidate) for c in chosen)
        if coupled and self.x_o is None:
            raise InvalidInputError(
                "Expected `x_o`, a batch of observations, with couplings among the "
                "candidates; got None. Pass it, or leave them out."
            )
        if not coupled and self.x_o is not None:
            raise InvalidInputError(
                "Expected couplings among the candidates with `x_o`; got none, so that "
                "the stack is for any observation. Leave `x_o` out of this call, also "
                "if RVNP learns from it, or add couplings, such as those of "
                "`default_candidates(couplings=True)`."
            )
        return chosen

    @torch.enable_grad()  # in case the caller has switched gradients off
    def cross_validate(
        self, *, num_training_folds: int | None = None, with_refit: bool = False
    ) -> tuple[Versions, CrossValidation]:
        """Train on the folds that follow each fold, and score on the fold itself.

        Args:
            num_training_folds: The number of folds to train on; all others if None.
            with_refit: Whether to add a version that is trained on all pairs. This
                version is not scored.
        """
        bench = self.bench
        num_folds = len(bench.folds)
        if num_training_folds is None:
            num_training_folds = num_folds - 1
        check("num_training_folds", num_training_folds, Count)
        if num_training_folds >= num_folds:
            raise InvalidInputError(
                f"Expected `num_training_folds` below the number of folds, {num_folds};"
                f" got {num_training_folds}."
            )
        folds = [
            Fold(bench, [(k + 1 + j) % num_folds for j in range(num_training_folds)])
            for k in range(num_folds)
        ]
        if with_refit:
            folds.append(Fold(bench, range(num_folds)))
        versions = self._train(folds, self.candidates)
        scores = score_versions(
            bench,
            versions,
            self.candidates,
            num_training_folds=num_training_folds,
            pseudo_count=self.pseudo_count,
            seed=self.seeds[2],
        )
        return versions, scores

    @torch.enable_grad()  # in case the caller has switched gradients off
    def recalibration(self, scores: CrossValidation) -> Recalibration:
        """Train without pairs of folds, and tell how wide the stack should be.

        Args:
            scores: The result of :meth:`cross_validate`.
        """
        bench = self.bench
        pairs = pairs_of_folds(len(bench.folds))
        numbers = set(range(len(bench.folds)))
        weights = fold_weights(
            scores.log_scores,
            scores.fold,
            self.pseudo_count,
            pair_weights=bench.labels.score_weights,
        )
        # The others take as long to train, and hardly change how wide the stack is.
        kept = (weights >= MIN_WEIGHT).any(dim=0).nonzero().flatten()
        versions = self._train(
            [Fold(bench, sorted(numbers - pair)) for pair in pairs],
            [self.candidates[number] for number in kept],
        )
        weights = weights[:, kept] / weights[:, kept].sum(dim=1, keepdim=True)
        return recalibration_of(bench, versions, pairs, weights, seed=self.seeds[2])

    @cached_property
    def _fixed(self) -> dict[str, list[Part]]:
        """The densities of the candidates that do not depend on the pairs."""
        return train_version(
            _amortised(self.candidates, fixed=True),
            Fold(self.bench, [0]),
            checkpoints=self._checkpoints,
        )

    @cached_property
    def _checkpoints(self) -> Checkpoints | None:
        """Where trained candidates are kept, if anywhere."""
        if self._folder is None:
            return None
        return Checkpoints(self._folder, self.candidates, self.bench, self.seeds)

    def discrepancy(self) -> DiscrepancyReport | None:
        """Return what the pairs say about each entry of x, if a candidate uses it."""
        corrected = (DiscrepancyCandidate, FinetunedCandidate)
        spaces = (c.space for c in self.candidates if isinstance(c, corrected))
        if any(space is not None for space in spaces) and self.bench.compares_entries:
            return self.bench.discrepancy()
        return None

    @property
    def learns_prior(self) -> bool:
        """Whether a candidate learns from the pairs how parameters are distributed."""
        return any(candidate.learns_prior for candidate in _amortised(self.candidates))

    def _train(self, folds: Sequence[Fold], chosen: Sequence[Candidate]) -> Versions:
        names = [candidate.name for candidate in chosen]
        # These come first, because they show the progress of their own training, and
        # because what a user passed to them may be refused.
        fixed = {name: of for name, of in self._fixed.items() if name in names}
        coupled = [c for c in chosen if isinstance(c, CouplingCandidate)]
        if any(candidate.tuned for candidate in coupled):
            # Couplings need the tuned nets here, and other candidates may too. In a
            # process of their own these would tune again.
            for fold in folds:
                _ = fold.rope
        trained = _amortised(chosen)
        with progress_bar(
            show=self.show,
            desc=f"Training {len(trained)} candidates in {len(folds)} folds",
            total=len(trained) * len(folds),
        ) as bar:
            versions = train_versions(
                trained,
                folds,
                num_workers=self.num_workers,
                checkpoints=self._checkpoints,
                advance=bar.update,
            )
        couplings: FittedCouplings | None = None
        if coupled:
            assert self.x_o is not None
            couplings = fit_couplings(
                coupled,
                folds,
                self.x_o,
                num_simulations=self.num_simulations,
                seed=self.seeds[1],
                unseen=self.unseen,
                require_convergence=self.require_convergence,
                show_progress_bars=self.show,
            )
        return Versions(
            names=tuple(names),
            fixed=fixed,
            trained=versions,
            couplings=couplings,
            tail_mass=self.tail_mass,
        )


def _amortised(
    candidates: Sequence[Candidate], *, fixed: bool = False
) -> list[AmortisedCandidate]:
    """Return the candidates that are trained in each version, or once if fixed."""
    return [
        candidate
        for candidate in candidates
        if isinstance(candidate, AmortisedCandidate) and candidate.fixed == fixed
    ]


def _warn_of_small_batch(num_observed: int, num_pairs: int) -> None:
    if num_observed + num_pairs < SMALL_BATCH:
        warn_user(
            f"{num_observed} real observation(s) are coupled together with those of "
            f"{num_pairs} calibration pairs. These few decide how much weight each "
            f"simulation gets. Use at least {SMALL_BATCH} together, or leave out "
            "couplings: `stack(rope)`."
        )


def _checked_observations(x_o: Tensor, rope: RoPE) -> Tensor:
    x_o = rope.checked_observations(x_o)
    warn_of_far_entries("x_o", x_o, rope.embedding_net)
    return x_o
