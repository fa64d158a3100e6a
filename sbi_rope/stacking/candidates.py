"""What a stack is made of: couplings at several settings, and other posteriors."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from sbi_rope._sbi import ConditionalDensityEstimator, estimator_of
from sbi_rope._validation import (
    check_choice,
    check_instance,
    check_not_negative,
    check_positive,
    check_unit_interval,
)
from sbi_rope.baselines import FinetunedNPE, PriorPosterior
from sbi_rope.errors import (
    InvalidInputError,
    InvalidTypeError,
    UnsupportedPosteriorError,
)
from sbi_rope.mixture import Part, part_of, part_of_prior
from sbi_rope.rope import RoPE

__all__ = [
    "Candidate",
    "CouplingCandidate",
    "DensityCandidate",
    "as_part",
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
    def net(self) -> tuple[bool, float | None]:
        """What tells the embedding nets of candidates apart."""
        return (self.tuned, self.rehearsal)

    @property
    def name(self) -> str:
        """The method with its setting."""
        scale = " of the embedding" if self.cost_scale == "none" else ""
        net = "" if self.rehearsal is None else f", rehearsal {self.rehearsal:g}"
        return f"{self.family} (gamma {self.gamma:g}{scale}, tau {self.tau:g}{net})"


@dataclass(frozen=True, kw_only=True)
class DensityCandidate:
    """A posterior with a density of its own, trained on calibration pairs or not.

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
        if self.name == "stack":
            raise InvalidInputError(
                "Expected another name; 'stack' is that of them all."
            )
        if not callable(self.build):
            raise InvalidTypeError(
                "Expected `build` to be a function of (rope, seed) that returns a "
                f"posterior; got {type(self.build).__name__}. Wrap a posterior: "
                "`lambda rope, seed: posterior`."
            )

    @property
    def family(self) -> str:
        """Its name."""
        return self.name


Candidate = CouplingCandidate | DensityCandidate


def default_candidates(
    *,
    gammas: Sequence[float] = GAMMAS,
    taus: Sequence[float] = TAUS,
    rehearsal: float | None = REHEARSAL,
) -> tuple[Candidate, ...]:
    """Return RoPE and OT-only over a grid, the prior, NPE, tuned NPE, fine-tuned NPE.

    Args:
        gammas: In units of the median distance between simulated embeddings.
        taus: Trust in the prior; 0 lets every observation choose by itself.
        rehearsal: Of a second RoPE over the same grid, whose tuning keeps simulations
            where they are, see :class:`~sbi_rope.CalibrationFinetuner`; None leaves it
            out.
    """
    rehearsed = [] if rehearsal is None else [{"rehearsal": rehearsal}]
    nets: list[dict[str, Any]] = [{"tuned": True}, *rehearsed, {"tuned": False}]
    couplings = [
        CouplingCandidate(gamma=gamma, tau=tau, **net)
        for net, gamma, tau in itertools.product(nets, gammas, taus)
    ]
    return (
        *couplings,
        DensityCandidate(name="prior", build=_prior, fixed=True),
        DensityCandidate(name="NPE", build=lambda rope, seed: rope.npe, fixed=True),
        DensityCandidate(
            name="tuning-only", build=lambda rope, seed: rope.tuned_posterior()
        ),
        DensityCandidate(name="fine-tuned NPE", build=_finetuned),
    )


def _prior(rope: RoPE, seed: int) -> PriorPosterior:
    return PriorPosterior(rope.npe.prior)


def _finetuned(rope: RoPE, seed: int) -> Any:
    method = FinetunedNPE.from_posterior(rope.npe)
    method.append_calibration(*rope.calibration)
    return method.train(seed=seed, show_progress_bars=False).build_posterior()


def check_candidates(candidates: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """Return the candidates, couplings first, with those of one net side by side.

    Raises:
        InvalidTypeError: If one is something else.
        InvalidInputError: If there is no coupling among them, or two have one name.
    """
    if not isinstance(candidates, Sequence):
        raise InvalidTypeError(
            "Expected `candidates` to be a list of candidates; got "
            f"{type(candidates).__name__}."
        )
    for candidate in candidates:
        if not isinstance(candidate, CouplingCandidate | DensityCandidate):
            raise InvalidTypeError(
                "Expected `candidates` to be CouplingCandidates and DensityCandidates; "
                f"got {type(candidate).__name__}. Wrap a posterior that was not "
                "trained on the calibration pairs: DensityCandidate(name=..., "
                "build=lambda rope, seed: posterior, fixed=True)."
            )
    if not any(isinstance(c, CouplingCandidate) for c in candidates):
        raise InvalidInputError(
            "Expected at least one CouplingCandidate; got none. Add to the list that "
            "`default_candidates()` returns."
        )
    names = [candidate.name for candidate in candidates]
    if len(set(names)) < len(names):
        double = sorted({name for name in names if names.count(name) > 1})
        raise InvalidInputError(f"Expected names that differ; got {double} twice.")
    couplings = [c for c in candidates if isinstance(c, CouplingCandidate)]
    nets = [c.net for c in couplings]
    couplings.sort(key=lambda c: nets.index(c.net))
    others = [c for c in candidates if not isinstance(c, CouplingCandidate)]
    return (*couplings, *others)


def as_part(name: str, posterior: Any, rope: RoPE) -> Part:
    """Return the density of a posterior of NPE, or of the prior.

    Raises:
        UnsupportedPosteriorError: If it has none, or is of other parameters or
            observations than those of RoPE.
    """
    if isinstance(posterior, PriorPosterior):
        shape = rope.calibration[0].shape[1:]
        if posterior.prior.event_shape != shape:
            raise UnsupportedPosteriorError(
                f"Expected the candidate {name!r} to be of theta {tuple(shape)}; got "
                f"{tuple(posterior.prior.event_shape)}."
            )
        return part_of_prior(posterior.prior, rope.calibration[1].shape[1:])
    estimator = estimator_of(posterior)
    if not isinstance(estimator, ConditionalDensityEstimator):
        raise UnsupportedPosteriorError(
            f"Expected the candidate {name!r} to have a density to score; got "
            f"{type(estimator).__name__}. Train NPE instead of FMPE or NPSE."
        )
    theta, x = rope.calibration
    shapes = (estimator.input_shape, estimator.condition_shape)
    if shapes != (theta.shape[1:], x.shape[1:]):
        raise UnsupportedPosteriorError(
            f"Expected the candidate {name!r} to map x {tuple(x.shape[1:])} to theta "
            f"{tuple(theta.shape[1:])}; got x {tuple(shapes[1])} and theta "
            f"{tuple(shapes[0])}."
        )
    return part_of(estimator)
