"""Every method of the benchmark on one task, trained on the same data.

    python -m benchmarks.compare --task light_tunnel_sensors --root FOLDER
    python -m benchmarks.compare --task pendulum --methods prior NPE RoPE HVAE

prints one table. Nothing was tuned on the test observations it reports: the settings
are those of `benchmarks/presets.py`.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.cases import Case, Sources
from benchmarks.cells import NEEDS_COUPLING, Cell
from benchmarks.machine import describe_machine
from benchmarks.methods import EXTRAS, ONLY_FOR, ORDER
from benchmarks.scoring import Failure, Score, scores
from benchmarks.store import Cache


def methods_for(task: str, names: list[str] | None) -> list[str]:
    """Return the methods asked for, or all that a task can be given to."""
    if names is None:
        names = [
            name
            for name in ORDER
            if task in ONLY_FOR.get(name, () if name in EXTRAS else (task,))
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
