"""Pictures show the numbers that they are given, with the right labels."""

from typing import Any

import pytest
import torch
from torch import Tensor

from sbi_rope import SinkhornCoupler, plots
from sbi_rope.discrepancy import DiscrepancyReport, Interval, SummaryDiscrepancy
from sbi_rope.errors import RoPEWarning
from sbi_rope.finetuning import History
from sbi_rope.metrics import CoverageCurve, coverage_curve_of
from tests import stacks
from tests.refusals import assert_refused

pytest.importorskip("matplotlib")


def legend_texts(legend: Any) -> list[str]:
    return [text.get_text() for text in legend.get_texts()]


def curve(n: int = 400, *, power: float = 1.0) -> CoverageCurve:
    return coverage_curve_of(torch.linspace(0, 1, n).unsqueeze(1) ** power)


def ends_of(patch: Any) -> tuple[float, float]:
    """Return where a shaded part of an axis begins and ends."""
    corners = patch.get_patch_transform().transform_path(patch.get_path()).vertices
    return float(corners[:, 0].min()), float(corners[:, 0].max())


def two_posteriors() -> dict[str, Tensor]:
    return {"NPE": torch.randn(200, 2), "RoPE": torch.randn(300, 2) + 1.0}


@pytest.mark.medium
def test_a_stack_has_a_credible_set_and_one_with_a_guarantee() -> None:
    stack, x = stacks.small_stack(), stacks.observed()[0]
    truth: Any = [0.0, 0.0]  # or an array, as everywhere
    figure = plots.credible_set(stack, x, truth)
    assert len(figure.axes) == 3
    texts = ["90 %, of the posterior", "90 %, guaranteed", "truth"]
    assert legend_texts(figure.legends[0]) == texts
    intervals = stack.credible_intervals(
        0.9, x, guaranteed=True, num_samples=2000, seed=0
    )
    ends = [line.get_xdata()[0] for line in figure.axes[0].lines[2:4]]
    assert ends == pytest.approx([float(intervals.low[0]), float(intervals.high[0])])
    # The larger set lies below the other.
    large, small = (len(one.get_offsets()) for one in figure.axes[1].collections)
    assert large > small > 0


@pytest.mark.medium
def test_a_stack_with_too_few_pairs_for_a_guarantee_is_drawn_without_it() -> None:
    stack, x = stacks.small_stack(), stacks.observed()[0]
    with pytest.warns(RoPEWarning, match="No set with a guarantee is drawn"):
        figure = plots.credible_set(stack, x, level=0.99)
    assert legend_texts(figure.legends[0]) == ["99 %, of the posterior"]


def test_pair_plot_has_a_panel_for_each_parameter_and_pair() -> None:
    for names in (["a"], ["a", "b", "c"]):
        size = len(names)
        figure = plots.pair_plot({"NPE": torch.randn(200, size)}, parameter_names=names)
        assert len(figure.axes) == size * (size + 1) // 2
        assert [axes.get_xlabel() for axes in figure.axes[-size:]] == names


def test_pair_plot_names_methods_and_marks_the_truth() -> None:
    figure = plots.pair_plot(two_posteriors(), torch.tensor([0.25, 0.5]))
    assert legend_texts(figure.legends[0]) == ["NPE", "RoPE", "truth"]
    marks = [line.get_xdata()[0] for line in figure.axes[0].lines]
    assert marks == pytest.approx([0.25])


def test_samples_that_do_not_fit_are_refused() -> None:
    good = {"a": torch.zeros(5, 2)}
    cases: list[tuple[Any, dict[str, Any], str]] = [
        ({"a": torch.zeros(5, 2), "b": torch.zeros(5, 3)}, {}, "'b'"),
        (good, {"theta": torch.zeros(3)}, "theta"),
    ]
    for samples, options, match in cases:
        assert_refused(match, plots.pair_plot, samples, **options)


def outline(axes: Any) -> Any:
    """Return all corners of the contours in a panel."""
    paths = [path for drawn in axes.collections for path in drawn.get_paths()]
    return torch.cat([torch.as_tensor(path.vertices) for path in paths])


