"""Generate pressure waves, and describe stored ones.

``python -m sbi_rope.tasks.hemodynamics generate --process simulator --n 10000 --out
FILE`` simulates people and stores their waves. ``info FILE`` says what a file holds.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import torch

from sbi_rope.tasks.hemodynamics.dataset import load
from sbi_rope.tasks.hemodynamics.generation import generate
from sbi_rope.tasks.hemodynamics.population import NUISANCES, PROCESSES, Population
from sbi_rope.utils.errors import RoPEError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command with the arguments of the command line and return its status."""
    parser = argparse.ArgumentParser(
        prog="python -m sbi_rope.tasks.hemodynamics",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    add = _add_generate(commands.add_parser("generate", help="simulate and store"))
    add.set_defaults(run=_generate)
    info = commands.add_parser("info", help="describe a file of stored waves")
    info.add_argument("file", type=Path)
    info.set_defaults(run=lambda args: _info(args.file))
    args = parser.parse_args(arguments)
    try:
        args.run(args)
    # Without numba, or with a full disk, a user needs no traceback.
    except (RoPEError, ImportError, OSError) as error:
        print(f"{parser.prog}: {error}", file=sys.stderr)
        return 2
    return 0


def _add_generate(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    person = Population()
    parser.add_argument("--n", type=int, default=10_000, help="people (%(default)s)")
    parser.add_argument("--process", choices=PROCESSES, required=True)
    parser.add_argument("--seed", type=int, default=0, help="of the cohort")
    parser.add_argument("--jobs", type=int, default=1, help="at a time; -1: all cores")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE")
    parser.add_argument(
        "--height-sd",
        type=float,
        default=person.height_sd,
        help="spread of the real height, in m (%(default)s)",
    )
    parser.add_argument(
        "--segment-sd",
        type=float,
        default=person.segment_sd,
        help="spread of the logarithm of each real length (%(default)s)",
    )
    parser.add_argument(
        "--fixed-aorta",
        action="store_true",
        help="do not vary the real proximal aorta by itself",
    )
    return parser


def _generate(args: argparse.Namespace) -> None:
    start = time.perf_counter()
    population = Population(
        height_sd=args.height_sd,
        segment_sd=args.segment_sd,
        proximal_aorta=not args.fixed_aorta,
    )
    generate(
        args.out,
        n=args.n,
        process=args.process,
        seed=args.seed,
        jobs=args.jobs,
        population=population,
    )
    print(f"Wrote {args.out}: {(time.perf_counter() - start) / 60:.1f} min")
    _info(args.out)


def _info(file: Path) -> None:
    beats = load(file)
    print(f"{len(beats)} people, {sum(beats.rejected.values())} rejected")
    for reason, count in beats.rejected.items():
        print(f"  {count}: {reason}")
    for name, value in beats.settings.items():
        print(f"{name}: {value}")
    usual = torch.tensor(beats.settings["physics"]["courant"], dtype=torch.float32)
    retried = int((beats.courant != usual).sum())
    print(f"calculated again with a smaller time step: {retried}\n")
    systolic, diastolic = beats.beat.amax(dim=1), beats.beat.amin(dim=1)
    columns = {
        "systolic pressure [mmHg]": systolic,
        "diastolic pressure [mmHg]": diastolic,
        "pulse pressure [mmHg]": systolic - diastolic,
        "mean pressure [mmHg]": beats.beat.mean(dim=1),
        "last two beats, difference": beats.period_error,
        "inflow less outflow, relative": beats.mass_error,
        "stroke volume [ml]": beats.theta[:, 0],
        "ejection time [ms]": beats.theta[:, 1],
        **dict(zip(NUISANCES, beats.nuisance.T, strict=True)),
    }
    if beats.length_factors is not None:
        columns["mean length factor"] = beats.length_factors.mean(dim=1)
    print(f"{'waves at the left wrist, and people':<36}{'mean':>11}{'sd':>11}")
    for name, values in columns.items():
        mean, std = values.double().mean(), values.double().std(correction=0)
        print(f"  {name:<34}{float(mean):>11.4g}{float(std):>11.4g}")


if __name__ == "__main__":
    sys.exit(main())
