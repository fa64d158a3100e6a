"""The kinds of candidates that a stack can be made of."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch

from sbi_rope._sbi import check_density, estimator_of
from sbi_rope.errors import (
    InvalidInputError,
    RoPEError,
    UnsupportedPosteriorError,
)
from sbi_rope.finetuning import NUM_REHEARSED
from sbi_rope.mixture import (
    MixturePosterior,
    Part,
    PriorPosterior,
    part_of,
    part_of_prior,
)
from sbi_rope.rope import RoPE
from sbi_rope.settings import NotNegative, Positive, UnitInterval, check
from sbi_rope.simulate import LimitedSimulator
from sbi_rope.stacking.folds import Fold
from sbi_rope.stacking.workbench import Workbench

__all__ = [
    "AmortisedCandidate",
    "Candidate",
    "CouplingCandidate",
    "DensityCandidate",
    "check_candidates",
]


@dataclass(frozen=True, kw_only=True)
class CouplingCandidate:
    """RoPE, or RoPE without tuning ("OT-only"), at one setting of the coupling.

    Its posterior belongs to a batch of observations.

    Args:
        gamma: As in :class:`~sbi_rope.SinkhornCoupler`.
        tau: As in :class:`~sbi_rope.SinkhornCoupler`.
        tuned: Whether observations are embedded by the tuned net g. Otherwise they
            are embedded by h.
        rehearsal: With None, g is tuned with RoPE's own finetuner. A number replaces
            its ``rehearsal``, see :class:`~sbi_rope.CalibrationFinetuner`.
        cost_scale: As in :class:`~sbi_rope.SinkhornCoupler`. By default gamma is in
            units of the median distance between simulated embeddings.

    Raises:
        InvalidInputError: If an argument is outside its range.
    """

    gamma: float
    tau: float
    tuned: bool = True
    rehearsal: float | None = None
    cost_scale: Literal["none", "simulated"] = "simulated"

    def __post_init__(self) -> None:
        """Check the ranges of all fields."""
        check("gamma", self.gamma, Positive)
        check("tau", self.tau, UnitInterval)
        check("tuned", self.tuned, bool)
        if self.rehearsal is not None:
            check("rehearsal", self.rehearsal, NotNegative)
            if not self.tuned:
                raise InvalidInputError(
                    "Expected `rehearsal` of None without tuning; got "
                    f"{self.rehearsal}."
                )
        check("cost_scale", self.cost_scale, Literal["none", "simulated"])

    @property
    def family(self) -> str:
        """The method that it is a setting of."""
        return "RoPE" if self.tuned else "OT-only"

    @property
    def name(self) -> str:
        """The name of the method and its setting."""
        scale = " of the embedding" if self.cost_scale == "none" else ""
        net = "" if self.rehearsal is None else f", rehearsal {self.rehearsal:g}"
        return f"{self.family} (gamma {self.gamma:g}{scale}, tau {self.tau:g}{net})"


class AmortisedCandidate(ABC):
    """A candidate whose density is defined for any observation.

    To implement one, give it a name and define :meth:`parts`. Random numbers that
    :meth:`parts` draws are seeded by the fold.

    Attributes:
        name: Its name in the report.
        fixed: Whether it does not depend on the calibration pairs.
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

    def prepare(self, bench: Workbench) -> None:  # noqa: B027 -- a choice
        """Compute what all versions share, before they are trained; nothing by default.

        What is kept here, such as ``bench.simulations``, is there for all versions. If
        these are trained in several processes, what :meth:`parts` keeps is lost.
        Random numbers are seeded. A stack may call it several times.
        """

    @abstractmethod
    def parts(self, fold: Fold) -> list[Part]:
        """Train on the pairs of a fold; return densities with equal shares."""


@dataclass(frozen=True, kw_only=True)
class DensityCandidate(AmortisedCandidate):
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

    def __post_init__(self) -> None:
        """Check the types of all fields."""
        check("name", self.name, str)
        check("fixed", self.fixed, bool)
        check("learns_prior", self.learns_prior, bool)
        _check_name(self.name)
        if not callable(self.build):
            raise InvalidInputError(
                "Expected `build` to be a function of (rope, seed) that returns a "
                f"posterior; got {type(self.build).__name__}. Wrap a posterior: "
                "`lambda rope, seed: posterior`."
            )

    def prepare(self, bench: Workbench) -> None:
        """Simulate what RoPE is tuned with."""
        finetuner, source = bench.rope.finetuner, bench.rope.source
        if bench.has_targets_of(finetuner):
            bench.moments("embedding")
        if finetuner.rehearsal or isinstance(source, LimitedSimulator):
            source.kept(NUM_REHEARSED, progress=bench.show)

    def parts(self, fold: Fold) -> list[Part]:
        """Build the posterior, and return its densities."""
        bench = fold.bench
        # A copy, because `build` may train it anew, and couplings use that of the fold.
        rope = (
            bench.rope.with_pairs(torch.arange(0))
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


def _check_name(name: str) -> None:
    if not isinstance(name, str) or not name:
        raise InvalidInputError(f"Expected a `name` of some letters; got {name!r}.")
    if name == "stack":
        raise InvalidInputError(
            "Expected another name than 'stack', which is the name of the mixture of "
            "all candidates."
        )


Candidate = CouplingCandidate | AmortisedCandidate


def check_candidates(candidates: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """Check and return the candidates of a user.

    Raises:
        InvalidInputError: If one of them is not a candidate.
        InvalidInputError: If there is none, or two have the same name.
    """
    if not isinstance(candidates, Sequence):
        raise InvalidInputError(
            "Expected `candidates` to be a list of candidates; got "
            f"{type(candidates).__name__}."
        )
    for candidate in candidates:
        if not isinstance(candidate, CouplingCandidate | AmortisedCandidate):
            raise InvalidInputError(
                "Expected `candidates` to be candidates, such as those of "
                f"`default_candidates()`; got {type(candidate).__name__}. Wrap a "
                "posterior that was not trained on the calibration pairs: "
                "DensityCandidate(name=..., build=lambda rope, seed: posterior, "
                "fixed=True)."
            )
    if not candidates:
        raise InvalidInputError(
            "Expected at least one candidate; got none. Add to the list that "
            "`default_candidates()` returns."
        )
    names = [candidate.name for candidate in candidates]
    for name in names:
        _check_name(name)
    if len(set(names)) < len(names):
        double = sorted({name for name in names if names.count(name) > 1})
        raise InvalidInputError(f"Expected names that differ; got {double} twice.")
    return tuple(candidates)


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
        parts = _equal_parts(name, posterior)
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


def _equal_parts(name: str, posterior: MixturePosterior) -> list[Part]:
    estimator = posterior.posterior_estimator
    weights = estimator.weights
    is_stack = hasattr(posterior, "report")
    is_equal = bool((weights == weights[0]).all())
    if is_stack or not is_equal or not posterior.is_amortised:
        raise UnsupportedPosteriorError(
            f"Expected the candidate {name!r} to be amortised, and a mixture to have "
            f"equal weights; got {type(posterior).__name__}. For RoPE's coupling, use "
            "a CouplingCandidate. A stack cannot be a candidate of another, because it "
            "has seen the pairs; leave it out."
        )
    return estimator.taken_apart()[0]
