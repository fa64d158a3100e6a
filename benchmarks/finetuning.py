"""How to tune the embedding net: learning rate, steps, and Monte-Carlo targets.

Scores every setting on labelled real observations of the calibration part that were
not tuned on; the test part is never touched. One row a run is added to a CSV file,
and runs that are in it already are skipped, so that it can be interrupted.

    python -m benchmarks.finetuning --task light_tunnel_sensors --root FOLDER
    python -m benchmarks.finetuning --task pendulum
"""

import argparse
import csv
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.npe import trained_npe
from sbi_rope import CalibrationFinetuner, RoPE, SinkhornCoupler
from sbi_rope._files import set_aside, write_atomically
from sbi_rope.errors import InvalidInputError, warn_user
from sbi_rope.metrics import lpp
from sbi_rope.tasks import Task, get_task

SETTINGS = {
    "paper: lr 1e-5, 1 fresh draw": {
        "learning_rate": 1e-5,
        "simulations_per_target": 1,
        "resample_targets": True,
    },
    "lr 1e-4, 1 fresh draw": {
        "learning_rate": 1e-4,
        "simulations_per_target": 1,
        "resample_targets": True,
    },
    "lr 1e-3, 1 fresh draw": {
        "learning_rate": 1e-3,
        "simulations_per_target": 1,
        "resample_targets": True,
    },
    "lr 1e-3, 10 fresh draws": {
        "learning_rate": 1e-3,
        "simulations_per_target": 10,
        "resample_targets": True,
    },
    "lr 1e-3, bank of 1": {"learning_rate": 1e-3, "simulations_per_target": 1},
    "lr 1e-3, bank of 10": {"learning_rate": 1e-3, "simulations_per_target": 10},
    "lr 1e-4, bank of 100": {"learning_rate": 1e-4},
    "lr 3e-4, bank of 100": {"learning_rate": 3e-4},
    "lr 1e-3, bank of 100": {"learning_rate": 1e-3},
    "lr 3e-3, bank of 100": {"learning_rate": 3e-3},
    "lr 1e-3, bank of 100, 300 steps": {"learning_rate": 1e-3, "num_steps": 300},
    "lr 1e-4, bank of 100, 3000 steps": {"learning_rate": 1e-4, "num_steps": 3000},
    "defaults: better of lr 1e-4 and 1e-3, bank of 100, patience 200": {},
    "defaults, rehearsal 1": {"rehearsal": 1.0},
    "stored, 1 neighbour": {"num_neighbors": 1},
    "stored, 10 neighbours": {"num_neighbors": 10},
}
COLUMNS = (
    "task",
    "setting",
    "n_calibration",
    "seed",
    "best_epoch",
    "distance",
    "tuning_lpp_z",
    "rope_lpp_z",
    "seconds",
)
# Named learning rates run to their last step, so that they can be compared.
for _options in SETTINGS.values():
    if "learning_rate" in _options:
        _options["patience"] = 10_000
# Labelled calibration rows; the first ones are tuned on, the last ones scored on.
NUM_LABELLED, NUM_SCORED = 1000, 500


def run(task: Task, npe: Any, setting: str, n: int, seed: int) -> dict[str, Any]:
    """Tune on the first n pairs of a seed and score on the last 500."""
    theta, x = task.get_calibration_set(NUM_LABELLED, seed=seed)
    theta_v, x_v = theta[-NUM_SCORED:], x[-NUM_SCORED:]
    start = time.perf_counter()
    source: dict[str, Any] = {"simulator": task.get_simulator()}
    if setting.startswith("stored"):
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            stored = task.get_prior().sample((10_000,))
            source = {"simulations": (stored, task.get_simulator()(stored))}
    rope = RoPE(
        npe,
        finetuner=CalibrationFinetuner(**SETTINGS[setting]),
        coupler=SinkhornCoupler(gamma=0.1, cost_scale="simulated"),
        **source,
    )
    rope.append_calibration(theta[:n], x[:n]).train(seed=seed, show_progress_bars=False)
    seconds = time.perf_counter() - start
    posterior = rope.build_posterior(x_v, seed=seed)
    natural = posterior.log_prob_batched(theta_v, x_v, norm_posterior=False)
    return {
        "task": task.name,
        "setting": setting,
        "n_calibration": n,
        "seed": seed,
        "best_epoch": rope.history.best_epoch,
        "distance": round(distance_to_targets(task, rope, theta_v, x_v), 4),
        "tuning_lpp_z": round(
            lpp(rope.tuned_posterior(), theta_v, x_v, theta_std=task.prior_std).mean, 4
        ),
        "rope_lpp_z": round(float(natural.mean() + task.prior_std.log().sum()), 4),
        "seconds": round(seconds, 1),
    }


