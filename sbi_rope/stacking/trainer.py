"""Train the candidates of a stack and score them, fold by fold."""

from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from sbi_rope._progress import is_shown, progress_bar
from sbi_rope._sbi import ConditionalDensityEstimator, estimator_of
from sbi_rope._standardisation import warn_of_far_entries
from sbi_rope._units import log_units_of
from sbi_rope._validation import (
    check_gradients,
    check_instance,
    check_integer,
    check_not_negative,
)
from sbi_rope.discrepancy import DiscrepancyReport
from sbi_rope.discrepancy.correction import network_of
from sbi_rope.errors import (
    InvalidInputError,
    NotReadyError,
    UnsupportedPosteriorError,
    warn_user,
)
from sbi_rope.mixture import MixturePosterior
from sbi_rope.recalibration import Recalibration
from sbi_rope.rope import HOW_TO_MAKE, RoPE
from sbi_rope.stacking.candidates import (
    AmortisedCandidate,
    Candidate,
    CouplingCandidate,
    check_candidates,
)
from sbi_rope.stacking.couplings import FittedCouplings, fit_couplings
from sbi_rope.stacking.cross_validation import CrossValidation, fold_weights
from sbi_rope.stacking.defaults import default_candidates
from sbi_rope.stacking.folds import NUM_FOLDS, Fold, Workbench, draw_seeds
from sbi_rope.stacking.held_out import (
    FoldScores,
    SetScores,
    joined,
    one_of_each_group,
    score_fold,
)
from sbi_rope.stacking.label_scores import (
    LabelScores,
    score_labelled_fold,
    score_labels,
)
from sbi_rope.stacking.recalibrating import pairs_of_folds, recalibration_of
from sbi_rope.stacking.trained_candidates import (
    DiscrepancyCandidate,
    FinetunedCandidate,
)
from sbi_rope.stacking.versions import Versions, train_version

__all__ = ["StackTrainer"]

