"""What a stack can be made of."""

import copy
import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch

from sbi_rope._sbi import (
    ConditionalDensityEstimator,
    embedding_of,
    estimator_of,
    headless,
    with_embedding,
)
from sbi_rope._validation import (
    check_choice,
    check_instance,
    check_not_negative,
    check_numbers,
    check_positive,
    check_unit_interval,
)
from sbi_rope.discrepancy.correction import Space
from sbi_rope.errors import (
    InvalidInputError,
    InvalidTypeError,
    RoPEError,
    UnsupportedPosteriorError,
)
from sbi_rope.mixture import (
    MixturePosterior,
    OwnContexts,
    Part,
    PriorPosterior,
    part_of,
    part_of_prior,
)
from sbi_rope.rope import RoPE
from sbi_rope.stacking.finetuning import finetune_without
from sbi_rope.stacking.folds import NUM_FOLDS, Fold, Workbench

__all__ = [
    "AmortisedCandidate",
    "Candidate",
    "CouplingCandidate",
    "DensityCandidate",
    "DiscrepancyCandidate",
    "FinetunedCandidate",
    "check_candidates",
    "default_candidates",
]

# Chosen on calibration data, see benchmarks/README.md.
GAMMAS = (0.02, 0.05, 0.1, 0.4)
TAUS = (1.0, 0.5, 0.0)
REHEARSAL = 1.0


@dataclass(frozen=True, kw_only=True)
class CouplingCandidate:
    """RoPE, or RoPE without tuning ("OT-only"), at one setting of the coupling.

    Its posterior belongs to a batch of observations.

    Args:
        gamma: As in :class:`~sbi_rope.SinkhornCoupler`.
        tau: As in :class:`~sbi_rope.SinkhornCoupler`.
        tuned: Whether observations are embedded by the tuned net g, or by h.
        rehearsal: None for RoPE's own g; a number for one tuned with so much of it, see
            :class:`~sbi_rope.CalibrationFinetuner`.
        cost_scale: As in :class:`~sbi_rope.SinkhornCoupler`, but in units of the median
            distance between simulated embeddings by default.

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
        check_positive("gamma", self.gamma)
        check_unit_interval("tau", self.tau)
        check_instance("tuned", self.tuned, bool)
        if self.rehearsal is not None:
            check_not_negative("rehearsal", self.rehearsal)
            if not self.tuned:
                raise InvalidInputError(
                    "Expected `rehearsal` of None without tuning; got "
                    f"{self.rehearsal}."
                )
        check_choice("cost_scale", self.cost_scale, ("none", "simulated"))

    @property
    def family(self) -> str:
        """The method that it is a setting of."""
        return "RoPE" if self.tuned else "OT-only"

    @property
    def name(self) -> str:
        """The method with its setting."""
        scale = " of the embedding" if self.cost_scale == "none" else ""
        net = "" if self.rehearsal is None else f", rehearsal {self.rehearsal:g}"
        return f"{self.family} (gamma {self.gamma:g}{scale}, tau {self.tau:g}{net})"


class AmortisedCandidate(ABC):
    """A candidate with a density of any observation.

    To implement one, give it a name and define :meth:`parts`, which is called with
    random numbers that follow from the seed of the fold.

    Attributes:
        name: What the report calls it.
        fixed: Whether it is the same whatever the pairs are.
    """

    name: str
    fixed: bool = False

    @property
    def family(self) -> str:
        """Its name."""
        return self.name

    def applies_to(self, bench: Workbench) -> bool:
        """Tell whether these data allow it; if not, the default stack does without."""
        return True

    @abstractmethod
    def parts(self, fold: Fold) -> list[Part]:
        """Train on the pairs of a fold; return densities that are mixed equally."""


@dataclass(frozen=True, kw_only=True)
class DensityCandidate(AmortisedCandidate):
    """A posterior of your own, trained on calibration pairs or not.

    Args:
        name: What the report calls it; any but "stack".
        build: Given RoPE, tuned on the pairs that may be used, and a seed, returns an
            sbi posterior of NPE. The pairs are ``rope.calibration``, the trained NPE is
            ``rope.npe``.
        fixed: Whether the posterior is the same whatever the pairs are, so that it is
            built once, with a RoPE that has no pairs. Never for one that was trained on
            the calibration pairs: it has seen the labels that it would be scored by.

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

    def __post_init__(self) -> None:
        """Check the types of all fields."""
        check_instance("name", self.name, str)
        check_instance("fixed", self.fixed, bool)
        _check_name(self.name)
        if not callable(self.build):
            raise InvalidTypeError(
                "Expected `build` to be a function of (rope, seed) that returns a "
                f"posterior; got {type(self.build).__name__}. Wrap a posterior: "
                "`lambda rope, seed: posterior`."
            )

    def parts(self, fold: Fold) -> list[Part]:
        """Build the posterior, and return its densities."""
        bench = fold.bench
        rope = bench.rope.with_pairs(torch.arange(0)) if self.fixed else fold.rope
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
        raise InvalidTypeError(f"Expected a `name` of some letters; got {name!r}.")
    if name == "stack":
        raise InvalidInputError("Expected another name; 'stack' is that of them all.")