def test_pair_plot_says_that_a_posterior_far_from_the_truth_is_outside() -> None:
    samples = {"NPE": torch.randn(400, 2) + 50.0, "RoPE": torch.randn(400, 2)}
    figure = plots.pair_plot(samples, torch.zeros(2))
    assert figure.axes[0].get_xlim()[1] < 10.0
    texts = legend_texts(figure.legends[0])
    assert texts == ["NPE (100 % outside)", "RoPE", "truth"]


def test_axes_of_a_pair_plot_reach_at_most_one_width_of_the_prior_beyond_it() -> None:
    samples = {"NPE": 30.0 * torch.randn(400, 2), "RoPE": torch.rand(400, 2)}
    figure = plots.pair_plot(samples, torch.full((2,), 0.5), prior=torch.rand(500, 2))
    low, high = figure.axes[0].get_xlim()
    assert -1.5 < low < -0.5
    assert 1.5 < high < 2.5
    assert "prior" in legend_texts(figure.legends[0])
    assert ends_of(figure.axes[0].patches[0]) == pytest.approx((0.0, 1.0), abs=0.05)


def test_pair_plot_draws_the_edge_of_the_prior_where_samples_leave_it() -> None:
    prior, inside = torch.rand(500, 2), 0.4 * torch.rand(400, 2) + 0.3
    leaving = inside + torch.tensor([0.6, 0.0])
    low, high = prior.amin(dim=0), prior.amax(dim=0)
    for samples, edges in ((inside, []), (leaving, [high[0]]), (-leaving, [low[0]])):
        marginal = plots.pair_plot({"a": samples}, prior=prior).axes[0]
        drawn = [line.get_xdata()[0] for line in marginal.lines]
        assert drawn == pytest.approx([float(edge) for edge in edges])


@pytest.mark.medium
def test_pair_plot_draws_samples_without_an_area_as_a_point_or_a_line() -> None:
    for count in (1, 2, 200):
        same = torch.tensor([[1.0, 2.0]]).repeat(count, 1)
        figure = plots.pair_plot({"same": same, "RoPE": torch.randn(200, 2)})
        point = figure.axes[1].lines[0]
        assert (point.get_xdata()[0], point.get_ydata()[0]) == (1.0, 2.0), count
        figure.draw_without_rendering()
    x = torch.linspace(0, 1, 300)
    line = plots.pair_plot({"a": torch.stack([x, 2 * x], dim=1)}).axes[1].lines[0]
    assert sorted(line.get_ydata()) == pytest.approx([0.0, 2.0])


def test_pair_plot_contours_enclose_50_and_90_percent_of_the_samples() -> None:
    axes = plots.pair_plot({"a": torch.randn(5000, 2)}).axes[1]
    radius = outline(axes).norm(dim=1)
    # Of a normal in two dimensions; smoothing widens them a little.
    for share in (0.5, 0.9):
        expected = (-2 * torch.log(torch.tensor(1 - share))).sqrt()
        assert (radius - expected).abs().min() < 0.1 * expected
    assert radius.max() < 1.3 * expected
    assert radius.min() > 0.9


def test_the_area_of_a_histogram_is_the_share_of_samples_that_it_shows() -> None:
    samples = torch.randn(1000, 1)
    samples[:3] = 1e6
    values, edges, _ = plots.pair_plot({"a": samples}).axes[0].patches[0].get_data()
    area = float((values * (edges[1:] - edges[:-1])).sum())
    assert area == pytest.approx(0.99, abs=0.005)


def test_calibration_curves_draw_each_average_against_its_level() -> None:
    curves = {"RoPE": curve(), "NPE": curve(power=0.3)}
    figure = plots.calibration_curves(curves)
    drawn = {line.get_label(): line for line in figure.axes[0].lines}
    for name, expected in curves.items():
        assert drawn[name].get_ydata() == pytest.approx(expected.average.tolist())
        assert drawn[name].get_xdata() == pytest.approx(expected.levels.tolist())
    assert drawn["RoPE"].get_color() != drawn["NPE"].get_color()


