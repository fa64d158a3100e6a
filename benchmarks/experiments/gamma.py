"""Which gamma and tau? The table "gamma and tau" of `benchmarks/choices.md`.

Scores are those of calibration rows that were not tuned on. The test part is never
touched.

    python -m benchmarks.experiments.gamma --task light_tunnel_sensors --root FOLDER
    python -m benchmarks.experiments.gamma --task pendulum
"""

import argparse
import itertools
from collections.abc import Iterator

from benchmarks.experiments.common import Row, add_task, begin, show
from benchmarks.experiments.data import NPE_SETTINGS, cache_of, labelled, trained_npe
from sbi_rope import RoPE, SinkhornCoupler
from sbi_rope.metrics import acauc, lpp
from sbi_rope.tasks import get_task

OPTIONS = {
    "--n-calibration": {"type": int, "nargs": "+", "default": [50, 200]},
    "--gammas": {"type": float, "nargs": "+", "default": [0.05, 0.1, 0.2]},
    "--taus": {"type": float, "nargs": "+", "default": [1.0, 0.9]},
}


def rows(args: argparse.Namespace) -> Iterator[Row]:
    """Yield the scores of each setting."""
    task = get_task(args.task, root=args.root)
    npe = trained_npe(task, seed=0, cache=cache_of(args.out))
    (theta, x), scored = labelled(task, seed=0)
    for n in args.n_calibration:
        rope = RoPE(npe, simulator=task.get_simulator())
        rope.append_calibration(theta[:n], x[:n]).train(
            seed=0, show_progress_bars=False
        )
        for gamma, tau in itertools.product(args.gammas, args.taus):
            coupler = SinkhornCoupler(gamma=gamma, tau=tau, cost_scale="simulated")
            posterior = rope.build_posterior(scored[1], coupler=coupler, seed=0)
            score = lpp(posterior, *scored, theta_std=task.prior_std)
            calibration = acauc(posterior, *scored, num_samples=300, seed=0)
            size = float(posterior.coupling.effective_sample_size.median())
            yield {
                "pairs": n,
                "gamma": gamma,
                "tau": tau,
                "LPP (z)": f"{score.mean:.2f} ± {score.standard_error:.2f}",
                "ACAUC": f"{calibration.value:.3f} ± {calibration.standard_error:.3f}",
                "median ESS": f"{size:.0f}",
            }


if __name__ == "__main__":
    show(rows(begin(__doc__, add_task(OPTIONS, choices=[*NPE_SETTINGS]))))
