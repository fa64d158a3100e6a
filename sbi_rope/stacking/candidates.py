"""The candidates that a stack can be made of, and those that it is made of by default.

A candidate is a class with a name and :meth:`Candidate.parts`, which trains on the
pairs of a fold and returns densities. Nothing else knows its type.
"""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor

from sbi_rope._sbi import check_density, estimator_of, headless, with_embedding
from sbi_rope.discrepancy.correction import Space, network_of
from sbi_rope.errors import (
    InvalidInputError,
    RoPEError,
    UnsupportedPosteriorError,
    warn_user,
)
from sbi_rope.mixture import (
    MixturePosterior,
    OwnEmbeddings,
    Part,
    PriorPosterior,
    part_of,
    part_of_prior,
)
from sbi_rope.rope import RoPE
from sbi_rope.settings import Settings, check
from sbi_rope.stacking.finetuning import finetune_without
from sbi_rope.stacking.workbench import NUM_FOLDS, Fold, Workbench
from sbi_rope.tensors import as_batch, as_numbers

__all__ = [
    "Candidate",
    "DensityCandidate",
    "DiscrepancyCandidate",
    "FinetunedCandidate",
    "RVNPCandidate",
    "RehearsedCandidate",
    "checked_candidates",
    "default_candidates",
    "suitable_candidates",
]


class Candidate(ABC):
    """A candidate whose density is defined for any observation.

    To implement one, give it a name and define :meth:`parts`. Random numbers that
    :meth:`parts` draws are seeded by the fold.

    Attributes:
        name: Its name in the report.
        fixed: Whether it does not depend on the calibration pairs. It is trained once.
        learns_prior: Whether it learns from the pairs how parameters are distributed.
    """

    name: str
    fixed: bool = False
    learns_prior: bool = False

    @property
    def family(self) -> str:
        """The name of its method; that of the candidate unless overridden."""
        return self.name

    def applies_to(self, bench: Workbench) -> bool:
        """Tell whether the data allow it. The default stack leaves it out if not."""
        return True

    @abstractmethod
    def parts(self, fold: Fold) -> list[Part]:
        """Train on the pairs of a fold; return densities with equal shares."""


@dataclass(frozen=True, kw_only=True)
class DensityCandidate(Settings, Candidate):
    """A posterior of your own, trained on calibration pairs or not.

    Args:
        name: Its name in the report; any name but "stack".
        build: A function of a RoPE and a seed that returns an sbi posterior of NPE.
            The RoPE is tuned on the pairs that may be used, ``rope.calibration``. The
            trained NPE is ``rope.npe``.
        fixed: Whether the posterior does not depend on the calibration pairs. It is
            then built once, with a RoPE that has no pairs. Do not use it for a
            posterior that was trained on the calibration pairs: it would be scored by
            labels that it has seen.
        learns_prior: Whether the pairs may teach it how parameters are distributed, as
            all training on them does. It has no effect if ``fixed``.

    Example:
        Another trained posterior:

        >>> another = object()  # NPE(...).build_posterior()
        >>> candidate = DensityCandidate(
        ...     name="older NPE", build=lambda rope, seed: another, fixed=True
        ... )
    """

    name: str
    build: Callable[[RoPE, int], Any]
    fixed: bool = False
    learns_prior: bool = True

    def parts(self, fold: Fold) -> list[Part]:
        """Build the posterior, and return its densities."""
        # A copy, because `build` may train it anew.
        rope = (
            fold.bench.rope.with_pairs(torch.arange(0))
            if self.fixed
            else copy.copy(fold.rope)
        )
        try:
            posterior = self.build(rope, fold.seed)
        except RoPEError:
            raise
        except Exception as error:
            raise InvalidInputError(
                f"The `build` of the candidate {self.name!r} raised "
                f"{type(error).__name__}: {error}"
            ) from error
        return _parts_of(self.name, posterior, rope)


