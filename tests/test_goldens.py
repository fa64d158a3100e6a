"""Numbers that were recorded before the package was made smaller, and are still right.

    python -m tests.test_goldens    # writes tests/data/goldens.json

Numbers of trained networks are recorded with two seeds, of four problems with one. They
agree if they differ by at most two standard errors of a difference of two runs, whose
variance is pooled over problems, and by the floor below where that is larger.
"""

import contextlib
import io
import json
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from sbi.inference import MNPE, NPE
from sbi.neural_nets import posterior_nn
from torch import Tensor, nn

from sbi_rope import RoPE, SinkhornCoupler, stack
from sbi_rope.discrepancy import DiscrepancyNPE
from sbi_rope.tasks import get_task, list_tasks
from tests import problems

FILE = Path(__file__).parent / "data" / "goldens.json"
RECORDED = Path(__file__).parents[2] / "shared" / "data" / "causal_chamber"
SEEDS = (0, 1)
NUM_PAIRS, NUM_TEST, NUM_SIMULATIONS = 20, 40, 1000
QUIET: dict[str, Any] = {"show_progress_bars": False}
MIXED = ["mdn", "maf", "nsf", "zuko_nsf", "zuko_maf"]
COUPLERS = [(0.1, 1.0), (0.1, 0.5), (0.02, 0.0), (0.4, 0.9)]
# Differences that mean nothing, in the units of each number.
FLOORS = {"score": 0.05, "weight": 0.1, "acauc": 0.02, "log_prob": 0.05, "width": 0.02}

Pairs = tuple[Tensor, Tensor]
Numbers = dict[str, float]


class Problem:
    """A trained NPE with its simulator, labelled observations and others."""

    def __init__(
        self,
        prior: Any,
        simulator: Callable[[Tensor], Tensor],
        calibration: Pairs,
        test: Pairs,
        *,
        net: nn.Module | None = None,
        labels: dict[str, Any] | None = None,
        mixed: bool = False,
        standardise: str = "independent",
    ) -> None:
        self.prior, self.simulator, self.test = prior, simulator, test
        self.calibration, self.labels = calibration, labels or {}
        self.builder = posterior_nn(
            "mnpe" if mixed else "mdn",
            embedding_net=net or nn.Identity(),
            hidden_features=16,
            z_score_x=standardise,
        )
        trainer = MNPE if mixed else NPE
        npe = trainer(prior, density_estimator=self.builder, **QUIET)
        theta = prior.sample((NUM_SIMULATIONS,))
        x = simulator(theta)
        npe.append_simulations(theta, x, exclude_invalid_x=False)
        npe.train(max_num_epochs=60)
        self.npe = npe.build_posterior()

    def rope(self) -> RoPE:
        rope = RoPE(self.npe, simulator=self.simulator)
        return rope.append_calibration(*self.calibration, **self.labels)


def of_task(name: str, label: str = "exact", **options: Any) -> Problem:
    task = get_task(name, **options)
    theta, x = task.get_calibration_set(NUM_PAIRS, seed=0)
    labels: dict[str, Any] = {}
    std = task.prior_std
    if label == "noisy":
        theta = theta + 0.1 * std * torch.randn(theta.shape)
        labels["theta_std"] = 0.1 * std
    elif label == "partial":
        theta = theta.clone()
        theta[::2, 0] = torch.nan
    elif label == "drawn":
        draws = task.get_prior().sample((2000,))
        nearest = ((draws - theta[:, None]) / std).norm(dim=-1).argsort(dim=1)
        theta = draws[nearest[:, :20]]
    elif label == "groups":
        labels["groups"] = torch.arange(NUM_PAIRS) // 2
    elif label == "weights":
        labels["weights"] = torch.linspace(0.5, 2.0, NUM_PAIRS)
    return Problem(
        task.get_prior(),
        task.get_simulator(),
        (theta, x),
        task.get_test_set(NUM_TEST, seed=0),
        net=task.get_embedding_net(),
        labels=labels,
    )


