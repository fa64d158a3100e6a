"""Generate pressure waves, validate the simulator, and describe stored waves.

``python -m sbi_rope.tasks.hemodynamics generate --process simulator --n 10000 --out
FILE`` simulates people and stores their waves; after an interrupt, the same command
goes on from there. ``validate`` prints how well the simulator agrees with what is
known, ``info FILE`` what a file holds.
"""

import argparse
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sbi_rope.errors import RoPEError
from sbi_rope.tasks.hemodynamics.dataset import BeatSet, load
from sbi_rope.tasks.hemodynamics.population import PROCESSES, Population
from sbi_rope.tasks.hemodynamics.subject import NUM_SEGMENTS, Physics

__all__ = ["main"]

QUANTILES = (0.01, 0.25, 0.5, 0.75, 0.99)
SITES = ("aortic", "brachial", "radial")
NUM_DRAWN = 10  # people in a picture


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command with the arguments of the command line and return its status."""
    parser = argparse.ArgumentParser(
        prog="python -m sbi_rope.tasks.hemodynamics",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    _add_generate(commands)
    _add_validate(commands)
    info = commands.add_parser("info", help="describe a file of stored waves")
    info.add_argument("file", type=Path)
    info.set_defaults(run=_info)
    args = parser.parse_args(arguments)
    try:
        return args.run(args)
    # Without numba or matplotlib, or with a full disk, a user needs no traceback.
    except (RoPEError, ImportError, OSError) as error:
        if isinstance(error, BrokenPipeError):
            raise
        print(f"{parser.prog}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"{parser.prog}: interrupted.", file=sys.stderr)
        return 130


# Generate ----------------------------------------------------------------------------


def _add_generate(commands: Any) -> None:
    parser = commands.add_parser("generate", help="simulate people and store the waves")
    parser.set_defaults(run=_generate)
    person, grid = Population(), Physics()
    parser.add_argument("--n", type=int, default=10_000, help="people (%(default)s)")
    parser.add_argument("--process", choices=PROCESSES, required=True)
    parser.add_argument("--seed", type=int, default=0, help="of the cohort")
    parser.add_argument("--jobs", type=int, default=1, help="at a time; -1: all cores")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE")
    parser.add_argument(
        "--prior",
        choices=("population", "independent"),
        default=person.prior,
        help="law of stroke volume and ejection time (%(default)s)",
    )
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
    parser.add_argument(
        "--cell-length",
        type=float,
        default=grid.cell_length,
        help="of the grid, in m (%(default)s)",
    )
    parser.add_argument(
        "--num-cycles", type=int, default=grid.num_cycles, help="beats (%(default)s)"
    )
    parser.add_argument(
        "--elastic", action="store_true", help="walls without viscosity"
    )


def _generate(args: argparse.Namespace) -> int:
    from sbi_rope.tasks.hemodynamics.generation import generate

    start = time.perf_counter()
    try:
        beats = generate(
            args.out,
            n=args.n,
            process=args.process,
            seed=args.seed,
            jobs=args.jobs,
            population=Population(
                height_sd=args.height_sd,
                segment_sd=args.segment_sd,
                proximal_aorta=not args.fixed_aorta,
                prior=args.prior,
            ),
            physics=Physics(
                cell_length=args.cell_length,
                num_cycles=args.num_cycles,
                viscoelastic=not args.elastic,
            ),
        )
    except KeyboardInterrupt:
        print("\nThe same command goes on from here.", file=sys.stderr)
        raise
    minutes = (time.perf_counter() - start) / 60
    print(
        f"Wrote {args.out}, {args.out.stat().st_size / 1e6:.1f} MB: {minutes:.1f} min"
    )
    _print_rejected(beats)
    return 0


def _print_rejected(beats: BeatSet) -> None:
    print(f"{len(beats)} people, {sum(beats.rejected.values())} rejected")
    for reason, count in beats.rejected.items():
        print(f"  {count}: {reason}")


# Validate ----------------------------------------------------------------------------


def _add_validate(commands: Any) -> None:
    parser = commands.add_parser("validate", help="compare with what is known")
    parser.set_defaults(run=_validate)
    parser.add_argument(
        "--reference", type=Path, metavar="FOLDER", help="stored waves of openBF"
    )
    parser.add_argument("--plot", type=Path, metavar="FILE", help="picture to write")


def _validate(args: argparse.Namespace) -> int:
    """Print a line for every check, and return 1 if one fails."""
    from sbi_rope.tasks.hemodynamics.validation import validation_table

    rows = validation_table(args.reference)
    print(f"{'check':<56}{'measured':>10}{'goal':>14}  {'unit':<14}passed")
    for row in rows:
        measured = "not run" if row.measured is None else f"{row.measured:.3g}"
        passed = {True: "yes", False: "NO", None: "-"}[row.passed]
        print(f"{row.name:<56}{measured:>10}{row.goal:>14}  {row.unit:<14}{passed}")
    if args.plot:
        _draw(args.plot)
    return int(any(row.passed is False for row in rows))


def _draw(path: Path) -> None:
    """Draw beats of the same people without and with arteries of their own lengths."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    from sbi_rope.tasks.hemodynamics.waveforms import simulate_beat

    figure = Figure(figsize=(10, 6), layout="constrained")
    axes = figure.subplots(len(PROCESSES), len(SITES), sharex=True, sharey=True)
    for index in range(NUM_DRAWN):
        real = Population().draw("real", seed=0, index=index)
        people = (replace(real, length_factors=(1.0,) * NUM_SEGMENTS), real)
        color = colormaps["viridis"]((real.age - 25.0) / 50.0)
        for row, subject in zip(axes, people, strict=True):
            beat = simulate_beat(subject, Physics())
            for ax, site in zip(row, SITES, strict=True):
                wave = beat.pressure[site]
                phase = torch.arange(len(wave)) / len(wave)
                ax.plot(beat.period * phase, wave, color=color, linewidth=1.0)
    for row, process in zip(axes, PROCESSES, strict=True):
        row[0].set_ylabel("pressure [mmHg]")
        for ax, site in zip(row, SITES, strict=True):
            ax.set_title(f"{site}, {process}")
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    figure.suptitle(
        f"The same {NUM_DRAWN} people in both processes, 25 (dark) to 75 years (bright)"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    print(f"\nWritten to {path}.")


# Info --------------------------------------------------------------------------------


def _info(args: argparse.Namespace) -> int:
    beats = load(args.file)
    _print_rejected(beats)
    for name, value in beats.settings.items():
        print(f"{name}: {value}")
    usual = torch.tensor(beats.settings["physics"]["courant"], dtype=torch.float32)
    retried = int((beats.courant != usual).sum())
    print(f"calculated again with a smaller time step: {retried}")
    systolic, diastolic = beats.beat.amax(dim=1), beats.beat.amin(dim=1)
    waves = {
        "systolic pressure [mmHg]": systolic,
        "diastolic pressure [mmHg]": diastolic,
        "pulse pressure [mmHg]": systolic - diastolic,
        "mean pressure [mmHg]": beats.beat.mean(dim=1),
        "last two beats, difference": beats.period_error,
        "inflow less outflow, relative": beats.mass_error,
    }
    _print_table("waves at the left wrist", waves)
    people = {
        "stroke volume [ml]": beats.theta[:, 0],
        "ejection time [ms]": beats.theta[:, 1],
        **dict(zip(beats.nuisance_names, beats.nuisance.T, strict=True)),
    }
    if beats.length_factors is not None:
        people["mean length factor"] = beats.length_factors.mean(dim=1)
    _print_table("people", people)
    return 0


def _print_table(title: str, columns: dict[str, Tensor]) -> None:
    head = "".join(f"{f'q{100 * q:02.0f}':>10}" for q in QUANTILES)
    print(f"\n{title:<32}{'mean':>10}{'sd':>10}{head}")
    for name, values in columns.items():
        values = values.double()
        numbers = [values.mean(), values.std(correction=0)]
        numbers += [torch.quantile(values, q) for q in QUANTILES]
        line = "".join(f"{float(v):>10.4g}" for v in numbers)
        print(f"  {name.replace('_', ' '):<30}{line}")


if __name__ == "__main__":
    try:
        status = main()
        sys.stdout.flush()
    except BrokenPipeError:  # the reader, `head` for one, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = 1
    sys.exit(status)
