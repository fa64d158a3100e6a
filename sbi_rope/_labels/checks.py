"""Checks of the labels that users pass, and their conversion."""

import math
from collections.abc import Hashable, Iterable, Sequence
from numbers import Real
from typing import Any

import torch
from torch import Tensor

from sbi_rope._bounds import off_bounds
from sbi_rope._labels.labels import Labels
from sbi_rope._validation import check_pair_weights
from sbi_rope.errors import InvalidInputError, warn_user
from sbi_rope.settings import default_names
from sbi_rope.tensors import as_batch, as_numbers, check_in_support

__all__ = ["checked_labels", "warn_of_ambiguous", "warn_of_labels_on_bounds"]

# A covariance may be this much asymmetric, or below zero, relative to its diagonal.
ROUNDING = 1e-6
# So many labels are compared with all others at a time.
CHUNK_SIZE = 100
# A correlation whose smallest eigenvalue is below this is singular.
SINGULAR = 1e-12
# A larger share of labels on a bound is no accident of rounding.
MANY_ON_BOUNDS = 0.05


def checked_labels(
    theta: Any,
    *,
    theta_std: Any,
    theta_cov: Any,
    weights: Any,
    groups: Any,
    like: Tensor,
    prior: Any,
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

    Raises:
        InvalidInputError: If an argument holds no numbers.
        InvalidInputError: If a shape or a value does not fit.
    """
    dim = like.shape[1]
    theta = as_numbers("theta", theta, device=like.device)
    is_draws = theta.ndim == 3
    if is_draws and theta.shape[1] < 2:
        raise InvalidInputError(
            "Expected `theta` of shape (n, d), or (n, S, d) with two draws of each "
            f"label at least; got {tuple(theta.shape)}."
        )
    if theta.ndim == 2 and theta.shape[1] < dim:
        raise InvalidInputError(
            f"Expected `theta` of shape (n, {dim}), with a column for each of the "
            f"{dim} parameters of NPE; got {tuple(theta.shape)}. NaN stands for a "
            "parameter that was not measured."
        )
    event_shape = (theta.shape[1], dim) if is_draws else (dim,)
    theta = as_batch("theta", theta, event_shape, finite=False)
    # Numbers that float32 cannot hold become Inf.
    theta = theta.detach().to(like.dtype, copy=True)
    _check_not_infinite("theta", theta)
    if is_draws:
        labels = _from_draws(theta, theta_std, theta_cov, prior)
    else:
        labels = Labels(
            theta=theta,
            covariance=_covariance(theta, theta_std, theta_cov),
            weights=torch.ones(len(theta), dtype=torch.double, device=theta.device),
        )
        # Noise may move a label out of the prior, but an exact one must be inside.
        known = labels.is_measured.all(dim=1) & ~labels.is_noisy.any(dim=1)
        check_in_support("theta", theta, prior, rows=known)
    if weights is not None:
        weights = as_numbers("weights", weights, device=theta.device)
        weights = check_pair_weights(weights, "theta", theta).detach()
        labels = labels.weighted(weights.to(theta.device, torch.double))
    if groups is not None:
        labels = labels.named(_checked_names(groups, len(labels)))
    return labels


def _from_draws(theta: Tensor, theta_std: Any, theta_cov: Any, prior: Any) -> Labels:
    if theta_std is not None or theta_cov is not None:
        raise InvalidInputError(
            "Expected neither `theta_std` nor `theta_cov` with labels that are given "
            f"as draws, `theta` of shape {tuple(theta.shape)}. The draws already say "
            "how well the parameters are known."
        )
    if torch.isnan(theta).any():
        raise InvalidInputError(
            "Expected draws of all parameters; got NaN. Draw a parameter that was not "
            "measured from the prior, given the others."
        )
    n, _, dim = theta.shape
    check_in_support("theta", theta.reshape(-1, dim), prior)
    return Labels(
        theta=theta.double().mean(dim=1).to(theta),
        covariance=theta.new_zeros(n, dim, dim, dtype=torch.double),
        weights=theta.new_ones(n, dtype=torch.double),
        samples=theta,
    )


def _covariance(theta: Tensor, theta_std: Any, theta_cov: Any) -> Tensor:
    """Return the covariance of each label, zero for what was not measured."""
    n, dim = theta.shape
    if theta_std is not None and theta_cov is not None:
        raise InvalidInputError(
            "Expected `theta_std` or `theta_cov`; got both. The covariance has the "
            "squares of the standard deviations on its diagonal."
        )
    if theta_cov is not None:
        return _checked_covariance(theta_cov, theta)
    if theta_std is not None:
        std = _checked_std(theta_std, theta)
        return torch.diag_embed(std.square())
    return theta.new_zeros(n, dim, dim, dtype=torch.double)


def _checked_std(theta_std: Any, theta: Tensor) -> Tensor:
    n, dim = theta.shape
    std = as_numbers("theta_std", theta_std, device=theta.device)
    if tuple(std.shape) not in ((), (dim,), (n, dim)):
        raise InvalidInputError(
            f"Expected `theta_std` as a number, or of shape ({dim},) or ({n}, {dim}); "
            f"got {tuple(std.shape)}."
        )
    std = std.detach().to(theta.device, torch.double).expand(n, dim)
    # What was not measured needs no standard deviation.
    std = std.where(~torch.isnan(theta), torch.zeros_like(std))
    if not bool((torch.isfinite(std) & (std >= 0)).all()):
        raise InvalidInputError(
            "Expected `theta_std` to be finite and not negative; got "
            f"{float(std[~(torch.isfinite(std) & (std >= 0))][0])}. Use zero for exact "
            "parameters, and NaN in `theta` for those that were not measured."
        )
    return std


def _checked_covariance(theta_cov: Any, theta: Tensor) -> Tensor:
    n, dim = theta.shape
    covariance = as_numbers("theta_cov", theta_cov, device=theta.device)
    if tuple(covariance.shape) not in ((dim, dim), (n, dim, dim)):
        raise InvalidInputError(
            f"Expected `theta_cov` of shape ({dim}, {dim}) or ({n}, {dim}, {dim}); got "
            f"{tuple(covariance.shape)}."
        )
    covariance = covariance.detach().to(theta.device, torch.double)
    # What was not measured needs no covariance.
    measured = ~torch.isnan(theta)
    both = measured[:, :, None] & measured[:, None, :]
    covariance = torch.where(both, covariance.expand(n, dim, dim), 0.0)
    if not torch.isfinite(covariance).all():
        raise InvalidInputError(
            "Expected `theta_cov` to be finite; got NaN or Inf. Put NaN into `theta` "
            "for parameters that were not measured."
        )
    # Relative to the standard deviations, because parameters may have different units.
    std = covariance.diagonal(dim1=1, dim2=2).abs().sqrt()
    std = std.where(std > 0, std.amax(dim=1, keepdim=True))
    std = std.where(std > 0, 1.0)
    correlation = covariance / (std[:, :, None] * std[:, None, :])
    asymmetry = (correlation - correlation.mT).abs().amax(dim=(1, 2))
    smallest = torch.linalg.eigvalsh((correlation + correlation.mT) / 2)[:, 0]
    bad = (asymmetry > ROUNDING) | (smallest < -ROUNDING)
    if bad.any():
        rows = bad.nonzero().flatten()[:5].tolist()
        raise InvalidInputError(
            "Expected `theta_cov` to be symmetric without negative eigenvalues; it is "
            f"not for {int(bad.sum())} labels (first: {rows})."
        )
    noisy = covariance.diagonal(dim1=1, dim2=2) > 0
    # Noisy parameters may have no direction without noise, which has no density.
    regular = correlation + torch.diag_embed((~noisy).to(correlation))
    flat = torch.linalg.eigvalsh(regular)[:, 0] <= SINGULAR
    if flat.any():
        rows = flat.nonzero().flatten()[:5].tolist()
        raise InvalidInputError(
            "Expected `theta_cov` in which noisy parameters are not functions of each "
            f"other; it is singular for {int(flat.sum())} labels (first: {rows}). Add "
            "a small number to its diagonal."
        )
    return (covariance + covariance.mT) / 2


def _checked_names(groups: Any, n: int) -> tuple[Hashable, ...]:
    # Tensors and arrays become lists of Python's numbers, which are equal if they are.
    values = groups.tolist() if hasattr(groups, "tolist") else groups
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise InvalidInputError(
            f"Expected `groups` with a number or a name for each pair; got {groups!r}."
        )
    names = tuple(values)
    if getattr(groups, "ndim", 1) != 1:
        raise InvalidInputError(
            "Expected `groups` with one number or name for each pair; got shape "
            f"{tuple(groups.shape)}. Of a table, pass a single column."
        )
    if len(names) != n:
        raise InvalidInputError(
            f"Expected `groups` with one number or name for each of {n} pairs; got "
            f"{len(names)}."
        )
    for row, name in enumerate(names):
        if not isinstance(name, str | Real):
            raise InvalidInputError(
                "Expected numbers or names in `groups`; got "
                f"{type(name).__name__} in row {row}."
            )
        if isinstance(name, Real) and math.isnan(name):
            raise InvalidInputError(
                f"Expected `groups` without NaN; got it in row {row}. Give a pair that "
                "belongs to no other a name of its own."
            )
    return names


def _check_not_infinite(name: str, theta: Tensor) -> None:
    infinite = torch.isinf(theta).flatten(1).any(dim=1)
    if infinite.any():
        rows = infinite.nonzero().flatten()[:5].tolist()
        raise InvalidInputError(
            f"Expected `{name}` without Inf; {int(infinite.sum())} of {len(theta)} "
            f"rows have it (first: {rows})."
        )


def warn_of_ambiguous(labels: Labels) -> None:
    """Warn of labels that may not mean what the user thinks they do."""
    total, effective = float(labels.weights.sum()), labels.effective_number
    if total < effective / 2:
        warn_user(
            f"The weights of the {len(labels)} calibration pairs sum to {total:.3g}, "
            f"so that all together count as {total:.3g} pair(s). A weight is the "
            "number of pairs that a pair counts as. If you have normalised the "
            "weights, multiply them by the number of pairs."
        )
    num_different = labels.num_groups
    unnamed = labels.names is None
    if unnamed and not labels.are_exact and num_different < len(labels) / 2:
        warn_user(
            f"{len(labels)} labels that are not exact have {num_different} different "
            "values. Pairs with equal labels are taken for recordings at the same "
            "parameters, and together count once in scores. Say with `groups` which "
            "of them are."
        )
    if unnamed and len(rows := _rows_that_agree(labels)):
        warn_user(
            f"{len(rows)} of {len(labels)} labels lack some parameters (NaN), and "
            "agree with the label of another pair in all that were measured in both "
            f"(first rows: {rows[:5].tolist()}). Each is taken for another person or "
            "specimen, and may be trained on while recordings of the same one are "
            "held out. Pass `groups`, a number or a name for each pair, to say which "
            "pairs belong together."
        )


def warn_of_labels_on_bounds(
    labels: Labels, prior: Any, parameter_names: Sequence[str] | None
) -> None:
    """Warn of parameters of which several labels are exactly on a bound of the prior.

    A posterior with a density does not expect any such label.
    """
    exact = labels.is_measured & ~labels.is_noisy
    if labels.samples is not None:
        exact = torch.zeros_like(exact)
    on_bound = exact & (labels.theta != off_bounds(prior, labels.theta))
    counts, numbers = on_bound.sum(dim=0), exact.sum(dim=0)
    many = (counts > 1) & (counts > MANY_ON_BOUNDS * numbers)
    if not many.any():
        return
    names = parameter_names or default_names(len(many))
    found = [
        f"{int(counts[j])} of {int(numbers[j])} of {names[j]}"
        for j in many.nonzero().flatten().tolist()
    ]
    warn_user(
        f"Labels are exactly on a bound of the prior: {', '.join(found)}. Posteriors "
        "with a density give a single number no probability. Their credible intervals "
        "hold hardly any of these labels, whatever the level is, although coverage can "
        "be right on average. Most intervals of a stack with `guaranteed=True` reach "
        "the bound for such observations if more labels are on it than the level may "
        "miss. If such a label stands for a value that is too small or too large to "
        "be measured, say with `theta_std` how well it is known."
    )


def _rows_that_agree(labels: Labels) -> Tensor:
    """Return the partial labels that another group's label agrees with, ``(m,)``."""
    theta, groups = labels.theta, labels.groups.to(labels.theta.device)
    measured = labels.is_measured
    partial = (~measured.all(dim=1)).nonzero().flatten()
    found = [partial[:0]]
    for rows in partial.split(CHUNK_SIZE) if len(partial) else ():
        both = measured[rows, None] & measured
        agree = ((theta[rows, None] == theta) | ~both).all(dim=2) & both.any(dim=2)
        found.append(rows[(agree & (groups[rows, None] != groups)).any(dim=1)])
    return torch.cat(found)