def of_simulator(
    prior: Any, simulator: Callable[[Tensor], Tensor], **options: Any
) -> Problem:
    """A problem whose observations are shifted and shrunk simulations."""
    theta, other = prior.sample((NUM_PAIRS,)), prior.sample((NUM_TEST,))

    def measured(theta: Tensor) -> Tensor:
        return 0.8 * simulator(theta) + 0.2

    calibration, test = (theta, measured(theta)), (other, measured(other))
    return Problem(prior, simulator, calibration, test, **options)


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "linear_gaussian": lambda: of_task("linear_gaussian"),
    "cs": lambda: of_task("cs"),
    "sir": lambda: of_task("sir"),
    "noisy labels": lambda: of_task("linear_gaussian", "noisy"),
    "partial labels": lambda: of_task("cs", "partial"),
    "drawn labels": lambda: of_task("linear_gaussian", "drawn"),
    "groups": lambda: of_task("sir", "groups"),
    "weights": lambda: of_task("cs", "weights"),
    "series": lambda: of_task("pendulum"),
    "image": lambda: of_simulator(
        problems.box(2), problems.simulate_image, net=problems.SmallCNN()
    ),
    "trials with NaN": lambda: of_simulator(
        problems.box(2),
        problems.simulate_trials,
        net=problems.TrialsNet(),
        standardise="none",
    ),
    "discrete parameters": lambda: of_simulator(
        problems.mixed_prior(2), problems.simulate, mixed=True
    ),
}


def numbers_of(name: str, seed: int) -> Numbers:
    """Return what a stack, RoPE and DiscrepancyNPE say of a problem."""
    numbers: Numbers = {}
    with quiet(), torch.random.fork_rng():
        torch.manual_seed(0)
        problem = PROBLEMS[name]()
        theta, x = problem.test
        posterior = stack(problem.rope(), seed=seed, **QUIET)
        scores = posterior.report.cross_validation
        for candidate, score in zip(
            scores.names, scores.log_scores.double().mean(dim=0), strict=True
        ):
            numbers[f"score of {candidate}"] = float(score)
        numbers["score of the stack"] = posterior.report.score[0]
        for family, weight in posterior.report.family_weights.items():
            numbers[f"weight of {family}"] = weight
        numbers["acauc of the stack"] = posterior.report.acauc.value
        torch.manual_seed(seed)
        numbers["log_prob of the stack"] = mean_log_prob(posterior, theta, x)
        intervals = posterior.credible_intervals_batched(0.9, x[:5])
        width = (intervals.high - intervals.low) / theta.std(dim=0)
        numbers["width of the stack"] = float(width.mean())

        rope = problem.rope().train(seed=seed, **QUIET)
        of_batch = rope.build_posterior(x, num_simulations=200, seed=seed)
        numbers["weight of the nearest simulation, RoPE"] = float(
            of_batch.weights.max(dim=1).values.mean()
        )
        numbers["log_prob of RoPE"] = mean_log_prob(of_batch, theta, x)

        known, _ = problem.calibration
        if not problem.labels and known.ndim == 2 and known.isfinite().all():
            method = DiscrepancyNPE.from_posterior(
                problem.npe, simulator=problem.simulator, num_simulations=5000
            )
            method.append_calibration(*problem.calibration).train(seed=seed, **QUIET)
            numbers["log_prob of DiscrepancyNPE"] = mean_log_prob(
                method.build_posterior(), theta, x, norm_posterior=False
            )
    return numbers


def mean_log_prob(posterior: Any, theta: Tensor, x: Tensor, **options: Any) -> float:
    log_prob = posterior.log_prob_batched(theta[None], x, **options)[0].double()
    return float(log_prob.clamp_min(-20.0).mean())


def log_probs_of_mixture(family: str, gamma: float, tau: float) -> list[float]:
    """Return log densities under the mixture of a coupling, without any training."""
    with quiet(), torch.random.fork_rng():
        npe = problems.npe_posterior(family)
        torch.manual_seed(0)
        theta = problems.box(2).sample((30,))
        x = 0.8 * problems.simulate(theta) + 0.2
        rope = RoPE(
            npe,
            simulator=problems.simulate,
            coupler=SinkhornCoupler(gamma=gamma, tau=tau),
        )
        posterior = rope.build_posterior(x, num_simulations=100, seed=0)
        # The mass inside the support is estimated from draws, and tested elsewhere.
        density = posterior.log_prob_batched(theta[None], x, norm_posterior=False)
        return density[0, :5].tolist()


