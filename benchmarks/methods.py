"""The methods of the benchmark: one entry each, and how it is constructed on a case."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from benchmarks.cases import Case
from sbi_rope.baselines import (
    FMCPE,
    FRISBI,
    HVAE,
    NNPE,
    NPERS,
    RNPE,
    RVNP,
    CalibrationMLP,
    JointNPE,
    PlainNPE,
    PriorBaseline,
    ReferenceNPE,
    Regression,
    TuningOnly,
)
from sbi_rope.density import MixturePosterior
from sbi_rope.methods import DiscrepancyNPE, FinetunedNPE, Method, Training
from sbi_rope.methods.discrepancy_npe import Corrected
from sbi_rope.rope import RoPE
from sbi_rope.stacking import StackData
from sbi_rope.stacking.candidates import DiscrepancyCandidate
from sbi_rope.training.fit import History

# Tasks whose observations are statistics: NNPE's noise is on them, not on h(x).
STATISTICS = ("cs", "sir", "linear_gaussian", "ocean_colour")
# More entries are no list of statistics that RNPE's chains could go through.
MAX_STATISTICS = 10
# With more entries than these, x itself is no list of summaries to be corrected.
MAX_SUMMARIES = 20
# With more entries than these, FMCPE maps h(x): x itself, as published, takes hours.
MAX_MAPPED = 200
# Channels of HVAE's first layer: an eighth of the paper's, for CPUs.
HVAE_WIDTH = 8
# Networks that a fine-tuned discrepancy averages over.
NUM_HOLDOUTS = 5
# Where there is no simulator, they look simulations up among the stored ones.
LOOK_UP = ("FMCPE", "FRISBI", "FRISBI (distilled)", "OT-only", "tuning-only")
# Of the pairs alone; of candidates that keep NPE's prior; and with a candidate that
# learns from the test set without its labels.
STACK, GIVEN_PRIOR_STACK = "stack", "stack, given prior"
OBSERVED_STACK = "stack with x_o"
STACKS = (STACK, GIVEN_PRIOR_STACK, OBSERVED_STACK)


@dataclass(frozen=True, kw_only=True)
class Entry:
    """What the benchmark knows of a method.

    Attributes:
        build: Constructs it on a case; None for what `scoring.py` makes itself.
        style: Colour, line and marker in figures.
        pairs: Whether it sees calibration pairs.
        observations: Whether it sees the test observations, without their labels.
        couples: Whether it has gamma and tau.
    """

    style: tuple[str, str, str | None]
    build: Callable[[Case], Method] | None = None
    pairs: bool = False
    observations: bool = False
    couples: bool = False


# How methods are constructed ----------------------------------------------------------


def _physics(case: Case) -> Callable[[Tensor], Tensor]:
    """Return the simulator without noise and nuisances, differentiable in theta."""
    simulator: Any = case.task.get_simulator()
    if case.task.name == "light_tunnel":
        return simulator.image

    def at_rest(theta: Tensor) -> Tensor:
        none = torch.zeros_like(theta[:, :1])
        return simulator.position(theta, phase=none, damping=none)

    return at_rest


def _noise_on(case: Case) -> Any:
    return "input" if case.task.name in STATISTICS else "embedding"


def _published_noise(case: Case) -> float:
    return 0.5 if case.task.name == "wind_tunnel" else 0.05


def _short_space(case: Case, most: int) -> Corrected:
    return "input" if math.prod(case.task.x_shape) <= most else "embedding"


def _from_scratch(case: Case) -> tuple[Any, Any]:
    return case.task.get_prior(), case.builder


class _ThenFinetuned(DiscrepancyNPE):
    """A corrected NPE that is then fine-tuned on the same pairs."""

    own_training: Training | None = None  # of the fine-tuning

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        corrected, _ = super()._fit(show_progress_bars=show_progress_bars)
        method = FinetunedNPE.from_posterior(
            corrected, training=self.own_training, num_holdouts=NUM_HOLDOUTS
        )
        method.append_calibration(*self._data.calibration)
        method.train(show_progress_bars=show_progress_bars)
        return method.build_posterior(), method.history


class _Tuned(DiscrepancyNPE):
    """The discrepancy behind tuned nets that is a candidate of stacks, alone."""

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, None]:
        simulations = self._looked_up
        rope = RoPE(self._given_npe, simulator=self._simulator, simulations=simulations)
        rope.append_calibration(*self._data.calibration)
        [seed] = torch.randint(2**31, (1,)).tolist()
        data = StackData(
            rope, num_folds=5, seed=seed, show_progress_bars=show_progress_bars
        )
        candidate = DiscrepancyCandidate(space="tuned", learn_prior=self.learn_prior)
        [density] = candidate.fit(data, [data.every])
        return MixturePosterior(density, self._prior), None


def _discrepancy(
    space: Corrected | None = None,
    *,
    kind: type[DiscrepancyNPE] = DiscrepancyNPE,
    learn_prior: bool = False,
) -> Callable[[Case], Method]:
    """Return how a variant is constructed; it corrects x where it is short if None."""
    # Where there is no simulator, simulations are appended.
    return lambda case: kind.from_posterior(
        case.npe,
        simulator=case.simulator,
        space=space or _short_space(case, MAX_SUMMARIES),
        learn_prior=learn_prior,
        num_simulations=case.settings.num_simulations,
    )


def _then_finetuned(case: Case) -> Method:
    method: Any = _discrepancy(kind=_ThenFinetuned)(case)
    method.own_training = case.settings.own_training
    return method


def _variational(*, shift: bool) -> Callable[[Case], Method]:
    """Return how RVNP is constructed, with errors as published or with an offset."""
    return lambda case: RVNP.from_posterior(
        case.npe,
        noise_on=_noise_on(case),
        shift=shift,
        surrogate_training=case.settings.training,
        training=case.settings.own_training,
    )


# All methods, in the order of tables. A new one is a line here.
METHODS: dict[str, Entry] = {
    "prior": Entry(
        style=("0.6", "-", None),
        build=lambda case: PriorBaseline(case.task.get_prior(), device=case.device),
    ),
    "SBI": Entry(
        style=("0.25", ":", None),
        build=lambda case: ReferenceNPE.from_posterior(case.npe),
    ),
    "NPE": Entry(
        style=("#D55E00", "--", None),
        build=lambda case: PlainNPE.from_posterior(case.npe),
    ),
    "NNPE": Entry(
        style=("#8B4513", "-.", None),
        build=lambda case: NNPE.from_posterior(
            case.npe, training=case.settings.training, noise_on=_noise_on(case)
        ),
    ),
    # It takes longer than all others together. Its chains do not mix on embeddings
    # wider than what they are made from.
    "RNPE": Entry(
        style=("#8B4513", ":", None),
        build=lambda case: RNPE.from_posterior(
            case.npe, noise_on=_short_space(case, MAX_STATISTICS)
        ),
    ),
    "NPE-RS": Entry(
        style=("#7F3C8D", ":", None),
        observations=True,
        build=lambda case: NPERS(
            *_from_scratch(case), training=case.settings.training, device=case.device
        ),
    ),
    "RVNP": Entry(
        style=("#999933", "-.", None),
        observations=True,
        build=_variational(shift=False),
    ),
    "RVNP (offset)": Entry(
        style=("#999933", ":", None),
        observations=True,
        build=_variational(shift=True),
    ),
    "J-NPE": Entry(
        style=("#CC79A7", "-.", "v"),
        pairs=True,
        build=lambda case: JointNPE(
            *_from_scratch(case),
            training=replace(case.settings.training, validation_fraction=0.2),
            device=case.device,
        ),
    ),
    "Regression": Entry(
        style=("0.35", "--", "x"),
        pairs=True,
        build=lambda case: Regression(case.task.get_prior(), device=case.device),
    ),
    "MLP": Entry(
        style=("0.35", ":", "x"),
        pairs=True,
        build=lambda case: CalibrationMLP(
            *_from_scratch(case),
            training=case.settings.own_training,
            device=case.device,
        ),
    ),
    "fine-tuned NPE": Entry(
        style=("#E69F00", "-", "D"),
        pairs=True,
        build=lambda case: FinetunedNPE.from_posterior(
            case.npe, training=case.settings.own_training
        ),
    ),
    "fine-tuned NPE (averaged)": Entry(
        style=("#E69F00", "--", "D"),
        pairs=True,
        build=lambda case: FinetunedNPE.from_posterior(
            case.npe, training=case.settings.own_training, num_holdouts=NUM_HOLDOUTS
        ),
    ),
    "discrepancy": Entry(
        style=("#882255", "-", "h"),
        pairs=True,
        build=_discrepancy("embedding"),
    ),
    # It corrects x itself, which has to be short.
    "discrepancy (input)": Entry(
        style=("#882255", "--", "h"),
        pairs=True,
        build=_discrepancy("input"),
    ),
    "discrepancy (tuned)": Entry(
        style=("#882255", "-.", "h"),
        pairs=True,
        build=_discrepancy("embedding", kind=_Tuned),
    ),
    "discrepancy, prior learned": Entry(
        style=("#882255", ":", "h"),
        pairs=True,
        build=_discrepancy("embedding", learn_prior=True),
    ),
    "discrepancy, fine-tuned": Entry(
        style=("#AA4499", "-", "p"),
        pairs=True,
        build=_then_finetuned,
    ),
    "FMCPE": Entry(
        style=("#E31A1C", "-", "<"),
        pairs=True,
        build=lambda case: FMCPE.from_posterior(
            case.npe,
            simulator=case.simulator,
            space=_short_space(case, MAX_MAPPED),
            noise=_published_noise(case),
            training=case.settings.own_training,
        ),
    ),
    "FRISBI": Entry(
        style=("#6A3D9A", "-", ">"),
        pairs=True,
        observations=True,
        build=lambda case: FRISBI.from_posterior(case.npe, simulator=case.simulator),
    ),
    "FRISBI (distilled)": Entry(
        style=("#6A3D9A", "--", ">"),
        pairs=True,
        observations=True,
        build=lambda case: FRISBI.from_posterior(
            case.npe, simulator=case.simulator, distilled=True
        ),
    ),
    # It takes a differentiable simulator.
    "HVAE": Entry(
        style=("#117733", "-.", "P"),
        pairs=True,
        observations=True,
        build=lambda case: HVAE.from_posterior(
            case.npe, physics=_physics(case), width=HVAE_WIDTH
        ),
    ),
    "tuning-only": Entry(
        style=("#009E73", "--", "^"),
        pairs=True,
        build=lambda case: TuningOnly.from_posterior(
            case.npe, simulator=case.simulator, finetuner=case.settings.finetuner
        ),
    ),
    "OT-only": Entry(style=("#56B4E9", "--", "s"), observations=True, couples=True),
    "RoPE": Entry(
        style=("#0072B2", "-", "o"), pairs=True, observations=True, couples=True
    ),
    STACK: Entry(style=("black", "-", "*"), pairs=True),
    GIVEN_PRIOR_STACK: Entry(style=("black", "-.", "*"), pairs=True),
    OBSERVED_STACK: Entry(style=("black", ":", "*"), pairs=True, observations=True),
}
