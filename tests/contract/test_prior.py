"""Every prior that sbi trains NPE with works in RoPE, in a stack and in a file."""

import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sbi.inference import NPE
from sbi.neural_nets import posterior_nn
from sbi.utils import BoxUniform, MultipleIndependent, process_prior
from torch import Tensor
from torch.distributions import (
    Beta,
    Categorical,
    Distribution,
    ExpTransform,
    Gamma,
    Independent,
    MultivariateNormal,
    Normal,
    TransformedDistribution,
    Uniform,
)

from sbi_rope import RoPE, load, save, stack
from sbi_rope.npe.prior import PriorDistribution
from tests.stacks import DEFAULTS, QUIET, quick

ONE, TWO = torch.ones(1), torch.ones(2)


class Slicing:
    """Reads single columns, so that it takes parameters ``(n, d)`` only."""

    def sample(self, sample_shape: Any = ()) -> Tensor:
        return torch.rand(*sample_shape, 2)

    def log_prob(self, value: Tensor) -> Tensor:
        first, second = value[:, :1], value[:, 1:2]
        inside = (first > 0) & (first < 1) & (second > 0) & (second < 1)
        return torch.zeros(len(value)).where(inside[:, 0], -torch.inf)


class OfArrays:
    """Works with NumPy arrays."""

    def sample(self, sample_shape: Any = ()) -> Any:
        return torch.rand(*sample_shape, 2).numpy()

    def log_prob(self, value: Any) -> Any:
        return np.where(((value >= 0) & (value <= 1)).all(axis=-1), 0.0, -np.inf)


PRIORS: dict[str, Any] = {
    "gamma": Gamma(2 * ONE, ONE),
    "normal": Normal(0 * ONE, ONE),
    "box": BoxUniform(0 * TWO, TWO),
    "float64": BoxUniform(0.1 * TWO.double(), 0.7 * TWO.double()),
    "gaussian": MultivariateNormal(0 * TWO, torch.eye(2)),
    "log-uniform": TransformedDistribution(
        Independent(Uniform(math.log(0.1) * TWO, math.log(10.0) * TWO), 1),
        [ExpTransform()],
    ),
    "list": [Gamma(2 * ONE, ONE), Normal(0 * ONE, ONE), Uniform(0 * ONE, ONE)],
    "slicing": Slicing(),
    "arrays": OfArrays(),
}
# Those whose repair takes other ways.
END_TO_END = ("gamma", "gaussian", "list", "slicing", "arrays")


def prior_of(name: str) -> Distribution:
    return process_prior(PRIORS[name])[0]


@pytest.mark.parametrize("name", PRIORS)
def test_a_prior_has_one_set_of_shapes(name: str) -> None:
    own = prior_of(name)
    prior = pickle.loads(pickle.dumps(PriorDistribution(own)))
    torch.manual_seed(1)
    theta = prior.sample((4, 3))
    (dim,) = prior.event_shape
    assert theta.shape == (4, 3, dim)
    assert theta.dtype == torch.float32
    log_prob = prior.log_prob(theta)
    flat = theta.flatten(0, 1)
    expected = own.log_prob(flat.to(prior._some.dtype)).reshape(4, 3)
    assert torch.allclose(log_prob.to(expected), expected, atol=1e-5)
    assert prior.inside(flat).all()
    far = torch.cat([flat, -1e3 - flat]).requires_grad_()
    safe, inside = prior.moved_inside(far)
    assert prior.inside(safe).all()
    assert prior.is_unbounded == (name in {"normal", "gaussian"})
    if not prior.is_unbounded:
        assert inside.tolist() == [True] * 12 + [False] * 12
    prior.log_prob(far).where(inside, 0.0).sum().backward()
    assert far.grad is not None
    assert torch.isfinite(far.grad).all()


def simulator(theta: Tensor) -> Tensor:
    x = torch.cat([theta, theta.sum(dim=1, keepdim=True)], dim=1)
    return x + 0.1 * torch.randn_like(x)


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name == "gamma" else pytest.mark.medium)
        for name in END_TO_END
    ],
)
def test_a_prior_of_sbi_works_from_end_to_end(name: str, tmp_path: Path) -> None:
    own = prior_of(name)
    prior = PriorDistribution(own)
    theta, labels = prior.sample((400,)), prior.sample((12,))
    trainer = NPE(own, posterior_nn("mdn"), **QUIET)
    trainer.append_simulations(theta, simulator(theta)).train(max_num_epochs=5)
    npe, x = trainer.build_posterior(), 0.8 * simulator(labels)
    rope = RoPE(npe, simulator=simulator).append_calibration(labels, x)
    rope.train(seed=0, **QUIET)
    with quick():
        stacked = stack(rope, **DEFAULTS)
    coupled = rope.build_posterior(x, num_simulations=60, seed=0)
    for posterior in (coupled, stacked):
        samples = posterior.sample_batched((20,), x[:4], **QUIET)
        assert prior.inside(samples.flatten(0, 1)).all()
        log_prob = posterior.log_prob_batched(samples, x[:4])
        assert torch.isfinite(log_prob).all()
        interval = posterior.credible_set(0.9, x=x[0])
        assert (interval.low < interval.high).all()
        file = tmp_path / f"{type(posterior).__name__}.pt"
        save(posterior, file)
        again = load(file, trusted=[Slicing, OfArrays])
        assert torch.equal(again.log_prob_batched(samples, x[:4]), log_prob)


def test_discrete_parameters_are_not_moved_off_their_bounds() -> None:
    prior = PriorDistribution(
        MultipleIndependent(
            [Uniform(-ONE, ONE), Categorical(probs=torch.ones(1, 3))],
            validate_args=False,
        )
    )
    theta = torch.tensor([[1.0, 0.0], [-1.0, 2.0], [0.5, 1.0]])
    low, high = prior.bounds(theta)
    assert torch.equal(low, torch.tensor([-1.0, 0.0]).expand(3, 2))
    assert torch.equal(high, torch.tensor([1.0, 2.0]).expand(3, 2))
    moved = prior.off_bounds(theta)
    assert torch.equal(moved[:, 1], theta[:, 1])
    assert (moved[:2, 0].abs() < 1).all()
    assert moved[2, 0] == 0.5


def test_the_density_on_a_bound_is_that_just_inside() -> None:
    box = PriorDistribution(BoxUniform(-TWO, TWO))
    corners = torch.tensor([[1.0, 1.0], [-1.0, 1.0], [0.0, -1.0], [0.0, 1.1]])
    expected = torch.tensor([0.25, 0.25, 0.25, 0.0]).log()
    assert torch.allclose(box.log_prob(corners), expected)
    arcsine = MultipleIndependent([Beta(0.5 * ONE, 0.5 * ONE)] * 2)
    assert PriorDistribution(arcsine).log_prob(torch.zeros(1, 2)).isfinite().all()
    # In float32, 0.7 is a little less than the bound of float64.
    narrow = PriorDistribution(prior_of("float64"))
    assert narrow.inside(torch.tensor([[0.1, 0.7], [0.7, 0.1]])).all()
