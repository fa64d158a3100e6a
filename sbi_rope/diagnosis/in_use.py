"""The posterior that is used: which findings concern it, and which it expects."""

from dataclasses import replace
from typing import Any, Protocol

from sbi_rope.density import MixturePosterior
from sbi_rope.diagnosis.report import UNLIKE_PAIRS, Diagnosis, PosteriorInUse
from sbi_rope.discrepancy.parameters import is_improbable

__all__ = ["read_for", "stack_in_use", "use_of"]


class ReportOfStack(Protocol):
    """What the report of a stack says about the parameters of the pairs."""

    @property
    def learns_prior(self) -> bool:
        """Whether the stack learns from the pairs how parameters are distributed."""
        ...

    @property
    def probability_of_prior(self) -> float | None:
        """The probability that the parameters of the pairs follow the prior."""
        ...


def use_of(posterior: MixturePosterior) -> PosteriorInUse:
    """Return what a diagnosis has to know of a posterior.

    Args:
        posterior: A stack, which has a ``report``, or another posterior, which all
            findings concern.
    """
    report: Any = getattr(posterior, "report", None)
    if not hasattr(report, "learns_prior"):
        return PosteriorInUse(name="this posterior")
    return stack_in_use(report)


def stack_in_use(report: ReportOfStack) -> PosteriorInUse:
    """Return what a diagnosis has to know of a stack, from its report."""
    return PosteriorInUse(
        name="this stack",
        has_couplings=False,
        has_learned_parameters=(
            report.learns_prior and is_improbable(report.probability_of_prior)
        ),
    )


def read_for(diagnosis: Diagnosis, posterior: PosteriorInUse) -> Diagnosis:
    """Return a diagnosis as it is to be read by somebody who uses a posterior.

    What the parameters of the batch have in common with those of the pairs is expected
    of a stack that has learned where these are, unless the batch is unlike the pairs.
    """
    is_like_pairs = UNLIKE_PAIRS in diagnosis and not diagnosis[UNLIKE_PAIRS].alarming
    is_known = is_like_pairs and posterior.has_learned_parameters
    findings = tuple(
        replace(one, is_expected=one.alarming and is_known)
        if one.name in diagnosis.also_in_pairs
        else one
        for one in diagnosis.findings
    )
    return replace(diagnosis, findings=findings, posterior=posterior)