def test_calibration_band_is_that_of_the_smallest_test_set() -> None:
    figure = plots.calibration_curves({"a": curve(100), "b": curve(900)})
    assert "n = 100" in legend_texts(figure.axes[0].get_legend())[0]
    corners = figure.axes[0].collections[0].get_paths()[0].vertices
    middle = corners[abs(corners[:, 0] - 0.5) < 1e-6, 1]
    assert middle.max() - 0.5 == pytest.approx(1.96 * 0.05, abs=1e-4)


def test_finetuning_history_marks_the_kept_step() -> None:
    history = History([3.0, 2.0, 1.0], [3.0, 2.5, 2.75], 1, 1e-3)
    axes = plots.finetuning_history(history).axes[0]
    mark = axes.lines[-1]
    assert (mark.get_xdata()[0], mark.get_ydata()[0]) == (1, 2.5)
    assert legend_texts(axes.get_legend())[-1] == "kept: step 1"
    assert "units of the embedding" in axes.get_ylabel()
    without_held_out = History([3.0, 2.0], [], 0, 1e-3)
    axes = plots.finetuning_history(without_held_out).axes[0]
    texts = legend_texts(axes.get_legend())
    assert texts == ["training pairs", "kept: step 0 (the starting point)"]


def test_effective_sample_sizes_count_every_observation() -> None:
    for num_simulations in (1, 50):
        simulated = torch.randn(num_simulations, 2)
        real = torch.cat([torch.randn(29, 2), 100 * simulated[:1]])
        coupler = SinkhornCoupler(gamma=1.0, tau=0.0, cost_scale="none")
        axes = plots.effective_sample_sizes(coupler.couple(real, simulated)).axes[0]
        assert sum(bar.get_height() for bar in axes.patches) == 30
        assert axes.patches[0].get_x() < axes.patches[-1].get_x()
        assert axes.lines[1].get_xdata()[0] == num_simulations
        assert f"{num_simulations}" in legend_texts(axes.get_legend())[1]


# The three steps ---------------------------------------------------------------------


def three_steps(**changes: Any) -> dict[str, Any]:
    """Return simulations around zero, and observations far off before tuning."""
    stretch = torch.tensor([3.0, 2.0, 0.1, 0.1])
    after = torch.randn(60, 4) * stretch
    weights = torch.full((200,), 0.05 / 198)
    weights[[7, 11]] = torch.tensor([0.6, 0.35])
    return {
        "simulated": torch.randn(200, 4) * stretch,
        "before": after + torch.tensor([20.0, 0.0, 0.0, 0.0]),
        "after": after,
        "weights": weights,
        "samples": {"NPE": torch.randn(200, 3) + 1.0, "RoPE": torch.randn(200, 3)},
        "theta": torch.tensor([0.25, 0.5, 0.75]),
        "parameter_names": ["a", "b", "c"],
    } | changes


def dots(axes: Any) -> list[Any]:
    """Return the scatters of a panel, in the order in which they were drawn."""
    return [c for c in axes.collections if type(c).__name__ == "PathCollection"]


def stars(axes: Any) -> Any:
    return [line.get_xydata()[0] for line in axes.lines if line.get_marker() == "*"]


def test_overview_projects_embeddings_to_components_of_the_simulations() -> None:
    data = three_steps()
    tune = plots.overview(**data).axes[0]
    simulated, before, after = (
        torch.as_tensor(c.get_offsets().data) for c in dots(tune)
    )
    # The plane is that of the two wide coordinates, up to sign and a small turn.
    spread = simulated.std(dim=0)
    assert spread.tolist() == pytest.approx([3.0, 2.0], rel=0.2)
    shift = (before - after).norm(dim=1)
    assert shift.tolist() == pytest.approx([20.0] * 60, rel=0.05)
    assert len(simulated) == 200


def test_overview_follows_the_first_observation() -> None:
    data = three_steps()
    tune, couple, _ = plots.overview(**data).axes
    after = dots(tune)[2].get_offsets()[0]
    assert stars(tune)[0] == pytest.approx(after)
    assert stars(couple)[0] == pytest.approx(after)
    assert tune.texts[0].xy == pytest.approx(tuple(after))
    assert tune.texts[0].xyann == pytest.approx(tuple(dots(tune)[1].get_offsets()[0]))


