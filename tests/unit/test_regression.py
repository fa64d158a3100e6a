"""A Gaussian process of the parameters, against scikit-learn and refits."""

from unittest.mock import patch

import pytest
import torch
from scipy import stats
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from torch import Tensor

from sbi_rope.baselines import Regression
from sbi_rope.density import GaussianProcess
from sbi_rope.metrics.evaluation import estimates_and_ranks
from sbi_rope.utils.errors import InvalidInputError
from tests import problems


def pairs(n: int, width: int = 3) -> tuple[Tensor, Tensor]:
    theta = torch.randn(n, 2) * torch.tensor([1.0, 5.0])
    mix = torch.randn(2, width)
    x = torch.tanh(theta / 4) @ mix + 0.1 * torch.randn(n, width)
    return theta, x


def process(theta: Tensor, x: Tensor, groups: Tensor | None = None) -> GaussianProcess:
    groups = torch.arange(len(x)) if groups is None else groups
    return GaussianProcess(theta, x, weights=torch.ones(len(x)), groups=groups)


def test_mean_and_spread_are_those_of_scikit_learn() -> None:
    theta, x = pairs(30)
    found = process(theta, x)
    variance, *lengths, noise = found.hyperparameters.tolist()
    kernel = ConstantKernel(variance) * RBF(lengths) + WhiteKernel(noise)
    mean, std = x.double().mean(0), x.double().std(0, correction=0)
    centre, unit = theta.double().mean(0), theta.double().std(0, correction=0)
    reference = GaussianProcessRegressor(kernel, optimizer=None, alpha=0.0)
    reference.fit(((x - mean) / std).numpy(), ((theta - centre) / unit).numpy())
    new = pairs(7)[1]
    expected, spread = reference.predict(((new - mean) / std).numpy(), return_std=True)
    z, far = found.embed(new), found.embed(new + 1e3)
    assert torch.allclose(z[:, :2], centre + unit * torch.as_tensor(expected))
    assert torch.allclose(z[:, 2], torch.as_tensor(spread[:, 0]), atol=1e-6)
    # Far from all pairs it says that it does not know.
    assert torch.allclose(far[:, :2], centre.expand(7, 2))
    assert (far[:, 2] ** 2).tolist() == pytest.approx([variance + noise] * 7)


def test_errors_are_those_of_predictions_without_the_group() -> None:
    theta, x = pairs(12)
    groups = torch.arange(12) // 2
    found = process(theta, x, groups)
    variance, noise = found.hyperparameters[0], found.hyperparameters[-1]
    kernel = variance * (-(torch.cdist(found.inputs, found.inputs) ** 2) / 2).exp()
    kernel = kernel + noise * torch.eye(12)
    unit = theta.double().std(dim=0, correction=0)
    y = (theta - found.centre) / unit
    scatter = 2 * torch.eye(2).double()
    for group in range(6):
        out, rest = groups == group, groups != group
        gain = kernel[out][:, rest] @ torch.linalg.inv(kernel[rest][:, rest])
        spread = (kernel[out][:, out] - gain @ kernel[rest][:, out]).diagonal().sqrt()
        error = (y[out] - gain @ y[rest]) / spread[:, None]
        scatter = scatter + error.T @ error
    factor = found.factor / unit[:, None]
    assert torch.allclose(factor @ factor.T, scatter / 14)


def test_the_density_is_that_of_student() -> None:
    theta, x = pairs(15)
    found = process(theta, x)
    new_theta, new_x = pairs(4)
    log_q = found.log_prob(new_theta[None], new_x)[0]
    assert float(found.degrees) == 15
    for at, x_o, value in zip(new_theta, new_x, log_q, strict=True):
        *mean, scale = found.embed(x_o[None])[0].tolist()
        shape = scale**2 * (found.factor @ found.factor.T).numpy()
        expected = stats.multivariate_t.logpdf(at.numpy(), mean, shape, df=15)
        assert float(value) == pytest.approx(expected, abs=1e-4)


@pytest.mark.medium
def test_ten_and_fifty_pairs_give_calibrated_predictions() -> None:
    """Of many inputs that are reduced to components, too."""
    for n in (10, 50):
        for width in (3, 40):
            levels = []
            for _ in range(20):
                theta, x = pairs(n + 50, width)
                found = process(theta[:n], x[:n])
                draws = found.sample(torch.Size((200,)), x[n:])
                _, ranks = estimates_and_ranks(draws, theta[n:])
                levels.append((2 * ranks - 1).abs())
            assert abs(float(torch.cat(levels).mean()) - 0.5) < 0.07, (n, width)


def test_copies_of_a_pair_that_share_its_weight_are_one_pair() -> None:
    theta, x = pairs(20)
    rows = torch.arange(20).repeat(3)
    learned = process(theta, x).hyperparameters
    with patch("sbi_rope.density.regression._learned", lambda *data: learned):
        third = torch.full((60,), 1 / 3)
        copied = GaussianProcess(theta[rows], x[rows], weights=third, groups=rows)
    new = pairs(5)[1]
    assert torch.allclose(copied.embed(new), process(theta, x).embed(new), atol=1e-4)
    assert float(copied.degrees) == pytest.approx(20)


def test_labels_that_hold_one_parameter_fixed_are_refused() -> None:
    theta = problems.box(2).sample((10,))
    x = problems.simulate(theta)
    theta[:, 1] = 0.5
    method = Regression(problems.box(2)).append_calibration(theta, x)
    with pytest.raises(InvalidInputError, match="differ in each parameter"):
        method.train()
