"""Every method of the benchmark on one task, trained on the same data.

    python -m benchmarks.methods --task light_tunnel_sensors --root FOLDER
    python -m benchmarks.methods --task pendulum --methods prior NPE RoPE HVAE

prints one table. Nothing was tuned on the test observations it reports: the settings
are those of `benchmarks/presets.py`.
"""

import argparse
import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.cases import Case, Sources
from benchmarks.cells import NEEDS_COUPLING, Cell
from benchmarks.machine import describe_machine
from benchmarks.store import Cache
from sbi_rope import RoPE, SinkhornCoupler
from sbi_rope.baselines import (
    HVAE,
    NNPE,
    NPE,
    NPERS,
    RNPE,
    SBI,
    BuildsOnNPE,
    CalibrationMLP,
    FinetunedNPE,
    JointNPE,
    Method,
    PriorBaseline,
    TuningOnly,
    UsesCalibration,
    UsesObservations,
    UsesSimulations,
)
from sbi_rope.metrics import Evaluation, evaluate

__all__ = ["EXTRAS", "METHODS", "ONLY_FOR", "Failure", "Score", "scores"]

# Tasks whose observations are statistics: NNPE's noise is on them, not on h(x).
STATISTICS = ("cs", "sir", "linear_gaussian")
# More entries are no list of statistics that RNPE's chains could go through.
MAX_STATISTICS = 10
# A method that takes a differentiable simulator, and the tasks that have one.
ONLY_FOR = {"HVAE": ("pendulum", "light_tunnel")}
# Channels of its first layer: an eighth of the paper's, for CPUs.
HVAE_WIDTH = 8
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


def _is_short(case: Case) -> bool:
    return math.prod(case.task.x_shape) <= MAX_STATISTICS


def _from_scratch(case: Case) -> tuple[Any, Any]:
    return case.task.get_prior(), case.builder


# How each method without a coupling is constructed; `scores` appends the data.
METHODS: dict[str, Callable[[Case], Method]] = {
    "prior": lambda case: PriorBaseline(case.task.get_prior(), device=case.device),
    "SBI": lambda case: SBI.from_posterior(case.npe),
    "NPE": lambda case: NPE.from_posterior(case.npe),
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
    "HVAE": lambda case: HVAE.from_posterior(
        case.npe, physics=_physics(case), width=HVAE_WIDTH
    ),
    "tuning-only": lambda case: TuningOnly.from_posterior(
        case.npe, simulator=case.simulator, finetuner=case.settings.finetuner
    ),
}