def _parts_of(name: str, posterior: Any, rope: RoPE) -> list[Part]:
    """Return the densities of a posterior of NPE, of an average of them, or of a prior.

    Raises:
        UnsupportedPosteriorError: If it has no density, or if its parameters or
            observations have other shapes than those of RoPE.
    """
    theta, x = rope.calibration
    if isinstance(posterior, PriorPosterior):
        parts = [part_of_prior(posterior.prior, x.shape[1:])]
    elif isinstance(posterior, MixturePosterior):
        weights = posterior.posterior_estimator.weights
        is_stack = hasattr(posterior, "report")
        if is_stack or len(weights.unique()) > 1 or not posterior.is_amortised:
            raise UnsupportedPosteriorError(
                f"Expected the candidate {name!r} to answer any x with densities of "
                f"equal weight; got {type(posterior).__name__}."
            )
        parts = posterior.posterior_estimator.taken_apart()[0]
    else:
        estimator = estimator_of(posterior)
        parts = [part_of(check_density(estimator, what=f"the candidate {name!r}"))]
    for part in parts:
        shapes = (part.density.input_shape, part.mixing.event_shape)
        if shapes != (theta.shape[1:], x.shape[1:]):
            raise UnsupportedPosteriorError(
                f"Expected the candidate {name!r} to map x {tuple(x.shape[1:])} to "
                f"theta {tuple(theta.shape[1:])}; got x {tuple(shapes[1])} and theta "
                f"{tuple(shapes[0])}."
            )
    return parts


@dataclass(frozen=True, kw_only=True)
class DiscrepancyCandidate(Settings, Candidate):
    """NPE trained on corrected simulations, as learned from the pairs.

    See :class:`~sbi_rope.discrepancy.DiscrepancyNPE`.

    Args:
        space: What is corrected: the embedding h(x), the input x, or the embedding
            by tuned nets.
        learn_prior: Whether the distribution of parameters is learned from the pairs.
            The scores of a stack assume in any case that the pairs are drawn like the
            observations to be inferred.
    """

    space: Space = "embedding"
    learn_prior: bool = True

    @property
    def name(self) -> str:  # type: ignore[override]
        """The name of the method and its setting."""
        space = "" if self.space == "embedding" else f" ({self.space})"
        return f"discrepancy{space}" + ("" if self.learn_prior else ", given prior")

    @property
    def family(self) -> str:
        """The method that it is a setting of."""
        return "discrepancy"

    @property
    def learns_prior(self) -> bool:  # type: ignore[override]
        """Whether it learns from the pairs how parameters are distributed."""
        return self.learn_prior

    def applies_to(self, bench: Workbench) -> bool:
        """Tell whether x is a short vector, or there are enough folds to tune."""
        if self.space == "input":
            return bench.reads_summaries
        return self.space == "embedding" or len(bench.folds) > 2

    def parts(self, fold: Fold) -> list[Part]:
        """Train NPE on corrected simulations; return its density."""
        corrected = fold.corrected(self.space, learn_prior=self.learn_prior)
        estimator = corrected.estimator
        if self.space == "input":
            return [part_of(estimator)]
        embeddings = OwnEmbeddings(corrected.nets, fold.bench.x.shape[1:])
        return [Part(headless(estimator), embeddings)]


# Learning rates of fine-tuning, by what was corrected in the net that it starts from.
# Of several, each net takes the one that is best on the pairs that it holds out. With
# "input" all parameters were trained already, and a smaller rate is enough. Chosen on
# calibration data, see benchmarks/choices.md.
LEARNING_RATES = {
    None: (1e-3,),
    "embedding": (1e-4, 1e-3),
    "tuned": (1e-3,),
    "input": (3e-4,),
}


