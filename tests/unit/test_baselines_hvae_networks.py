"""The U-Net and the encoder of the HVAE."""

import pytest
import torch
from torch import nn

from sbi_rope.baselines.hvae.networks import (
    ConditionalUNet,
    LatentEncoder,
    bounded,
)

EVENTS = [(200,), (100,), (50,), (16,), (3, 100, 100), (3, 64, 64), (1, 17, 40)]


def trained_like(net: nn.Module) -> nn.Module:
    """Give every parameter a value, also those that start at zero."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        for parameter in net.parameters():
            if not parameter.any():
                nn.init.normal_(parameter, std=0.3)
    return net.eval()


def test_every_latent_reaches_nearly_every_entry_of_both_outputs() -> None:
    for event in [(50,), (3, 20, 33)]:
        for output in [0, 1]:
            torch.manual_seed(0)
            net = trained_like(ConditionalUNet(event, 5, width=4)).double()
            x, z = torch.randn(1, *event).double(), torch.randn(1, 5).double()
            before = net(x, z)[output]
            for k in range(5):
                moved = z + torch.eye(5)[k]
                # Some ReLUs are shut.
                assert (net(x, moved)[output] != before).double().mean() > 0.95


def test_several_latents_of_one_x_are_the_same_as_one_at_a_time() -> None:
    torch.manual_seed(0)
    net = trained_like(ConditionalUNet((50,), 5, width=4))
    x, z = torch.randn(3, 50), torch.randn(3 * 4, 5)
    together = net(x, z)
    for i in range(12):
        alone = net(x[i // 4 : i // 4 + 1], z[i : i + 1])
        torch.testing.assert_close(together[0][i], alone[0][0])
        torch.testing.assert_close(together[1][i], alone[1][0])


def test_residual_net_starts_as_the_identity_at_the_given_variance() -> None:
    std = torch.tensor([2.0, 3.0])
    net = ConditionalUNet(
        (2, 20, 20), 5, width=4, mean=torch.ones(2), std=std, log_variance=-4.0
    )
    x = torch.randn(3, 2, 20, 20)
    mean, log_variance = net(x, torch.randn(3, 5))
    torch.testing.assert_close(mean, x)
    expected = bounded(torch.tensor(-4.0)) + 2 * std.log()
    torch.testing.assert_close(log_variance[0, :, 0, 0], expected)


def test_outputs_follow_the_units_of_the_data() -> None:
    for residual in [True, False]:
        nets = []
        for mean, std in ((0.0, 1.0), (5.0, 10.0)):
            torch.manual_seed(0)
            moments = {"mean": torch.tensor([mean]), "std": torch.tensor([std])}
            net = ConditionalUNet((40,), 2, width=4, residual=residual, **moments)
            nets.append(trained_like(net))
        x, z = torch.randn(3, 40), torch.randn(3, 2)
        mean, log_variance = nets[0](x, z)
        scaled_mean, scaled_log_variance = nets[1](5.0 + 10.0 * x, z)
        torch.testing.assert_close(scaled_mean, 5.0 + 10.0 * mean)
        expected = log_variance + 2 * torch.tensor(10.0).log()
        torch.testing.assert_close(scaled_log_variance, expected)


def test_log_variances_are_bounded_and_nearly_unchanged_about_zero() -> None:
    values = torch.tensor([-1e6, -1.0, 0.0, 1.0, 1e6])
    result = bounded(values)
    torch.testing.assert_close(result[[0, -1]], torch.tensor([-10.0, 10.0]))
    torch.testing.assert_close(result[1:-1], values[1:-1], atol=4e-3, rtol=0)


@pytest.mark.parametrize(
    "embedding", [nn.Flatten(), nn.Sequential(nn.Flatten(), nn.Linear(48, 7))]
)
def test_encoder_is_trainable_and_leaves_the_embedding_net_alone(
    embedding: nn.Module,
) -> None:
    embedding.requires_grad_(False)
    before = [p.clone() for p in embedding.parameters()]
    x = torch.randn(6, 3, 16)
    encoder = LatentEncoder(embedding, 5, x)
    mean, log_variance = encoder(x)
    assert mean.shape == log_variance.shape == (6, 5)
    optimizer = torch.optim.Adam(encoder.parameters(), lr=0.1)
    (mean.square().sum() + log_variance.sum()).backward()
    assert all(p.grad is not None and p.grad.any() for p in encoder.parameters())
    optimizer.step()
    for old, new in zip(before, embedding.parameters(), strict=True):
        torch.testing.assert_close(old, new, rtol=0, atol=0)
