"""Labels as users give them."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from sbi_rope._bounds import off_bounds
from sbi_rope._labels.labels import Labels
from sbi_rope.errors import InvalidInputError
from sbi_rope.settings import default_names
from sbi_rope.tensors import as_batch, as_numbers, check_in_support, rows_with

__all__ = ["given_labels", "on_bounds"]

# A covariance may be this much asymmetric, relative to its diagonal.
ROUNDING = 1e-6
# A correlation whose smallest eigenvalue is below this is singular.
SINGULAR = 1e-12
# A larger share of labels on a bound is no accident of rounding.
MANY_ON_BOUNDS = 0.05


def given_labels(
    theta: Any,
    *,
    theta_std: Any,
    theta_cov: Any,
    weights: Any,
    groups: Any,
    like: Tensor,
    prior: Any,
    names: Sequence[str] | None,
) -> Labels:
    """Return labels from what a user passes to ``append_calibration``.

    Args:
        theta: Measured parameters ``(n, d)``, NaN where missing, or draws
            ``(n, S, d)``.
        theta_std: Standard deviations of the measurements, or None.
        theta_cov: Their covariance, or None.
        weights: How many pairs each label counts as, or None.
        groups: The name of the person or specimen of each label, or None.
        like: A tensor of shape ``(0, d)`` with the dtype and device to convert to.
        prior: The prior of NPE.
        names: The names of the parameters; None if they are not known.

    Raises:
        InvalidInputError: If a shape or a value does not fit.
    """
    dim, device = like.shape[1], like.device
    theta = as_numbers("theta", theta, device=device, names=names)
    event_shape = (theta.shape[1], dim) if theta.ndim == 3 else (dim,)
    theta = as_batch("theta", theta, event_shape, finite=False)
    theta = theta.to(like.dtype, copy=True)
    if (infinite := torch.isinf(theta)).any():
        raise InvalidInputError(
            "Expected `theta` to be finite, or NaN where it was not measured; got Inf "
            f"in {rows_with(infinite)}."
        )
    n, is_draws = len(theta), theta.ndim == 3
    if is_draws:
        noise = theta_std is not None or theta_cov is not None
        if noise or torch.isnan(theta).any():
            raise InvalidInputError(
                "Expected draws of all parameters, without NaN, `theta_std` and "
                f"`theta_cov`; got `theta` of shape {tuple(theta.shape)} with some."
            )
        check_in_support("theta", theta.reshape(-1, dim), prior)
    measured = ~torch.isnan(theta if not is_draws else theta[:, 0])
    labels = Labels(
        theta=theta.double().mean(dim=1).to(theta) if is_draws else theta,
        covariance=_covariance(measured, theta_std, theta_cov, names),
        weights=torch.ones(n, dtype=torch.double, device=device),
        samples=theta if is_draws else None,
    )
    if not is_draws:
        # Noise may move a label out of the prior, but an exact one must be inside.
        check_in_support("theta", theta, prior, rows=labels.is_exact)
    if weights is not None:
        weights = as_batch("weights", weights, (), rows=n, device=device)
        if (bad := weights <= 0).any():
            raise InvalidInputError(
                f"Expected positive `weights`; got others in {rows_with(bad)}."
            )
        labels = labels.weighted(weights.double())
    if groups is not None:
        # Tensors and arrays become Python's numbers, which are equal if they are.
        of_rows = tuple(groups.tolist() if hasattr(groups, "tolist") else groups)
        if len(of_rows) != n:
            raise InvalidInputError(
                f"Expected `groups` with one number or name for each of {n} pairs; got "
                f"{len(of_rows)}."
            )
        labels = labels.named(of_rows)
    return labels


def _covariance(
    measured: Tensor, theta_std: Any, theta_cov: Any, names: Sequence[str] | None
) -> Tensor:
    """Return the covariance of each label, zero for what was not measured."""
    n, dim = measured.shape
    if theta_std is not None and theta_cov is not None:
        raise InvalidInputError("Expected `theta_std` or `theta_cov`; got both.")
    if theta_cov is not None:
        return _given_covariance(theta_cov, measured)
    if theta_std is None:
        return measured.new_zeros(n, dim, dim, dtype=torch.double)
    std = as_numbers("theta_std", theta_std, device=measured.device, names=names)
    if tuple(std.shape) not in ((), (dim,), (n, dim)):
        raise InvalidInputError(
            f"Expected `theta_std` as a number, or of shape ({dim},) or ({n}, {dim}); "
            f"got {tuple(std.shape)}."
        )
    # What was not measured needs no standard deviation.
    std = std.double().expand(n, dim).where(measured, 0.0)
    if (bad := ~(torch.isfinite(std) & (std >= 0))).any():
        raise InvalidInputError(
            f"Expected `theta_std` to be finite and not negative; got {std[bad][0]:g}."
        )
    return torch.diag_embed(std.square())


def _given_covariance(theta_cov: Any, measured: Tensor) -> Tensor:
    n, dim = measured.shape
    covariance = as_numbers("theta_cov", theta_cov, device=measured.device).double()
    if tuple(covariance.shape) not in ((dim, dim), (n, dim, dim)):
        raise InvalidInputError(
            f"Expected `theta_cov` of shape ({dim}, {dim}) or ({n}, {dim}, {dim}); got "
            f"{tuple(covariance.shape)}."
        )
    # What was not measured needs no covariance.
    both = measured[:, :, None] & measured[:, None, :]
    covariance = covariance.expand(n, dim, dim).where(both, 0.0)
    bad = ~torch.isfinite(covariance).flatten(1).all(dim=1)
    # Relative to the standard deviations, because parameters may have different units.
    variance = covariance.diagonal(dim1=1, dim2=2).nan_to_num()
    noisy = variance > 0
    std = variance.where(noisy, 1.0).sqrt()
    correlation = covariance.nan_to_num() / (std[:, :, None] * std[:, None, :])
    bad |= (correlation - correlation.mT).abs().amax(dim=(1, 2)) > ROUNDING
    # Without noise there is no covariance either.
    bad |= correlation.where(~noisy[:, :, None], 0.0).flatten(1).any(dim=1)
    # Noisy parameters may have no direction without noise, which has no density.
    regular = (correlation + correlation.mT) / 2 + torch.diag_embed((~noisy).double())
    bad |= torch.linalg.eigvalsh(regular)[:, 0] <= SINGULAR
    if bad.any():
        raise InvalidInputError(
            "Expected `theta_cov` to be finite, symmetric, and positive definite for "
            f"the noisy parameters; got another one in {rows_with(bad)}."
        )
    return (covariance + covariance.mT) / 2


def on_bounds(labels: Labels, prior: Any, names: Sequence[str] | None) -> list[str]:
    """Say of which parameters many exact labels are on a bound of the prior.

    A posterior with a density does not expect any such label.
    """
    if labels.samples is not None:
        return []
    exact = labels.is_measured & ~labels.is_noisy
    on_bound = exact & (labels.theta != off_bounds(prior, labels.theta))
    counts, numbers = on_bound.sum(dim=0), exact.sum(dim=0)
    many = (counts > 1) & (counts > MANY_ON_BOUNDS * numbers)
    names = names or default_names(len(many))
    return [
        f"{int(counts[j])} of {int(numbers[j])} labels of {names[j]}"
        for j in many.nonzero().flatten().tolist()
    ]