@dataclass(frozen=True, kw_only=True)
class FinetunedCandidate(Settings, Candidate):
    """NPE, unchanged or corrected, whose parameters are then trained on the pairs.

    It is the average of several nets. Each of them holds out another part of the
    pairs, to know when to stop training.

    Args:
        space: None starts from the unchanged NPE. Otherwise, what is corrected in the
            NPE that it starts from.
    """

    space: Space | None = None
    learns_prior = True

    @property
    def name(self) -> str:  # type: ignore[override]
        """The name of the method and its setting."""
        if self.space is None:
            return "fine-tuned NPE"
        return f"{DiscrepancyCandidate(space=self.space).name}, fine-tuned"

    @property
    def family(self) -> str:
        """The method that it is a setting of."""
        return "fine-tuned NPE" if self.space is None else "discrepancy, fine-tuned"

    def applies_to(self, bench: Workbench) -> bool:
        """Tell whether there are parts to hold out, and the starting NPE applies.

        The embedding is corrected first where x itself is not.
        """
        if self.space is None:
            starts = True
        elif self.space == "embedding":
            starts = not bench.reads_summaries
        else:
            starts = DiscrepancyCandidate(space=self.space).applies_to(bench)
        return starts and len(bench.folds) > 2

    def parts(self, fold: Fold) -> list[Part]:
        """Train one net without each part of the pairs."""
        if len(fold.parts) < 2:
            # Nothing can be held out, so that NPE is used as it starts.
            if self.space is None:
                return [part_of(estimator_of(fold.bench.npe))]
            return DiscrepancyCandidate(space=self.space).parts(fold)
        rates = LEARNING_RATES[self.space]
        return [
            part_of(
                finetune_without(
                    self._start(fold, number), fold, number, learning_rates=rates
                )
            )
            for number in fold.parts
        ]

    def _start(self, fold: Fold, number: int) -> Any:
        if self.space is None:
            return estimator_of(fold.bench.npe)
        corrected = fold.corrected(self.space, learn_prior=True)
        if self.space != "tuned":
            return corrected.estimator
        # This net has not seen the part that is held out.
        net = corrected.nets[list(fold.parts).index(number)]
        return with_embedding(corrected.estimator, copy.deepcopy(net))


# Pairs with different parameters. On calibration data it was worse than fine-tuned NPE
# with 50, and better with 200; nothing between was tried.
MIN_TO_REHEARSE = 100


@dataclass(frozen=True, kw_only=True)
class RehearsedCandidate(Candidate):
    r"""NPE whose parameters are trained on the pairs and on simulations alike.

    It starts from NPE and minimises what :class:`~sbi_rope.baselines.JointNPE`
    minimises from scratch. It is for images, series and sets of trials, where the
    embedding net has to learn what simulations do not show. A version holds out one
    part of its pairs, to know when to stop training.
    """

    name = "fine-tuned NPE, rehearsed"
    learns_prior = True

    @property
    def family(self) -> str:
        """The method that it is a setting of."""
        return FinetunedCandidate().name

    def applies_to(self, bench: Workbench) -> bool:
        """Tell whether x is no short vector, and there are pairs and folds enough."""
        enough = int(bench.groups.max()) + 1 >= MIN_TO_REHEARSE
        return enough and not bench.is_short and len(bench.folds) > 2

    def parts(self, fold: Fold) -> list[Part]:
        """Train one net without one part of the pairs."""
        start = estimator_of(fold.bench.npe)
        if len(fold.parts) < 2:  # nothing can be held out
            return [part_of(start)]
        # The part after the one that the version does not see, so that the versions
        # that are scored hold out different parts.
        others = list(fold.parts)
        unseen = set(range(len(fold.bench.folds))) - fold.used
        after = [number for number in others if number > min(unseen, default=-1)]
        return [
            part_of(
                finetune_without(
                    start,
                    fold,
                    (after or others)[0],
                    learning_rates=LEARNING_RATES[None],
                    rehearse=True,
                )
            )
        ]