@dataclass(frozen=True, kw_only=True)
class DiscrepancyCandidate(AmortisedCandidate):
    """NPE on simulations that were corrected by what the pairs tell.

    See :class:`~sbi_rope.discrepancy.DiscrepancyNPE`.

    Args:
        space: What is corrected.
        learn_prior: Whether the distribution of parameters is learned from the pairs.
            The scores of a stack assume in any case that these are drawn like the
            observations to be inferred.
    """

    space: Space = "embedding"
    learn_prior: bool = True

    def __post_init__(self) -> None:
        """Check the values of all fields."""
        check_choice("space", self.space, ("embedding", "input", "tuned"))
        check_instance("learn_prior", self.learn_prior, bool)

    @property
    def name(self) -> str:  # type: ignore[override]
        """The method with its setting."""
        space = "" if self.space == "embedding" else f" ({self.space})"
        return f"discrepancy{space}" + ("" if self.learn_prior else ", given prior")

    @property
    def family(self) -> str:
        """The method that it is a setting of."""
        return "discrepancy"

    def applies_to(self, bench: Workbench) -> bool:
        """Tell whether x is a short vector, or there are folds to tune without."""
        if self.space == "input":
            return _has_summaries(bench)
        return self.space == "embedding" or len(bench.folds) > 2

    def parts(self, fold: Fold) -> list[Part]:
        """Correct NPE."""
        corrected = fold.corrected(self.space, learn_prior=self.learn_prior)
        estimator = corrected.estimator
        if self.space == "input":
            return [part_of(estimator)]
        contexts = OwnContexts(corrected.nets, fold.bench.x.shape[1:])
        return [Part(headless(estimator), contexts)]


def _has_summaries(bench: Workbench) -> bool:
    """Whether x is a short vector that an embedding net could lose something of."""
    net = embedding_of(estimator_of(bench.npe))
    has_net = any(True for _ in net.parameters())
    return bench.has_summaries and has_net


# Of fine-tuning, by what is corrected in the start. Trained on the input, a whole
# network is nearly right already. Chosen on calibration data, see benchmarks/README.md.
LEARNING_RATES = {None: 1e-3, "embedding": 1e-3, "tuned": 1e-3, "input": 3e-4}


@dataclass(frozen=True, kw_only=True)
class FinetunedCandidate(AmortisedCandidate):
    """NPE, as it is or corrected, with all its parameters trained on the pairs.

    It is the average of several nets, each of which holds another part of the pairs
    out to know when to stop.

    Args:
        space: None to start from NPE; else what is corrected in the NPE to start from.
    """

    space: Space | None = None

    def __post_init__(self) -> None:
        """Check the value of the field."""
        check_choice("space", self.space, (None, "embedding", "input", "tuned"))

    @property
    def name(self) -> str:  # type: ignore[override]
        """The method with its setting."""
        if self.space is None:
            return "fine-tuned NPE"
        return f"{DiscrepancyCandidate(space=self.space).name}, fine-tuned"

    @property
    def family(self) -> str:
        """The method that it is a setting of."""
        return "fine-tuned NPE" if self.space is None else "discrepancy, fine-tuned"

    def applies_to(self, bench: Workbench) -> bool:
        """Tell whether there are parts to hold out, and the start applies."""
        start = self.space is None or DiscrepancyCandidate(space=self.space).applies_to(
            bench
        )
        return start and len(bench.folds) > 2

    def parts(self, fold: Fold) -> list[Part]:
        """Train without each part of the pairs."""
        if len(fold.used) < 2:
            # Nothing can be held out; the start is what there is.
            if self.space is None:
                return [part_of(estimator_of(fold.bench.npe))]
            return DiscrepancyCandidate(space=self.space).parts(fold)
        rate = LEARNING_RATES[self.space]
        return [
            part_of(
                finetune_without(
                    self._start(fold, number), fold, number, learning_rate=rate
                )
            )
            for number in sorted(fold.used)
        ]

    def _start(self, fold: Fold, number: int) -> Any:
        if self.space is None:
            return estimator_of(fold.bench.npe)
        corrected = fold.corrected(self.space, learn_prior=True)
        if self.space != "tuned":
            return corrected.estimator
        # The net that has not seen the part which is held out.
        net = corrected.nets[sorted(fold.used).index(number)]
        return with_embedding(corrected.estimator, copy.deepcopy(net))


