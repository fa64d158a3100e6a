"""Scores of candidates on calibration pairs that they were not trained on."""

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution
from tqdm.auto import tqdm

from sbi_rope._random import seeded
from sbi_rope._validation import (
    check_choice,
    check_instance,
    check_integer,
    check_not_negative,
)
from sbi_rope.errors import InvalidInputError, NotReadyError
from sbi_rope.metrics.calibration import central_levels
from sbi_rope.metrics.calls import draw_ranks
from sbi_rope.rope import RoPE
from sbi_rope.stacking.candidates import (
    Candidate,
    check_candidates,
    default_candidates,
)
from sbi_rope.stacking.estimator import StackedEstimator
from sbi_rope.stacking.fitting import Components, fit_candidates
from sbi_rope.stacking.posterior import StackedPosterior
from sbi_rope.stacking.weights import StackingWeights, stacking_weights

__all__ = [
    "CrossValidation",
    "Difference",
    "check_setup",
    "cross_validate",
    "score_folds",
]

# Fewest pairs: one to train on and one to score.
MIN_PAIRS = 2
# Five folds, but leave-one-out for so few pairs: a fifth of them would be missed.
NUM_FOLDS, FEW_PAIRS = 5, 10
# Most unlabelled observations that held-out pairs are coupled together with.
MAX_BATCH = 2000
NUM_BOOTSTRAP = 2000
# Samples of each held-out pair behind the calibration of the stack.
NUM_SAMPLES = 500


@dataclass(frozen=True, kw_only=True)
class Difference:
    """A mean difference of log scores, pair by pair, with its 95 % interval.

    Attributes:
        mean: The mean over pairs.
        low: Lower end of the bootstrap interval.
        high: Upper end.
    """

    mean: float
    low: float
    high: float