def distance_to_targets(task: Task, rope: RoPE, theta: Tensor, x: Tensor) -> float:
    """Mean distance of g(x_o) from the mean embedding of 100 simulations."""
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(0)
        x_s = task.get_simulator()(theta.repeat_interleave(100, dim=0))
        h, g = rope.embedding_net, rope.tuned_embedding_net
        targets = torch.cat([h(part) for part in x_s.split(1000)])
        targets = targets.reshape(len(theta), 100, -1).mean(dim=1)
        return float((g(x) - targets).norm(dim=1).mean())


def main() -> None:
    """Run all settings that are not in the CSV file yet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", required=True)
    parser.add_argument("--root", type=Path)
    parser.add_argument("--n-calibration", type=int, nargs="+", default=[10, 50, 200])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--settings", nargs="+", default=list(SETTINGS))
    parser.add_argument("--out", type=Path, default=Path("results/finetuning"))
    args = parser.parse_args()
    task = get_task(args.task, root=args.root)
    args.out.mkdir(parents=True, exist_ok=True)
    npe = trained_npe(task, seed=0, cache=args.out)
    path = args.out / f"{task.name}.csv"
    rows = read_rows(path)
    done = {(row["setting"], row["n_calibration"], row["seed"]) for row in rows}
    for seed in args.seeds:
        for n in args.n_calibration:
            for setting in args.settings:
                if (setting, str(n), str(seed)) in done:
                    continue
                row = run(task, npe, setting, n, seed)
                rows.append({name: str(value) for name, value in row.items()})
                write_rows(path, rows)
                print(*row.values(), sep=" | ", flush=True)
    print_table(rows)


def read_rows(path: Path) -> list[dict[str, str]]:
    """Return the finished runs; a damaged file is set aside, with a warning."""
    if not path.exists():
        return []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        for number, row in enumerate(rows, 2):
            if set(row) != set(COLUMNS) or None in row.values():
                raise InvalidInputError(f"row {number} is not whole")
            for name in COLUMNS[2:]:
                float(row[name])
    except (ValueError, csv.Error) as error:
        warn_user(f"{path} is damaged and is now {set_aside(path)}: {error}.")
        return []
    return rows


def write_rows(path: Path, rows: list[dict[str, str]]) -> None:
    """Write all runs, so that the file is whole whenever this is interrupted."""
    with (
        write_atomically(path) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)


def print_table(rows: list[dict[str, str]]) -> None:
    """Print the means over seeds, in the form of benchmarks/README.md."""
    groups: dict[tuple[int, str], list[dict[str, str]]] = {}
    for row in rows:
        key = (int(row["n_calibration"]), row["setting"])
        groups.setdefault(key, []).append(row)
    print(
        "| pairs | setting | best step | distance | tuning-only LPP | RoPE LPP | "
        "seconds | seeds |\n|---|---|---|---|---|---|---|---|"
    )
    digits = {
        "best_epoch": 0,
        "distance": 3,
        "tuning_lpp_z": 2,
        "rope_lpp_z": 2,
        "seconds": 1,
    }
    for (n, setting), group in sorted(groups.items(), key=lambda item: item[0][0]):
        means = [
            f"{sum(float(row[column]) for row in group) / len(group):.{places}f}"
            for column, places in digits.items()
        ]
        print(f"| {n} | {setting} | {' | '.join(means)} | {len(group)} |")


if __name__ == "__main__":
    main()
