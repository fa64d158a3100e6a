"""FMCPE: its maps and densities belong together, and it learns from pairs."""

from typing import Any

import pytest
import torch
from sbi.utils import BoxUniform
from torch import nn

from sbi_rope.baselines import FMCPE
from sbi_rope.baselines.flow_matching import Unbounded, VelocityField
from sbi_rope.methods import Training
from tests import gaussian, problems
from tests.baselines import log_prob, sample, train

DIM = 2


@pytest.fixture(autouse=True)
def _few_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sbi_rope.baselines.fmcpe.NUM_DRAWS", 10)


def bent_field() -> VelocityField:
    """A field of strong and varying velocities."""
    torch.manual_seed(0)
    field = VelocityField(DIM, nn.Identity(), 1)
    nn.init.normal_(field.last.weight, std=0.15)
    nn.init.normal_(field.last.bias, std=0.5)
    return field.double().requires_grad_(requires_grad=False)


@pytest.mark.medium
def test_the_way_back_ends_where_it_began_and_knows_the_change_of_volume() -> None:
    field, c = bent_field(), torch.randn(5, 1).double()
    z = torch.randn(5, DIM).double()
    end = field.follow(z, c)
    assert (end - z).norm(dim=1).mean() > 0.4
    back, divergence = field.follow_back(end, c)
    torch.testing.assert_close(back, z, atol=2e-3, rtol=0)
    for row in range(5):
        jacobian: Any = torch.autograd.functional.jacobian(
            lambda point, row=row: field.follow(point[None], c[row : row + 1])[0],
            z[row],
        )
        expected = jacobian.det().log()
        assert abs(float(expected)) > 0.02
        torch.testing.assert_close(divergence[row], expected, atol=5e-3, rtol=0)


@pytest.mark.parametrize(("space", "noise"), [("input", None), ("embedding", 0.05)])
@pytest.mark.slow
def test_with_many_pairs_it_comes_near_the_exact_posterior(
    space: str, noise: float | None
) -> None:
    training = Training(
        training_batch_size=160,
        learning_rate=3e-3,
        max_num_epochs=25,
        stop_after_epochs=25,
        validation_fraction=0.2,
    )
    options: dict[str, Any] = {"space": space, "noise": noise, "training": training}
    method = FMCPE.from_posterior(
        gaussian.posterior(), simulator=gaussian.simulator, **options
    )
    posterior = train(method.append_calibration(*gaussian.labelled(400)))
    assert gaussian.nats_lost(gaussian.posterior()) > 1.0
    assert gaussian.nats_lost(posterior.build_posterior()) < 0.25


@pytest.mark.medium
def test_what_npe_has_outside_the_prior_is_replaced_by_the_prior() -> None:
    # NPE has no mass inside for this observation, and there is nothing to learn.
    far = torch.full((1, DIM), 100.0)
    prior = problems.box(DIM)
    npe = type(gaussian.posterior())(gaussian.GaussianEstimator(), prior)
    method = FMCPE.from_posterior(
        npe,
        simulator=gaussian.simulator,
        training=Training(learning_rate=1e-12, max_num_epochs=1),
    )
    theta = prior.sample((20,))
    method.append_calibration(theta, gaussian.simulator(theta))
    posterior, middle = train(method).build_posterior(), torch.zeros(1, DIM)
    draws = posterior.sample((2000,), x=far, show_progress_bars=False)
    assert draws.std(dim=0).allclose(torch.tensor(1 / 3**0.5), atol=0.05)
    assert torch.allclose(log_prob(posterior, middle, far), prior.log_prob(middle))


@pytest.mark.medium
def test_in_a_box_its_mass_is_one_and_labels_on_a_bound_are_like_those_next_to_it() -> (
    None
):
    """Recorded settings are often exactly at the end of their range."""
    theta = problems.box(1).sample((40,))
    x = problems.simulate(torch.tensor([[-0.9]])) + 0.3
    points = torch.tensor([[-1.0], [-0.9999], [-0.99], [0.0], [1.0]])
    training = Training(learning_rate=3e-3, max_num_epochs=15, stop_after_epochs=15)
    densities = []
    for label in (-1.0, -0.9999):
        theta[:4] = label
        torch.manual_seed(1)
        method = FMCPE.from_posterior(
            problems.npe_posterior("mdn", dim=1),
            simulator=problems.simulate,
            training=training,
        )
        method.append_calibration(theta, problems.simulate(theta) + 0.3)
        posterior = train(method).build_posterior()
        densities.append(log_prob(posterior, points[:, None], x))
        # By the rectangle rule all mass is inside, and where the samples are.
        grid = torch.linspace(-0.9995, 0.9995, 2000)[:, None, None]
        mass = log_prob(posterior, grid, x).exp() * 0.001
        assert float(mass.sum()) == pytest.approx(1, abs=0.05)
        mean = float((mass[..., None] * grid).sum())
        assert float(sample(posterior, 2000, x).mean()) == pytest.approx(mean, abs=0.1)
    torch.testing.assert_close(*densities, atol=0.3, rtol=0)
    # A density at the bound is like that next to it, and not 60 nats higher.
    assert float(densities[0][0]) == pytest.approx(float(densities[0][1]), abs=0.01)
    assert float(densities[0][:3].max()) < 6


def test_the_volume_of_the_transform_is_right_far_from_its_middle() -> None:
    """Parameters near a bound of [0, 5] have rounded distances from it."""
    prior = BoxUniform(torch.zeros(1), torch.full((1,), 5.0))
    unbounded = Unbounded(prior)
    for raw in (-30.0, -18.0, 0.0, 18.0, 30.0):
        line = torch.tensor([[raw]])
        u = unbounded.unit(line)
        slope = 5 * line.double().sigmoid() * (-line.double()).sigmoid()
        expected = -slope.log().flatten() - unbounded.unit.std.log()
        torch.testing.assert_close(
            unbounded.log_scale(u).double(), expected.double(), atol=1e-3, rtol=1e-4
        )