@dataclass(frozen=True, eq=False, kw_only=True)
class CrossValidation:
    """The scores of candidates on held-out calibration pairs.

    Attributes:
        names: Of the candidates, K of them.
        families: The method each is a setting of.
        log_scores: Log density of the true parameters, shape ``(n, K)``, not corrected
            for leakage.
        fold: The fold of each pair, shape ``(n,)``.
        theta: The parameters of the pairs, shape ``(n, d)``.
        x: Their observations.
        num_trained_on: Pairs that the candidates were trained on, on average, rounded
            down.
        estimators: For each fold, all candidates trained without it, with equal
            weights.
        pseudo_count: As in :func:`stacking_weights`.
    """

    names: tuple[str, ...]
    families: tuple[str, ...]
    log_scores: Tensor
    fold: Tensor
    theta: Tensor
    x: Tensor
    num_trained_on: int
    estimators: tuple[StackedEstimator, ...] = field(repr=False)
    prior: Distribution = field(repr=False)
    pseudo_count: float = 1.0
    shared: dict[int, Tensor] = field(repr=False, default_factory=dict)

    def __len__(self) -> int:
        return len(self.theta)

    @property
    def num_folds(self) -> int:
        """The number of folds."""
        return len(self.estimators)

    @cached_property
    def weights(self) -> StackingWeights:
        """The weights of the candidates, fitted to all pairs."""
        return stacking_weights(self.log_scores, pseudo_count=self.pseudo_count)

    def posteriors(self) -> Iterator[tuple[Tensor, StackedPosterior]]:
        """Yield the rows of each fold, and the stack that was made without it.

        Its candidates have not seen the labels of the fold. Its weights are fitted to
        the scores of the other folds; these come from candidates that have. With few
        pairs the weights depend on the labels of the fold by that.
        """
        for number, estimator in enumerate(self.estimators):
            held_out = self.fold == number
            weights = stacking_weights(
                self.log_scores[~held_out], pseudo_count=self.pseudo_count
            ).weights
            yield (
                held_out.nonzero().flatten(),
                StackedPosterior(
                    copy.deepcopy(estimator).with_weights(weights),
                    copy.deepcopy(self.prior),
                    weights=dict(zip(self.names, weights.tolist(), strict=True)),
                    shared=self.shared,
                ),
            )

    @cached_property
    def stack_scores(self) -> Tensor:
        """Log density of each pair under the stack without its fold, shape ``(n,)``.

        As the stack's ``log_prob``: normalised inside the support of the prior.
        """
        scores = self.log_scores.new_empty(len(self))
        for rows, posterior in self.posteriors():
            theta, x = self.theta[rows], self.x[rows]
            scores[rows] = posterior.log_prob_batched(theta[None], x)[0].double()
        return scores

    def levels(self, *, num_samples: int = NUM_SAMPLES, seed: int = 0) -> Tensor:
        """Return the levels of central intervals that end at the true parameters.

        Under the stack that has not seen the pair; uniform if it is calibrated.

        Args:
            num_samples: Posterior samples for each pair.
            seed: Seed of the samples.

        Returns:
            Shape ``(n, d)``, as :func:`sbi_rope.metrics.central_levels`.
        """
        levels = torch.empty_like(self.theta)
        with seeded(seed):
            for rows, posterior in self.posteriors():
                ranks = draw_ranks(
                    posterior,
                    self.theta[rows],
                    self.x[rows],
                    num_samples=num_samples,
                    chunk_size=500,
                    show=False,
                )
                levels[rows] = central_levels(ranks).to(levels)
        return levels

    def scores_of(self, name: str) -> Tensor:
        """Return the log scores of a candidate, or of "stack", shape ``(n,)``.

        None is corrected for leakage, so that they can be compared.

        Raises:
            InvalidInputError: If there is no candidate of that name.
        """
        if name == "stack":
            scores = self.log_scores.new_empty(len(self))
            for rows, posterior in self.posteriors():
                weights = scores.new_tensor(list(posterior.candidate_weights.values()))
                scores[rows] = torch.logsumexp(
                    self.log_scores[rows] + weights.log(), dim=1
                )
            return scores
        check_choice("name", name, (*self.names, "stack"))
        return self.log_scores[:, self.names.index(name)]

    def difference(self, name: str, other: str, *, seed: int = 0) -> Difference:
        """Return by how much one candidate scores higher than another.

        Args:
            name: A candidate, or "stack".
            other: Another.
            seed: Seed of the bootstrap over pairs.

        Raises:
            InvalidInputError: If there is no candidate of that name.
        """
        difference = self.scores_of(name) - self.scores_of(other)
        # Where both are minus infinity, neither is better.
        difference = difference.nan_to_num(nan=0.0, posinf=torch.inf, neginf=-torch.inf)
        with seeded(seed):
            rows = torch.randint(len(difference), (NUM_BOOTSTRAP, len(difference)))
        means = difference[rows.to(difference.device)].mean(dim=1).sort().values
        margin = int(0.025 * NUM_BOOTSTRAP)
        return Difference(
            mean=float(difference.mean()),
            low=float(means[margin]),
            high=float(means[-1 - margin]),
        )

    def as_rows(self) -> list[dict[str, Any]]:
        """Return a row for each candidate: name, family, weight, score and error."""
        scores = self.log_scores
        errors = scores.std(dim=0, correction=1) / len(self) ** 0.5
        return [
            {
                "candidate": name,
                "family": family,
                "weight": weight,
                "score": score,
                "standard_error": error,
            }
            for name, family, weight, score, error in zip(
                self.names,
                self.families,
                self.weights.weights.tolist(),
                scores.mean(dim=0).tolist(),
                errors.tolist(),
                strict=True,
            )
        ]


def cross_validate(
    rope: RoPE,
    x_o: Tensor,
    *,
    candidates: Sequence[Candidate] | None = None,
    num_folds: int | None = None,
    num_training_folds: int | None = None,
    num_simulations: int | None = None,
    pseudo_count: float = 1.0,
    seed: int | None = None,
    show_progress_bars: bool = True,
) -> CrossValidation:
    """Score candidates on calibration pairs that they were not trained on.

    For each fold everything is trained on the pairs of other folds. The held-out
    observations, without their labels, are coupled together with the batch (of more
    than 2000 observations with a random part of it), as the observations to be inferred
    are.

    Args:
        rope: RoPE with its calibration pairs; it is left as it is.
        x_o: The batch of real observations to be inferred, shape ``(n_o, *event)``.
        candidates: What to score; ``default_candidates()`` if None.
        num_folds: Folds, at most as many as there are pairs; 5 if None, leave-one-out
            of up to 10 pairs.
        num_training_folds: Folds to train on for each held out; all others if None.
            Fewer tell what fewer pairs would have given.
        num_simulations: As in :meth:`~sbi_rope.RoPE.build_posterior`.
        pseudo_count: As in :func:`stacking_weights`.
        seed: Seed of everything random; None uses the states of torch, NumPy and
            Python.
        show_progress_bars: Whether to show the folds done.

    Returns:
        The scores, pair by candidate.

    Raises:
        NotReadyError: If there are fewer than two calibration pairs.
        InvalidInputError: If an argument is outside its range or has the wrong shape.
        UnsupportedPosteriorError: If a candidate has no density.
        SimulationError: If the simulator fails.
    """
    chosen, seeds = check_setup(rope, candidates, num_folds, pseudo_count, seed)
    components = Components.of(
        rope,
        x_o,
        chosen,
        num_simulations=num_simulations,
        seed=seeds[0],
        show_progress_bars=show_progress_bars,
    )
    return score_folds(
        rope,
        components,
        chosen,
        num_folds=num_folds,
        num_training_folds=num_training_folds,
        pseudo_count=pseudo_count,
        seed=seeds[1],
        show_progress_bars=show_progress_bars,
    )