@dataclass(frozen=True, kw_only=True)
class Score:
    """The scores of a cell on the test set, and what it cost.

    Attributes:
        cell: The cell.
        posterior: The posterior that was scored.
        test_set: The pairs it was scored on.
        evaluation: Its scores.
        train_seconds: Training, without that of the NPE that methods share; of RoPE the
            fine-tuning, which the couplings of a sweep share.
        couple_seconds: Simulating and coupling.
        test_seconds: Sampling and evaluating the posteriors of the test set.
        num_simulations: Simulations behind the posterior, those of the shared NPE
            included.
        shares_npe: Whether it starts from the NPE that methods share.
        converged: Whether the coupling has converged; True without one.
    """

    cell: Cell
    posterior: Any
    test_set: tuple[Tensor, Tensor]
    evaluation: Evaluation
    train_seconds: float
    couple_seconds: float
    test_seconds: float
    num_simulations: int
    shares_npe: bool
    converged: bool = True


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A cell that could not be scored, and why."""

    cell: Cell
    error: Exception


def scores(
    case: Case, cells: Sequence[Cell], group: Sequence[Cell]
) -> Iterator[Score | Failure]:
    """Score cells that differ in gamma and tau only, each when it is asked for.

    The sweep over gamma and tau passes by all of ``group``, of which ``cells`` are a
    part.

    A posterior that cannot be scored is a failure of its cell alone.

    Raises:
        Exception: Whatever stops all cells, such as a failing training.
    """
    if case.cell.method in NEEDS_COUPLING:
        yield from _coupled_scores(case, cells, group)
    else:
        for cell in cells:
            yield _score(case, cell)


def _score(case: Case, cell: Cell) -> Score:
    theta, x_o = case.test_set
    pairs = (theta, x_o)
    count = _Count(case)
    method = METHODS[cell.method](case)
    start = time.perf_counter()
    if isinstance(method, UsesSimulations) and method.needs_simulations:
        # Without a simulator, tuning-only looks targets up among stored simulations.
        stored = cell.method == "tuning-only"
        method.append_simulations(*(case.stored if stored else case.simulations))
    if isinstance(method, UsesCalibration):
        method.append_calibration(*case.calibration)
    if isinstance(method, UsesObservations):
        method.append_observations(x_o)
    method.train(seed=case.seed, show_progress_bars=False)
    posterior = method.build_posterior()
    seconds = time.perf_counter() - start
    used = len(case.simulations[0]) if isinstance(method, UsesSimulations) else 0
    used += count.new
    if isinstance(method, SBI):
        if case.simulator is None:
            assert case.held_out is not None
            pairs = case.held_out
        else:
            pairs = method.simulated_test_set(theta, case.simulator, seed=case.seed)
    evaluation, test_seconds = _evaluate(case, posterior, pairs)
    return Score(
        cell=cell,
        posterior=posterior,
        test_set=pairs,
        evaluation=evaluation,
        train_seconds=seconds,
        couple_seconds=0.0,
        test_seconds=test_seconds,
        num_simulations=used,
        shares_npe=isinstance(method, BuildsOnNPE),
    )


def _coupled_scores(
    case: Case, cells: Sequence[Cell], group: Sequence[Cell]
) -> Iterator[Score | Failure]:
    count = _Count(case)
    rope = RoPE(
        case.npe,
        simulator=case.simulator,
        simulations=case.stored if case.simulator is None else None,
        finetuner=case.settings.finetuner,
    )
    start = time.perf_counter()
    if case.cell.method == "RoPE":
        rope.append_calibration(*case.calibration)
        rope.train(seed=case.seed, show_progress_bars=False)
    train_seconds = time.perf_counter() - start
    wanted = {(cell.gamma, cell.tau): cell for cell in cells}
    # One sweep over all, from large gammas to small: it simulates and normalises once.
    gammas = sorted({cell.gamma for cell in group if cell.gamma}, reverse=True)
    taus = sorted({cell.tau for cell in group if cell.tau is not None}, reverse=True)
    start = time.perf_counter()
    posteriors = rope.sweep(
        case.test_set[1],
        gammas=gammas,
        taus=taus,
        coupler=SinkhornCoupler(cost_scale=case.cell.cost_scale),  # type: ignore[arg-type]
        seed=case.seed,
        require_convergence=False,
        show_progress_bars=False,
    )
    used = len(case.simulations[0]) + count.new
    settings = itertools.product(gammas, taus)
    for setting, posterior in zip(settings, posteriors, strict=True):
        couple_seconds = time.perf_counter() - start
        cell = wanted.get(setting)
        if cell is not None:
            try:
                evaluation, test_seconds = _evaluate(case, posterior, case.test_set)
            except Exception as error:  # such as no mass inside the prior's support
                yield Failure(cell=cell, error=error)
            else:
                yield Score(
                    cell=cell,
                    posterior=posterior,
                    test_set=case.test_set,
                    evaluation=evaluation,
                    train_seconds=train_seconds,
                    couple_seconds=couple_seconds,
                    test_seconds=test_seconds,
                    num_simulations=used,
                    converged=posterior.coupling.converged,
                    shares_npe=True,
                )
        start = time.perf_counter()


class _Count:
    """How many simulations were made since."""

    def __init__(self, case: Case) -> None:
        self.simulator = case.simulator
        self.before = 0 if self.simulator is None else self.simulator.count

    @property
    def new(self) -> int:
        return 0 if self.simulator is None else self.simulator.count - self.before


def _evaluate(
    case: Case, posterior: Any, pairs: tuple[Tensor, Tensor]
) -> tuple[Evaluation, float]:
    start = time.perf_counter()
    evaluation = evaluate(
        posterior,
        *pairs,
        theta_std=case.task.prior_std.to(pairs[0]),
        num_samples=case.settings.num_samples,
        seed=case.seed,
    )
    return evaluation, time.perf_counter() - start


# The command ------------------------------------------------------------------------

ORDER = ("prior", "SBI", "NPE", "NNPE", "RNPE", "NPE-RS", "J-NPE", "MLP")
ORDER += ("fine-tuned NPE", "HVAE", "tuning-only", "OT-only", "RoPE")


def methods_for(task: str, names: list[str] | None) -> list[str]:
    """Return the methods asked for, or all that a task can be given to."""
    if names is None:
        names = [
            name
            for name in ORDER
            if name not in EXTRAS or task in ONLY_FOR.get(name, ())
        ]
    for name in names:
        if name not in ORDER:
            raise SystemExit(f"No method {name!r}; there are {list(ORDER)}.")
        if task not in ONLY_FOR.get(name, (task,)):
            raise SystemExit(f"{name} is only for {ONLY_FOR[name]}.")
    return names


HEADER = (
    "| method | LPP | LPP (z) | median LPP | -inf | ACAUC | ECE | training [s] | "
    "test [s] | simulations |\n|---|---|---|---|---|---|---|---|---|---|"
)


def as_line(score: Score) -> str:
    """Return a score as a line of a Markdown table."""
    row = score.evaluation.as_row()
    error = score.evaluation.lpp.standard_error
    lpp = f"{row['lpp']:.2f} ± {error:.2f}" if row["neg_inf_fraction"] == 0 else "-inf"
    seconds = score.train_seconds + score.couple_seconds
    return (
        f"| {score.cell.method} | {lpp} | {row['lpp_z']:.2f} | "
        f"{row['lpp_median']:.2f} | {row['neg_inf_fraction']:.3f} | "
        f"{row['acauc']:+.3f} | "
        f"{row['expected_coverage_error']:.3f} | {seconds:.1f} | "
        f"{score.test_seconds:.1f} | {score.num_simulations:,} |"
    )


def main() -> None:
    """Print one row a method."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", required=True)
    parser.add_argument("--variant", default="")
    parser.add_argument("--root", type=Path, help="folder of recorded data")
    parser.add_argument("--n-calibration", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--gamma", type=float, default=0.1, help="of the scaled cost")
    parser.add_argument("--tau", type=float, default=1.0)
    parser.add_argument("--methods", nargs="+")
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=Path("results/methods"))
    args = parser.parse_args()
    names = methods_for(args.task, args.methods)
    cell = Cell(
        task=args.task,
        variant=args.variant,
        preset=args.preset,
        method="prior",
        n_calibration=args.n_calibration,
        repetition=args.seed,
    )
    case = Case.of(cell, Sources(root=args.root), Cache(args.out), args.device)
    print(f"{case.task!r}: {args.n_calibration} calibration pairs,")
    print(f"{len(case.test_set[0])} test observations, seed {args.seed}; coupling at")
    print(f"gamma={args.gamma}, tau={args.tau} of the distances over their median.")
    print(describe_machine(threads=torch.get_num_threads()))
    print(f"NPE, which methods share, was trained in {case.npe_seconds:.0f} s.\n")
    print(HEADER, flush=True)
    for name in names:
        cell = replace(
            cell,
            method=name,
            gamma=args.gamma if name in NEEDS_COUPLING else None,
            tau=args.tau if name in NEEDS_COUPLING else None,
            cost_scale="simulated" if name in NEEDS_COUPLING else "",
        )
        for score in scores(replace(case, cell=cell), [cell], [cell]):
            if isinstance(score, Failure):
                raise score.error
            print(as_line(score), flush=True)


if __name__ == "__main__":
    main()
