"""What all tasks share: registry, pairs without a common observation, networks."""

from itertools import pairwise

import pytest
import torch
from sbi.utils import within_support
from torch import Tensor, nn

from sbi_rope.tasks import TASKS, get_task, list_tasks
from sbi_rope.tasks.networks import ImageEmbedding, SeriesEmbedding
from sbi_rope.tasks.splits import (
    MAX_SEED,
    DrawnPairs,
    Part,
    RecordedPairs,
    stream_of,
)
from sbi_rope.tasks.variants import beta_shaped, with_label_noise
from sbi_rope.utils.errors import InvalidInputError, RoPEWarning


def test_tasks_are_registered_and_listed_under_their_names() -> None:
    assert list_tasks() == sorted(TASKS)
    assert all(TASKS[name].name == name for name in TASKS)


def test_unknown_names_and_settings_without_effect_are_refused() -> None:
    for call, match in (
        (lambda: get_task("pendulu"), "`name`"),
        (lambda: get_task("pendulum", variant="damped"), "`variant`"),
        (lambda: get_task("pendulum", label_noise=0.1), "`label_noise`"),
        (lambda: get_task("cs", necrosis_radius=-0.1), "`necrosis_radius`"),
        (lambda: get_task("sir").get_test_set(0), "`n`"),
        (lambda: get_task("sir").get_test_set(1, seed=-1), "`seed`"),
    ):
        with pytest.raises(InvalidInputError, match=match):
            call()


# Drawn pairs -------------------------------------------------------------------------


def test_streams_of_all_seeds_and_uses_differ() -> None:
    seeds = [0, 1, 2, 3, 100, MAX_SEED - 2, MAX_SEED - 1]
    uses = ("calibration", "test", "simulation", "labels")
    streams = {stream_of(seed, use) for seed in seeds for use in uses}
    assert len(streams) == 4 * len(seeds)
    assert all(0 <= stream < 2**32 for stream in streams)


def test_kept_pairs_follow_the_chances_and_begin_a_larger_set() -> None:
    pairs = DrawnPairs(
        draw_theta=lambda n: torch.rand(n, 2),
        observe=lambda theta: theta[:, :1] + torch.zeros(len(theta), 3),
    )

    def kept(n: int) -> Tensor:
        theta, x = pairs.take(n, seed=0, part="test", keep=lambda theta: theta[:, 0])
        assert len(theta) == n
        assert torch.equal(theta[:, 0], x[:, 0])
        return theta

    theta = kept(2000)
    assert torch.equal(kept(10), theta[:10])
    # The density 2 t has mean 2/3 and variance 1/18.
    assert theta[:, 0].mean() == pytest.approx(2 / 3, abs=4 * (1 / 18 / 2000) ** 0.5)


def test_pairs_with_nan_are_replaced_jointly_and_counted() -> None:
    pairs = DrawnPairs(
        draw_theta=lambda n: torch.rand(n, 2),
        observe=lambda theta: torch.where(theta[:, :1] < 0.1, torch.nan, theta),
    )
    with pytest.warns(RoPEWarning, match=r"Replaced \d+ of \d+ drawn pairs"):
        theta, x = pairs.take(500, seed=0, part="test")
    assert theta.shape == (500, 2)
    assert torch.equal(theta, x)
    assert (theta[:, 0] >= 0.1).all()


# Recorded pairs ----------------------------------------------------------------------


def recorded(num_rows: int) -> RecordedPairs:
    theta = torch.arange(float(num_rows)).unsqueeze(1)
    return RecordedPairs(theta=theta, read_x=lambda rows: theta[rows] * 10)


def test_parts_are_a_partition_that_does_not_depend_on_the_seed() -> None:
    def rows(n: int, seed: int, part: Part) -> set[float]:
        theta, _ = recorded(20).take(n, seed=seed, part=part)
        return set(theta.flatten().tolist())

    calibration = rows(6, 0, "calibration")
    assert calibration | rows(14, 1, "test") == set(range(20))
    assert calibration == rows(6, 2, "calibration")
    with pytest.raises(InvalidInputError, match=r"at most 6, .*got 7"):
        rows(7, 0, "calibration")


def test_the_split_does_not_follow_the_order_of_the_file() -> None:
    rows = torch.tensor(recorded(3000).rows_of("calibration"))
    assert rows.double().mean() == pytest.approx(1500, abs=100)
    assert rows.double().std() == pytest.approx(3000 / 12**0.5, rel=0.05)


# Variants ----------------------------------------------------------------------------


def test_the_beta_shape_is_a_density_over_its_maximum() -> None:
    u = torch.rand(1000, 2, dtype=torch.float64)
    three, half = torch.tensor([3.0, 0.5], dtype=torch.float64)
    law = torch.distributions.Beta(three, three)
    expected = (law.log_prob(u) - law.log_prob(half)).sum(dim=1).exp()
    torch.testing.assert_close(beta_shaped(u), expected)


def test_label_noise_stays_in_the_support_and_does_not_depend_on_later_rows() -> None:
    prior = get_task("pendulum").get_prior()
    theta = prior.sample(torch.Size((250,)))
    std = torch.tensor([1.0, 3.0])
    noisy = with_label_noise(theta, std, prior, seed=3)
    assert within_support(prior, noisy).all()
    assert torch.equal(with_label_noise(theta[:130], std, prior, seed=3), noisy[:130])
    assert not torch.equal(with_label_noise(theta, std, prior, seed=4), noisy)


# Networks ----------------------------------------------------------------------------

# Channels in and out, kernel, stride and dilation of the paper's convolutions.
SERIES = [
    *[(1, 16, 3, 1, 2), (16, 64, 3, 2, 2), (64, 128, 3, 1, 2)],
    *[(128, 128, 3, 2, 2), (128, 128, 3, 1, 2)] * 2,
]
IMAGES = [
    *[(3, 64, 3, 2, 1), (64, 128, 3, 2, 1), (128, 128, 3, 2, 1)],
    *[(128, 64, 1, 1, 1), (64, 3, 1, 1, 1)],
]


def test_layers_of_the_embedding_networks_are_those_of_the_paper() -> None:
    for net, convolutions, widths in (
        (SeriesEmbedding(), SERIES, [2048, 512, 128, 32, 10]),
        (ImageEmbedding(), IMAGES, [27, 100, 20]),
        (get_task("cs").get_embedding_net(), [], [4, 12, 48, 48, 36, 9]),
        (get_task("sir").get_embedding_net(), [], [6, 8, 32, 32, 24, 6]),
    ):
        layers = list(net.modules())
        assert convolutions == [
            (*m.weight.shape[1::-1], m.kernel_size[0], m.stride[0], m.dilation[0])
            for m in layers
            if isinstance(m, nn.Conv1d | nn.Conv2d)
        ]
        assert list(pairwise(widths)) == [
            (m.in_features, m.out_features) for m in layers if isinstance(m, nn.Linear)
        ]
