"""Run RoPE once on every task, with a small NPE: a smoke test and a first look.

Recorded data are looked for in ROOT. Where they are missing, tasks with a synthetic
stand-in use it (and say so), others are skipped. Numbers from runs this small compare
methods only roughly.
"""

import warnings
from pathlib import Path
from typing import Any

from study import Study, argument_parser, print_table, train_small_npe

from sbi_rope import CalibrationFinetuner, SinkhornCoupler
from sbi_rope.tasks import Task, get_task, list_tasks

# Small images are quick to simulate and to embed.
OPTIONS: dict[str, dict[str, Any]] = {"light_tunnel": {"image_size": 64}}
# sbi lists all pixels that are black in every simulated image.
warnings.filterwarnings("ignore", "Data has constant values")


def train_npe(task: Task, seed: int, num_simulations: int, max_num_epochs: int) -> Any:
    """Train plain sbi on simulations; nothing here knows of RoPE."""
    theta, x = task.get_simulations(num_simulations, seed=seed)
    return train_small_npe(
        task,
        (theta, x),
        seed=seed,
        learning_rate=1e-3,
        max_num_epochs=max_num_epochs,
    )


def find_task(name: str, root: Path | None) -> Task | None:
    """Return a task whose data are at hand, or its stand-in, or nothing."""
    options = OPTIONS.get(name, {})
    task = get_task(name, root=root, **options)
    if task.has_data:
        return task
    if "synthetic" in task.variants:
        print(f"{name}: no recorded data, using its synthetic stand-in", flush=True)
        return get_task(name, variant="synthetic", **options)
    print(f"{name}: skipped, no recorded data in {root}", flush=True)
    return None


def main() -> None:
    """Run one study a task with the arguments of the command line."""
    parser = argument_parser(__doc__ or "", n_test=200, out="results/all_tasks")
    parser.add_argument("--root", type=Path, help="folder of recorded data")
    parser.add_argument("--tasks", nargs="+", default=list_tasks())
    parser.add_argument("--num-simulations", type=int, default=4000)
    parser.add_argument("--max-num-epochs", type=int, default=20)
    args = parser.parse_args()
    tables = {}
    for name in args.tasks:
        task = find_task(name, args.root)
        if task is None:
            continue
        print(f"\n==== {task!r} ====", flush=True)
        tables[repr(task)] = Study(
            task=task,
            train_npe=lambda task, seed: train_npe(
                task, seed, args.num_simulations, args.max_num_epochs
            ),
            # Fixed beforehand for all tasks.
            coupler=SinkhornCoupler(gamma=0.1, tau=1.0),
            seeds=args.seeds,
            n_calibration=args.n_calibration,
            n_test=args.n_test,
            out=args.out / name,
            finetuner=CalibrationFinetuner(max_num_epochs=args.max_tuning_epochs),
            with_stack=args.stack,
            num_folds=args.num_folds,
            with_diagnosis=args.diagnose,
        ).run()
    print("\n\n==== all tasks ====")
    for title, rows in tables.items():
        print(f"\n{title}")
        print_table(rows, explain=False)


if __name__ == "__main__":
    main()