Candidate = CouplingCandidate | AmortisedCandidate


def default_candidates(
    rope: RoPE | None = None,
    *,
    couplings: bool = False,
    gammas: Sequence[float] = GAMMAS,
    taus: Sequence[float] = TAUS,
    rehearsal: float | None = REHEARSAL,
) -> tuple[Candidate, ...]:
    """Return the prior, NPE, fine-tuned NPE and the discrepancy models.

    Args:
        rope: RoPE with its calibration pairs; leaves out what these do not allow or
            need, as :func:`stack` does by itself. All if None.
        couplings: Whether RoPE and OT-only over a grid of gamma and tau take part, and
            tuning-only; for a stack of a batch of observations.
        gammas: In units of the median distance between simulated embeddings.
        taus: Trust in the prior; 0 lets every observation choose by itself.
        rehearsal: Of a second RoPE over the same grid, whose tuning keeps simulations
            where they are, see :class:`~sbi_rope.CalibrationFinetuner`; None leaves it
            out.

    Returns:
        The candidates, couplings first.

    Raises:
        InvalidTypeError: If ``rope`` is something else.
        InvalidInputError: If a gamma, a tau or the rehearsal is outside its range.
    """
    gammas, taus = check_numbers("gammas", gammas), check_numbers("taus", taus)
    amortised: tuple[AmortisedCandidate, ...] = (
        DensityCandidate(name="prior", build=_prior, fixed=True),
        DensityCandidate(name="NPE", build=_npe, fixed=True),
        FinetunedCandidate(),
        DiscrepancyCandidate(space="embedding"),
        DiscrepancyCandidate(space="input"),
        DiscrepancyCandidate(space="tuned"),
        FinetunedCandidate(space="input"),
        FinetunedCandidate(space="tuned"),
    )
    if rope is not None:
        check_instance("rope", rope, RoPE)
        bench = Workbench(rope, num_folds=NUM_FOLDS, seed=0, show_progress_bars=False)
        amortised = tuple(one for one in amortised if one.applies_to(bench))
    if not couplings:
        return amortised
    rehearsed = [] if rehearsal is None else [{"rehearsal": rehearsal}]
    nets: list[dict[str, Any]] = [{"tuned": True}, *rehearsed, {"tuned": False}]
    coupled = [
        CouplingCandidate(gamma=gamma, tau=tau, **net)
        for net, gamma, tau in itertools.product(nets, gammas, taus)
    ]
    tuned = DensityCandidate(name="tuning-only", build=_tuning_only)
    return (*coupled, *amortised, tuned)


# Functions with a name, so that a stack can be pickled.


def _prior(rope: RoPE, seed: int) -> PriorPosterior:
    return PriorPosterior(rope.npe.prior)


def _npe(rope: RoPE, seed: int) -> Any:
    return rope.npe


def _tuning_only(rope: RoPE, seed: int) -> Any:
    return rope.tuned_posterior()


def check_candidates(candidates: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """Return the candidates of a user.

    Raises:
        InvalidTypeError: If one is something else.
        InvalidInputError: If there is none, or two have one name.
    """
    if not isinstance(candidates, Sequence):
        raise InvalidTypeError(
            "Expected `candidates` to be a list of candidates; got "
            f"{type(candidates).__name__}."
        )
    for candidate in candidates:
        if not isinstance(candidate, CouplingCandidate | AmortisedCandidate):
            raise InvalidTypeError(
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
    """Return the densities of a posterior of NPE, of an average of them, or the prior.

    Raises:
        UnsupportedPosteriorError: If it has none, or is of other parameters or
            observations than those of RoPE.
    """
    theta, x = rope.calibration
    if isinstance(posterior, PriorPosterior):
        parts = [part_of_prior(posterior.prior, x.shape[1:])]
    elif isinstance(posterior, MixturePosterior):
        parts = _equal_parts(name, posterior)
    else:
        estimator = estimator_of(posterior)
        if not isinstance(estimator, ConditionalDensityEstimator):
            raise UnsupportedPosteriorError(
                f"Expected the candidate {name!r} to have a density to score; got "
                f"{type(estimator).__name__}. Train NPE instead of FMPE or NPSE."
            )
        parts = [part_of(estimator)]
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
    if not posterior.is_amortised or not bool((weights == weights[0]).all()):
        raise UnsupportedPosteriorError(
            f"Expected the candidate {name!r} to be amortised, and an average of equal "
            f"weights if it is a mixture; got {type(posterior).__name__}. Couplings "
            "are CouplingCandidates."
        )
    return copy.deepcopy(estimator).parts
