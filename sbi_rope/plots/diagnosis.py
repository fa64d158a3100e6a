"""Which parameters a batch implies, beside the prior."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from sbi_rope._validation import check_batch, check_finite, check_names, check_tensor
from sbi_rope.errors import InvalidInputError
from sbi_rope.plots._figures import BLUE, GREY, empty_figure, hide_frame
from sbi_rope.plots._samples import central_interval, drawable, with_margin

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["implied_parameters"]

NUM_BINS = 20
MAX_COLUMNS = 4


def implied_parameters(
    theta: Tensor,
    *,
    implied: Tensor,
    unshifted: Tensor | None = None,
    parameter_names: Sequence[str] | None = None,
) -> "Figure":
    """Histograms of the prior and of the parameters that a batch implies.

    Args:
        theta: Parameters of simulations from the prior, shape ``(n_s, d)``.
        implied: Their weights for the batch, shape ``(n_s,)``;
            ``diagnosis.implied``.
        unshifted: Their weights for a batch that follows the prior, which differ from
            the prior by what the coupling blurs; ``diagnosis.unshifted``.
        parameter_names: One label for each parameter, with its unit.

    Returns:
        The figure, with one panel for each parameter.

    Raises:
        InvalidInputError: If shapes do not fit, a value is not finite, or weights are
            negative or all 0.
        ImportError: If matplotlib is not installed.
    """
    check_tensor("theta", theta)
    if theta.ndim != 2:
        raise InvalidInputError(
            f"Expected `theta` of shape (n_s, d); got {tuple(theta.shape)}."
        )
    theta = drawable("theta", check_batch("theta", theta, theta.shape[1:]))
    size = theta.shape[1]
    names = [f"theta_{k + 1}" for k in range(size)]
    if parameter_names is not None:
        names = check_names("parameter_names", parameter_names, size)
    weights = {"implied": _checked_weights("implied", implied, len(theta))}
    if unshifted is not None:
        weights["unshifted"] = _checked_weights("unshifted", unshifted, len(theta))
    columns = min(size, MAX_COLUMNS)
    rows = -(-size // columns)
    figure = empty_figure(3.4 * columns, 2.7 * rows + 0.5)
    panels = figure.subplots(rows, columns, squeeze=False).flatten()
    for k, axes in enumerate(panels):
        if k < size:
            _draw(axes, theta[:, k], weights)
            axes.set_xlabel(names[k])
        else:
            axes.set_visible(False)
    panels[0].set_ylabel("density")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=len(labels), frameon=False
    )
    return figure


def _draw(axes: "Axes", theta: Tensor, weights: dict[str, Tensor]) -> None:
    hide_frame(axes)
    axes.set_yticks([])
    low, high = with_margin(*central_interval(theta.unsqueeze(1)))[:, 0].tolist()
    edges = torch.linspace(low, high, NUM_BINS + 1, dtype=theta.dtype).tolist()
    axes.set_xlim(low, high)
    # Nothing is cut off at the sides: the outermost bins hold the tails.
    inside = theta.clamp(low, high).numpy()
    axes.hist(inside, bins=edges, density=True, color="0.85", label="prior")
    styles = {
        "unshifted": (GREY, "--", "implied by a batch of the prior"),
        "implied": (BLUE, "-", "implied by this batch"),
    }
    for name, (colour, line, label) in styles.items():
        if name in weights:
            axes.hist(
                inside,
                bins=edges,
                weights=weights[name].numpy(),
                density=True,
                histtype="step",
                color=colour,
                ls=line,
                lw=1.6,
                label=label,
            )


def _checked_weights(name: str, weights: Tensor, count: int) -> Tensor:
    if check_tensor(name, weights).shape != (count,):
        raise InvalidInputError(
            f"Expected `{name}` of shape ({count},), one weight for each row of "
            f"`theta`; got {tuple(weights.shape)}."
        )
    check_finite(name, weights)
    if (weights < 0).any() or not (weights > 0).any():
        raise InvalidInputError(
            f"Expected `{name}` of at least 0, not all of them 0; got "
            f"{float(weights.min()):.3g} to {float(weights.max()):.3g}."
        )
    return weights.detach().cpu().double()
