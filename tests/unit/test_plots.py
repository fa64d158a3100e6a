"""The plots show what their labels say; looks are judged by eye."""

import builtins
import sys
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from sbi_rope import plots
from sbi_rope.errors import InvalidInputError
from sbi_rope.metrics import CoverageCurve, coverage_curve_of

pytest.importorskip("matplotlib")


def legend_texts(legend: Any) -> list[str]:
    return [text.get_text() for text in legend.get_texts()]


def curve(n: int = 400, *, power: float = 1.0) -> CoverageCurve:
    return coverage_curve_of(torch.linspace(0, 1, n).unsqueeze(1) ** power)


def two_posteriors() -> dict[str, Tensor]:
    return {"NPE": torch.randn(200, 2), "RoPE": torch.randn(300, 2) + 1.0}


@pytest.mark.parametrize("size", [1, 3])
def test_pair_plot_has_a_diagonal_panel_for_each_parameter(size: int) -> None:
    pytest.importorskip("six")
    figure = plots.pair_plot(
        {"NPE": torch.randn(200, size)}, parameter_names=["a", "b", "c"][:size]
    )
    labels = [axes.get_xlabel() for axes in figure.axes[:: size + 1]]
    assert labels == ["a", "b", "c"][:size]


def test_pair_plot_names_methods_and_marks_the_truth() -> None:
    pytest.importorskip("six")
    figure = plots.pair_plot(two_posteriors(), torch.tensor([0.25, 0.5]))
    assert legend_texts(figure.legends[0]) == ["NPE", "RoPE", "truth"]
    marks = [line.get_xdata()[0] for line in figure.axes[0].lines]
    assert marks == pytest.approx([0.25])


def test_pair_plot_limits_ignore_extremes_but_hold_the_truth() -> None:
    pytest.importorskip("six")
    samples = two_posteriors()
    samples["NPE"][0] = 1e6
    low, high = plots.pair_plot(samples, torch.tensor([-9.0, 0.0])).axes[0].get_xlim()
    assert low < -9.0
    assert high < 10.0


def test_pair_plot_leaves_no_open_figure() -> None:
    pytest.importorskip("six")
    from matplotlib import pyplot

    before = pyplot.get_fignums()
    plots.pair_plot(two_posteriors())
    assert pyplot.get_fignums() == before


@pytest.mark.parametrize(
    ("samples", "kwargs", "match"),
    [
        pytest.param({}, {}, "at least one entry", id="nothing"),
        pytest.param(
            {"a": torch.zeros(5, 2), "b": torch.zeros(5, 3)}, {}, "'b'", id="widths"
        ),
        pytest.param(
            {"a": torch.zeros(5, 2)},
            {"parameter_names": ["x"]},
            "parameter_names",
            id="names",
        ),
        pytest.param(
            {"a": torch.zeros(5, 2)}, {"theta": torch.zeros(3)}, "theta", id="theta"
        ),
        pytest.param({"a": torch.full((5, 2), torch.nan)}, {}, "finite", id="nan"),
    ],
)
def test_pair_plot_refuses(
    samples: dict[str, Tensor], kwargs: dict[str, Any], match: str
) -> None:
    with pytest.raises(InvalidInputError, match=match):
        plots.pair_plot(samples, **kwargs)


def test_missing_six_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    original = builtins.__import__

    def without_six(name: str, *args: Any, **kwargs: Any) -> Any:
        if name == "sbi.analysis":
            raise ModuleNotFoundError("No module named 'six'", name="six")
        return original(name, *args, **kwargs)

    monkeypatch.delitem(sys.modules, "sbi.analysis", raising=False)
    monkeypatch.setattr(builtins, "__import__", without_six)
    with pytest.raises(ImportError, match=r"`six`.*sbi-rope\[benchmarks\]"):
        plots.pair_plot(two_posteriors())


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


def test_calibration_curves_refuse_nothing() -> None:
    with pytest.raises(InvalidInputError, match="curves"):
        plots.calibration_curves({})


@pytest.mark.parametrize("kind", [list, torch.tensor])
def test_finetuning_history_marks_the_kept_step(kind: Any) -> None:
    history = SimpleNamespace(
        training_loss=kind([3.0, 2.0, 1.0]),
        validation_loss=kind([3.0, 2.5, 2.75]),
        best_step=1,
    )
    axes = plots.finetuning_history(history).axes[0]
    mark = axes.lines[-1]
    assert (mark.get_xdata()[0], mark.get_ydata()[0]) == (1, 2.5)
    assert legend_texts(axes.get_legend())[-1] == "kept: step 1"
    assert "units of the embedding" in axes.get_ylabel()


def test_finetuning_history_without_holdout_draws_the_training_loss_only() -> None:
    history = SimpleNamespace(training_loss=[3.0, 2.0], validation_loss=[], best_step=0)
    axes = plots.finetuning_history(history).axes[0]
    texts = legend_texts(axes.get_legend())
    assert texts == ["training pairs", "kept: step 0 (the starting point)"]


@pytest.mark.parametrize("num_simulations", [1, 50])
def test_effective_sample_sizes_count_every_row(num_simulations: int) -> None:
    weights = torch.softmax(torch.randn(30, num_simulations), dim=1)
    weights[0] = 0.0
    weights[0, 0] = 1.0
    coupling = SimpleNamespace(
        weights=weights, effective_sample_size=1.0 / weights.square().sum(dim=1)
    )
    axes = plots.effective_sample_sizes(coupling).axes[0]
    assert sum(bar.get_height() for bar in axes.patches) == 30
    assert axes.patches[0].get_x() < axes.patches[-1].get_x()
    assert axes.lines[1].get_xdata()[0] == num_simulations
    assert f"{num_simulations}" in legend_texts(axes.get_legend())[1]
