"""Which gamma and tau: scores on calibration rows that were not tuned on.

The test part is never touched.

    python -m benchmarks.gamma --task light_tunnel_sensors --root FOLDER
    python -m benchmarks.gamma --task pendulum
"""

import argparse
import itertools
from pathlib import Path

from benchmarks.npe import trained_npe
from sbi_rope import RoPE, SinkhornCoupler
from sbi_rope.metrics import acauc, lpp
from sbi_rope.tasks import get_task

NUM_LABELLED, NUM_SCORED = 1000, 500


def main() -> None:
    """Print one row a setting."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", required=True)
    parser.add_argument("--root", type=Path)
    parser.add_argument("--n-calibration", type=int, nargs="+", default=[50, 200])
    parser.add_argument("--gammas", type=float, nargs="+", default=[0.05, 0.1, 0.2])
    parser.add_argument("--taus", type=float, nargs="+", default=[1.0, 0.9])
    parser.add_argument("--out", type=Path, default=Path("results/finetuning"))
    args = parser.parse_args()
    task = get_task(args.task, root=args.root)
    args.out.mkdir(parents=True, exist_ok=True)
    npe = trained_npe(task, seed=0, cache=args.out)
    theta, x = task.get_calibration_set(NUM_LABELLED, seed=0)
    theta_v, x_v = theta[-NUM_SCORED:], x[-NUM_SCORED:]
    print("| pairs | gamma | tau | LPP (z) | ACAUC | median ESS |")
    print("|---|---|---|---|---|---|")
    for n in args.n_calibration:
        rope = RoPE(npe, simulator=task.get_simulator())
        rope.append_calibration(theta[:n], x[:n]).train(
            seed=0, show_progress_bars=False
        )
        for gamma, tau in itertools.product(args.gammas, args.taus):
            coupler = SinkhornCoupler(gamma=gamma, tau=tau, cost_scale="simulated")
            posterior = rope.build_posterior(x_v, coupler=coupler, seed=0)
            score = lpp(posterior, theta_v, x_v, theta_std=task.prior_std)
            calibration = acauc(posterior, theta_v, x_v, num_samples=300, seed=0)
            ess = float(posterior.coupling.effective_sample_size.median())
            print(
                f"| {n} | {gamma} | {tau} | {score.mean:.2f} ± "
                f"{score.standard_error:.2f} | {calibration.value:.3f} ± "
                f"{calibration.standard_error:.3f} | {ess:.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