# Fewest pairs: one to train on and one to score.
MIN_PAIRS = 2
# A recalibration leaves out candidates with a smaller weight in all folds.
MIN_WEIGHT = 0.01
# Samples at each held-out pair, from which the calibration of the stack is computed.
NUM_SAMPLES = 500


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
        show_progress_bars: bool | None,
        unseen: Literal["raise", "extend"] = "raise",
        tail_mass: float = 1e-3,
    ) -> None:
        check_gradients()
        check_instance("rope", rope, RoPE, hint=HOW_TO_MAKE)
        if num_folds is not None:
            check_integer("num_folds", num_folds, minimum=2)
        if num_simulations is not None:
            check_integer("num_simulations", num_simulations)
        check_not_negative("pseudo_count", pseudo_count)
        check_instance("require_convergence", require_convergence, bool)
        _check_pairs(len(rope.calibration[0]))
        self.x_o = None if x_o is None else _checked_observations(x_o, rope)
        self.show = is_shown(show_progress_bars)
        self.seeds = draw_seeds(seed, 3)
        self.bench = Workbench(
            rope,
            num_folds=NUM_FOLDS if num_folds is None else num_folds,
            seed=self.seeds[0],
            show_progress_bars=self.show,
        )
        _check_pairs(len(self.bench.folds))
        _check_density(estimator_of(self.bench.npe))
        self.candidates = self._chosen(candidates)
        self.num_simulations = num_simulations
        self.pseudo_count = pseudo_count
        self.require_convergence = require_convergence
        self.unseen: Literal["raise", "extend"] = unseen
        self.tail_mass = tail_mass

    @property
    def prior(self) -> Any:
        """The prior NPE was trained with."""
        return self.bench.npe.prior

    def _chosen(self, candidates: Sequence[Candidate] | None) -> tuple[Candidate, ...]:
        if candidates is None:
            chosen = default_candidates(couplings=self.x_o is not None)
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
            if isinstance(candidate, DiscrepancyCandidate | FinetunedCandidate)
        ]
        if any(candidate.space == "input" for candidate in corrected):
            # Raises for images and series, before any candidate is trained.
            network_of(estimator_of(self.bench.npe), "input")
        coupled = any(isinstance(c, CouplingCandidate) for c in chosen)
        if coupled and self.x_o is None:
            raise InvalidInputError(
                "Expected `x_o`, a batch of observations, with couplings among the "
                "candidates; got None. Pass it, or leave them out."
            )
        if not coupled and self.x_o is not None:
            raise InvalidInputError(
                "Expected couplings among the candidates with `x_o`; got none, so that "
                "nothing depends on the batch. Leave `x_o` out, or add couplings, "
                "such as those of `default_candidates(couplings=True)`."
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
        check_integer("num_training_folds", num_training_folds)
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
        scores = self._score(versions, num_training_folds)
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
            pair_weights=bench.score_weights,
        )
        # The others take as long to train, and hardly change how wide the stack is.
        kept = (weights >= MIN_WEIGHT).any(dim=0).nonzero().flatten()
        versions = self._train(
            [Fold(bench, sorted(numbers - pair)) for pair in pairs],
            [self.candidates[number] for number in kept],
        )
        weights = weights[:, kept] / weights[:, kept].sum(dim=1, keepdim=True)
        return recalibration_of(bench, versions, pairs, weights, seed=self.seeds[2])

    def discrepancy(self) -> DiscrepancyReport | None:
        """Return what the pairs say about each entry of x, if a candidate uses it."""
        corrected = (DiscrepancyCandidate, FinetunedCandidate)
        spaces = (c.space for c in self.candidates if isinstance(c, corrected))
        if self.bench.has_summaries and any(space is not None for space in spaces):
            return self.bench.discrepancy()
        return None

    def _train(self, folds: Sequence[Fold], chosen: Sequence[Candidate]) -> Versions:
        count = sum(isinstance(c, AmortisedCandidate) and not c.fixed for c in chosen)
        with progress_bar(
            show=self.show,
            desc=f"Training {count} candidates in {len(folds)} folds",
            total=count * len(folds),
        ) as bar:
            trained = tuple(
                train_version(chosen, fold, advance=bar.update) for fold in folds
            )
        couplings: FittedCouplings | None = None
        coupled = [c for c in chosen if isinstance(c, CouplingCandidate)]
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
            names=tuple(candidate.name for candidate in chosen),
            fixed=train_version(chosen, folds[0], fixed=True),
            trained=trained,
            couplings=couplings,
            tail_mass=self.tail_mass,
        )

    def _score(self, versions: Versions, num_training_folds: int) -> CrossValidation:
        bench = self.bench
        of_labels = None
        if not bench.labels.are_exact:
            of_labels = [
                score_labels(bench, versions, number)
                for number in range(len(bench.folds))
            ]
        log_scores, fold = self._log_scores(versions, of_labels)
        weights = fold_weights(
            log_scores, fold, self.pseudo_count, pair_weights=bench.score_weights
        )
        of_stack = self._stack_scores(versions, weights, of_labels)
        num_folds = len(self.bench.folds)
        scores = CrossValidation(
            names=tuple(candidate.name for candidate in self.candidates),
            families=tuple(candidate.family for candidate in self.candidates),
            log_scores=log_scores,
            fold=fold,
            num_trained_on=len(fold) * num_training_folds // num_folds,
            stack_scores=of_stack.log_prob,
            levels=of_stack.levels,
            set_scores=self._set_scores(of_stack, weights),
            pseudo_count=self.pseudo_count,
            log_unit=self._log_unit(),
            pair_weights=bench.score_weights,
            groups=bench.score_groups,
            score_errors=None if bench.labels.are_exact else of_stack.errors,
            labels="" if bench.labels.are_simple else str(bench.labels),
        )
        if not scores.weights.converged:
            warn_user(
                "The weights of the stack have not converged: the held-out score could "
                f"be better by up to {scores.weights.gap / len(fold):.3f} nats a "
                "pair. Leave out candidates that are nearly the same."
            )
        return scores

    def _set_scores(self, of_stack: FoldScores, weights: Tensor) -> SetScores | None:
        """Return what sets with a guarantee are made from; None without exact labels.

        A set that holds a noisy label need not hold the parameters.
        """
        if not self.bench.labels.are_exact:
            return None
        return SetScores(
            joint=of_stack.joint,
            marginal=of_stack.marginal,
            is_counted=one_of_each_group(self.bench.groups, seed=self.seeds[2]).to(
                self.bench.theta.device
            ),
            weights=weights,
            num_draws=NUM_SAMPLES,
        )

    def _log_unit(self) -> float:
        """Return by how much scores are higher in the prior's standard deviations."""
        labels = self.bench.labels
        if labels.samples is not None:
            return 0.0  # these scores are relative to the prior
        units = log_units_of(self.prior)
        if labels.are_exact:
            return float(units.sum())
        known = labels.is_measured.to(units)
        weights = self.bench.score_weights
        weights = labels.weights if weights is None else weights
        shares = weights.to(units) / weights.sum().to(units)
        return float((shares @ known) @ units)

    def _log_scores(
        self, versions: Versions, of_labels: Sequence[LabelScores] | None
    ) -> tuple[Tensor, Tensor]:
        """Return the score of each candidate at each pair, and the folds."""
        bench = self.bench
        theta, x = bench.theta, bench.x
        log_scores = theta.new_empty(
            len(theta), len(self.candidates), dtype=torch.double
        )
        fold = torch.empty(len(theta), dtype=torch.long, device=theta.device)
        log_q = None
        if versions.couplings is not None and of_labels is None:
            # All folds share the same simulations, and so the same components.
            log_q = versions.couplings.component_log_probs(theta)
        for number, rows in enumerate(bench.folds):
            fold[rows] = number
            if of_labels is not None:
                log_scores[rows] = of_labels[number].of_candidates
                continue
            log_scores[rows] = versions.log_probs(
                theta[rows],
                x[rows],
                [number],
                log_q=None if log_q is None else log_q[rows],
            )
        return log_scores, fold

    def _stack_scores(
        self,
        versions: Versions,
        weights: Tensor,
        of_labels: Sequence[LabelScores] | None,
    ) -> FoldScores:
        """Return the scores of the stack at each pair, normalised in the support.

        Args:
            versions: The candidates.
            weights: The weights of the stack that scores each fold, ``(F, K)``.
            of_labels: The densities at labels that are not exact; None if all are.

        Returns:
            The scores, their Monte-Carlo errors (None for exact labels), and the
            levels of the central intervals that end at the labels.
        """
        bench = self.bench
        theta, x = bench.theta, bench.x
        # The couplings are the first part, and have the same simulations in all folds.
        # The mass of the other parts inside the prior can differ from fold to fold.
        masses: dict[int, Tensor] = {}
        of_folds = []
        for number, rows in enumerate(bench.folds):
            shared = dict(masses)
            posterior = MixturePosterior(
                versions.estimator(weights[number], [number]),
                self.prior,
                enable_transform=False,
                shared=shared,
            )
            if of_labels is None:
                scores = score_fold(
                    posterior,
                    theta[rows],
                    x[rows],
                    num_samples=NUM_SAMPLES,
                    seed=self.seeds[2],
                )
            else:
                scores = score_labelled_fold(
                    posterior,
                    of_labels[number],
                    weights[number],
                    bench.labels[rows],
                    x[rows],
                    num_samples=NUM_SAMPLES,
                    seed=self.seeds[2],
                )
            of_folds.append(scores)
            if versions.couplings is not None and 0 in shared:
                masses[0] = shared[0]
        return joined(of_folds, bench.folds)


def _check_pairs(count: int) -> None:
    if count < MIN_PAIRS:
        raise NotReadyError(
            f"Expected at least {MIN_PAIRS} calibration pairs with different "
            f"parameters, to hold some out; got {count}. Call "
            "`append_calibration(theta, x)` first."
        )


def _check_density(estimator: Any) -> None:
    if not isinstance(estimator, ConditionalDensityEstimator):
        raise UnsupportedPosteriorError(
            "Expected a RoPE of a posterior with a density, such as that of NPE, "
            "because candidates are scored by the density of held-out parameters; got "
            f"{type(estimator).__name__}. Please train NPE instead of FMPE or NPSE."
        )


def _checked_observations(x_o: Tensor, rope: RoPE) -> Tensor:
    x_o = rope.checked_observations(x_o)
    warn_of_far_entries("x_o", x_o, rope.embedding_net)
    return x_o
