"""The choices inside the stack, measured on calibration data.

    python -m benchmarks.choices run --task pendulum --n-calibration 10 --seeds 1 2 3
    python -m benchmarks.choices report

`run` trains all candidates on some calibration pairs, without each fold of them and on
all, and scores every version on 300 others of the calibration set, not of the test set.
`report` compares choices (which candidates, how strong a prior of the weights, how much
of the refitted version) by what their stacks would have scored. No choice needs a
second run.
"""

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.cases import Case, Sources
from benchmarks.cells import Cell
from benchmarks.store import Cache
from sbi_rope import RoPE, stack
from sbi_rope._files import read_arrays, set_aside, write_atomically
from sbi_rope.errors import InvalidInputError, warn_user
from sbi_rope.stacking import stacking_weights

__all__ = ["CHOICES", "Choice", "Run", "calibration_data", "report", "run"]

NUM_OTHERS = 300


@dataclass(frozen=True, eq=False, kw_only=True)
class Run:
    """What a stack was made from, and how its candidates did on other pairs.

    Attributes:
        task: The task, with its variant.
        seed: Of the calibration pairs.
        seconds: That the training took.
        names: Of the candidates, K of them.
        fold: The fold of each pair, shape ``(n,)``.
        held_out: Log scores on held-out pairs, shape ``(n, K)``.
        others: Log density of other pairs under each version, in standard deviations of
            the prior, shape ``(V, m, K)``; the last version is trained on all pairs.
    """

    task: str
    seed: int
    seconds: float
    names: tuple[str, ...]
    fold: Tensor
    held_out: Tensor
    others: Tensor

    @property
    def num_folds(self) -> int:
        """The number of folds."""
        return len(self.others) - 1

    def candidate_scores(self, refit: float) -> Tensor:
        """Return the log density of other pairs under each candidate, ``(m, K)``."""
        shares = torch.full((len(self.others),), (1.0 - refit) / self.num_folds)
        shares[-1] = refit
        return (self.others + shares.double().log()[:, None, None]).logsumexp(dim=0)

    @classmethod
    def load(cls, path: Path) -> "Run":
        """Read what :func:`run` wrote.

        Raises:
            InvalidInputError: If the file is damaged.
        """
        try:
            stored = read_arrays(path)
            return cls(
                task=str(stored["task"]),
                seed=int(stored["seed"]),
                seconds=float(stored["seconds"]),
                names=tuple(stored["names"].tolist()),
                **{
                    name: torch.as_tensor(stored[name])
                    for name in ("fold", "held_out", "others")
                },
            )
        except (ValueError, TypeError, KeyError) as error:
            raise InvalidInputError(
                f"Expected {path} to hold a run; {error}. Remove it, or let `run` set "
                "it aside and make it again."
            ) from error


def calibration_data(
    case: Case, n_calibration: int, *, seed: int
) -> tuple[RoPE, tuple[Tensor, Tensor]]:
    """Return a RoPE with pairs of the calibration set, and others of it."""
    count = n_calibration + NUM_OTHERS
    recorded = case.task.num_recorded("calibration", seed=seed)
    if recorded is not None:
        count = min(count, recorded)
    theta, x = case.task.get_calibration_set(count, seed=seed)
    rope = RoPE(
        case.npe,
        simulator=case.simulator,
        simulations=case.stored if case.simulator is None else None,
        finetuner=case.settings.finetuner,
    )
    rope.append_calibration(theta[:n_calibration], x[:n_calibration])
    return rope, (theta[n_calibration:], x[n_calibration:])


def run(case: Case, n_calibration: int, num_folds: int, seed: int) -> Run:
    """Stack on pairs of the calibration set, and score on others of it."""
    rope, (theta, x) = calibration_data(case, n_calibration, seed=seed)
    start = time.process_time()
    posterior = stack(rope, num_folds=num_folds, seed=seed, show_progress_bars=False)
    seconds = time.process_time() - start
    versions, scores = posterior.versions, posterior.report.cross_validation
    others = [versions.log_probs(theta, x, [v]) for v in range(len(versions.trained))]
    return Run(
        task="-".join(filter(None, (case.cell.task, case.cell.variant))),
        seed=seed,
        seconds=seconds,
        names=scores.names,
        fold=scores.fold,
        held_out=scores.log_scores,
        others=torch.stack(others) + case.task.prior_std.log().sum(),
    )


@dataclass(frozen=True, kw_only=True)
class Choice:
    """One way to make a stack.

    Attributes:
        without: Names of candidates that are left out.
        pseudo_count: As in :func:`sbi_rope.stacking.stacking_weights`.
        refit: Share of the version that is trained on all pairs; None for that of
            every other version.
    """

    without: tuple[str, ...] = ()
    pseudo_count: float = 1.0
    refit: float | None = None

    def weights(self, run: Run) -> Tensor:
        """Return the weights of all candidates; zero for those that are left out."""
        kept = torch.tensor([name not in self.without for name in run.names])
        found = stacking_weights(run.held_out[:, kept], pseudo_count=self.pseudo_count)
        weights = torch.zeros(len(run.names), dtype=torch.double)
        weights[kept] = found.weights
        return weights

    def score(self, run: Run) -> float:
        """Return the mean log density of other pairs under the stack.

        Not corrected for leakage: a lower bound.
        """
        refit = 1.0 / (run.num_folds + 1) if self.refit is None else self.refit
        scores = run.candidate_scores(refit) + self.weights(run).log()
        return float(scores.logsumexp(dim=1).mean())


