"""The choices inside the stack, measured on calibration data.

    python -m benchmarks.choices run --task pendulum --n-calibration 10 --seeds 1 2 3
    python -m benchmarks.choices report

`run` stacks a wide grid of candidates on some calibration pairs, and scores every
candidate on 300 others of the calibration set, not of the test set. `report` compares
choices (which candidates, how strong a prior of the weights, how many folds) by what
their stacks would have scored: weights need no second run.
"""

import argparse
import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.cases import Case, Sources
from benchmarks.cells import Cell
from benchmarks.store import Cache
from sbi_rope import RoPE, stack
from sbi_rope.stacking import CouplingCandidate, default_candidates
from sbi_rope.stacking.candidates import Candidate

__all__ = ["Run", "candidates", "run"]

NUM_OTHERS = 300
GAMMAS = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8)
TAUS = (1.0, 0.9, 0.5, 0.0)
REHEARSAL = 1.0


def candidates() -> list[Candidate]:
    """Return a grid that contains those of all choices."""
    return [
        *default_candidates(gammas=GAMMAS, taus=TAUS),
        *(
            CouplingCandidate(gamma=gamma, tau=tau, rehearsal=REHEARSAL)
            for gamma, tau in itertools.product(GAMMAS, TAUS)
        ),
    ]


@dataclass(frozen=True, eq=False, kw_only=True)
class Run:
    """What a stack was made from, and how its candidates did on other pairs.

    Attributes:
        task: The task, with its variant.
        num_folds: Folds of the calibration pairs.
        names: Of the candidates, K of them.
        held_out: Their log scores on held-out pairs, shape ``(n, K)``.
        others: Their log density at other pairs, in standard deviations of the prior,
            shape ``(m, K)``.
        mass: Of the couplings inside the prior's support, shape ``(m, K)``; one for
            the other candidates.
    """

    task: str
    num_folds: int
    names: tuple[str, ...]
    held_out: Tensor
    others: Tensor
    mass: Tensor

    def score(self, keep: list[int], weights: Tensor) -> float:
        """Return the mean log density of the other pairs under a stack."""
        log_density = torch.logsumexp(self.others[:, keep] + weights.log(), dim=1)
        return float((log_density - (self.mass[:, keep] @ weights).log()).mean())

    @classmethod
    def load(cls, path: Path) -> "Run":
        """Read what :func:`run` wrote."""
        with np.load(path) as stored:
            return cls(
                task=str(stored["task"]),
                num_folds=int(stored["num_folds"]),
                names=tuple(stored["names"].tolist()),
                **{
                    name: torch.as_tensor(stored[name])
                    for name in ("held_out", "others", "mass")
                },
            )


def run(case: Case, n_calibration: int, num_folds: int, seed: int) -> Run:
    """Stack on pairs of the calibration set, and score on others of it."""
    theta, x = case.task.get_calibration_set(n_calibration + NUM_OTHERS, seed=seed)
    rope = RoPE(case.npe, simulator=case.simulator, finetuner=case.settings.finetuner)
    rope.append_calibration(theta[:n_calibration], x[:n_calibration])
    rope.train(seed=seed, show_progress_bars=False)
    theta, x = theta[n_calibration:], x[n_calibration:]
    posterior = stack(
        rope,
        x,
        candidates=candidates(),
        num_folds=num_folds,
        seed=seed,
        show_progress_bars=False,
    )
    normalised = posterior.candidate_log_probs(theta, x)
    as_scored = posterior.posterior_estimator.candidate_log_probs(theta, x)
    both_zero = torch.isneginf(as_scored) & torch.isneginf(normalised)
    return Run(
        task="-".join(filter(None, (case.cell.task, case.cell.variant))),
        num_folds=num_folds,
        names=tuple(posterior.candidate_weights),
        held_out=posterior.report.cross_validation.log_scores,
        others=as_scored + case.task.prior_std.log().sum(),
        mass=(as_scored - normalised).where(~both_zero, 0.0).exp(),
    )


def main() -> None:
    """Run, or report on all runs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    runs = commands.add_parser("run")
    runs.add_argument("--task", required=True, help="one with a simulator")
    runs.add_argument("--variant", default="")
    runs.add_argument("--root", type=Path, help="folder of recorded data")
    runs.add_argument("--n-calibration", type=int, default=10)
    runs.add_argument("--folds", type=int, default=5)
    runs.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    runs.add_argument("--preset", default="standard")
    report = commands.add_parser("report")
    for command in (runs, report):
        command.add_argument("--out", type=Path, default=Path("results/choices"))
    args = parser.parse_args()
    if args.command == "run":
        cell = Cell(
            task=args.task, variant=args.variant, preset=args.preset, method="stack"
        )
        case = Case.of(cell, Sources(root=args.root), Cache(args.out), "cpu")
        args.out.mkdir(parents=True, exist_ok=True)
        for seed in args.seeds:
            name = f"{args.task}{args.variant}_{args.n_calibration}_{args.folds}_{seed}"
            path = args.out / f"{name}.npz"
            if path.exists():
                continue
            result = run(case, args.n_calibration, args.folds, seed)
            np.savez(path, **{k: np.asarray(v) for k, v in vars(result).items()})
            print(name, flush=True)


if __name__ == "__main__":
    main()
