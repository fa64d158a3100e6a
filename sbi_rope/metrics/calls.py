"""How metrics call a posterior: in chunks, and never in an unbounded loop.

sbi's ``DirectPosterior`` rejects samples outside the prior, and divides its density by
the share that it keeps. If a misspecified observation has moved all mass out of the
prior, these loops never end. Metrics take such a posterior as its network states it:
samples are not rejected, and ``log_prob`` is not normalised, although it is still minus
infinity outside the prior. Posteriors that bound the loop, such as those of this
package, are called as they are.
"""

import warnings
from collections.abc import Iterable, Iterator
from typing import Annotated, Any

import torch
from sbi.inference import DirectPosterior, EnsemblePosterior, VectorFieldPosterior
from torch import Tensor, nn

from sbi_rope.density import Density, MixturePosterior, PriorPosterior
from sbi_rope.npe.sbi import NeuralPosterior, is_bounded, readable
from sbi_rope.utils.errors import (
    InvalidInputError,
    LogProbUnavailableError,
)
from sbi_rope.utils.progress import progress_bar
from sbi_rope.utils.settings import Count, Range, check
from sbi_rope.utils.tensors import as_batch, as_numbers, rows_with

# How many observations a posterior is called with at a time, unless the user says.
CHUNK_SIZE = 100

# The most draws for one observation. More would fill the memory without making any
# score more precise.
MAX_SAMPLES = 10**8

# The fewest draws for one observation by which calibration is judged. By a single draw
# all posteriors look calibrated whose draws are too large as often as too small.
MIN_SAMPLES = 20

NumSamples = Annotated[int, Range(MIN_SAMPLES, MAX_SAMPLES)]

# sbi warns of samples that are not rejected, and of whole chunks that are sampled at
# once. Both are done here on purpose.
EXPECTED_WARNINGS = (
    r".*lie outside the prior support",
    r"Capping max_sampling_batch_size",
    r"Note that for batched sampling",
)


def read_test_set(
    posterior: Any, theta: Tensor, x: Tensor, chunk_size: int
) -> tuple[Tensor, Tensor]:
    """Return a test set in the dtype of the posterior.

    Args:
        posterior: The posterior to be scored.
        theta: True parameters, shape ``(n, d)``.
        x: Their observations, shape ``(n, *event_shape)``.
        chunk_size: How many observations are scored at a time.

    Raises:
        InvalidInputError: If a shape does not fit or an entry is not finite.
    """
    check("chunk_size", chunk_size, Count)
    theta = as_numbers(
        "theta", theta, names=getattr(posterior, "parameter_names", None)
    )
    theta_shape = theta.shape[-1:]
    if isinstance(posterior, DirectPosterior):
        theta_shape = posterior.posterior_estimator.input_shape
    theta = as_batch("theta", theta, theta_shape)
    if isinstance(posterior, NeuralPosterior):  # sbi's estimators use float32
        theta = theta.float()
    return theta, _read_x(posterior, x, rows=len(theta))


def evaluate_log_probs(
    posterior: Any, theta: Tensor, x: Tensor, *, chunk_size: int, show: bool
) -> Tensor:
    """Return the log density of each true parameter, float64, shape ``(n,)``."""
    log_prob_batched = _log_prob_of(posterior)
    arguments = {"norm_posterior": False} if _is_unbounded_direct(posterior) else {}
    parts = []
    for rows in _chunks(theta.shape[0], chunk_size, "Evaluating log_prob", show=show):
        with torch.no_grad():
            # A copy of x, because an embedding net may change its argument.
            part = log_prob_batched(theta[rows], x=x[rows].clone(), **arguments)
        if part.numel() != theta[rows].shape[0]:
            raise InvalidInputError(
                f"Expected `log_prob_batched` to return one value for each of "
                f"{theta[rows].shape[0]} observations; got shape {tuple(part.shape)}."
            )
        parts.append(part.reshape(-1).double())
    log_probs = torch.cat(parts)
    bad = torch.isnan(log_probs) | torch.isposinf(log_probs)
    _require_none(bad, "log-probabilities that are NaN or +Inf")
    return log_probs


def draw_chunks(
    posterior: Any,
    theta: Tensor,
    x: Tensor,
    *,
    num_samples: int,
    chunk_size: int,
    show: bool,
) -> Iterator[tuple[slice, Tensor]]:
    """Yield samples of some observations at a time, ``(num_samples, rows, d)``."""
    for rows in _chunks(theta.shape[0], chunk_size, "Drawing samples", show=show):
        yield rows, _draw(posterior, theta, x, rows, num_samples)