CHOICES = {
    "refit as one more version (default)": Choice(),
    "no refit": Choice(refit=0.0),
    "half of it refit": Choice(refit=0.5),
    "refit only": Choice(refit=1.0),
    "pseudo-count .3": Choice(pseudo_count=0.3),
    "pseudo-count 3": Choice(pseudo_count=3.0),
    "pseudo-count 10": Choice(pseudo_count=10.0),
    "without fine-tuned NPE": Choice(without=("fine-tuned NPE",)),
    "without discrepancy, fine-tuned": Choice(
        without=("discrepancy (input), fine-tuned", "discrepancy (tuned), fine-tuned")
    ),
    "without discrepancy": Choice(without=("discrepancy",)),
    "without discrepancy (input)": Choice(without=("discrepancy (input)",)),
    "without discrepancy (tuned)": Choice(without=("discrepancy (tuned)",)),
    "without the prior": Choice(without=("prior",)),
}


def report(runs: Sequence[Run]) -> str:
    """Return tables in Markdown: choices against tasks, as gains over the first choice.

    One for each number of pairs and folds. The last rows are the best single candidate,
    chosen on the pairs it is scored on, the one with the best held-out score, and the
    seconds.
    """
    settings = sorted({(len(run.held_out), run.num_folds) for run in runs})
    lines = []
    for n, num_folds in settings:
        group = [
            run for run in runs if (len(run.held_out), run.num_folds) == (n, num_folds)
        ]
        tasks = sorted({run.task for run in group})
        of_task = {task: [run for run in group if run.task == task] for task in tasks}
        lines += ["", f"{n} pairs, {num_folds} folds", ""]
        lines += [f"| choice | {' | '.join(tasks)} | mean |", "|---" * (len(tasks) + 2)]
        first, *_ = CHOICES.values()
        base = {task: _mean(of_task[task], first.score) for task in tasks}

        def line(
            name: str,
            score: Callable[[Run], float],
            of_task: dict[str, list[Run]] = of_task,
            base: dict[str, float] = base,
        ) -> str:
            gains = [_mean(part, score) - base[task] for task, part in of_task.items()]
            entries = [f"{gain:+.2f}" for gain in (*gains, statistics.mean(gains))]
            return f"| {name} | {' | '.join(entries)} |"

        lines.append(
            f"| {next(iter(CHOICES))}, LPP | "
            + " | ".join(f"{base[task]:.2f} ({len(of_task[task])})" for task in tasks)
            + f" | {statistics.mean(base.values()):.2f} |"
        )
        lines += [line(name, choice.score) for name, choice in CHOICES.items()]
        lines.append(line("best single candidate", _best))
        lines.append(line("best held-out candidate", _picked))
        seconds = [_mean(of_task[task], lambda run: run.seconds) for task in tasks]
        entries = [f"{value:.0f}" for value in (*seconds, statistics.mean(seconds))]
        lines.append(f"| seconds | {' | '.join(entries)} |")
    return "\n".join(lines[1:])


def _mean(runs: Sequence[Run], score: Callable[[Run], float]) -> float:
    return statistics.mean(score(run) for run in runs)


def _single(run: Run) -> Tensor:
    return run.candidate_scores(1.0 / (run.num_folds + 1)).mean(dim=0)


def _best(run: Run) -> float:
    return float(_single(run).max())


def _picked(run: Run) -> float:
    return float(_single(run)[run.held_out.mean(dim=0).argmax()])


def main() -> None:
    """Run a task, or print the table."""
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    runs = commands.add_parser("run")
    runs.add_argument("--task", required=True)
    runs.add_argument("--variant", default="")
    runs.add_argument("--root", type=Path, help="folder of recorded data")
    runs.add_argument("--hemodynamics", type=Path, help="folder of stored people")
    runs.add_argument("--n-calibration", type=int, default=10)
    runs.add_argument("--folds", type=int, default=5)
    runs.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    runs.add_argument("--preset", default="standard")
    table = commands.add_parser("report")
    for command in (runs, table):
        command.add_argument("--out", type=Path, default=Path("results/choices"))
    args = parser.parse_args()
    if args.command == "run":
        _run(args)
    else:
        print(report([Run.load(path) for path in sorted(args.out.glob("*.npz"))]))


def _run(args: argparse.Namespace) -> None:
    cell = Cell(
        task=args.task, variant=args.variant, preset=args.preset, method="stack"
    )
    sources = Sources(root=args.root, hemodynamics=args.hemodynamics)
    case = Case.of(cell, sources, Cache(args.out / "cache"), "cpu")
    args.out.mkdir(parents=True, exist_ok=True)
    for seed in args.seeds:
        name = "_".join(
            [
                *filter(None, (args.task, args.variant, args.preset)),
                *map(str, (args.n_calibration, args.folds, seed)),
            ]
        )
        path = args.out / f"{name}.npz"
        if path.exists():
            try:
                Run.load(path)
                continue
            except InvalidInputError as error:
                warn_user(f"{path} is damaged and is now {set_aside(path)}. {error}")
        result = run(case, args.n_calibration, args.folds, seed)
        arrays = {key: np.asarray(value) for key, value in vars(result).items()}
        with write_atomically(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
        print(name, flush=True)


if __name__ == "__main__":
    main()
