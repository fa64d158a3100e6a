"""The candidates of a stack that are trained on the calibration pairs."""

import copy
from dataclasses import dataclass
from typing import Any, Literal

from sbi_rope._sbi import estimator_of, headless, with_embedding
from sbi_rope.discrepancy.correction import Space
from sbi_rope.mixture import OwnEmbeddings, Part, part_of
from sbi_rope.settings import check, one_of
from sbi_rope.stacking.candidates import AmortisedCandidate
from sbi_rope.stacking.finetuning import finetune_without
from sbi_rope.stacking.folds import Fold
from sbi_rope.stacking.workbench import Workbench

__all__ = ["DiscrepancyCandidate", "FinetunedCandidate", "RehearsedCandidate"]


@dataclass(frozen=True, kw_only=True)
class DiscrepancyCandidate(AmortisedCandidate):
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

    def __post_init__(self) -> None:
        """Check the values of all fields."""
        check("space", self.space, Literal["embedding", "input", "tuned"])
        check("learn_prior", self.learn_prior, bool)

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

    def prepare(self, bench: Workbench) -> None:
        """Simulate at the labels, and from the prior."""
        bench.moments(self.space)

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
class FinetunedCandidate(AmortisedCandidate):
    """NPE, unchanged or corrected, whose parameters are then trained on the pairs.

    It is the average of several nets. Each of them holds out another part of the
    pairs, to know when to stop training.

    Args:
        space: None starts from the unchanged NPE. Otherwise, what is corrected in the
            NPE that it starts from.
    """

    space: Space | None = None
    learns_prior = True

    def __post_init__(self) -> None:
        """Check the value of the field."""
        check("space", self.space, one_of((None, "embedding", "input", "tuned")))

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

    def prepare(self, bench: Workbench) -> None:
        """Simulate at the labels, and from the prior, if NPE is corrected first."""
        if self.space is not None:
            bench.moments(self.space)

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
class RehearsedCandidate(AmortisedCandidate):
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

    def prepare(self, bench: Workbench) -> None:
        """Simulate from the prior."""
        _ = bench.simulations

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
