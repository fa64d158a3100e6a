"""The choices inside the stack, measured on calibration data.

    python -m benchmarks.choices run --task pendulum --n-calibration 10 --seeds 1 2 3
    python -m benchmarks.choices report

`run` stacks a wide grid of candidates on some calibration pairs, and scores every
candidate on 300 others of the calibration set, not of the test set. `report` compares
choices (which candidates, how strong a prior of the weights, how many folds) by what
their stacks would have scored: weights need no second run.
"""

import argparse
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.cases import Case, Sources
from benchmarks.cells import Cell
from benchmarks.store import Cache, write_atomically
from sbi_rope import RoPE, stack
from sbi_rope.stacking import (
    CouplingCandidate,
    default_candidates,
    stacking_weights,
)
from sbi_rope.stacking.candidates import Candidate

__all__ = ["CHOICES", "Choice", "Run", "candidates", "report", "run"]

NUM_OTHERS = 300
GAMMAS = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8)
TAUS = (1.0, 0.9, 0.5, 0.0)


def candidates() -> list[Candidate]:
    """Return a grid that contains those of all choices."""
    return list(default_candidates(gammas=GAMMAS, taus=TAUS))


@dataclass(frozen=True, eq=False, kw_only=True)
class Run:
    """What a stack was made from, and how its candidates did on other pairs.

    Attributes:
        task: The task, with its variant.
        seed: Of the calibration pairs.
        num_folds: Folds of the calibration pairs.
        names: Of the candidates, K of them.
        held_out: Their log scores on held-out pairs, shape ``(n, K)``.
        others: Their log density at other pairs, in standard deviations of the prior,
            shape ``(m, K)``.
        mass: Of the couplings inside the prior's support, shape ``(m, K)``; one for
            the other candidates.
    """

    task: str
    seed: int
    num_folds: int
    names: tuple[str, ...]
    held_out: Tensor
    others: Tensor
    mass: Tensor

    def score(self, weights: Tensor) -> float:
        """Return the mean log density of the other pairs under a stack.

        A lower bound where NPE and its relatives leak out of the prior.
        """
        log_density = torch.logsumexp(self.others + weights.log(), dim=1)
        return float((log_density - (self.mass @ weights).log()).mean())

    def scores(self) -> Tensor:
        """Return the mean log density of the other pairs under each candidate."""
        return (self.others - self.mass.log()).mean(dim=0)

    @classmethod
    def load(cls, path: Path) -> "Run":
        """Read what :func:`run` wrote."""
        with np.load(path) as stored:
            return cls(
                task=str(stored["task"]),
                seed=int(stored["seed"]),
                num_folds=int(stored["num_folds"]),
                names=tuple(stored["names"].tolist()),
                **{
                    name: torch.as_tensor(stored[name])
                    for name in ("held_out", "others", "mass")
                },
            )


def run(case: Case, n_calibration: int, num_folds: int, seed: int) -> Run:
    """Stack on pairs of the calibration set, and score on others of it."""
    theta, x = case.task.get_calibration_set(n_calibration + NUM_OTHERS, seed=seed)
    rope = RoPE(case.npe, simulator=case.simulator, finetuner=case.settings.finetuner)
    rope.append_calibration(theta[:n_calibration], x[:n_calibration])
    rope.train(seed=seed, show_progress_bars=False)
    theta, x = theta[n_calibration:], x[n_calibration:]
    posterior = stack(
        rope,
        x,
        candidates=candidates(),
        num_folds=num_folds,
        seed=seed,
        show_progress_bars=False,
    )
    normalised = posterior.candidate_log_probs(theta, x)
    as_scored = posterior.posterior_estimator.candidate_log_probs(theta, x)
    both_zero = torch.isneginf(as_scored) & torch.isneginf(normalised)
    return Run(
        task="-".join(filter(None, (case.cell.task, case.cell.variant))),
        seed=seed,
        num_folds=num_folds,
        names=tuple(posterior.candidate_weights),
        held_out=posterior.report.cross_validation.log_scores,
        others=as_scored + case.task.prior_std.log().sum(),
        mass=(as_scored - normalised).where(~both_zero, 0.0).exp(),
    )


@dataclass(frozen=True, kw_only=True)
class Choice:
    """One way to make a stack.

    Attributes:
        gammas: Of the couplings.
        taus: Of the couplings.
        rehearsal: Whether there is a rehearsed RoPE beside the other.
        untuned: Whether there is an OT-only.
        pseudo_count: As in :func:`sbi_rope.stacking.stacking_weights`.
    """

    gammas: tuple[float, ...] = (0.05, 0.1, 0.2, 0.4)
    taus: tuple[float, ...] = TAUS
    rehearsal: bool = False
    untuned: bool = True
    pseudo_count: float = 1.0

    def keeps(self, candidate: Candidate) -> bool:
        """Tell whether a candidate of the wide grid belongs to this choice."""
        if not isinstance(candidate, CouplingCandidate):
            return True
        return (
            candidate.gamma in self.gammas
            and candidate.tau in self.taus
            and (self.rehearsal or candidate.rehearsal is None)
            and (self.untuned or candidate.tuned)
        )

    def weights(self, run: Run) -> Tensor:
        """Return the weights of all candidates; zero for those that are left out."""
        known = {candidate.name: candidate for candidate in candidates()}
        kept = torch.tensor([self.keeps(known[name]) for name in run.names])
        found = stacking_weights(run.held_out[:, kept], pseudo_count=self.pseudo_count)
        weights = torch.zeros(len(run.names), dtype=torch.double)
        weights[kept] = found.weights
        return weights


