"""Where does RoPE lose? Its score on a task, taken apart.

The table of "Where RoPE loses, and why" in `docs/background/benchmark.md`.

    python -m benchmarks.experiments.losses --task pendulum --n-calibration 10
    python -m benchmarks.experiments.losses --task sir --n-calibration 50

From line to line one more thing goes wrong:

- SBI: NPE on simulations of the test parameters.
- transport alone: the same simulations, coupled and mixed, so that the difference is
  what the coupling costs. They take the labels of the test set: an oracle for this
  diagnosis, and no method.
- RoPE tuned on all calibration pairs there are, up to 1000.
- RoPE tuned on as many as asked for.
- OT-only: not tuned at all.

Distances are those of g(x_o) from the mean embedding of simulations with the same
parameters, mean and median, in units of the median distance between two simulations
from the prior: of the pairs tuned on (for OT-only, of the same pairs) and of the test
observations. Of "transport alone" they are the scatter of single simulations, which no
tuning can go below. ESS is the median of the couplings' effective sample sizes, and
"inside" the mass of the posteriors inside the support of the prior.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from sbi.utils import within_support
from torch import Tensor, nn

from benchmarks.cases import Case, CountingSimulator, Pairs
from benchmarks.experiments.common import Row, add_task, begin, show
from benchmarks.experiments.data import case_of
from benchmarks.scoring import evaluate_on, rope_of
from sbi_rope import SinkhornCoupler
from sbi_rope.baselines import ReferenceNPE
from sbi_rope.metrics import Evaluation, draw_samples
from sbi_rope.sweep import sweep

__all__ = ["Loss", "as_row", "losses", "target_distances"]

# Most calibration pairs to tune on.
MAX_PAIRS = 1000
# Simulations behind the mean embedding at one theta, and thetas treated at a time.
NUM_PER_TARGET, CHUNK = 100, 100
# Draws from each posterior of SBI to tell how many are outside the prior.
NUM_DRAWS = 100


@dataclass(frozen=True, kw_only=True)
class Loss:
    """A line of the table.

    Attributes:
        name: What was scored.
        evaluation: Its scores on the test set.
        inside: Mean mass of a posterior inside the prior's support.
        gamma: Of the coupling; None without one, like all that follow.
        effective_sample_size: Its median over the observations.
        converged: Whether the coupling has converged.
        calibration: Distances from the targets of the pairs tuned on.
        test: The same of the test observations.
    """

    name: str
    evaluation: Evaluation
    inside: float
    gamma: float | None = None
    effective_sample_size: float | None = None
    converged: bool = True
    calibration: Tensor | None = None
    test: Tensor | None = None


@dataclass(frozen=True, kw_only=True)
class _Stage:
    """What RoPE is given: pairs to tune on, if any, and observations to infer."""

    name: str
    tuned_on: Pairs | None = None
    looked_at: Pairs | None = None
    test_set: Pairs


def losses(
    case: Case,
    *,
    gammas: Sequence[float],
    tau: float = 1.0,
    num_simulations: int | None = None,
) -> Iterator[Loss]:
    """Score RoPE with and without what it loses by, each when it is asked for.

    Args:
        case: The data; its calibration pairs are those that RoPE is tuned on.
        gammas: Of the coupling, in units of the median distance between simulations.
        tau: Of the coupling.
        num_simulations: To couple with; as many as RoPE chooses if None.

    Raises:
        SystemExit: If the task has no simulator.
    """
    if case.simulator is None:
        raise SystemExit(
            f"{case.task.name} has stored simulations only: those of the test "
            "parameters, which this command compares with, cannot be made."
        )
    sbi = ReferenceNPE.from_posterior(case.npe)
    sbi.train(seed=case.seed, show_progress_bars=False)
    simulated = sbi.simulated_test_set(case.test_set[0], case.simulator, seed=case.seed)
    yield _without_coupling(case, sbi.build_posterior(), simulated)
    recorded = case.task.num_recorded("calibration", seed=case.seed)
    count = min(MAX_PAIRS, recorded or MAX_PAIRS)
    all_pairs, pairs = (
        case.task.get_calibration_set(n, seed=case.seed)
        for n in (count, case.cell.n_calibration)
    )
    real = case.test_set
    for stage in (
        _Stage(name="transport alone (sees test labels)", test_set=simulated),
        _Stage(name=f"RoPE, all {count} pairs", tuned_on=all_pairs, test_set=real),
        _Stage(name=f"RoPE, {len(pairs[0])} pairs", tuned_on=pairs, test_set=real),
        _Stage(name="OT-only", looked_at=pairs, test_set=real),
    ):
        yield from _with_coupling(
            case, stage, gammas=gammas, tau=tau, num_simulations=num_simulations
        )


def target_distances(
    g: nn.Module,
    h: nn.Module,
    simulator: CountingSimulator,
    pairs: Pairs,
    *,
    seed: int,
) -> Tensor:
    """Return how far g(x) is from the mean of h over simulations at theta, ``(n,)``.

    Args:
        g: Embedding net of the observations.
        h: Embedding net of the simulations.
        simulator: Maps parameters to simulations, batched.
        pairs: Parameters and observations.
        seed: Seed of the simulations.
    """
    distances = []
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(seed)
        for theta, x in zip(*(part.split(CHUNK) for part in pairs), strict=True):
            embedded = h(simulator(theta.repeat_interleave(NUM_PER_TARGET, dim=0)))
            targets = embedded.unflatten(0, (len(theta), NUM_PER_TARGET))
            # Where a simulation failed, the target is the mean of the others.
            distances.append((g(x) - targets.nanmean(dim=1)).norm(dim=1))
    return torch.cat(distances)


def _without_coupling(case: Case, posterior: Any, test_set: Pairs) -> Loss:
    with torch.random.fork_rng():
        torch.manual_seed(case.seed)
        draws = draw_samples(posterior, test_set[1], num_samples=NUM_DRAWS)
    inside = within_support(case.task.get_prior(), draws.flatten(0, 1))
    return Loss(
        name="SBI",
        evaluation=evaluate_on(case, posterior, test_set),
        inside=float(inside.double().mean()),
    )


def _with_coupling(
    case: Case,
    stage: _Stage,
    *,
    gammas: Sequence[float],
    tau: float,
    num_simulations: int | None,
) -> Iterator[Loss]:
    assert case.simulator is not None
    rope = rope_of(case)
    h = g = rope.embedding_net
    if stage.tuned_on is not None:
        rope.append_calibration(*stage.tuned_on)
        rope.train(seed=case.seed, show_progress_bars=False)
        g = rope.tuned_embedding_net
    near, test = (
        None
        if pairs is None
        else target_distances(g, h, case.simulator, pairs, seed=case.seed)
        for pairs in (stage.tuned_on or stage.looked_at, stage.test_set)
    )
    assert test is not None
    posteriors = sweep(
        rope,
        stage.test_set[1],
        gammas=gammas,
        taus=[tau],
        coupler=SinkhornCoupler(cost_scale="simulated"),
        num_simulations=num_simulations,
        seed=case.seed,
        require_convergence=False,
        show_progress_bars=False,
    )
    for gamma, posterior in zip(gammas, posteriors, strict=True):
        coupling = posterior.coupling
        unit = coupling.gamma / gamma
        yield Loss(
            name=stage.name,
            evaluation=evaluate_on(case, posterior, stage.test_set),
            inside=float(posterior.leakage(stage.test_set[1]).mass.mean()),
            gamma=gamma,
            effective_sample_size=float(coupling.effective_sample_size.median()),
            converged=coupling.converged,
            calibration=None if near is None else near / unit,
            test=test / unit,
        )


# The table --------------------------------------------------------------------------

OPTIONS = {
    "--n-calibration": {"type": int, "required": True},
    "--repetition": {"type": int, "default": 0},
    "--gamma": {"type": float, "nargs": "+", "default": [0.1]},
    "--tau": {"type": float, "default": 1.0},
    "--num-simulations": {"type": int, "help": "to couple with"},
}


def rows(args: argparse.Namespace) -> Iterator[Row]:
    """Yield one row a line and gamma."""
    case = case_of(args, n_calibration=args.n_calibration, repetition=args.repetition)
    print(f"{case.task!r}, preset {args.preset}, repetition {args.repetition},")
    print(f"{len(case.test_set[0])} test observations, tau {args.tau:g}.\n")
    for loss in losses(
        case, gammas=args.gamma, tau=args.tau, num_simulations=args.num_simulations
    ):
        yield as_row(loss)


def as_row(loss: Loss) -> Row:
    """Return a row of the table."""
    score = loss.evaluation.lpp_z
    assert score is not None
    gamma = size = "-"
    if loss.gamma is not None:
        gamma = f"{loss.gamma:g}" + ("" if loss.converged else " (not converged)")
        size = f"{loss.effective_sample_size:.0f}"
    mean = "-inf"
    if not score.neg_inf_fraction:
        mean = f"{score.mean:.2f} ± {score.standard_error:.2f}"
    return {
        "scored": loss.name,
        "gamma": gamma,
        "LPP (z)": mean,
        "median": f"{score.median:.2f}",
        "ACAUC": f"{loss.evaluation.acauc.value:+.3f}",
        "ESS": size,
        "inside": f"{loss.inside:.3f}",
        "distance, pairs": _summary(loss.calibration),
        "distance, test": _summary(loss.test),
    }


def _summary(distances: Tensor | None) -> str:
    if distances is None:
        return "-"
    return f"{distances.mean():.3f}, {distances.median():.3f}"


if __name__ == "__main__":
    show(rows(begin(__doc__, add_task(OPTIONS))))