# With fewer observations, or with more statistics, the default stack does without it.
# One of thousands of steps takes .05 s with 6 statistics, .4 s with 20 and 3 s with 50.
MIN_OBSERVATIONS, MAX_STATISTICS = 100, 20
# Training takes longer with every observation. None of these was tuned.
MAX_OBSERVATIONS = 1000


@dataclass(frozen=True, eq=False)
class RVNPCandidate(Candidate):
    """NPE with an error model that is learned from observations without labels.

    See :class:`~sbi_rope.baselines.RVNP`. It is trained once, because it does not see
    the labels of the pairs, which only decide about its weight.

    Args:
        x_o: Real observations, shape ``(n_o, *event)``. The stack may be asked about
            these or about others. The observations of the calibration pairs should
            not be among them, so that the scores are those of new observations. If
            there are more than 1000, a thousand of them are drawn.
        space: What the errors are in: the ``"embedding"`` h(x), or the ``"input"`` x,
            whose shape must be ``(l,)`` then. The default stack has the latter if x
            is a short vector and NPE has an embedding net. Training takes minutes
            with a few statistics, and hours with fifty.

    Raises:
        InvalidInputError: If x_o holds no numbers, or ``space`` is something else.
            Shape and values of x_o are checked when the stack is made.
    """

    x_o: Tensor = field(repr=False)
    space: Literal["embedding", "input"] = field(default="embedding", kw_only=True)
    fixed = True

    def __post_init__(self) -> None:
        """Check the space, and take a copy of the observations."""
        check("space", self.space, Literal["embedding", "input"])
        object.__setattr__(self, "x_o", as_numbers("x_o", self.x_o).clone())

    @property
    def name(self) -> str:  # type: ignore[override]
        """The name of the method and its setting."""
        return "RVNP" if self.space == "embedding" else "RVNP (input)"

    @property
    def family(self) -> str:
        """The method that it is a setting of."""
        return "RVNP"

    def applies_to(self, bench: Workbench) -> bool:
        """Tell whether there are enough observations of a few statistics."""
        if len(self.x_o) < MIN_OBSERVATIONS:
            return False
        reads_x = bench.reads_summaries and bool(torch.isfinite(self.x_o).all())
        if self.space != ("input" if reads_x else "embedding"):
            return False
        statistics = bench.simulations[1] if reads_x else bench.embedded
        varies = bool((statistics != statistics[0]).any())
        return varies and statistics.shape[1] <= MAX_STATISTICS

    def parts(self, fold: Fold) -> list[Part]:
        """Train errors and posterior on the observations; return the density."""
        # Importing the package does not load the baselines.
        from sbi_rope.baselines.rvnp import RVNP

        bench = fold.bench
        method = RVNP.from_posterior(bench.npe, noise_on=self.space)
        # The fold has seeded the random numbers.
        x_o = self.x_o
        if len(x_o) > MAX_OBSERVATIONS:
            x_o = x_o[torch.randperm(len(x_o))[:MAX_OBSERVATIONS]]
        # What a user passed is checked before anything is simulated.
        method.append_observations(x_o).append_simulations(*bench.simulations)
        method.train(show_progress_bars=bench.show)
        return [part_of(estimator_of(method.build_posterior()))]


