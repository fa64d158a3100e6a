"""Pictures show the numbers that they are given, with the right labels."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from sbi_rope import plots
from sbi_rope.discrepancy import DiscrepancyReport, Interval, SummaryDiscrepancy
from sbi_rope.metrics import Evaluation
from sbi_rope.utils.errors import RoPEWarning
from tests import stacks

pytest.importorskip("matplotlib")


def legend_texts(legend: Any) -> list[str]:
    return [text.get_text() for text in legend.get_texts()]


@pytest.mark.medium
def test_a_stack_has_a_credible_set_and_one_with_a_guarantee_if_there_is_one() -> None:
    stack, x = stacks.small_stack(), stacks.observed()[0]
    figure = plots.credible_set(stack, x, torch.zeros(2))
    assert len(figure.axes) == 3
    texts = ["90 %, of the posterior", "90 %, guaranteed", "truth"]
    assert legend_texts(figure.legends[0]) == texts
    intervals = stack.credible_set(0.9, x, guaranteed=True, seed=0)
    drawn = [line.get_xdata()[0] for line in figure.axes[0].lines]
    for end in (intervals.low[0], intervals.high[0]):
        assert any(x == pytest.approx(float(end)) for x in drawn)
    # The larger set lies below the other.
    large, small = (len(one.get_offsets()) for one in figure.axes[1].collections)
    assert large > small > 0
    # There are too few pairs for this level.
    with pytest.warns(RoPEWarning, match="No set with a guarantee is drawn"):
        figure = plots.credible_set(stack, x, level=0.99)
    assert legend_texts(figure.legends[0]) == ["99 %, of the posterior"]


# Posteriors --------------------------------------------------------------------------


@pytest.mark.parametrize("names", [["a"], ["a", "b", "c"]])
def test_pair_plot_has_a_panel_for_each_parameter_and_pair(names: list[str]) -> None:
    size = len(names)
    samples = {"NPE": torch.randn(200, size), "RoPE": torch.randn(300, size)}
    figure = plots.pair_plot(samples, torch.zeros(size), parameter_names=names)
    assert len(figure.axes) == size * (size + 1) // 2
    assert [axes.get_xlabel() for axes in figure.axes[-size:]] == names
    assert legend_texts(figure.legends[0]) == ["truth", "NPE", "RoPE"]
    assert figure.axes[0].lines[0].get_xdata()[0] == 0.0


def test_axes_of_a_pair_plot_reach_at_most_one_width_of_the_prior_beyond_it() -> None:
    inside = torch.rand(400, 2)
    for npe, ends, label in (
        (30.0 * torch.randn(400, 2), (-1.0, 2.0), "NPE ("),
        (inside + 50.0, (0.0, 1.0), "NPE (100 % outside)"),  # it cannot be seen
        (inside + 0.5, (0.0, 1.5), "NPE"),
    ):
        samples = {"NPE": npe, "RoPE": inside}
        figure = plots.pair_plot(samples, torch.rand(2), prior=torch.rand(5000, 2))
        limits = figure.axes[0].get_xlim()
        assert limits == pytest.approx(ends, abs=0.2)
        assert legend_texts(figure.legends[0])[1].startswith(label)
        (shaded,) = (p for p in figure.axes[0].patches if p.get_label() == "prior")
        ends = (shaded.get_x(), shaded.get_x() + shaded.get_width())
        assert ends == pytest.approx((0.0, 1.0), abs=0.02)


@pytest.mark.medium
def test_pair_plot_draws_samples_without_an_area() -> None:
    x = torch.linspace(0, 1, 300)
    for samples in (torch.ones(200, 2), torch.stack([x, 2 * x], dim=1)):
        figure = plots.pair_plot({"same": samples, "RoPE": torch.randn(200, 2)})
        dots = [line for line in figure.axes[1].lines if line.get_marker() == "."]
        assert dots[0].get_xydata().tolist() == samples.tolist()
        figure.draw_without_rendering()


def outline(axes: Any) -> Tensor:
    """Return all corners of the contours in a panel."""
    drawn = [one for one in axes.collections if type(one).__name__ == "QuadContourSet"]
    paths = [path for one in drawn for path in one.get_paths()]
    return torch.cat([torch.as_tensor(path.vertices) for path in paths])


def test_pair_plot_contours_enclose_50_and_90_percent_of_the_samples() -> None:
    samples = torch.randn(5000, 2)
    samples[:9] = 1e6  # which may not widen them
    several = {"a": samples, "b": samples, "c": samples}  # not filled
    radius = outline(plots.pair_plot(several).axes[1]).norm(dim=1)
    # Of a normal in two dimensions; smoothing widens them a little.
    for share, part in ((0.5, radius[radius < 1.6]), (0.9, radius[radius >= 1.6])):
        expected = (-2 * math.log(1 - share)) ** 0.5
        assert part.mean() == pytest.approx(expected, rel=0.1)
    # They do not leave the support of the samples.
    samples = torch.rand(1000, 2)
    contours = outline(plots.pair_plot({"a": samples}).axes[1])
    low, high = samples.amin(dim=0).double(), samples.amax(dim=0).double()
    assert ((contours > low - 1e-9) & (contours < high + 1e-9)).all()


# Calibration and discrepancies -------------------------------------------------------


def test_calibration_curves_draw_the_coverage_averaged_over_parameters() -> None:
    ranks = torch.rand(100, 3)
    ranks[:, 1] = torch.nan  # it was never measured
    found = {
        name: Evaluation(log_prob=one.sum(dim=1), ranks=one, estimates=one)
        for name, one in {"RoPE": ranks, "a": torch.rand(900, 1)}.items()
    }
    axes = plots.calibration_curves(found).axes[0]
    drawn = {line.get_label(): line for line in axes.lines}
    for name, one in found.items():
        x, y = drawn[name].get_data()
        levels = (2 * one.ranks.double() - 1).abs()
        known = ~levels.isnan()
        shares = [float((levels <= at)[known].double().mean()) for at in x]
        assert y == pytest.approx(shares)
    assert drawn["RoPE"].get_color() != drawn["a"].get_color()
    # The band is that of the smallest test set.
    assert "n = 100" in legend_texts(axes.get_legend())[0]
    corners = axes.collections[0].get_paths()[0].vertices
    middle = corners[abs(corners[:, 0] - 0.5) < 1e-6, 1]
    assert middle.max() - 0.5 == pytest.approx(1.96 * 0.05, abs=1e-4)


def test_discrepancy_draws_a_row_with_intervals_for_each_summary() -> None:
    first = SummaryDiscrepancy(
        name="a",
        gain=Interval(low=0.5, median=0.75, high=1.25),
        shift=Interval(low=-200.0, median=-150.0, high=100.0),
        error=Interval(low=0.0, median=1.0, high=2.0),
        size=Interval(low=0.25, median=0.5, high=0.875),
        std=400.0,
        probability_of_none=0.01,
    )
    small = Interval(low=0.001, median=0.0015, high=0.002)
    second = replace(first, name="b", shift=small, std=0.01, probability_of_none=0.9)
    report = DiscrepancyReport(summaries=(first, second), num_pairs=7, num_groups=7)
    figure = plots.discrepancy(report)
    size, shift, _ = figure.axes
    assert [label.get_text() for label in size.get_yticklabels()] == ["a", "b"]
    assert size.get_ylim()[0] > size.get_ylim()[1]
    rows: Any = [[list(line.get_xdata()) for line in one.lines] for one in figure.axes]
    assert rows[0][:2] == [[0.25, 0.5, 0.875]] * 2
    assert rows[2][:2] == [[0.5, 0.75, 1.25]] * 2
    # Shifts are in standard deviations of simulations, so that rows can be compared.
    assert rows[1][0] == [-0.5, -0.375, 0.25]
    assert rows[1][1] == pytest.approx([0.1, 0.15, 0.2])
    texts = [(text.get_text(), text.get_position()[1]) for text in shift.texts]
    assert texts == [("-150 [-200, 100]", 0), ("0.0015 [0.001, 0.002]", 1)]
    assert len(legend_texts(figure.legends[0])) == 2
    figure.draw_without_rendering()


# The three steps ---------------------------------------------------------------------


def three_steps(width: int = 4, dim: int = 3) -> dict[str, Any]:
    """Return simulations around zero, and observations far off before tuning."""
    stretch = torch.tensor([3.0, 2.0, 0.1, 0.1])[:width]
    after = torch.randn(60, width) * stretch
    weights = torch.full((200,), 0.05 / 198)
    weights[[7, 11]] = torch.tensor([0.6, 0.35])
    return {
        "simulated": torch.randn(200, width) * stretch,
        "before": after + torch.tensor([20.0, 0.0, 0.0, 0.0])[:width],
        "after": after,
        "weights": weights,
        "samples": {"NPE": torch.randn(200, dim) + 1.0, "RoPE": torch.randn(200, dim)},
        "theta": torch.tensor([0.25, 0.5, 0.75])[:dim],
        "parameter_names": ["a", "b", "c"][:dim],
    }


def dots(axes: Any) -> list[Any]:
    """Return the scatters of a panel, in the order in which they were drawn."""
    return [c for c in axes.collections if type(c).__name__ == "PathCollection"]


def test_overview_shows_the_plane_in_which_simulations_vary() -> None:
    tune, couple, mix = plots.overview(**three_steps()).axes
    clouds = [torch.as_tensor(c.get_offsets().data) for c in dots(tune)]
    simulated, before, after = clouds
    # The plane is that of the two wide coordinates, up to sign and a small turn.
    assert simulated.std(dim=0).tolist() == pytest.approx([3.0, 2.0], rel=0.2)
    shift = (before - after).norm(dim=1)
    assert shift.tolist() == pytest.approx([20.0] * 60, rel=0.05)
    # Star and arrow follow the first observation.
    for axes in (tune, couple):
        star = next(line for line in axes.lines if line.get_marker() == "*")
        assert star.get_xydata()[0] == pytest.approx(after[0])
    assert tune.texts[0].xy == pytest.approx(after[0].tolist())
    assert tune.texts[0].xyann == pytest.approx(before[0].tolist())
    # Heavier simulations are larger and darker.
    faint, heavy = dots(couple)
    expected = faint.get_offsets()[[7, 11]]
    assert heavy.get_offsets()[:2].tolist() == expected.tolist()
    for one in (heavy.get_sizes(), heavy.get_alpha()):
        assert one[0] > one[1] > one[2]
    assert (mix.get_xlabel(), mix.get_ylabel()) == ("a", "b")


def test_overview_shows_a_single_parameter() -> None:
    figure = plots.overview(**three_steps(width=1, dim=1))
    mix = figure.axes[2]
    assert (mix.get_xlabel(), mix.get_ylabel()) == ("a", "")
    (truth,) = (line for line in mix.lines if line.get_label() == "truth")
    assert truth.get_xdata()[0] == 0.25
    figure.draw_without_rendering()