def check_setup(
    rope: RoPE,
    candidates: Sequence[Candidate] | None,
    num_folds: int | None,
    pseudo_count: float,
    seed: int | None,
) -> tuple[tuple[Candidate, ...], list[int]]:
    """Return the candidates, couplings first, and seeds for all that is random."""
    check_instance("rope", rope, RoPE)
    if num_folds is not None:
        check_integer("num_folds", num_folds, minimum=2)
    check_not_negative("pseudo_count", pseudo_count)
    num_pairs = len(rope.calibration[0])
    if num_pairs < MIN_PAIRS:
        raise NotReadyError(
            f"Expected at least {MIN_PAIRS} calibration pairs to hold some out; got "
            f"{num_pairs}. Call `append_calibration(theta, x)` first."
        )
    chosen = check_candidates(
        default_candidates() if candidates is None else candidates
    )
    return chosen, draw_seeds(seed, 3)


def draw_seeds(seed: int | None, count: int) -> list[int]:
    """Return seeds that follow from one, or from torch's state."""
    with seeded(seed):
        return torch.randint(2**31, (count,)).tolist()


def score_folds(
    rope: RoPE,
    components: Components,
    candidates: tuple[Candidate, ...],
    *,
    num_folds: int | None,
    num_training_folds: int | None = None,
    pseudo_count: float,
    seed: int,
    show_progress_bars: bool,
) -> CrossValidation:
    """Train on the folds after each fold, and score on it; see :func:`cross_validate`.

    What a fold is scored with depends on its observations, but not on its labels.
    """
    theta, x = rope.calibration
    if num_folds is None:
        num_folds = FEW_PAIRS if len(theta) <= FEW_PAIRS else NUM_FOLDS
    num_folds = min(num_folds, len(theta))
    if num_training_folds is None:
        num_training_folds = num_folds - 1
    check_integer("num_training_folds", num_training_folds)
    if num_training_folds >= num_folds:
        raise InvalidInputError(
            f"Expected `num_training_folds` below the number of folds, {num_folds}; "
            f"got {num_training_folds}."
        )
    seeds = draw_seeds(seed, 2 * num_folds + 1)
    with seeded(seeds[-1]):
        order = torch.randperm(len(theta))
        batch = components.x_o[torch.randperm(len(components.x_o))[:MAX_BATCH]]
    folds = [part.to(theta.device) for part in order.tensor_split(num_folds)]
    # Each fold with a seed of its own: the targets of the others know nothing of it.
    targets = [
        rope.draw_targets(rows, seed=fold_seed, show_progress_bars=False)
        for rows, fold_seed in zip(folds, seeds, strict=False)
    ]
    bar = tqdm(range(num_folds), desc="Folds", disable=not show_progress_bars)
    fold = torch.empty(len(theta), dtype=torch.long, device=theta.device)
    log_q, log_scores, estimators = None, None, []
    for number in bar:
        used = [(number + 1 + j) % num_folds for j in range(num_training_folds)]
        part = rope.with_pairs(
            torch.cat([folds[j] for j in used]),
            targets=torch.cat([targets[j] for j in used]),
        ).train(seed=seeds[num_folds + number], show_progress_bars=False)
        rows = folds[number]
        estimator = fit_candidates(
            candidates,
            part,
            torch.cat([x[rows], batch]),
            components,
            seed=seeds[num_folds + number],
        )
        if log_q is None or log_scores is None:
            # The components are the same in all folds.
            log_q = estimator.component_log_probs(theta)
            log_scores = log_q.new_empty(
                len(theta), len(candidates), dtype=torch.double
            )
        log_scores[rows] = estimator.candidate_log_probs(
            theta[rows], x[rows], log_q=log_q[rows]
        )
        fold[rows] = number
        estimators.append(estimator)
    assert log_scores is not None
    return CrossValidation(
        names=tuple(candidate.name for candidate in candidates),
        families=tuple(candidate.family for candidate in candidates),
        log_scores=log_scores,
        fold=fold,
        theta=theta,
        x=x,
        num_trained_on=len(theta) * num_training_folds // num_folds,
        estimators=tuple(estimators),
        prior=components.prior,
        pseudo_count=pseudo_count,
    )
