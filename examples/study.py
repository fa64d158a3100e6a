"""One study of RoPE on a task: train NPE, repair it, score all methods, draw them.

Used by the example scripts; a study is (seeds) x (calibration sizes).
"""

import argparse
import itertools
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from sbi.inference import NPE
from sbi.neural_nets import posterior_nn
from torch import Tensor

from sbi_rope import (
    CalibrationFinetuner,
    RoPE,
    SinkhornCoupler,
    diagnose,
    plots,
    stack,
)
from sbi_rope.density import PriorPosterior
from sbi_rope.methods import DiscrepancyNPE
from sbi_rope.metrics import Evaluation, evaluate
from sbi_rope.tasks import Task
from sbi_rope.utils.files import write_atomically

COLUMNS = (
    "task",
    "variant",
    "seed",
    "method",
    "n_calibration",
    "lpp",
    "lpp_z",
    "acauc",
    "seconds",
)
# Draws per observation behind the calibration scores.
NUM_SAMPLES = 500


@dataclass(frozen=True, kw_only=True)
class Study:
    """What to run; the train function returns an sbi posterior of a task.

    With ``stored``, RoPE uses these simulations instead of the task's simulator. With
    ``held_out``, NPE is also scored on simulations it has not seen: the row "SBI".
    ``with_stack`` weighs NPE, fine-tuned NPE and discrepancy models by ``num_folds``
    folds of the pairs, prints the report of the stack, and says what is wrong with each
    summary of x if these have names; ``with_diagnosis`` prints whether the test
    observations are fit for RoPE.
    """

    task: Task
    train_npe: Callable[[Task, int], Any]
    coupler: SinkhornCoupler
    seeds: list[int]
    n_calibration: list[int]
    n_test: int
    out: Path
    finetuner: CalibrationFinetuner | None = None
    stored: Callable[[Task, int], tuple[Tensor, Tensor]] | None = None
    held_out: Callable[[Task, int], tuple[Tensor, Tensor]] | None = None
    with_stack: bool = False
    num_folds: int | None = None
    with_diagnosis: bool = False

    def run(self) -> list[dict[str, Any]]:
        """Run all seeds and sizes; rows are written as they are finished."""
        try:
            self.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise SystemExit(f"Cannot write to {self.out}: {error}") from error
        if not os.access(self.out, os.W_OK):
            raise SystemExit(f"Cannot write to {self.out}; pass another `--out`.")
        results = ResultsFile(self.out / "results.csv")
        for seed in self.seeds:
            self._run_seed(seed, results)
        print_table(results.rows)
        print(f"\nWritten to {self.out}/: results.csv and pictures (*.png).")
        return results.rows

    def _run_seed(self, seed: int, results: "ResultsFile") -> None:
        task = self.task
        theta_o, x_o = task.get_test_set(self.n_test, seed=seed)
        if self.stored is None:
            source = {"simulator": task.get_simulator()}
        else:
            source = {"simulations": self.stored(task, seed)}
        evaluations: dict[str, Evaluation] = {}

        def score(
            method: str,
            posterior: Any,
            start: float,
            n: int = 0,
            pairs: tuple[Tensor, Tensor] = (theta_o, x_o),
        ) -> None:
            print(f"  scoring {method} ...", flush=True)
            evaluation: Evaluation = evaluate(
                posterior,
                *pairs,
                theta_std=task.prior_std,
                num_samples=NUM_SAMPLES,
                seed=seed,
            )
            evaluations[method] = evaluation
            results.append(
                task=task.name,
                variant=task.variant,
                seed=seed,
                method=method,
                n_calibration=n,
                seconds=round(time.perf_counter() - start, 1),
                lpp=evaluation.lpp.mean,
                lpp_z=evaluation.lpp_z.mean,
                acauc=evaluation.acauc.mean,
            )

        print(f"Seed {seed}: {task.name}, {self.n_test} test observations", flush=True)
        start = time.perf_counter()
        score("prior", PriorPosterior(task.get_prior()), start)
        start = time.perf_counter()
        print("  training NPE on simulations ...", flush=True)
        npe = self.train_npe(task, seed)
        score("NPE", npe, start)
        if self.held_out is not None:
            start = time.perf_counter()
            score("SBI", npe, start, pairs=self.held_out(task, seed))

        start = time.perf_counter()
        ot_only = RoPE(npe, coupler=self.coupler, **source)
        score("OT-only", ot_only.build_posterior(x_o, seed=seed), start)
        for n in self.n_calibration:
            start = time.perf_counter()
            theta_cal, x_cal = task.get_calibration_set(n, seed=seed)
            rope = RoPE(
                npe,
                coupler=self.coupler,
                finetuner=self.finetuner,
                parameter_names=task.parameter_names,
                **source,
            )
            rope.append_calibration(theta_cal, x_cal)
            rope.train(seed=seed, show_progress_bars=False)
            score("tuning-only", rope.tuned_posterior(), start, n)
            start = time.perf_counter()
            posterior = rope.build_posterior(x_o, seed=seed)
            score("RoPE", posterior, start, n)
            name = f"seed{seed}_n{n}"
            if self.with_stack:
                start = time.perf_counter()
                print("  stacking ...", flush=True)
                stacked = stack(
                    rope,
                    num_folds=self.num_folds,
                    seed=seed,
                    show_progress_bars=False,
                )
                score("stack", stacked, start, n)
                print(stacked.report, flush=True)
                self._save(plots.stacking_report(stacked.report), f"stack_{name}")
                if task.x_names:
                    simulator = source.get("simulator")
                    method = DiscrepancyNPE.from_posterior(npe, simulator=simulator)
                    if "simulations" in source:
                        method.append_simulations(*source["simulations"])
                    method.append_calibration(theta_cal, x_cal)
                    report = method.report(x_names=task.x_names)
                    print(report, flush=True)
                    self._save(plots.discrepancy(report), f"discrepancy_{name}")
            if self.with_diagnosis:
                diagnosis = diagnose(
                    rope,
                    x_o,
                    seed=seed,
                    show_progress_bars=False,
                )
                print(diagnosis, flush=True)
                self._save(plots.implied_parameters(diagnosis), f"diagnosis_{name}")
            self._draw(name, npe, rope, posterior, theta_o, evaluations)

    def _draw(
        self,
        name: str,
        npe: Any,
        rope: RoPE,
        posterior: Any,
        theta_o: Tensor,
        evaluations: dict[str, Evaluation],
    ) -> None:
        task, x_o = self.task, posterior.x_o
        with torch.random.fork_rng(), torch.no_grad():
            torch.manual_seed(0)
            prior = task.get_prior().sample(torch.Size((2000,)))
            h, g = rope.npe.h, rope.tuned_embedding_net
            before, after = h(x_o), g(x_o)
            samples = {
                "NPE": npe.sample(
                    (2000,),
                    x=x_o[:1],
                    show_progress_bars=False,
                    reject_outside_prior=False,
                ),
                "RoPE": posterior[0].sample((2000,), show_progress_bars=False),
            }
        ends = sorted({0, task.theta_dim - 1})
        names = [
            name if unit == "1" else f"{name} [{unit}]"
            for name, unit in zip(
                task.parameter_names, task.parameter_units, strict=True
            )
        ]
        figures = {
            "overview": plots.overview(
                simulated=posterior.coupling.simulated,
                before=before,
                after=after,
                weights=posterior.weights[0],
                samples={name: value[:, ends] for name, value in samples.items()},
                theta=theta_o[0, ends],
                parameter_names=[names[k] for k in ends],
                prior=prior[:, ends],
            ),
            "posterior": plots.pair_plot(
                samples, theta_o[0], parameter_names=names, prior=prior
            ),
            "calibration": plots.calibration_curves(evaluations),
        }
        for kind, figure in figures.items():
            self._save(figure, f"{kind}_{name}")

    def _save(self, figure: Any, name: str) -> None:
        figure.savefig(self.out / f"{name}.png", dpi=120, bbox_inches="tight")


