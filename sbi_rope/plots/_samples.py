"""Draw posterior samples in a panel: limits of axes, histograms, contours."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.stats import gaussian_kde
from torch import Tensor

from sbi_rope.plots._figures import PRIOR, empty_figure, hide_frame, line_styles
from sbi_rope.utils.settings import names_of
from sbi_rope.utils.tensors import as_batch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Shares that contours enclose, the most samples behind one, and points on its axes.
SHARES, MAX_SAMPLES, GRID = (0.9, 0.5), 1000, 80
TRUTH: dict[str, Any] = dict(color="black", lw=1.2, marker="X", ms=8, mec="w", zorder=5)
# Samples and their line style by label.
Draws = dict[str, tuple[Tensor, dict[str, Any]]]


def as_posteriors(
    samples: Mapping[str, Tensor],
    theta: Tensor | None,
    parameter_names: Sequence[str] | None,
    prior: Tensor | None,
) -> tuple[Draws, Tensor | None, list[str], Tensor, Tensor | None]:
    """Return draws, truth, names, limits of axes, and ends of the prior, ``(2, d)``.

    Labels say if many samples are outside the axes.
    """
    draws, truth, names = as_samples(samples, theta, parameter_names)
    spans = torch.stack([central_interval(value) for value in draws.values()])
    if prior is not None:
        prior = central_interval(as_drawn("prior", prior, (len(names),)))
        width = prior[1] - prior[0]
        floor, ceiling = prior[0] - width, prior[1] + width
        is_near = (spans[:, :1] <= ceiling) & (spans[:, 1:] >= floor)
        spans = spans.clamp(floor, ceiling).where(is_near, prior)
        spans = torch.cat([spans, prior[None]])
    if truth is not None:
        spans = torch.cat([spans, truth.expand(1, 2, -1)])
    limits = with_margin(spans[:, 0].amin(dim=0), spans[:, 1].amax(dim=0))
    found = {}
    for name, style in line_styles(draws).items():
        is_inside = (draws[name] >= limits[0]) & (draws[name] <= limits[1])
        outside = 1.0 - float(is_inside.all(dim=1).double().mean())
        # The axes are made to leave out one sample in a hundred of each parameter.
        is_large = outside > 0.05 + 0.01 * len(names)
        label = f"{name} ({100 * outside:.0f} % outside)" if is_large else name
        found[label] = draws[name], style
    return found, truth, names, limits, prior


def as_samples(
    samples: Mapping[str, Tensor],
    theta: Tensor | None,
    parameter_names: Sequence[str] | None,
) -> tuple[dict[str, Tensor], Tensor | None, list[str]]:
    """Return samples by method, the truth, and a name for each parameter."""
    (dim,) = np.shape(next(iter(samples.values())))[-1:]
    draws = {k: as_drawn(f"samples[{k!r}]", v, (dim,)) for k, v in samples.items()}
    names = [f"$\\theta_{{{j + 1}}}$" for j in range(dim)]
    if parameter_names is not None:
        names = list(names_of(parameter_names, dim))
    truth = None if theta is None else as_drawn("theta", theta, (), rows=dim)
    return draws, truth, names


def as_drawn(
    name: str, value: Any, event_shape: Sequence[int], rows: int | None = None
) -> Tensor:
    """Return a batch of a user on the CPU in float64, see ``tensors.as_batch``."""
    return as_batch(name, value, event_shape, rows=rows).cpu().double()


def central_interval(values: Tensor) -> Tensor:
    """Return the ends of the central 99 % of each column, shape ``(2, d)``."""
    last = len(values) - 1
    # From five rows on, a single extreme value has no say.
    low = min(math.ceil(0.005 * last), last // 4)
    return values.sort(dim=0).values[[low, last - low]]


def with_margin(low: Tensor, high: Tensor) -> Tensor:
    """Return limits that are a little wider than an interval, shape ``(2, d)``."""
    margin = 0.06 * (high - low).where(high > low, 1.0)
    return torch.stack([low - margin, high + margin])


def set_up_panel(
    axes: "Axes",
    names: Sequence[str],
    limits: Tensor,
    truth: Tensor | None,
    shown: list[int],
) -> None:
    """Label a panel of one or two parameters, set its limits, and mark the truth."""
    hide_frame(axes)
    axes.set(xlabel=names[shown[0]], xlim=limits[:, shown[0]].tolist())
    if len(shown) == 1:
        axes.spines["left"].set_visible(False)
        axes.set_yticks([])
        if truth is not None:
            # The marker is that of the legend.
            axes.axvline(float(truth[shown]), **TRUTH, markevery=[], label="truth")
    else:
        axes.set(ylabel=names[shown[1]], ylim=limits[:, shown[1]].tolist())
        if truth is not None:
            axes.plot(*truth[shown].tolist(), **TRUTH, ls="", label="truth")


def corner_panels(
    names: Sequence[str], limits: Tensor, truth: Tensor | None
) -> "tuple[Figure, list[tuple[Axes, list[int]]]]":
    """Return a figure with a panel for each parameter and pair, and what they show."""
    dim, panels = len(names), []
    figure = empty_figure(2.0 * dim + 0.8, 2.0 * dim + 1.0)
    for row in range(dim):
        for column in range(row + 1):
            shown = [row] if row == column else [column, row]
            axes = figure.add_subplot(dim, dim, row * dim + column + 1)
            set_up_panel(axes, names, limits, truth, shown)
            axes.label_outer()
            panels.append((axes, shown))
    return figure, panels


def corner_legend(figure: "Figure", handles: list[Any]) -> None:
    """Add a legend in the empty half of the figure, or above a single panel."""
    place = "upper right" if len(figure.axes) > 1 else "outside upper center"
    figure.legend(handles=handles, loc=place, frameon=False)


def draw_posteriors(
    axes: "Axes", draws: Draws, prior: Tensor | None, shown: list[int]
) -> None:
    """Draw one or two parameters of posteriors on the shaded interval of the prior."""
    for label, (values, style) in draws.items():
        axes.plot([], [], label=label, **style)  # for the legend
        if len(shown) == 1:
            draw_marginal(axes, values[:, shown[0]], style)
        else:
            draw_contours(axes, values[:, shown], style)
    if prior is not None:
        shade = {"color": PRIOR, "lw": 0, "zorder": 0, "label": "prior"}
        sides, *ends = prior[:, shown].T.tolist()
        if ends:
            axes.fill_between(sides, *ends[0], **shade)
        else:
            axes.axvspan(*sides, **shade)


def draw_marginal(axes: "Axes", values: Tensor, style: Mapping[str, Any]) -> None:
    """Draw a histogram of the central 99 % of ``values``, shape ``(n,)``."""
    low, high = central_interval(values[:, None]).flatten().tolist()
    left, right = axes.get_xlim()
    if low > right or high < left:  # it would change the height of the panel
        return
    density, edges = np.histogram(values, "auto", range=(low, high), density=True)
    # The lines are solid, because dashed steps are hard to read.
    axes.stairs(density, edges, color=style["color"], lw=1.6)


def draw_contours(
    axes: "Axes",
    values: Tensor,
    style: Mapping[str, Any],
    shares: Sequence[float] = SHARES,
) -> None:
    """Draw contours that enclose shares of ``values``, shape ``(n, 2)``."""
    low, high = central_interval(values)
    margin = (high - low) / 2
    core = values[((values >= low - margin) & (values <= high + margin)).all(dim=1)]
    if not core.T.corrcoef()[0, 1].abs() < 1 - 1e-9:  # all are on a point or a line
        axes.plot(*values.T.numpy(), ".", color=style["color"], ms=4)
        return
    kernels = gaussian_kde(core[:: -(-len(core) // MAX_SAMPLES)].T.numpy())
    # Beyond the outermost values, contours would leave the prior's support.
    ends = zip(core.amin(dim=0).tolist(), core.amax(dim=0).tolist(), strict=True)
    x, y = np.meshgrid(*(np.linspace(*pair, GRID) for pair in ends))
    density = kernels(np.stack([x.ravel(), y.ravel()])).reshape(x.shape)
    # There the density falls to zero, so that contours close along the edge.
    x, y, density = np.pad(x, 1, "edge"), np.pad(y, 1, "edge"), np.pad(density, 1)
    # They are equal if most samples of discrete parameters are.
    levels = np.unique(np.quantile(kernels(kernels.dataset), 1 - np.array(shares)))
    colour, line = style["color"], style["linestyle"]
    axes.contour(x, y, density, levels, colors=[colour], linestyles=line)
    for level in levels:
        axes.contourf(x, y, density, [level, np.inf], colors=[colour], alpha=0.16)