def draw_samples(posterior: Any, x: Tensor, *, num_samples: int) -> Tensor:
    """Draw posterior samples as the scores do, without sbi's unbounded rejection.

    ``sample`` and ``sample_batched`` of an sbi posterior reject samples outside the
    prior until enough lie inside. On real observations all may lie outside, and the
    call does not return unless ``max_sampling_time`` bounds it. ``log_prob`` estimates
    the share inside by the same loop, except with ``norm_posterior=False``. This
    function returns what the network draws.

    Args:
        posterior: Any posterior with ``sample_batched``.
        x: Observations, shape ``(n, *event_shape)``.
        num_samples: The number of samples for each observation.

    Returns:
        The samples, shape ``(num_samples, n, d)``. Samples of sbi's own posteriors may
        lie outside the prior.

    Raises:
        InvalidInputError: If the posterior cannot be sampled or returns no tensor,
            ``x`` is empty or not finite, or ``num_samples`` is not from 1 to 10^8.
    """
    check("num_samples", num_samples, Annotated[int, Range(1, MAX_SAMPLES)])
    x = _read_x(posterior, x)
    samples = _sample(posterior, x, num_samples)
    if samples.ndim != 3 or samples.shape[:2] != (num_samples, len(x)):
        raise InvalidInputError(
            f"Expected samples of shape ({num_samples}, {len(x)}, d); `sample_batched` "
            f"returned {tuple(samples.shape)}."
        )
    return samples


def _read_x(posterior: Any, x: Any, rows: int | None = None) -> Tensor:
    """Return observations that the posterior can read."""
    estimator = getattr(posterior, "posterior_estimator", None)
    event_shape = getattr(estimator, "condition_shape", None)
    if isinstance(posterior, PriorPosterior):
        event_shape = None  # it never reads x
    names = getattr(posterior, "x_names", None)
    x = as_batch("x", x, event_shape, rows=rows, names=names, finite=False)
    if isinstance(posterior, NeuralPosterior):
        x = x.float()
    if isinstance(posterior, MixturePosterior):
        return x  # it refuses what it cannot read
    if isinstance(estimator, Density):
        unread = ~estimator.readable(x)
    else:
        net = getattr(estimator, "embedding_net", None)
        unread = ~readable(net if isinstance(net, nn.Module) else nn.Identity(), x)
    if unread.any():
        raise InvalidInputError(
            f"Expected `x` that can be read; got NaN or Inf in {rows_with(unread)}."
        )
    return x


def _sample(posterior: Any, x: Tensor, num_samples: int) -> Tensor:
    arguments = {"reject_outside_prior": False} if _is_unbounded(posterior) else {}
    with torch.no_grad(), warnings.catch_warnings():
        for message in EXPECTED_WARNINGS:
            warnings.filterwarnings("ignore", message=message)
        return posterior.sample_batched(
            torch.Size((num_samples,)),
            x=x.clone(),
            show_progress_bars=False,
            **arguments,
        )


def _draw(
    posterior: Any, theta: Tensor, x: Tensor, rows: slice, num_samples: int
) -> Tensor:
    samples = _sample(posterior, x[rows], num_samples)
    expected = (num_samples, *theta[rows].shape)
    if tuple(samples.shape) != expected:
        raise InvalidInputError(
            f"Expected samples of shape {expected}; `sample_batched` returned "
            f"{tuple(samples.shape)}."
        )
    bad = torch.isnan(samples).any(dim=0).any(dim=-1)
    _require_none(bad, "NaN samples", start=rows.start)
    return samples


def _is_unbounded(posterior: Any) -> bool:
    """Say whether sbi would reject without a bound, and can be told not to."""
    if isinstance(posterior, EnsemblePosterior):
        return any(_is_unbounded(member) for member in posterior.posteriors)
    if isinstance(posterior, DirectPosterior):
        return not is_bounded(posterior)
    return isinstance(posterior, VectorFieldPosterior)


def _is_unbounded_direct(posterior: Any) -> bool:
    return isinstance(posterior, DirectPosterior) and _is_unbounded(posterior)


def _log_prob_of(posterior: Any) -> Any:
    """Return the method that gives densities, before anything is drawn."""
    if not hasattr(posterior, "log_prob_batched"):
        raise LogProbUnavailableError(
            "Expected `posterior` with a method `log_prob_batched`; got "
            f"{type(posterior).__name__}."
        )
    return posterior.log_prob_batched


def _require_none(bad: Tensor, what: str, *, start: int = 0) -> None:
    if bad.any():
        first = (bad.nonzero().flatten()[:5] + start).tolist()
        raise InvalidInputError(
            f"Expected a posterior with finite results; got {what} for "
            f"{int(bad.sum())} observations (first: {first})."
        )


def _chunks(length: int, size: int, text: str, *, show: bool) -> Iterable[slice]:
    chunks = [slice(first, first + size) for first in range(0, length, size)]
    return progress_bar(chunks, show=show, desc=text)
