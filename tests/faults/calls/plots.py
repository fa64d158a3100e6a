"""Pictures."""

from collections.abc import Callable
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import torch

from sbi_rope import metrics, plots
from tests.faults.outcomes import Call
from tests.faults.problem import (
    THETA,
    THETA_S,
    X_O,
    X_S,
    X,
    diagnosed,
    discrepancy_report,
    draw,
    posterior,
    stacked,
    trained,
)

SAMPLES = draw(7, 50, 2)
WEIGHTS = torch.full((60,), 1 / 60)
OVERVIEW: dict[str, Any] = {
    "simulated": X_S,
    "before": X_O,
    "after": X_O,
    "weights": WEIGHTS,
    "theta": THETA[0],
    "parameter_names": ("a", "b"),
}


# Two parameters may have the same label, and theta may be a column.
LABELS = ("theta: one dimension more", "parameter_names: ['a', 'a']")


def drawn(plot: Callable[..., Any]) -> Callable[..., None]:
    """Return a function that draws a picture and closes it."""

    def run(*given: Any, **arguments: Any) -> None:
        from matplotlib import pyplot

        # Coarse contours are drawn in less time, and refuse the same.
        with patch("sbi_rope.plots._samples.GRID", 15):
            pyplot.close(plot(*given, **arguments))

    return run


def report_of(name: str) -> Any:
    return stacked().report if name == "stacking_report" else discrepancy_report()


def written(path: Any, **options: Any) -> None:
    """Write a report into a folder that is removed again."""
    with TemporaryDirectory() as folder:
        target = f"{folder}/{path}" if isinstance(path, str) else path
        stacked().report.to_html(target, **options)


CALLS = [
    Call(
        name="overview",
        run=lambda samples=SAMPLES, **changed: drawn(plots.overview)(
            samples={"RoPE": samples}, **(OVERVIEW | changed)
        ),
        tensors={"simulated": X_S, "samples": SAMPLES, "theta": THETA[0]},
        options={"parameter_names": "names", "index": "row", "parameters": "names"},
        accepts=("samples: one row less", *LABELS),
    ),
    Call(
        name="overview(prior)",
        run=lambda prior: drawn(plots.overview)(
            samples={"RoPE": SAMPLES}, prior=prior, **OVERVIEW
        ),
        tensors={"prior": THETA_S},
        accepts=("prior: None", "prior: one row less"),
    ),
    Call(
        name="pair_plot",
        run=lambda samples=SAMPLES, theta=THETA[0], **options: drawn(plots.pair_plot)(
            samples={"RoPE": samples}, theta=theta, **options
        ),
        tensors={"samples": SAMPLES, "theta": THETA[0]},
        options={"parameter_names": "names"},
        accepts=("samples: one row less", "theta: None", *LABELS),
    ),
    Call(
        name="credible_set",
        run=lambda x=X_O[0], theta=THETA[0], posterior=None, **options: drawn(
            plots.credible_set
        )(
            stacked() if posterior is None else posterior,
            x,
            theta,
            **{"num_samples": 20, **options},
        ),
        tensors={"x": X_O[:1], "theta": THETA[0]},
        options={
            "posterior": "instance",
            "level": "share",
            "parameter_names": "names",
            "num_samples": "count",
            "seed": "seed",
        },
        accepts=(
            "x: a list",
            "x: a NumPy array",
            "x: one dimension less",
            "theta: None",
            *LABELS,
        ),
    ),
    Call(
        name="implied_parameters",
        run=lambda diagnosis=None: drawn(plots.implied_parameters)(
            diagnosed() if diagnosis is None else diagnosis
        ),
        options={"diagnosis": "instance"},
    ),
    Call(
        name="real_and_simulated",
        run=drawn(plots.real_and_simulated),
        tensors={"x_o": X, "x_s": X_S[:20]},
    ),
    Call(
        name="calibration_curves",
        run=lambda curves=None: drawn(plots.calibration_curves)(
            {"RoPE": metrics.coverage_curve_of(torch.rand(20, 2))}
            if curves is None
            else curves
        ),
        options={"curves": "instance"},
        is_random=True,
    ),
    Call(
        name="ranks_by_estimate",
        run=lambda found=None, **options: drawn(plots.ranks_by_estimate)(
            metrics.coverage_by_estimate(torch.rand(20, 2), THETA)
            if found is None
            else found,
            **options,
        ),
        options={"found": "instance", "parameter_names": "names"},
        accepts=("parameter_names: ['a', 'a']", "parameter_names: None"),
        is_random=True,
    ),
    Call(
        name="effective_sample_sizes",
        run=lambda coupling=None: drawn(plots.effective_sample_sizes)(
            posterior().coupling if coupling is None else coupling
        ),
        options={"coupling": "instance"},
    ),
    Call(
        name="finetuning_history",
        run=lambda history=None: drawn(plots.finetuning_history)(
            trained().history if history is None else history
        ),
        options={"history": "instance"},
    ),
    *(
        Call(
            name=name,
            run=lambda report=None, name=name: drawn(getattr(plots, name))(
                report_of(name) if report is None else report
            ),
            options={"report": "instance"},
        )
        for name in ("discrepancy", "stacking_report")
    ),
    Call(
        name="StackingReport.to_html",
        run=lambda path="report.html", **options: written(path, **options),
        options={
            "path": "path",
            "diagnosis": "instance",
            "parameter_names": "names",
            "x_names": "names",
        },
        accepts=LABELS,
    ),
]
