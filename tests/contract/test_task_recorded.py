"""Tasks whose published files are too large for tests, on files of their kind."""

from pathlib import Path

import pytest
import torch
from sbi.utils import within_support

from sbi_rope.tasks import Task, get_task
from tests.chamber_files import write_camera_experiments, write_impulses
from tests.tasks import draw, largest_z, same_rows

OPTIONS = {"light_tunnel": {"image_size": 64, "dequantise": True}, "wind_tunnel": {}}
# The variants that read files in a way of their own.
KINDS = [
    ("light_tunnel", None),
    ("light_tunnel", "biased_calibration"),
    ("light_tunnel", "misspecified_prior"),
    ("light_tunnel", "flipped"),
    ("wind_tunnel", None),
]


@pytest.fixture(scope="module")
def written_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("chambers")
    with torch.random.fork_rng():
        torch.manual_seed(0)
        write_camera_experiments(root, num_rows=120)
        write_impulses(root, num_impulses=120)
    return root


@pytest.fixture(params=KINDS, ids=str)
def recorded(request: pytest.FixtureRequest, written_root: Path) -> Task:
    name, variant = request.param
    return get_task(name, variant=variant, root=written_root, **OPTIONS[name])


@pytest.mark.medium
def test_recorded_sets_have_the_shapes_asked_for_and_share_no_observation(
    recorded: Task,
) -> None:
    assert recorded.has_data
    prior = recorded.get_prior()
    sets = []
    for part, n in (("calibration", 15), ("test", 30)):
        for seed in (0, 1):
            theta, x = draw(recorded, part, n, seed=seed)
            assert theta.shape == (n, recorded.theta_dim)
            assert x.shape == (n, *recorded.x_shape)
            assert theta.dtype == x.dtype == torch.float32
            assert torch.isfinite(x).all()
            assert within_support(prior, theta).all()
            assert torch.isfinite(prior.log_prob(theta)).all()
            sets.append(x)
    assert same_rows(torch.cat(sets[:2]), torch.cat(sets[2:])) == 0


@pytest.mark.medium
def test_recorded_sets_are_reproducible_prefixes_that_differ_between_seeds(
    recorded: Task,
) -> None:
    before = torch.get_rng_state()
    for part in ("calibration", "test"):
        few, many = (draw(recorded, part, n, seed=1) for n in (5, 15))
        assert torch.equal(few[0], many[0][:5])
        assert torch.equal(few[1], many[1][:5])
        assert not torch.equal(many[0], draw(recorded, part, 15, seed=2)[0])
    assert torch.equal(before, torch.get_rng_state())


def test_recorded_observations_differ_from_simulations_of_their_parameters(
    recorded: Task,
) -> None:
    theta, x_o = recorded.get_test_set(60)
    assert largest_z(recorded.get_simulator()(theta), x_o) > 4.5
