"""Make a stack from a RoPE with calibration pairs, in one call."""

import time
from collections.abc import Sequence
from typing import Annotated

import torch
from torch import Tensor

from sbi_rope._progress import is_shown, progress_bar
from sbi_rope._random import seeded
from sbi_rope._sbi import check_density, embed, estimator_of
from sbi_rope._standardisation import warn_of_far_entries
from sbi_rope._two_sample import TwoSampleTest, compare_with_pairs
from sbi_rope.discrepancy import DiscrepancyReport
from sbi_rope.errors import InvalidInputError, warn_user
from sbi_rope.mixture import Part
from sbi_rope.rope import RoPE
from sbi_rope.settings import Count, Range, check
from sbi_rope.stacking.candidates import (
    Candidate,
    checked_candidates,
    suitable_candidates,
)
from sbi_rope.stacking.cross_validation import CrossValidation, LearningCurve
from sbi_rope.stacking.posterior import StackedPosterior
from sbi_rope.stacking.report import Provenance, StackingReport
from sbi_rope.stacking.scoring import score_versions
from sbi_rope.stacking.versions import Versions
from sbi_rope.stacking.workbench import NUM_FOLDS, Fold, Workbench, draw_seeds

__all__ = ["cross_validate", "stack"]

# The learning curve trains on these shares of the folds, and on all folds but one.
SMALLER = (0.25, 0.5)


def stack(
    rope: RoPE,
    x_o: Tensor | None = None,
    *,
    candidates: Sequence[Candidate] | None = None,
    num_folds: int | None = None,
    learning_curve: bool = False,
    seed: int | None = None,
    show_progress_bars: bool | None = None,
) -> StackedPosterior:
    r"""Mix candidate posteriors with the weights that score best on held-out pairs.

    The calibration pairs are divided into folds. Every candidate is trained without
    each fold and scored on that fold, and the posterior is the mixture of the
    candidates with the weights that score best
    (:func:`~sbi_rope.stacking.stacking_weights`). It answers any x.

    The stack is made of the models that were scored. Each candidate is the average of
    its versions: one for each fold, trained on the other folds, and one trained on all
    pairs. The held-out score is that of single versions. By Jensen's inequality their
    average has a higher expected score, for observations like those of the pairs. The
    version trained on all pairs is not scored.

    The weights, the scores and the calibration in the report hold for observations like
    those of the pairs. With ``x_o`` the two are compared by an energy test of their
    embeddings, and a p-value below 0.01 gives a warning. Without it,
    :func:`~sbi_rope.diagnose` makes the same comparison.

    Args:
        rope: A RoPE with calibration pairs. It need not be trained, and it is not
            changed, except that it counts calls of the simulator, and the simulations
            that are dropped.
        x_o: Real observations without labels, shape ``(n_o, *event)``, other than those
            of the pairs. If there are a hundred of at most 20 statistics, the default
            candidates have RVNP among them, which learns from ``x_o``.
        candidates: What to stack;
            :func:`default_candidates(rope, x_o)
            <sbi_rope.stacking.default_candidates>` if None: the prior, NPE, fine-tuned
            NPE and discrepancy models.
        num_folds: The number of folds, 5 if None, and at most the number of groups.
            Pairs with equal labels, or of the same of the ``groups`` that were
            appended, are in the same fold.
        learning_curve: Whether to train on fewer folds too, so that the report can
            estimate what more labels would add. It takes about twice the time.
        seed: Seed of everything random; None uses the states of torch, NumPy and
            Python.
        show_progress_bars: Whether to show how many trainings and scores are done.
            None does so in a terminal or a notebook, but not in a file.

    Returns:
        The stack, an sbi posterior. Its ``report`` holds the held-out scores, and
        compares the stack with the prior and with NPE.

    Raises:
        NotReadyError: If there are fewer than two groups of pairs.
        InvalidInputError: If an argument is outside its range or has the wrong shape,
            or if entries of x are missing (NaN) that a candidate with
            ``space="input"`` corrects.
        UnsupportedPosteriorError: If NPE or a candidate has no density.
        SamplingError: If the candidates have almost no mass inside the support of the
            prior at a held-out observation.
        SimulationError: If the simulator fails.
    """
    check("learning_curve", learning_curve, bool)
    trainer = _Trainer(
        rope, x_o, candidates, num_folds, seed, show=is_shown(show_progress_bars)
    )
    start, calls = time.perf_counter(), rope.num_simulator_calls
    bench = trainer.bench
    # This comes first, so that nobody waits for the training to hear of it.
    batch = None if trainer.x_o is None else _compare_batch(bench, trainer.x_o)
    versions, scores = trainer.cross_validate(with_refit=True)
    curve = None
    if learning_curve:
        wanted = [int(share * scores.num_folds) for share in SMALLER]
        smaller = [
            trainer.cross_validate(num_training_folds=count)[1]
            for count in dict.fromkeys(wanted)
            if 1 <= count < scores.num_folds - 1
        ]
        curve = LearningCurve.of([*smaller, scores])
    report = StackingReport.of(
        scores,
        curve,
        batch=batch,
        discrepancy=trainer.discrepancy(),
        probability_of_prior=bench.probability_of_prior(),
        learns_prior=any(
            one.learns_prior and not one.fixed for one in trainer.candidates
        ),
        parameter_names=rope.parameter_names,
        provenance=Provenance.since(
            start, seed=seed, num_simulator_calls=rope.num_simulator_calls - calls
        ),
    )
    posterior = StackedPosterior(
        versions,
        bench.npe.prior,
        report=report,
        enable_transform=bench.npe.enable_transform,
    )
    posterior.parameter_names = rope.parameter_names
    posterior.x_names = rope.x_names
    return posterior


