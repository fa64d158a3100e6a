"""Repair an NPE posterior on real measurements of a light tunnel.

The data set (CC BY 4.0) is read from ROOT/lt_interventions_standard_v1/; pass
--download to fetch it there with the package causalchamber.
"""

from pathlib import Path
from typing import Any

import torch
from sbi.inference import NPE
from sbi.neural_nets import posterior_nn
from study import Study, argument_parser

from sbi_rope import CalibrationFinetuner, SinkhornCoupler
from sbi_rope.tasks import Task, get_task


def train_npe(
    task: Task,
    seed: int,
    *,
    num_simulations: int = 20_000,
    density_estimator: str = "nsf",
) -> Any:
    """Train plain sbi on simulations; nothing here knows of RoPE."""
    torch.manual_seed(seed)
    prior, simulator = task.get_prior(), task.get_simulator()
    theta = prior.sample((num_simulations,))
    npe = NPE(
        prior,
        density_estimator=posterior_nn(
            density_estimator,
            embedding_net=task.get_embedding_net(),
            num_transforms=3,
            hidden_features=50,
        ),
        show_progress_bars=False,
    )
    npe.append_simulations(theta, simulator(theta))
    npe.train(training_batch_size=200, learning_rate=1e-3, max_num_epochs=30)
    return npe.build_posterior()


def main() -> None:
    """Run the study with the arguments of the command line."""
    parser = argument_parser(
        __doc__ or "",
        n_test=1000,
        out="results/light_tunnel_sensors",
        with_stack=True,
    )
    parser.add_argument("--root", type=Path, required=True, help="folder of the data")
    parser.add_argument("--download", action="store_true", help="fetch the data set")
    parser.add_argument("--num-simulations", type=int, default=20_000)
    parser.add_argument(
        "--density-estimator",
        default="nsf",
        help="any that sbi's posterior_nn knows; mdn is quicker",
    )
    args = parser.parse_args()
    Study(
        task=get_task("light_tunnel_sensors", root=args.root, download=args.download),
        train_npe=lambda task, seed: train_npe(
            task,
            seed,
            num_simulations=args.num_simulations,
            density_estimator=args.density_estimator,
        ),
        # Chosen on calibration data, see benchmarks/choices.md.
        coupler=SinkhornCoupler(gamma=0.1, tau=1.0),
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