def test_overview_draws_heavier_simulations_larger_and_darker() -> None:
    couple = plots.overview(**three_steps()).axes[1]
    faint, heavy = dots(couple)
    expected = faint.get_offsets()[[11, 7]]
    assert heavy.get_offsets().tolist() == expected.tolist()
    assert heavy.get_sizes()[0] < heavy.get_sizes()[1]
    assert heavy.get_alpha()[0] < heavy.get_alpha()[1]


def test_overview_shows_the_parameters_asked_for() -> None:
    truth = {"a": 0.25, "b": 0.5, "c": 0.75}
    cases = ((None, ("a", "b")), ((2, 0), ("c", "a")), ((1,), ("b", "density")))
    for parameters, labels in cases:
        mix = plots.overview(**three_steps(parameters=parameters)).axes[2]
        assert (mix.get_xlabel(), mix.get_ylabel()) == labels
        assert mix.lines[-1].get_xdata()[0] == truth[labels[0]]
        if labels[1] in truth:
            assert mix.lines[-1].get_ydata()[0] == truth[labels[1]]


# Observations ------------------------------------------------------------------------


def test_images_are_drawn_real_above_simulated() -> None:
    x_o, x_s = torch.rand(9, 3, 8, 8), torch.rand(9, 3, 8, 8)
    figure = plots.real_and_simulated(x_o, x_s)
    assert len(figure.axes) == 12
    shown = [torch.tensor(axes.images[0].get_array()) for axes in figure.axes]
    for i in range(6):
        assert torch.equal(shown[i], x_o[i].permute(1, 2, 0))
        assert torch.equal(shown[6 + i], x_s[i].permute(1, 2, 0))


# Discrepancies -----------------------------------------------------------------------


def interval(low: float, median: float, high: float) -> Interval:
    return Interval(median=median, low=low, high=high)


def summary(name: str, **changes: Any) -> SummaryDiscrepancy:
    options: dict[str, Any] = {
        "gain": interval(0.5, 0.75, 1.25),
        "shift": interval(-200.0, -150.0, 100.0),
        "error": interval(0.0, 1.0, 2.0),
        "size": interval(0.25, 0.5, 0.875),
        "std": 1.0,
        "num_independent": 7.0,
        "probability_of_none": 0.01,
    }
    return SummaryDiscrepancy(name=name, **options | changes)


def lines_at(axes: Any, position: int) -> list[Any]:
    """Return the interval and the estimate in one row of a panel."""
    return [line for line in axes.lines if set(line.get_ydata()) == {position}]


def test_discrepancy_draws_a_row_with_intervals_for_each_summary() -> None:
    second = summary("b", size=interval(0.0, 0.125, 0.25), gain=interval(1.0, 2.0, 3.0))
    report = DiscrepancyReport(
        summaries=(summary("a"), second), num_pairs=7, num_groups=7
    )
    figure = plots.discrepancy(report)
    size, _, _, gain = figure.axes
    assert [label.get_text() for label in size.get_yticklabels()] == ["a", "b"]
    assert size.get_ylim()[0] > size.get_ylim()[1]
    for position, shown in enumerate(report.summaries):
        for axes, expected in ((size, shown.size), (gain, shown.gain)):
            line, point = lines_at(axes, position)
            assert list(line.get_xdata()) == [expected.low, expected.high]
            assert list(point.get_xdata()) == [expected.median]
    assert "7 calibration pairs" in figure.get_supxlabel()
    figure.draw_without_rendering()


def test_discrepancy_draws_shifts_on_one_scale_and_writes_their_numbers() -> None:
    small = interval(0.001, 0.0015, 0.002)
    report = DiscrepancyReport(
        summaries=(summary("a", std=400.0), summary("b", shift=small, std=0.01)),
        num_pairs=7,
        num_groups=7,
    )
    _, shift, numbers, _ = plots.discrepancy(report).axes
    drawn = [list(lines_at(shift, k)[0].get_xdata()) for k in range(2)]
    # In standard deviations of simulations, so that rows can be compared.
    assert drawn[0] == [-0.5, 0.25]
    assert drawn[1] == pytest.approx([0.1, 0.2])
    texts = [(text.get_text(), text.xy[1]) for text in numbers.texts]
    assert texts == [("-150 [-200, 100]", 0), ("0.0015 [0.001, 0.002]", 1)]
