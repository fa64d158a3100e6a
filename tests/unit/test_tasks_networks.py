"""The embedding networks of the tasks."""

import torch
from torch import nn

from sbi_rope.tasks.networks import SeriesEmbedding, fully_connected


def test_the_number_of_features_follows_the_length_of_the_series() -> None:
    for num_steps, num_features in (
        *((200, 2048), (193, 2048), (201, 2176), (100, 512), (1000, 14_848)),
    ):
        net = SeriesEmbedding(num_steps=num_steps, padding=1)
        assert net.num_features == num_features
        assert net(torch.randn(2, num_steps)).shape == (2, 10)


def test_layers_are_those_of_the_paper() -> None:
    net = SeriesEmbedding()
    convolutions = [
        (m.in_channels, m.out_channels, m.kernel_size[0], m.stride[0], m.dilation[0])
        for m in net.modules()
        if isinstance(m, nn.Conv1d)
    ]
    assert convolutions == [
        (1, 16, 3, 1, 2),
        (16, 64, 3, 2, 2),
        (64, 128, 3, 1, 2),
        (128, 128, 3, 2, 2),
        (128, 128, 3, 1, 2),
        (128, 128, 3, 2, 2),
        (128, 128, 3, 1, 2),
    ]
    linear = [
        (m.in_features, m.out_features)
        for m in net.modules()
        if isinstance(m, nn.Linear)
    ]
    assert linear == [(2048, 512), (512, 128), (128, 32), (32, 10)]


def test_fully_connected_has_relu_between_layers_only() -> None:
    net = fully_connected(3, (12, 48, 9))
    kinds = [type(layer) for layer in net]
    assert kinds == [nn.Linear, nn.ReLU, nn.Linear, nn.ReLU, nn.Linear]
    assert net(torch.randn(5, 3)).shape == (5, 9)
