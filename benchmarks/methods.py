"""The methods of the benchmark, and how each is constructed on a case."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from benchmarks.cases import Case
from sbi_rope._training import History
from sbi_rope.baselines import (
    HVAE,
    NNPE,
    NPERS,
    RNPE,
    CalibrationMLP,
    FinetunedNPE,
    JointNPE,
    Method,
    PlainNPE,
    PriorBaseline,
    ReferenceNPE,
    TuningOnly,
)
from sbi_rope.discrepancy import DiscrepancyNPE
from sbi_rope.discrepancy.correction import Space

__all__ = ["COUPLED_STACK", "EXTRAS", "METHODS", "ONLY_FOR", "ORDER", "STACK"]

# Tasks whose observations are statistics: NNPE's noise is on them, not on h(x).
STATISTICS = ("cs", "sir", "linear_gaussian")
# More entries are no list of statistics that RNPE's chains could go through.
MAX_STATISTICS = 10
# With more entries than these, x itself is no list of summaries to be corrected.
MAX_SUMMARIES = 20
# Methods for some tasks only: one takes a differentiable simulator, one short x.
ONLY_FOR = {
    "HVAE": ("pendulum", "light_tunnel"),
    "discrepancy (input)": ("cs", "light_tunnel_sensors", "linear_gaussian", "sir"),
}
# Channels of its first layer: an eighth of the paper's, for CPUs.
HVAE_WIDTH = 8
# Networks that a fine-tuned discrepancy averages over.
NUM_HOLDOUTS = 5
# Run where they are asked for by name: they take longer than all others together.
EXTRAS = ("RNPE", "HVAE")


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


def _is_short(case: Case, most: int = MAX_STATISTICS) -> bool:
    return math.prod(case.task.x_shape) <= most


def _from_scratch(case: Case) -> tuple[Any, Any]:
    return case.task.get_prior(), case.builder


class _ThenFinetuned(DiscrepancyNPE):
    """A corrected NPE that is then fine-tuned on the same pairs."""

    def _fit(self, *, show_progress_bars: bool) -> tuple[Any, History]:
        corrected, _ = super()._fit(show_progress_bars=show_progress_bars)
        method = FinetunedNPE.from_posterior(corrected, num_holdouts=NUM_HOLDOUTS)
        method.append_calibration(*self._data.calibration)
        method.train(show_progress_bars=show_progress_bars)
        return method.build_posterior(), method.history


def _discrepancy(
    space: Space | None = None,
    *,
    kind: type[DiscrepancyNPE] = DiscrepancyNPE,
    learn_prior: bool = False,
) -> Callable[[Case], Method]:
    """Return how a variant is constructed; it corrects x where it is short if None."""

    def construct(case: Case) -> Method:
        short: Space = "input" if _is_short(case, MAX_SUMMARIES) else "embedding"
        # Where there is no simulator, `scores` appends simulations.
        return kind.from_posterior(
            case.npe,
            simulator=case.simulator,
            space=short if space is None else space,
            learn_prior=learn_prior,
            num_simulations=case.settings.num_simulations,
        )

    return construct


# How each method without a coupling is constructed; `scores` appends the data.
METHODS: dict[str, Callable[[Case], Method]] = {
    "prior": lambda case: PriorBaseline(case.task.get_prior(), device=case.device),
    "SBI": lambda case: ReferenceNPE.from_posterior(case.npe),
    "NPE": lambda case: PlainNPE.from_posterior(case.npe),
    "NNPE": lambda case: NNPE.from_posterior(
        case.npe, training=case.settings.training, noise_on=_noise_on(case)
    ),
    # Its chains do not mix on embeddings wider than what they are made from.
    "RNPE": lambda case: RNPE.from_posterior(
        case.npe, noise_on="input" if _is_short(case) else "embedding"
    ),
    "NPE-RS": lambda case: NPERS(
        *_from_scratch(case), training=case.settings.training, device=case.device
    ),
    "J-NPE": lambda case: JointNPE(
        *_from_scratch(case),
        training=replace(case.settings.training, validation_fraction=0.2),
        device=case.device,
    ),
    "MLP": lambda case: CalibrationMLP(*_from_scratch(case), device=case.device),
    "fine-tuned NPE": lambda case: FinetunedNPE.from_posterior(case.npe),
    "discrepancy": _discrepancy("embedding"),
    "discrepancy (input)": _discrepancy("input"),
    "discrepancy (tuned)": _discrepancy("tuned"),
    "discrepancy, prior learned": _discrepancy("embedding", learn_prior=True),
    "discrepancy, fine-tuned": _discrepancy(kind=_ThenFinetuned),
    "HVAE": lambda case: HVAE.from_posterior(
        case.npe, physics=_physics(case), width=HVAE_WIDTH
    ),
    "tuning-only": lambda case: TuningOnly.from_posterior(
        case.npe, simulator=case.simulator, finetuner=case.settings.finetuner
    ),
}

# Of any observation, and of the test set as a batch, with couplings.
STACK, COUPLED_STACK = "stack", "stack of a batch"
# All names, in the order of tables.
ORDER = ("prior", "SBI", "NPE", "NNPE", "RNPE", "NPE-RS", "J-NPE", "MLP")
ORDER += ("fine-tuned NPE", "discrepancy", "discrepancy (input)")
ORDER += ("discrepancy (tuned)", "discrepancy, prior learned")
ORDER += ("discrepancy, fine-tuned", "HVAE", "tuning-only", "OT-only", "RoPE")
ORDER += (STACK, COUPLED_STACK)
