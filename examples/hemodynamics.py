"""Repair an NPE posterior of the heart from the pulse at the wrist.

Without arguments this uses the small data sets of the package. Make larger ones with
``python -m sbi_rope.tasks.hemodynamics generate`` (a third of a second a person).
"""

from pathlib import Path
from typing import Any

import torch
from study import Study, argument_parser, train_small_npe
from torch import Tensor

from sbi_rope import CalibrationFinetuner, SinkhornCoupler
from sbi_rope.tasks import Task, get_task

Pairs = tuple[Tensor, Tensor]
# Share of the simulated people that NPE is not trained on.
HELD_OUT = 0.2


def split_people(task: Task, seed: int, rounds: int) -> dict[str, Pairs]:
    """Split simulated people into those to train on and those held out.

    Returns:
        Recordings ``"to_train"`` on, ``rounds`` of each person with other starts and
        other noise; one more of each, ``"stored"``, for RoPE; and one of each person
        ``"held_out"``.
    """
    people = len(task.get_simulator().theta)  # type: ignore[attr-defined]
    theta, x = task.get_simulations((rounds + 1) * people, seed=seed)
    count = int(HELD_OUT * people)
    # Stroke volumes tell people apart: they are drawn from a continuum.
    kept = ~torch.isin(theta[:, 0], theta[:count, 0])
    last = torch.arange(len(theta)) >= rounds * people
    return {
        "to_train": (theta[kept & ~last], x[kept & ~last]),
        "stored": (theta[kept & last], x[kept & last]),
        "held_out": (theta[:count], x[:count]),
    }


def train_npe(task: Task, seed: int, rounds: int, max_num_epochs: int) -> Any:
    """Train plain sbi on simulations; nothing here knows of RoPE."""
    theta, x = split_people(task, seed, rounds)["to_train"]
    return train_small_npe(
        task,
        (theta, x),
        seed=seed,
        learning_rate=5e-4,
        max_num_epochs=max_num_epochs,
    )


def main() -> None:
    """Run the study with the arguments of the command line."""
    parser = argument_parser(__doc__ or "", n_test=500, out="results/hemodynamics")
    parser.add_argument("--simulations", type=Path, help="data set of the simulator")
    parser.add_argument("--observations", type=Path, help="data set of real people")
    parser.add_argument("--rounds", type=int, default=10, help="recordings a person")
    parser.add_argument("--max-num-epochs", type=int, default=30)
    args = parser.parse_args()
    Study(
        task=get_task(
            "hemodynamics",
            simulations=args.simulations,
            observations=args.observations,
        ),
        train_npe=lambda task, seed: train_npe(
            task, seed, args.rounds, args.max_num_epochs
        ),
        stored=lambda task, seed: split_people(task, seed, args.rounds)["stored"],
        held_out=lambda task, seed: split_people(task, seed, args.rounds)["held_out"],
        finetuner=CalibrationFinetuner(max_num_epochs=args.max_tuning_epochs),
        # Fixed beforehand.
        coupler=SinkhornCoupler(gamma=0.1, tau=1.0),
        seeds=args.seeds,
        n_calibration=args.n_calibration,
        n_test=args.n_test,
        out=args.out,
        with_stack=args.stack,
        num_folds=args.num_folds,
        with_diagnosis=args.diagnose,
    ).run()


if __name__ == "__main__":
    main()
