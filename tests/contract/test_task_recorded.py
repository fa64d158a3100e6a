"""Tasks whose published files are too large for tests, on files of their kind."""

from pathlib import Path

import pytest
import torch
from sbi.utils import within_support

from sbi_rope.tasks import TASKS, Task, get_task
from tests.chamber_files import write_camera_experiments, write_impulses
from tests.tasks import draw, largest_z, same_rows

RECORDED = {"light_tunnel": {"image_size": 64, "dequantise": True}, "wind_tunnel": {}}


@pytest.fixture(scope="session")
def written_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("chambers")
    with torch.random.fork_rng():
        torch.manual_seed(0)
        write_camera_experiments(root, num_rows=450)
        write_impulses(root, num_impulses=450)
    return root


@pytest.mark.parametrize(
    ("name", "variant"),
    [
        pytest.param(name, variant, id=f"{name}-{variant}")
        for name in RECORDED
        for variant in (None, *TASKS[name].variants)
    ],
)
@pytest.mark.usefixtures("shorter_files")
class TestRecordedFiles:
    @pytest.fixture
    def recorded(self, name: str, variant: str | None, written_root: Path) -> Task:
        options = RECORDED[name]
        return get_task(name, variant=variant, root=written_root, **options)

    def test_sets_have_shapes_values_and_support(self, recorded: Task) -> None:
        assert recorded.has_data
        for part in ("calibration", "test"):
            theta, x = draw(recorded, part, 15)
            assert theta.shape == (15, recorded.theta_dim)
            assert x.shape == (15, *recorded.x_shape)
            assert theta.dtype == x.dtype == torch.float32
            assert torch.isfinite(x).all()
            assert within_support(recorded.get_prior(), theta).all()
            assert torch.isfinite(recorded.get_prior().log_prob(theta)).all()

    def test_sets_are_reproducible_prefixes_that_differ_between_seeds(
        self, recorded: Task
    ) -> None:
        for part in ("calibration", "test"):
            few, many = (
                draw(recorded, part, 5, seed=1),
                draw(recorded, part, 15, seed=1),
            )
            assert torch.equal(few[0], many[0][:5])
            assert torch.equal(few[1], many[1][:5])
            assert not torch.equal(many[0], draw(recorded, part, 15, seed=2)[0])

    def test_calibration_and_test_sets_share_no_observation(
        self, recorded: Task
    ) -> None:
        calibration = [recorded.get_calibration_set(15, seed=s)[1] for s in (0, 1)]
        test = [recorded.get_test_set(30, seed=s)[1] for s in (0, 1)]
        assert same_rows(torch.cat(calibration), torch.cat(test)) == 0

    def test_sets_leave_the_global_random_state_alone(self, recorded: Task) -> None:
        before = torch.get_rng_state()
        draw(recorded, "calibration", 5)
        assert torch.equal(before, torch.get_rng_state())

    def test_real_law_is_the_simulated_law_only_where_the_task_says_so(
        self, recorded: Task, variant: str | None
    ) -> None:
        theta, x_o = recorded.get_test_set(60)
        different = largest_z(recorded.get_simulator()(theta), x_o) > 4.5
        assert different == (variant != "well_specified")
