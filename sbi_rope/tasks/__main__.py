"""List the tasks, describe one, and draw its observations.

``python -m sbi_rope.tasks`` prints all tasks, ``python -m sbi_rope.tasks NAME`` one of
them, with prior-predictive summaries; ``--plot FILE`` draws real beside simulated.
"""

import argparse
import dataclasses
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from sbi_rope.errors import RoPEError
from sbi_rope.tasks import Task, get_task, list_tasks

__all__ = ["main", "print_table"]

QUANTILES = (0.01, 0.25, 0.5, 0.75, 0.99)
NUM_ROWS = 1000
# Seconds that a simulator is timed for.
BUDGET = 0.5


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command with the arguments of the command line and return its status."""
    parser = argparse.ArgumentParser(
        prog="python -m sbi_rope.tasks",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("name", nargs="?", help=f"one of {', '.join(list_tasks())}")
    parser.add_argument("--variant", help="a kind of real process")
    parser.add_argument("--root", type=Path, help="folder with recorded data")
    parser.add_argument(
        "--stand-in",
        action="store_true",
        help="put a model in the place of recorded data, where the task has one",
    )
    parser.add_argument(
        "-n", type=int, default=NUM_ROWS, help="draws behind a summary (%(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--plot", type=Path, metavar="FILE", help="picture to write")
    args = parser.parse_args(arguments)
    if args.name is None and (args.plot or args.variant or args.stand_in):
        parser.error("--plot, --variant and --stand-in need the name of a task")
    try:
        if args.name is None:
            _print_list(args.root)
        else:
            options = {"stand_in": True} if args.stand_in else {}
            task = get_task(args.name, variant=args.variant, root=args.root, **options)
            # Draws first: what cannot be done is said before anything is printed.
            theta, x_s = task.get_simulations(args.n, seed=args.seed)
            real = None
            if task.has_data or args.plot:
                real = task.get_test_set(args.n, seed=args.seed)
            _describe(task, theta, x_s, real)
            if args.plot and real:
                _draw(task, *real, path=args.plot, seed=args.seed)
    except (RoPEError, ImportError, OSError) as error:
        print(f"{parser.prog}: {error}", file=sys.stderr)
        return 2
    return 0


# All tasks ---------------------------------------------------------------------------


def _print_list(root: Path | None) -> None:
    print(f"{'task':<22}{'theta':>6}  {'x':<15}{'real data':<20}{'simulations/s':>14}")
    for name in list_tasks():
        task = get_task(name, root=root)
        shape = " x ".join(map(str, task.x_shape))
        line = f"{name:<22}{task.theta_dim:>6}  {shape:<15}{_state_of_data(task):<20}"
        print(line, end="", flush=True)
        print(f"{_simulations_per_second(task):>14,.0f}", flush=True)
    print(
        f"\nsimulations/s: batches of {NUM_ROWS} on {torch.get_num_threads()} "
        "thread(s), measured now. Recorded data are looked for in --root."
    )


def _state_of_data(task: Task) -> str:
    if not task.required_files:
        return "drawn"
    if task.has_data:
        return "recorded, found"
    return "recorded, no --root" if task.root is None else "recorded, missing"


def _simulations_per_second(task: Task) -> float:
    simulator = task.get_simulator()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        theta = task.get_prior().sample(torch.Size((NUM_ROWS,)))
        simulator(theta[:100])  # tables that are made once
        count, seconds, start = 0, 0.0, time.perf_counter()
        while count == 0 or seconds < BUDGET:
            simulator(theta)
            count += NUM_ROWS
            seconds = time.perf_counter() - start
    return count / seconds


# One task ----------------------------------------------------------------------------


def _describe(
    task: Task, theta: Tensor, x_s: Tensor, real: tuple[Tensor, Tensor] | None
) -> None:
    n = len(theta)
    wrong = "nothing" if task.variant == "well_specified" else task.misspecification
    print(f"{task!r}\nWhat the simulator gets wrong: {wrong}.\n")
    units = dict(zip(task.parameter_names, task.parameter_units, strict=True))
    columns = {
        name if unit == "1" else f"{name} [{unit}]": theta[:, k]
        for k, (name, unit) in enumerate(units.items())
    }
    print_table(f"prior ({n} draws)", columns)
    print_table(f"simulated x ({n} draws)", _summaries(task, x_s))
    if real:
        title = f"{_kind(task)} x ({n} test observations)"
        print_table(title, _summaries(task, real[1]))
    else:
        files = ", ".join(map(str, task.required_files))
        print(f"No real x: {files} not found; give its folder as --root.\n")
    print("Variants:")
    for name, sentence in task.variants.items():
        print(f"  {name}: {sentence}")
    region = " and ".join(
        f"{low:g} < {name} < {high:g}"
        for name, (low, high) in task.shifted_region.items()
    )
    print(f"shifted_region: {region}")
    if task.paper_settings is not None:
        print("\nHyper-parameters in the paper (None: not stated):")
        for name, value in dataclasses.asdict(task.paper_settings).items():
            print(f"  {name}: {value}")


def _kind(task: Task) -> str:
    if task.variant == "well_specified":
        return "well-specified"
    return "stand-in" if task.stand_in else "real"


def _summaries(task: Task, x: Tensor) -> dict[str, Tensor]:
    if task.x_names:
        return dict(zip(task.x_names, x.T, strict=True))
    x = x.flatten(1)
    return {
        "mean over x": x.mean(dim=1),
        "sd over x": x.std(dim=1),
        "minimum of x": x.amin(dim=1),
        "maximum of x": x.amax(dim=1),
    }


def print_table(title: str, columns: dict[str, Tensor]) -> None:
    """Print mean, standard deviation and quantiles of named numbers."""
    head = "".join(f"{f'q{100 * q:02.0f}':>11}" for q in QUANTILES)
    print(f"{title:<34}{'mean':>11}{'sd':>11}{head}")
    for name, values in columns.items():
        values = values.double()
        numbers = [values.mean(), values.std(correction=0)]
        numbers += [torch.quantile(values, q) for q in QUANTILES]
        print(f"  {name:<32}" + "".join(f"{float(v):>11.4g}" for v in numbers))
    print()


def _draw(task: Task, theta: Tensor, x_o: Tensor, *, path: Path, seed: int) -> None:
    from sbi_rope.plots import real_and_simulated

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        x_s = task.get_simulator()(theta)
    figure = real_and_simulated(
        x_o, x_s, x_names=task.x_names, labels=(_kind(task), "simulated")
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    print(
        f"\nWritten to {path}: {_kind(task)} test observations, and simulations at "
        "the same parameters."
    )


if __name__ == "__main__":
    sys.exit(main())