NEW = (0.02, 0.05, 0.1, 0.4)
CHOICES = {
    "gamma .05 to .4, four taus": Choice(),
    "+ gamma .02": Choice(gammas=(0.02, 0.05, 0.1, 0.2, 0.4)),
    "+ gamma .8": Choice(gammas=(0.05, 0.1, 0.2, 0.4, 0.8)),
    "tau 1, .5, 0": Choice(taus=(1.0, 0.5, 0.0)),
    "tau 1, .5": Choice(taus=(1.0, 0.5)),
    "gamma .05, .2": Choice(gammas=(0.05, 0.2)),
    "without OT-only": Choice(untuned=False),
    "pseudo-count .3": Choice(pseudo_count=0.3),
    "pseudo-count 3": Choice(pseudo_count=3.0),
    "pseudo-count 10": Choice(pseudo_count=10.0),
    "+ rehearsal": Choice(rehearsal=True),
    "+ rehearsal, gamma .02": Choice(
        rehearsal=True, gammas=(0.02, 0.05, 0.1, 0.2, 0.4)
    ),
    "rehearsal, gamma .02 .05 .1 .4, tau 1 .5": Choice(
        rehearsal=True, gammas=NEW, taus=(1.0, 0.5)
    ),
    "rehearsal, gamma .02 .05 .1 .4, tau 1 .5 0 (default)": Choice(
        rehearsal=True, gammas=NEW, taus=(1.0, 0.5, 0.0)
    ),
    "default, pseudo-count .3": Choice(
        rehearsal=True, gammas=NEW, taus=(1.0, 0.5, 0.0), pseudo_count=0.3
    ),
}


def report(runs: Sequence[Run]) -> str:
    """Return tables in Markdown: choices against tasks, as gains over the first choice.

    One for each number of pairs and folds. The last two rows are the best single
    candidate, chosen on the pairs it is scored on, and the one with the best held-out
    score.
    """
    settings = sorted({(len(run.held_out), run.num_folds) for run in runs})
    return "\n\n".join(
        f"{n} pairs, {folds} folds:\n\n"
        + _table([r for r in runs if (len(r.held_out), r.num_folds) == (n, folds)])
        for n, folds in settings
    )


def _table(runs: Sequence[Run]) -> str:
    tasks = {
        task: [run for run in runs if run.task == task]
        for task in sorted({run.task for run in runs})
    }
    scorers: dict[str, Callable[[Run], float]] = {
        name: lambda run, choice=choice: run.score(choice.weights(run))
        for name, choice in CHOICES.items()
    }
    scorers["best single candidate for these pairs"] = lambda run: float(
        run.scores().max()
    )
    scorers["best single candidate by held-out score"] = lambda run: float(
        run.scores()[run.held_out.mean(dim=0).argmax()]
    )
    rows = {
        name: [statistics.mean(map(score, drawn)) for drawn in tasks.values()]
        for name, score in scorers.items()
    }
    titles = [f"{task} ({len(drawn)})" for task, drawn in tasks.items()]
    lines = [
        "| choice | " + " | ".join(titles) + " | mean | worst |",
        "|---" * (len(titles) + 3) + "|",
    ]
    first = next(iter(rows.values()))
    for name, scores in rows.items():
        gains = [score - base for score, base in zip(scores, first, strict=True)]
        entries = (
            [*(f"{score:.2f}" for score in scores), "", ""]
            if scores is first
            else [
                f"{gain:+.2f}" for gain in (*gains, statistics.mean(gains), min(gains))
            ]
        )
        lines.append(f"| {name} | {' | '.join(entries)} |")
    return "\n".join(lines)


def main() -> None:
    """Run, or report on all runs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    runs = commands.add_parser("run")
    runs.add_argument("--task", required=True, help="one with a simulator")
    runs.add_argument("--variant", default="")
    runs.add_argument("--root", type=Path, help="folder of recorded data")
    runs.add_argument("--n-calibration", type=int, default=10)
    runs.add_argument("--folds", type=int, default=5)
    runs.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    runs.add_argument("--preset", default="standard")
    table = commands.add_parser("report")
    for command in (runs, table):
        command.add_argument("--out", type=Path, default=Path("results/choices"))
    args = parser.parse_args()
    if args.command == "run":
        cell = Cell(
            task=args.task, variant=args.variant, preset=args.preset, method="stack"
        )
        case = Case.of(cell, Sources(root=args.root), Cache(args.out), "cpu")
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
                continue
            result = run(case, args.n_calibration, args.folds, seed)
            arrays = {key: np.asarray(value) for key, value in vars(result).items()}
            with write_atomically(path) as temporary, temporary.open("wb") as file:
                np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
            print(name, flush=True)
    else:
        print(report([Run.load(path) for path in sorted(args.out.glob("*.npz"))]))


if __name__ == "__main__":
    main()
