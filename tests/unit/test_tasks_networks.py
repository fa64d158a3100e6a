"""The embedding networks of the tasks are those of the paper."""

from itertools import pairwise

import pytest
from torch import nn

from sbi_rope.tasks import get_task
from sbi_rope.tasks.networks import ImageEmbedding, SeriesEmbedding

# Channels in and out, kernel, stride and dilation of convolutions.
SERIES = [
    (1, 16, 3, 1, 2),
    (16, 64, 3, 2, 2),
    (64, 128, 3, 1, 2),
    (128, 128, 3, 2, 2),
    (128, 128, 3, 1, 2),
    (128, 128, 3, 2, 2),
    (128, 128, 3, 1, 2),
]
IMAGES = [
    (3, 64, 3, 2, 1),
    (64, 128, 3, 2, 1),
    (128, 128, 3, 2, 1),
    (128, 64, 1, 1, 1),
    (64, 3, 1, 1, 1),
]


@pytest.mark.parametrize(
    ("net", "convolutions", "widths"),
    [
        (SeriesEmbedding(), SERIES, [2048, 512, 128, 32, 10]),
        (ImageEmbedding(), IMAGES, [27, 100, 20]),
        (get_task("cs").get_embedding_net(), [], [4, 12, 48, 48, 36, 9]),
        (get_task("sir").get_embedding_net(), [], [6, 8, 32, 32, 24, 6]),
    ],
    ids=["series", "images", "cs", "sir"],
)
def test_layers_are_those_of_the_paper(
    net: nn.Module, convolutions: list[tuple[int, ...]], widths: list[int]
) -> None:
    found = [
        (m.in_channels, m.out_channels, m.kernel_size[0], m.stride[0], m.dilation[0])
        for m in net.modules()
        if isinstance(m, nn.Conv1d | nn.Conv2d)
    ]
    assert found == convolutions
    linear = [
        (m.in_features, m.out_features)
        for m in net.modules()
        if isinstance(m, nn.Linear)
    ]
    assert linear == list(pairwise(widths))