def cross_validate(
    rope: RoPE,
    x_o: Tensor | None = None,
    *,
    candidates: Sequence[Candidate] | None = None,
    num_folds: int | None = None,
    num_training_folds: int | None = None,
    seed: int | None = None,
    show_progress_bars: bool | None = None,
) -> CrossValidation:
    """Score candidates on calibration pairs that they were not trained on.

    Args:
        rope: As in :func:`stack`.
        x_o: As in :func:`stack`.
        candidates: As in :func:`stack`.
        num_folds: As in :func:`stack`.
        num_training_folds: The number of folds to train on for each held-out fold;
            all others if None. A smaller number shows how the candidates would score
            with fewer pairs.
        seed: As in :func:`stack`.
        show_progress_bars: As in :func:`stack`.

    Returns:
        The score of each candidate at each pair. It raises what :func:`stack` does.
    """
    trainer = _Trainer(
        rope, x_o, candidates, num_folds, seed, show=is_shown(show_progress_bars)
    )
    return trainer.cross_validate(num_training_folds=num_training_folds)[1]


class _Trainer:
    """Trains and scores all candidates. The arguments are those of :func:`stack`."""

    def __init__(
        self,
        rope: RoPE,
        x_o: Tensor | None,
        candidates: Sequence[Candidate] | None,
        num_folds: int | None,
        seed: int | None,
        *,
        show: bool,
    ) -> None:
        check("rope", rope, RoPE)
        num_folds = NUM_FOLDS if num_folds is None else num_folds
        check("num_folds", num_folds, Annotated[int, Range(2)])
        if x_o is not None:
            x_o = rope.checked_observations(x_o)
            warn_of_far_entries("x_o", x_o, rope.embedding_net)
        self.x_o = x_o
        # The second one is not used, and leaves the third as it is.
        of_folds, _, self.seed = draw_seeds(seed, 3)
        self.bench = Workbench(
            rope,
            num_folds=num_folds,
            seed=of_folds,
            show_progress_bars=show,
        )
        check_density(
            estimator_of(self.bench.npe),
            what="a RoPE of a posterior",
            because="candidates are scored by the density of held-out parameters",
        )
        if candidates is None:
            self.candidates = suitable_candidates(self.bench, x_o)
        else:
            self.candidates = checked_candidates(candidates, self.bench)
        self._fixed: dict[str, list[Part]] = {}

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
        bench, num_folds = self.bench, len(self.bench.folds)
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
        versions = self._train(folds)
        scores = score_versions(
            bench,
            versions,
            self.candidates,
            num_training_folds=num_training_folds,
            seed=self.seed,
        )
        return versions, scores

    def _train(self, folds: Sequence[Fold]) -> Versions:
        # These come first, because they show the progress of their own training, and
        # because what a user passed to them may be refused.
        for candidate in self.candidates:
            if candidate.fixed and candidate.name not in self._fixed:
                fold = Fold(self.bench, [0])
                self._fixed[candidate.name] = _trained(candidate, fold)
        others = [candidate for candidate in self.candidates if not candidate.fixed]
        versions = []
        with progress_bar(
            show=self.bench.show,
            desc=f"Training {len(others)} candidates in {len(folds)} folds",
            total=len(others) * len(folds),
        ) as bar:
            for fold in folds:
                version = {}
                for candidate in others:
                    version[candidate.name] = _trained(candidate, fold)
                    bar.update()
                versions.append(version)
        return Versions(
            names=tuple(candidate.name for candidate in self.candidates),
            fixed=self._fixed,
            trained=tuple(versions),
        )

    def discrepancy(self) -> DiscrepancyReport | None:
        """Return what the pairs say about each entry of x, if a candidate uses it."""
        is_used = any(
            "discrepancy" in candidate.family for candidate in self.candidates
        )
        if is_used and self.bench.compares_entries:
            return self.bench.discrepancy()
        return None


def _trained(candidate: Candidate, fold: Fold) -> list[Part]:
    # A candidate that ignores its seed still does not change the caller's random state.
    with seeded(fold.seed):
        parts = list(candidate.parts(fold))
    if not parts:
        raise InvalidInputError(
            f"Expected at least one density of {candidate.name!r}; got none."
        )
    return parts


def _compare_batch(bench: Workbench, x_o: Tensor) -> TwoSampleTest | None:
    """Compare observations with those of the pairs, and warn if they clearly differ.

    Returns:
        An energy test of the embeddings h(x), with the pairs as the first set, or None
        if there are too few observations or pairs.
    """
    net = bench.embedding_net
    test = compare_with_pairs(embed(net, bench.x), bench.groups, embed(net, x_o))
    if test is not None and test.is_different:
        warn_user(
            f"`x_o` differs from the observations of the calibration pairs (p = "
            f"{test.p_value:.3f}), so that the report need not hold for it. Look at "
            "`diagnose(rope, x_o)`."
        )
    return test