def moments_of_sets(name: str, variant: str | None) -> list[float]:
    """Return numbers that tell sets of a task apart from any others."""
    root = root_of(name)
    with quiet():
        task = get_task(name, variant=variant, root=root, **TASK_OPTIONS.get(name, {}))
        theta, x = task.get_calibration_set(5, seed=0)
        theta_test, x_test = task.get_test_set(5, seed=0)
        with torch.random.fork_rng():
            torch.manual_seed(0)
            prior = task.get_prior().sample((5,))
            simulated = task.get_simulator()(theta)
    sets = (theta, x, theta_test, x_test, prior, simulated)
    numbers = []
    for values in sets:
        flat = values.double().nan_to_num(-1.0).flatten()
        ramp = torch.linspace(1.0, 2.0, len(flat), dtype=torch.double)
        numbers += [float(flat.mean()), float((ramp * flat).mean())]
    return numbers


TASK_OPTIONS: dict[str, dict[str, Any]] = {
    "light_tunnel": {"image_size": 64, "stand_in": True},
    "wind_tunnel": {"stand_in": True},
}


def root_of(name: str) -> Path | None:
    return RECORDED if name == "light_tunnel_sensors" else None


def sets_of_tasks() -> list[tuple[str, str | None]]:
    """List tasks with variants; the solver of hemodynamics has its own oracles."""
    return [
        (name, variant)
        for name in list_tasks()
        if name != "hemodynamics" and not (root_of(name) and not RECORDED.exists())
        for variant in (None, *get_task(name, root=root_of(name)).variants)
    ]


@contextlib.contextmanager
def quiet() -> Any:
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        yield


def tolerance(quantity: str, runs: dict[str, dict[str, Numbers]]) -> float:
    """Return two standard errors of a run minus the mean of the recorded runs."""
    kind = quantity.split(" of ")[0]
    differences = [
        first[name] - second[name]
        for first, second in (
            list(by_seed.values()) for by_seed in runs.values() if len(by_seed) == 2
        )
        for name in first.keys() & second.keys()
        if name.split(" of ")[0] == kind
    ]
    variance = sum(d * d for d in differences) / (2 * len(differences))
    return max(FLOORS[kind], 2 * math.sqrt(1.5 * variance))


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_a_problem_has_the_answers_of_before(name: str) -> None:
    runs = json.loads(FILE.read_text())["runs"]
    found, before = numbers_of(name, SEEDS[0]), runs[name]
    # Candidates come and go; what is deployed stays.
    known = set(found).intersection(*before.values())
    assert {"score of the stack", "log_prob of the stack"} <= known
    for quantity in sorted(known):
        mean = sum(run[quantity] for run in before.values()) / len(before)
        assert found[quantity] == pytest.approx(mean, abs=tolerance(quantity, runs)), (
            quantity
        )


@pytest.mark.parametrize("family", MIXED)
def test_mixtures_have_the_densities_of_before(family: str) -> None:
    mixtures = json.loads(FILE.read_text())["mixtures"]
    for gamma, tau in COUPLERS:
        found = log_probs_of_mixture(family, gamma, tau)
        assert found == pytest.approx(mixtures[f"{family} {gamma} {tau}"], abs=1e-3)


@pytest.mark.medium
def test_tasks_have_the_sets_of_before() -> None:
    sets = json.loads(FILE.read_text())["sets"]
    for name, variant in sets_of_tasks():
        found = moments_of_sets(name, variant)
        assert found == pytest.approx(sets[f"{name} {variant}"], rel=1e-3, abs=1e-5)


def record() -> None:
    found = json.loads(FILE.read_text()) if FILE.exists() else {}
    mixtures, sets = found.setdefault("mixtures", {}), found.setdefault("sets", {})
    runs = found.setdefault("runs", {})

    def write() -> None:
        FILE.write_text(json.dumps(found, indent=1) + "\n")

    for family in MIXED:
        for gamma, tau in COUPLERS:
            key = f"{family} {gamma} {tau}"
            mixtures[key] = log_probs_of_mixture(family, gamma, tau)
    for name, variant in sets_of_tasks():
        sets[f"{name} {variant}"] = moments_of_sets(name, variant)
    write()
    for seed in SEEDS:
        for name in PROBLEMS:
            if str(seed) not in runs.setdefault(name, {}):
                runs[name][str(seed)] = numbers_of(name, seed)
                print(name, seed, flush=True)  # noqa: T201
                write()


if __name__ == "__main__":
    record()
