"""Make a stack from a RoPE with calibration pairs, in one call."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from torch import Tensor

from sbi_rope.discrepancy.parameters import is_improbable
from sbi_rope.errors import warn_user
from sbi_rope.rope import RoPE
from sbi_rope.settings import UnitInterval, check
from sbi_rope.stacking.batch import compare_batch
from sbi_rope.stacking.candidates import Candidate
from sbi_rope.stacking.cross_validation import CrossValidation
from sbi_rope.stacking.learning_curve import LearningCurve
from sbi_rope.stacking.posterior import StackedPosterior
from sbi_rope.stacking.provenance import Stopwatch
from sbi_rope.stacking.recalibrating import check_recalibration
from sbi_rope.stacking.report import StackingReport
from sbi_rope.stacking.trainer import StackTrainer

__all__ = ["cross_validate", "stack"]

# The learning curve trains on these shares of the folds, and on all folds but one.
SMALLER = (0.25, 0.5)
RECALIBRATES_FOR_PAIRS = (
    "The parameters of the pairs are not distributed like the prior, which all "
    "candidates keep. `recalibrate` makes the stack fit the pairs, and it can become "
    "over-confident about other parameters. Leave it out, unless the observations are "
    "drawn like the pairs."
)


def stack(
    rope: RoPE,
    x_o: Tensor | None = None,
    *,
    candidates: Sequence[Candidate] | None = None,
    num_folds: int | None = None,
    num_simulations: int | None = None,
    pseudo_count: float = 1.0,
    learning_curve: bool = False,
    recalibrate: bool = False,
    unseen: Literal["raise", "extend"] = "raise",
    tail_mass: float = 1e-3,
    require_convergence: bool = True,
    seed: int | None = None,
    num_workers: int = 1,
    checkpoints: str | Path | None = None,
    show_progress_bars: bool | None = None,
) -> StackedPosterior:
    r"""Mix candidate posteriors with the weights that score best on held-out pairs.

    The calibration pairs are divided into folds. Every candidate is trained without
    each fold and scored on that fold, and the posterior is the mixture of the
    candidates with the weights that score best
    (:func:`~sbi_rope.stacking.stacking_weights`).

    The stack is made of the models that were scored. Each candidate is the average of
    its versions: one for each fold, trained on the other folds, and one trained on all
    pairs. The held-out score is that of single versions. By Jensen's inequality their
    average has a higher expected score, for observations like those of the pairs. The
    version trained on all pairs is not scored.

    Without ``x_o`` the stack answers any observation. With ``x_o``, RoPE and OT-only at
    many values of gamma and tau take part, and the stack is for that batch only.

    The weights, the scores and the calibration in the report hold for observations like
    those of the pairs. With ``x_o`` the two are compared by an energy test of their
    embeddings, and a p-value below 0.01 gives a warning. Without it,
    :func:`~sbi_rope.diagnose` makes the same comparison.

    Args:
        rope: A RoPE with calibration pairs. It need not be trained, and it is not
            changed, except that it counts calls of the simulator, and the simulations
            that are dropped.
        x_o: A batch of real observations, shape ``(n_o, *event)``. With None the
            posterior answers any x.
        candidates: What to stack. If None,
            :func:`~sbi_rope.stacking.default_candidates`: the prior, NPE, fine-tuned
            NPE and discrepancy models, and with ``x_o`` also tuning-only, RoPE, RoPE
            tuned with rehearsal and OT-only at four gammas and three taus, and RVNP if
            there are a hundred observations of at most 20 statistics. For a stack that
            has learned from ``x_o`` and answers any x, pass
            ``default_candidates(rope, x_o)`` here and no ``x_o``.
        num_folds: The number of folds, 5 if None, and at most the number of groups.
            Pairs with equal labels, or of the same of the ``groups`` that were
            appended, are in the same fold.
        num_simulations: The number of simulations to couple with, as in
            :meth:`~sbi_rope.RoPE.build_posterior`. Candidates are trained on others:
            the simulator makes 20,000 from the prior and 100 for each label. To have
            fewer, give RoPE itself a number, ``RoPE(..., num_simulations=2000)``.
        pseudo_count: Strength of the Dirichlet prior of the weights, in pairs.
        learning_curve: Whether to train on fewer folds too, so that the report can
            estimate what more labels would add. It takes about twice the time.
        recalibrate: Whether to make the stack narrower or wider around its centre, as
            held-out pairs say; ``report.recalibration`` tells by how much. Further
            versions are trained for this, ten with five folds, which takes up to three
            times as long.
        unseen: What the posterior of a batch does with an x outside the batch:
            ``"raise"`` an error, or ``"extend"`` each coupling by one row.
        tail_mass: As in :meth:`~sbi_rope.RoPE.build_posterior`.
        require_convergence: Whether a coupling that has not converged is an error.
        seed: Seed of everything random; None uses the states of torch, NumPy and
            Python.
        num_workers: The number of processes that train versions of the candidates. With
            five folds there are six versions. Each process has a copy of the
            simulations in its memory. The numbers are those of one process, up to
            rounding, which grows in the course of a training.
        checkpoints: A folder in which trained candidates are kept. The same call, with
            the same ``seed``, data and folder, goes on where another was interrupted,
            and returns what that one would have. Simulations are made again, and
            nothing is taken over if they differ. They are the same if the simulator
            draws from torch, NumPy or Python alone, and from no generator of its own.
            Couplings and candidates of your own are trained again. Nobody else should
            be able to write to the folder. It can be removed afterwards.
        show_progress_bars: Whether to show how many trainings and scores are done.
            None does so in a terminal or a notebook, but not in a file.

    Returns:
        The stack, an sbi posterior. Its ``report`` holds the held-out scores, and
        compares the stack with the prior and with NPE.

    Raises:
        NotReadyError: If there are fewer than two groups of pairs.
        InvalidInputError: If an argument is outside its range or has the wrong shape,
            if there are couplings among the candidates but no batch, if there are
            ``checkpoints`` but no seed, or an NPE that cannot be described in a file,
            if entries of x are missing (NaN) that a candidate with ``space="input"``
            corrects, or if something cannot be sent to ``num_workers`` processes, or
            one of them dies.
        UnsupportedPosteriorError: If NPE or a candidate has no density, or the
            posterior cannot be recalibrated.
        CouplingError: If a coupling has not converged.
        SamplingError: If the candidates have almost no mass inside the support of the
            prior at a held-out observation.
        SimulationError: If the simulator fails.
        NotWritableError: If the folder of ``checkpoints`` cannot be made.
    """
    check("unseen", unseen, Literal["raise", "extend"])
    check("tail_mass", tail_mass, UnitInterval)
    check("rope", rope, RoPE)
    check("recalibrate", recalibrate, bool)
    check("learning_curve", learning_curve, bool)
    stopwatch = Stopwatch(rope)
    trainer = StackTrainer(
        rope,
        x_o,
        candidates=candidates,
        num_folds=num_folds,
        num_simulations=num_simulations,
        pseudo_count=pseudo_count,
        unseen=unseen,
        tail_mass=tail_mass,
        require_convergence=require_convergence,
        seed=seed,
        num_workers=num_workers,
        checkpoints=checkpoints,
        show_progress_bars=show_progress_bars,
    )
    if recalibrate:
        check_recalibration(trainer.bench)
    # This comes first, so that nobody waits for the training to hear of it.
    batch = None if trainer.x_o is None else compare_batch(trainer.bench, trainer.x_o)
    probability = trainer.bench.probability_of_prior()
    if recalibrate and not trainer.learns_prior and is_improbable(probability):
        warn_user(RECALIBRATES_FOR_PAIRS)
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
    posterior = StackedPosterior(
        versions,
        trainer.prior,
        report=StackingReport.of(
            scores,
            curve,
            batch=batch,
            discrepancy=trainer.discrepancy(),
            probability_of_prior=probability,
            learns_prior=trainer.learns_prior,
            is_amortised=versions.couplings is None,
            parameter_names=rope.parameter_names,
            recalibration=trainer.recalibration(scores) if recalibrate else None,
            # This comes last, because it counts what came before.
            provenance=stopwatch.provenance(seed),
        ),
        enable_transform=trainer.bench.npe.enable_transform,
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
    num_simulations: int | None = None,
    pseudo_count: float = 1.0,
    require_convergence: bool = True,
    seed: int | None = None,
    num_workers: int = 1,
    checkpoints: str | Path | None = None,
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
        num_simulations: As in :func:`stack`.
        pseudo_count: As in :func:`stack`.
        require_convergence: As in :func:`stack`.
        seed: As in :func:`stack`.
        num_workers: As in :func:`stack`.
        checkpoints: As in :func:`stack`.
        show_progress_bars: As in :func:`stack`.

    Returns:
        The score of each candidate at each pair.

    Raises:
        NotReadyError: As in :func:`stack`.
        InvalidInputError: As in :func:`stack`.
        UnsupportedPosteriorError: As in :func:`stack`.
        CouplingError: As in :func:`stack`.
        SamplingError: As in :func:`stack`.
        SimulationError: As in :func:`stack`.
        NotWritableError: As in :func:`stack`.
    """
    trainer = StackTrainer(
        rope,
        x_o,
        candidates=candidates,
        num_folds=num_folds,
        num_simulations=num_simulations,
        pseudo_count=pseudo_count,
        require_convergence=require_convergence,
        seed=seed,
        num_workers=num_workers,
        checkpoints=checkpoints,
        show_progress_bars=show_progress_bars,
    )
    return trainer.cross_validate(num_training_folds=num_training_folds)[1]
