"""The parameters that a batch implies, and the prior."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from sbi_rope.diagnosis import Diagnosis
from sbi_rope.plots._figures import (
    BLUE,
    GREY,
    add_legend_above,
    empty_figure,
    hide_frame,
)
from sbi_rope.plots._samples import central_interval, with_margin
from sbi_rope.utils.settings import check

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NUM_BINS = 20
MAX_COLUMNS = 4


def implied_parameters(diagnosis: Diagnosis) -> "Figure":
    """Draw the prior, and histograms of the parameters that a batch implies.

    The parameters that the batch implies are those of the simulations that it is
    coupled with. A dashed histogram shows the same for a batch that follows the prior.
    It differs from the prior because a coupling blurs.

    Args:
        diagnosis: What :func:`sbi_rope.diagnose` returns.

    Returns:
        The figure, with one panel for each parameter.
    """
    check("diagnosis", diagnosis, Diagnosis)
    names = diagnosis.parameter_names
    columns = min(len(names), MAX_COLUMNS)
    rows = -(-len(names) // columns)
    figure = empty_figure(3.4 * columns, 2.7 * rows + 0.5)
    panels = figure.subplots(rows, columns, squeeze=False).flatten()
    for k, axes in enumerate(panels):
        if k < len(names):
            _draw(axes, diagnosis, k)
            axes.set_xlabel(names[k])
        else:
            axes.set_visible(False)
    panels[0].set_ylabel("density")
    add_legend_above(figure, panels[0])
    return figure


def _draw(axes: "Axes", diagnosis: Diagnosis, k: int) -> None:
    hide_frame(axes)
    axes.set_yticks([])
    theta, prior = diagnosis.theta[:, k], diagnosis.prior[:, k]
    ends = _ends(prior)
    low, high = ends.tolist()
    axes.set_xlim(*with_margin(ends[:1], ends[1:])[:, 0].tolist())
    options = {
        "bins": torch.linspace(low, high, NUM_BINS + 1, dtype=theta.dtype).tolist(),
        "density": True,
    }
    # The outermost bins hold the tails, so that nothing is cut off. There are many
    # draws of the prior, so that a flat one looks flat.
    axes.hist(prior.clamp(low, high).numpy(), color="0.85", label="prior", **options)
    for weights, colour, line, label in (
        (diagnosis.unshifted, GREY, "--", "implied by a batch of the prior"),
        (diagnosis.implied, BLUE, "-", "implied by this batch"),
    ):
        axes.hist(
            theta.clamp(low, high).numpy(),
            weights=weights.numpy(),
            histtype="step",
            color=colour,
            ls=line,
            lw=1.6,
            label=label,
            **options,
        )


def _ends(prior: Tensor) -> Tensor:
    """Return the range of the prior, or its central 99 % if that is much narrower."""
    whole = torch.stack([prior.min(), prior.max()])
    centre = central_interval(prior.unsqueeze(1))[:, 0]
    is_bounded = whole[1] - whole[0] < 1.1 * (centre[1] - centre[0])
    return whole if is_bounded else centre
