"""Repair an NPE posterior on the pendulum, whose simulator knows no friction."""

from typing import Any

import torch
from sbi.inference import NPE
from sbi.neural_nets import posterior_nn
from study import Study, argument_parser

from sbi_rope import CalibrationFinetuner, SinkhornCoupler
from sbi_rope.tasks import Task, get_task


def train_npe(task: Task, seed: int, num_simulations: int, max_num_epochs: int) -> Any:
    """Train plain sbi on simulations; nothing here knows of RoPE."""
    torch.manual_seed(seed)
    prior, simulator = task.get_prior(), task.get_simulator()
    theta = prior.sample((num_simulations,))
    npe = NPE(
        prior,
        density_estimator=posterior_nn(
            "nsf",
            embedding_net=task.get_embedding_net(),
            z_score_x="structured",
            num_transforms=2,
        ),
        show_progress_bars=False,
    )
    npe.append_simulations(theta, simulator(theta))
    npe.train(
        training_batch_size=100, learning_rate=1e-3, max_num_epochs=max_num_epochs
    )
    return npe.build_posterior()


def main() -> None:
    """Run the study with the arguments of the command line."""
    parser = argument_parser(__doc__ or "", n_test=500, out="results/quickstart")
    parser.add_argument("--num-simulations", type=int, default=10_000)
    parser.add_argument("--max-num-epochs", type=int, default=8)
    args = parser.parse_args()
    Study(
        task=get_task("pendulum"),
        train_npe=lambda task, seed: train_npe(
            task, seed, args.num_simulations, args.max_num_epochs
        ),
        # Chosen on calibration data, see benchmarks/choices.md.
        coupler=SinkhornCoupler(gamma=0.2, tau=1.0),
        seeds=args.seeds,
        n_calibration=args.n_calibration,
        n_test=args.n_test,
        out=args.out,
        finetuner=CalibrationFinetuner(max_num_epochs=args.max_tuning_epochs),
        with_stack=args.stack,
        num_folds=args.num_folds,
        with_diagnosis=args.diagnose,
    ).run()


if __name__ == "__main__":
    main()
