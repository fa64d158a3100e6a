"""Does FMCPE do on its authors' Gaussian task what it is said to do?

The task as their code describes it: three parameters with a Gaussian prior, ten
observables that are linear in them with Gaussian noise, and a real process that maps a
simulation linearly and adds noise again. All matrices are drawn from one seed. The
posterior given a real observation is Gaussian and known. "LPP - exact" is the mean log
density of the true parameters minus that of the exact posterior, and "C2ST" the
accuracy with which a classifier tells samples of the two apart, .5 at best, averaged
over ten observations. NPE is given a real observation as it is. Rows are kept in a
file, and an interrupted run goes on where it was.

    python -m benchmarks.experiments.fmcpe
"""

import argparse
from collections.abc import Callable, Iterator
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import torch
from sbi.inference import NPE
from sbi.neural_nets import posterior_nn
from sbi.utils.metrics import c2st
from torch import Tensor
from torch.distributions import MultivariateNormal

from benchmarks.experiments.common import Row, begin, kept_rows, show
from sbi_rope.baselines import FMCPE, FinetunedNPE

OPTIONS = {
    "--n-calibration": {"type": int, "nargs": "+", "default": [10, 50, 200, 1000]},
    "--repetitions": {"type": int, "default": 3},
    "--num-simulations": {"type": int, "default": 50_000},
    "--max-num-epochs": {"type": int, "default": 50},
    "--out": {"type": Path, "default": Path("results/experiments")},
}
METHODS: dict[str, Any] = {"NPE": None, "fine-tuned NPE": FinetunedNPE, "FMCPE": FMCPE}
COLUMNS = ("repetition", "method", "pairs", "LPP - exact", "C2ST")
DIM, NUM_OBSERVABLES = 3, 10
# Standard deviation of the entries of the matrix behind the noise of the real process.
REAL_NOISE = 0.1
NUM_PAIRS, NUM_TEST, NUM_COMPARED, NUM_SAMPLES = 1000, 500, 10, 1000


class GaussianTask:
    r"""x = A theta + b + noise, and y = C x + d + noise."""

    def __init__(self) -> None:
        with torch.random.fork_rng():
            torch.manual_seed(0)
            mean = torch.rand(DIM) * 10 - 5
            root = torch.randn(DIM, DIM)
            noise = torch.randn(NUM_OBSERVABLES, NUM_OBSERVABLES)
            self.a = torch.randn(NUM_OBSERVABLES, DIM)
            self.b = torch.randn(NUM_OBSERVABLES)
            real = REAL_NOISE * torch.randn(NUM_OBSERVABLES, NUM_OBSERVABLES)
            self.c = 1 + torch.randn(NUM_OBSERVABLES, NUM_OBSERVABLES)
            self.d = torch.rand(NUM_OBSERVABLES) * 5 + 5
        self.prior = MultivariateNormal(mean, root @ root.T + torch.eye(DIM))
        self.noise, self.real_noise = noise, real

    def simulate(self, theta: Tensor) -> Tensor:
        """Return simulations, ``(n, 10)``."""
        noise = torch.randn(len(theta), NUM_OBSERVABLES) @ self.noise.T
        return theta @ self.a.T + self.b + noise

    def observe(self, theta: Tensor) -> Tensor:
        """Return real observations, ``(n, 10)``."""
        noise = torch.randn(len(theta), NUM_OBSERVABLES) @ self.real_noise.T
        return self.simulate(theta) @ self.c.T + self.d + noise

    def posterior(self, y: Tensor) -> MultivariateNormal:
        """Return the exact posteriors given real observations, in float64."""
        y, a, c = y.double(), self.a.double(), self.c.double()
        inner, outer = self.noise.double(), self.real_noise.double()
        covariance = c @ inner @ inner.T @ c.T + outer @ outer.T
        slope = c @ a
        weighted = torch.linalg.solve(covariance, slope)
        prior = torch.linalg.inv(self.prior.covariance_matrix.double())
        precision = prior + slope.T @ weighted
        offset = c @ self.b.double() + self.d.double()
        pulled = (y - offset) @ weighted + prior @ self.prior.loc.double()
        mean = torch.linalg.solve(precision, pulled.T).T
        return MultivariateNormal(mean, precision_matrix=precision)


def trained_npe(task: GaussianTask, args: argparse.Namespace) -> Any:
    """Return NPE with a spline flow, trained on simulations."""
    torch.manual_seed(0)
    theta = task.prior.sample((args.num_simulations,))
    builder = posterior_nn("nsf", num_transforms=5, hidden_features=64, num_bins=8)
    npe = NPE(task.prior, density_estimator=builder, show_progress_bars=False)
    npe.append_simulations(theta, task.simulate(theta))
    npe.train(
        training_batch_size=512, learning_rate=5e-4, max_num_epochs=args.max_num_epochs
    )
    return npe.build_posterior()


def scores(task: GaussianTask, posterior: Any, theta: Tensor, y: Tensor) -> Row:
    """Compare a posterior with the exact one."""
    exact = task.posterior(y)
    options = {"norm_posterior": False}
    log_prob = posterior.log_prob_batched(theta[None], x=y, **options)[0]
    lost = float((log_prob.double() - exact.log_prob(theta.double())).mean())
    accuracy = []
    for row in y[:NUM_COMPARED]:
        ours = posterior.sample((NUM_SAMPLES,), x=row, show_progress_bars=False)
        theirs = task.posterior(row[None]).sample((NUM_SAMPLES,))[:, 0].float()
        accuracy.append(float(c2st(theirs, ours)))
    return {
        "LPP - exact": f"{lost:.2f}",
        "C2ST": f"{sum(accuracy) / len(accuracy):.3f}",
    }


def rows_of(
    args: argparse.Namespace,
) -> Iterator[tuple[tuple[str, ...], Callable[[], Row]]]:
    """Yield the head of each row, and a function that computes the rest."""
    task = GaussianTask()
    # It is trained when the first row needs it.
    npe = cache(lambda: trained_npe(task, args))
    for repetition, name in product(range(args.repetitions), METHODS):
        for n in args.n_calibration if name != "NPE" else [0]:
            head = str(repetition), name, str(n)
            yield head, partial(score, task, npe, repetition, name, n)


def score(
    task: GaussianTask,
    npe: Callable[[], Any],
    repetition: int,
    name: str,
    n: int,
) -> Row:
    """Return the scores of a method with so many pairs."""
    posterior = npe()
    torch.manual_seed(1 + repetition)
    theta, theta_o = (task.prior.sample((count,)) for count in (NUM_PAIRS, NUM_TEST))
    y, y_o = task.observe(theta), task.observe(theta_o)
    if name != "NPE":
        # Its way to simulations starts at noise alone, as in its code.
        options = {"simulator": task.simulate, "noise": None} if name == "FMCPE" else {}
        method = METHODS[name].from_posterior(posterior, **options)
        method.append_calibration(theta[:n], y[:n])
        method.train(seed=repetition, show_progress_bars=False)
        posterior = method.build_posterior()
    return scores(task, posterior, theta_o, y_o)


def main() -> None:
    """Print the table."""
    args = begin(__doc__, OPTIONS, threads=1)
    if max(args.n_calibration) > NUM_PAIRS:
        raise SystemExit(f"There are {NUM_PAIRS} calibration pairs.")
    # Rows of another NPE are other rows.
    name = f"rows_{args.num_simulations}_{args.max_num_epochs}.csv"
    show(kept_rows(args.out / "fmcpe" / name, COLUMNS, rows_of(args)))


if __name__ == "__main__":
    main()