def train_small_npe(
    task: Task,
    simulations: tuple[Tensor, Tensor],
    *,
    seed: int,
    learning_rate: float,
    max_num_epochs: int,
) -> Any:
    """Train plain sbi with the task's light network; nothing here knows of RoPE."""
    torch.manual_seed(seed)
    npe = NPE(
        task.get_prior(),
        density_estimator=posterior_nn(
            "nsf",
            embedding_net=task.get_embedding_net(light=True),
            z_score_x=task.z_score_x,
            num_transforms=2,
        ),
        show_progress_bars=False,
    )
    npe.append_simulations(*simulations)
    npe.train(
        training_batch_size=100,
        learning_rate=learning_rate,
        max_num_epochs=max_num_epochs,
    )
    return npe.build_posterior()


class ResultsFile:
    """A CSV file that is complete after every row; an older one is set aside."""

    def __init__(self, path: Path) -> None:
        if path.exists():
            others = (path.with_name(f"results_{i}.csv") for i in itertools.count(1))
            path.rename(next(other for other in others if not other.exists()))
        self.path = path
        self.rows: list[dict[str, Any]] = []
        self._write()

    def append(self, **row: Any) -> None:
        """Add a row to the file."""
        self.rows.append(row)
        self._write()

    def _write(self) -> None:
        with write_atomically(self.path) as path:
            pd.DataFrame(self.rows, columns=[*COLUMNS]).to_csv(path, index=False)


