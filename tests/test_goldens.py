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
OPTIONS: dict[str, dict[str, Any]] = {
    "light_tunnel": {"image_size": 64, "stand_in": True},
    "light_tunnel_sensors": {"root": RECORDED},
    "wind_tunnel": {"stand_in": True},
}


@contextlib.contextmanager
def quiet() -> Any:
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        with torch.random.fork_rng():
            yield


def mixtures() -> dict[str, list[float]]:
    """Return log densities under mixtures of couplings, without any training."""
    found = {}
    for family, gamma, tau in MIXED:
        with quiet():
            npe = problems.npe_posterior(family)
            torch.manual_seed(0)
            theta = problems.box(2).sample((30,))
            x = 0.8 * problems.simulate(theta) + 0.2
            coupler = SinkhornCoupler(gamma=gamma, tau=tau)
            rope = RoPE(npe, simulator=problems.simulate, coupler=coupler)
            posterior = rope.build_posterior(x, num_simulations=100, seed=0)
            # The mass inside the support is estimated from draws, and tested elsewhere.
            density = posterior.log_prob_batched(theta[None], x, norm_posterior=False)
        found[f"{family} {gamma} {tau}"] = density[0, :5].tolist()
    return found


def moments_of_sets(task: Any) -> list[float]:
    """Return numbers that tell sets of a task apart from any others."""
    theta, x = task.get_calibration_set(5, seed=0)
    held_out = task.get_test_set(5, seed=0)
    torch.manual_seed(0)
    prior = task.get_prior().sample((5,))
    numbers = []
    for values in (theta, x, *held_out, prior, task.get_simulator()(theta)):
        flat = values.double().nan_to_num(-1.0).flatten()
        ramp = torch.linspace(1.0, 2.0, len(flat), dtype=torch.double)
        numbers += [float(flat.mean()), float((ramp * flat).mean())]
    return numbers


def sets() -> dict[str, list[float]]:
    """Return the numbers of tasks and variants, but for those that are newer."""
    names = set(list_tasks()) - {"hemodynamics", *MEASURED}
    if not RECORDED.exists():
        names -= {"light_tunnel_sensors"}
    found = {}
    for name in sorted(names):
        options = OPTIONS.get(name, {})
        for variant in (None, *get_task(name, **options).variants):
            with quiet():
                task = get_task(name, variant=variant, **options)
                found[f"{name} {variant}"] = moments_of_sets(task)
    return found


@pytest.mark.parametrize(
    ("kind", "tolerance"),
    [
        pytest.param("mixtures", {"abs": 1e-3}),
        pytest.param("sets", {"rel": 1e-3, "abs": 1e-5}, marks=pytest.mark.medium),
    ],
)
def test_numbers_are_those_of_before(kind: str, tolerance: dict[str, float]) -> None:
    known = json.loads(FILE.read_text())[kind]
    for name, found in {"mixtures": mixtures, "sets": sets}[kind]().items():
        assert found == pytest.approx(known[name], **tolerance), name


if __name__ == "__main__":
    both = {"mixtures": mixtures(), "sets": sets()}
    FILE.write_text(json.dumps(both, indent=1) + "\n")
