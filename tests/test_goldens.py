"""Numbers that were recorded before the package was made smaller, and are still right.

python -m tests.test_goldens    # writes tests/data/goldens.json
"""

import contextlib
import io
import json
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch

from sbi_rope import RoPE, SinkhornCoupler
from sbi_rope.tasks import get_task, list_tasks
from tests import problems
from tests.tasks import MEASURED

FILE = Path(__file__).parent / "data" / "goldens.json"
RECORDED = Path(__file__).parents[2] / "shared" / "data" / "causal_chamber"
# Families, gamma and tau.
MIXED = [
    *[("mdn", 0.1, 1.0), ("maf", 0.1, 0.5), ("nsf", 0.02, 0.0)],
    *[("zuko_nsf", 0.4, 0.9), ("zuko_maf", 0.1, 0.5)],
]


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
    """List tasks with variants whose numbers are recorded; others are newer."""
    return [
        (name, variant)
        for name in list_tasks()
        if name not in ("hemodynamics", *MEASURED)
        and not (root_of(name) and not RECORDED.exists())
        for variant in (None, *get_task(name, root=root_of(name)).variants)
    ]


@contextlib.contextmanager
def quiet() -> Any:
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        yield


def test_mixtures_have_the_densities_of_before() -> None:
    mixtures = json.loads(FILE.read_text())["mixtures"]
    for family, gamma, tau in MIXED:
        found = log_probs_of_mixture(family, gamma, tau)
        assert found == pytest.approx(mixtures[f"{family} {gamma} {tau}"], abs=1e-3)


@pytest.mark.medium
def test_tasks_have_the_sets_of_before() -> None:
    sets = json.loads(FILE.read_text())["sets"]
    for name, variant in sets_of_tasks():
        found = moments_of_sets(name, variant)
        assert found == pytest.approx(sets[f"{name} {variant}"], rel=1e-3, abs=1e-5)


def record() -> None:
    found = {
        "mixtures": {
            f"{family} {gamma} {tau}": log_probs_of_mixture(family, gamma, tau)
            for family, gamma, tau in MIXED
        },
        "sets": {
            f"{name} {variant}": moments_of_sets(name, variant)
            for name, variant in sets_of_tasks()
        },
    }
    FILE.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    record()