def default_candidates(
    rope: RoPE | None = None,
    x_o: Tensor | None = None,
    *,
    learn_prior: bool = True,
) -> tuple[Candidate, ...]:
    """Return the prior, NPE, fine-tuned NPE, discrepancy models, and RVNP with x_o.

    NPE is fine-tuned on the pairs alone, and from discrepancy models, and on pairs and
    simulations together.

    Args:
        rope: A RoPE with its calibration pairs. Candidates that these data do not
            allow or need are left out, as in :func:`stack`. None returns all.
        x_o: Real observations without labels, shape ``(n_o, *event)``, other than those
            of the pairs. They add RVNP, which learns errors from them. With a rope, it
            is left out if there are fewer than a hundred observations, or more than 20
            statistics: these are x if it is a short vector and NPE has an embedding
            net, and the embedding otherwise.
        learn_prior: Whether candidates may learn from the pairs how parameters are
            distributed. They should if the pairs are drawn like the observations to be
            inferred. With False, discrepancy models keep the prior of NPE.
            Fine-tuned candidates cannot keep it, and are left out.

    Raises:
        InvalidInputError: If an argument has the wrong type, or, with a rope, x_o has
            the wrong shape or device, is empty or not finite.
        NotReadyError: If ``rope`` has fewer than two calibration pairs.
    """
    check("learn_prior", learn_prior, bool)
    if rope is None:
        return _all_candidates(x_o, learn_prior=learn_prior)
    check("rope", rope, RoPE)
    x_o = None if x_o is None else rope.checked_observations(x_o)
    bench = Workbench(rope, num_folds=NUM_FOLDS, seed=0, show_progress_bars=False)
    return suitable_candidates(bench, x_o, learn_prior=learn_prior)


def suitable_candidates(
    bench: Workbench, x_o: Tensor | None, *, learn_prior: bool = True
) -> tuple[Candidate, ...]:
    """Return the default candidates that the data allow; warn if x_o adds none."""
    chosen = tuple(
        candidate
        for candidate in _all_candidates(x_o, learn_prior=learn_prior)
        if candidate.applies_to(bench)
    )
    if x_o is not None and not any(isinstance(one, RVNPCandidate) for one in chosen):
        warn_user(
            f"`x_o` adds no candidate: RVNP needs {MIN_OBSERVATIONS} observations of "
            f"at most {MAX_STATISTICS} statistics that vary; got {len(x_o)}."
        )
    return chosen


def _all_candidates(x_o: Tensor | None, *, learn_prior: bool) -> tuple[Candidate, ...]:
    candidates: tuple[Candidate, ...] = (
        DensityCandidate(name="prior", build=_prior, fixed=True),
        DensityCandidate(name="NPE", build=_npe, fixed=True),
        FinetunedCandidate(),
        DiscrepancyCandidate(space="embedding", learn_prior=learn_prior),
        DiscrepancyCandidate(space="input", learn_prior=learn_prior),
        DiscrepancyCandidate(space="tuned", learn_prior=learn_prior),
        FinetunedCandidate(space="embedding"),
        FinetunedCandidate(space="input"),
        FinetunedCandidate(space="tuned"),
        RehearsedCandidate(),
    )
    if not learn_prior:
        candidates = tuple(
            one for one in candidates if one.fixed or not one.learns_prior
        )
    if x_o is not None:
        candidates += (RVNPCandidate(x_o), RVNPCandidate(x_o, space="input"))
    return candidates


# These are functions and not lambdas, so that a stack can be pickled.


def _prior(rope: RoPE, seed: int) -> PriorPosterior:
    return PriorPosterior(rope.npe.prior)


def _npe(rope: RoPE, seed: int) -> Any:
    return rope.npe


def checked_candidates(
    candidates: Sequence[Candidate], bench: Workbench
) -> tuple[Candidate, ...]:
    """Return the candidates of a user, if they can be trained on these pairs.

    Raises:
        InvalidInputError: If one of them is not a candidate, there is none, two have
            the same name, or entries of x are missing that one of them corrects.
    """
    check("candidates", candidates, Sequence)
    for candidate in candidates:
        check("candidates[...]", candidate, Candidate)
    names = [candidate.name for candidate in candidates]
    if not names or len(set(names)) < len(names) or "stack" in names:
        raise InvalidInputError(
            "Expected `candidates` with different names, none of them 'stack'; got "
            f"{names}."
        )
    if any(getattr(one, "space", None) == "input" for one in candidates):
        # Raises for images and series, before any candidate is trained.
        network_of(estimator_of(bench.npe), "input")
        as_batch("x", bench.x)
        as_batch("x of simulations", bench.simulations[1])
    return tuple(candidates)