EXPLANATION = """
LPP: mean log-probability of the true parameters, in standard deviations of the prior
(higher is better). ACAUC: 0 is calibrated, above 0 is over-confident. NPE and
tuning-only are scored without sbi's leakage correction. SBI is NPE on simulations that
it has not seen. RoPE has one setting, fixed beforehand; stack weighs its rivals by
hold-out pairs.
With several seeds: mean, and standard deviation of the LPP over seeds (+-).
"""


def print_table(rows: list[dict[str, Any]], *, explain: bool = True) -> None:
    """Print the mean over seeds of each method and calibration size."""
    if explain:
        print(EXPLANATION)
    order = ("prior", "SBI", "NPE", "tuning-only", "OT-only", "RoPE", "stack")
    frame = pd.DataFrame(rows)
    frame["method"] = pd.Categorical(frame["method"], order)
    groups = frame.groupby(["method", "n_calibration"], observed=True)
    columns = ["lpp_z", "acauc"]
    table = groups[columns].mean()
    table.insert(1, "+-", groups["lpp_z"].std())
    table.columns = ["LPP", "+-", "ACAUC"]
    table = table.rename_axis(["method", "pairs"]).reset_index()
    table["pairs"] = table["pairs"].replace({0: "-"})
    print(
        table.to_string(
            index=False,
            na_rep="-",
            float_format="{:.2f}".format,
            formatters={"ACAUC": "{:.3f}".format},
        )
    )


def argument_parser(
    description: str, *, n_test: int, out: str, with_stack: bool = False
) -> Any:
    """Return the arguments that all examples share."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument(
        "--n-calibration",
        type=int,
        nargs="+",
        default=[50],
        help="labelled real observations to repair with",
    )
    parser.add_argument("--n-test", type=int, default=n_test)
    parser.add_argument(
        "--stack",
        action=argparse.BooleanOptionalAction,
        default=with_stack,
        help="weigh many methods by held-out pairs; a minute or two each",
    )
    parser.add_argument(
        "--max-tuning-epochs",
        type=int,
        default=CalibrationFinetuner().max_num_epochs,
        help="epochs after which the fine-tuning of RoPE ends",
    )
    parser.add_argument(
        "--num-folds",
        type=int,
        help="folds of the pairs, for the stack; fewer are quicker",
    )
    parser.add_argument(
        "--diagnose",
        action="store_true",
        help="say whether the test observations are fit for RoPE",
    )
    parser.add_argument("--out", type=Path, default=Path(out))
    return parser
