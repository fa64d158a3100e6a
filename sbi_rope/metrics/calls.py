r"""How the metrics call a posterior: in chunks, and never in an unbounded loop.

sbi's ``DirectPosterior`` rejects samples outside the prior, and normalises its density
by the share it keeps. Both go on until enough samples are accepted, which is for ever
once a misspecified observation has pushed the flow's mass out of the prior. The metrics
therefore score such posteriors as the network states them: samples without rejection,
``log_prob`` without renormalisation (but still :math:`-\infty` outside the prior).
Leakage counts as an error of the posterior.

A posterior that has replaced sbi's normalisation by a bounded one, as those of this
package, is called without these arguments.
"""

import warnings
from collections.abc import Iterable
from typing import Any

import torch
from sbi.inference import DirectPosterior, EnsemblePosterior, VectorFieldPosterior
from torch import Tensor

from sbi_rope._progress import progress_bar
from sbi_rope._sbi import NeuralPosterior, is_bounded
from sbi_rope._slices import slices
from sbi_rope._validation import (
    as_float32,
    check_batch,
    check_device,
    check_integer,
    check_same_length,
    check_tensor,
    check_values,
)
from sbi_rope.errors import (
    InvalidInputError,
    InvalidTypeError,
    LogProbUnavailableError,
)
from sbi_rope.metrics.calibration import count_ranks

__all__ = [
    "CHUNK_SIZE",
    "check_num_samples",
    "check_test_set",
    "draw_joint_levels",
    "draw_ranks",
    "draw_samples",
    "evaluate_log_probs",
]

# Observations treated in one call unless the caller says otherwise.
CHUNK_SIZE = 100

# Draws of one observation; more fill the memory before they sharpen any score.
MAX_SAMPLES = 10**8

# Draws whose density is evaluated in one call: some flows embed x once per draw.
DRAWS_PER_CALL = 10

# sbi warns about what is done on purpose here: no rejection, whole chunks at once.
EXPECTED_WARNINGS = (
    r".*lie outside the prior support",
    r"Capping max_sampling_batch_size",
    r"Note that for batched sampling",
)


def check_num_samples(num_samples: Any) -> None:
    """Raise unless a number of draws is one that can be asked for."""
    check_integer("num_samples", num_samples, maximum=MAX_SAMPLES)


def check_test_set(
    posterior: Any, theta: Tensor, x: Tensor, chunk_size: int
) -> tuple[Tensor, Tensor]:
    """Check theta (n, k) and x (n, ...), and return them in the posterior's dtype."""
    check_integer("chunk_size", chunk_size)
    check_batch("theta", theta, check_tensor("theta", theta).shape[-1:])
    check_batch("x", x, check_tensor("x", x).shape[1:])
    check_same_length("theta", theta, "x", x)
    if isinstance(posterior, DirectPosterior):
        estimator = posterior.posterior_estimator
        check_batch("theta", theta, estimator.input_shape, finite=False)
        check_batch("x", x, estimator.condition_shape, finite=False)
    if isinstance(posterior, NeuralPosterior):  # sbi's estimators know float32 only
        return as_float32("theta", theta), as_float32("x", x)
    return theta, x


def evaluate_log_probs(
    posterior: Any, theta: Tensor, x: Tensor, *, chunk_size: int, show: bool
) -> Tensor:
    """Log density of each true parameter given its observation, float64, ``(n,)``."""
    _require_log_prob(posterior)
    arguments = {"norm_posterior": False} if _is_unbounded_direct(posterior) else {}
    parts = []
    for rows in _chunks(theta.shape[0], chunk_size, "Evaluating log_prob", show=show):
        with torch.no_grad():
            part = _returned(
                "log_prob_batched",
                # A copy: embedding nets may change their argument.
                posterior.log_prob_batched(theta[rows], x=x[rows].clone(), **arguments),
            )
        if part.numel() != theta[rows].shape[0]:
            raise InvalidInputError(
                f"Expected `log_prob_batched` to return one value for each of "
                f"{theta[rows].shape[0]} observations; got shape {tuple(part.shape)}."
            )
        parts.append(part.reshape(-1).double())
    log_probs = torch.cat(parts)
    bad = torch.isnan(log_probs) | torch.isposinf(log_probs)
    _refuse("log-probabilities that are NaN or +Inf", bad)
    return log_probs


def draw_ranks(
    posterior: Any,
    theta: Tensor,
    x: Tensor,
    *,
    num_samples: int,
    chunk_size: int,
    show: bool,
) -> Tensor:
    """Mid-rank of each true parameter among posterior samples, shape ``(n, k)``."""
    parts = []
    for rows in _chunks(theta.shape[0], chunk_size, "Drawing samples", show=show):
        samples = _draw(posterior, theta, x, rows, num_samples)
        parts.append(count_ranks(samples, theta[rows]))
    return torch.cat(parts)


def draw_joint_levels(
    posterior: Any,
    theta: Tensor,
    x: Tensor,
    *,
    num_samples: int,
    chunk_size: int,
    show: bool,
) -> Tensor:
    """Level of the smallest joint HPD region containing theta, shape ``(n, 1)``."""
    _require_log_prob(posterior)
    parts = []
    for rows in _chunks(theta.shape[0], chunk_size, "Drawing samples", show=show):
        samples = _draw(posterior, theta, x, rows, num_samples)
        draws = torch.cat([theta[rows].unsqueeze(0).to(samples), samples])
        densities = torch.cat(
            [
                _density(posterior, part, x[rows].clone())
                for part in draws.split(DRAWS_PER_CALL)
            ]
        )
        bad = torch.isnan(densities).any(dim=0)
        _refuse("NaN log-probabilities", bad, start=rows.start)
        # Ranking -log p ascending counts the draws that are denser than theta.
        parts.append(count_ranks(-densities[1:, :, None], -densities[0, :, None]))
    return torch.cat(parts)


def draw_samples(posterior: Any, x: Tensor, *, num_samples: int) -> Tensor:
    """Draw as the scores see a posterior, without sbi's unbounded rejection.

    Args:
        posterior: Any posterior with ``sample_batched``.
        x: Observations, shape ``(n, *event_shape)``.
        num_samples: Draws for each.

    Returns:
        Samples, shape ``(num_samples, n, k)``; those of a leaking posterior of sbi may
        lie outside the prior.

    Raises:
        InvalidTypeError: If the posterior cannot be sampled, or returns no tensor.
        InvalidInputError: If ``x`` is empty or not finite, or ``num_samples`` out of
            range.
    """
    check_num_samples(num_samples)
    check_batch("x", x, _event_shape(posterior, check_tensor("x", x)))
    if isinstance(posterior, NeuralPosterior):
        x = as_float32("x", x)
    samples = _sample(posterior, x, num_samples)
    if samples.ndim != 3 or samples.shape[:2] != (num_samples, len(x)):
        raise InvalidInputError(
            f"Expected samples of shape ({num_samples}, {len(x)}, k); `sample_batched` "
            f"returned {tuple(samples.shape)}."
        )
    return samples


def _event_shape(posterior: Any, x: Tensor) -> torch.Size:
    """Return the shape of an observation, that of ``x`` itself where it is unknown."""
    estimator = getattr(posterior, "posterior_estimator", None)
    return getattr(estimator, "condition_shape", x.shape[1:])


def _sample(posterior: Any, x: Tensor, num_samples: int) -> Tensor:
    if not callable(getattr(posterior, "sample_batched", None)):
        raise InvalidTypeError(
            "Expected `posterior` with a method `sample_batched`, such as one of sbi; "
            f"got {type(posterior).__name__}."
        )
    arguments = {"reject_outside_prior": False} if _is_unbounded(posterior) else {}
    with torch.no_grad(), warnings.catch_warnings():
        for message in EXPECTED_WARNINGS:
            warnings.filterwarnings("ignore", message=message)
        samples = posterior.sample_batched(
            torch.Size((num_samples,)),
            x=x.clone(),
            show_progress_bars=False,
            **arguments,
        )
    return _returned("sample_batched", samples)


def _draw(
    posterior: Any, theta: Tensor, x: Tensor, rows: slice, num_samples: int
) -> Tensor:
    samples = _sample(posterior, x[rows], num_samples)
    expected = (num_samples, *theta[rows].shape)
    if tuple(samples.shape) != expected:
        raise InvalidInputError(
            f"Expected samples of shape {expected}; `sample_batched` returned "
            f"{tuple(samples.shape)}. Check that `theta` has one row for each"
            f" observation and one column for each parameter."
        )
    check_device("theta", theta, samples.device, where="what the posterior draws")
    bad = torch.isnan(samples).any(dim=0).any(dim=-1)
    _refuse("NaN samples", bad, start=rows.start)
    return samples


def _density(posterior: Any, theta: Tensor, x: Tensor) -> Tensor:
    """Log density of draws, ``(draws, n)``, under the law they were drawn from."""
    with torch.no_grad():
        if _is_unbounded_direct(posterior):
            # Unrejected draws can leave the prior, where `log_prob` is -Inf although
            # the density they come from is not: a leaking posterior would look
            # under-confident. The estimator states the density of its own draws.
            return posterior.posterior_estimator.log_prob(theta, condition=x)
        density = posterior.log_prob_batched(theta, x=x)
    if tuple(_returned("log_prob_batched", density).shape) != tuple(theta.shape[:2]):
        raise InvalidInputError(
            f"Expected `log_prob_batched` to return one value for each draw, shape "
            f"{tuple(theta.shape[:2])}; got {tuple(density.shape)}."
        )
    return density


def _returned(method: str, value: Any) -> Tensor:
    """Return what a posterior returned, if it is a tensor of numbers."""
    if not isinstance(value, Tensor):
        raise InvalidTypeError(
            f"Expected `{method}` of the posterior to return a torch.Tensor; got "
            f"{type(value).__name__}. Wrap the posterior in a class whose `{method}` "
            "returns a tensor, with the dtype and device of `x`."
        )
    name = f"posterior.{method}(...)"
    check_values(name, check_tensor(name, value))
    return value


def _is_unbounded(posterior: Any) -> bool:
    """Whether sbi would reject without a bound, and can be told not to."""
    if isinstance(posterior, EnsemblePosterior):
        return any(_is_unbounded(member) for member in posterior.posteriors)
    if isinstance(posterior, DirectPosterior):
        return not is_bounded(posterior)
    return isinstance(posterior, VectorFieldPosterior)


def _is_unbounded_direct(posterior: Any) -> bool:
    return isinstance(posterior, DirectPosterior) and _is_unbounded(posterior)


def _require_log_prob(posterior: Any) -> None:
    if not callable(getattr(posterior, "log_prob_batched", None)):
        raise LogProbUnavailableError(
            f"Expected `posterior` with a method `log_prob_batched`; got "
            f"{type(posterior).__name__}. Its calibration can still be scored with "
            f"`acauc` (kinds 'central' and 'rank') and `coverage_curve`."
        )


def _refuse(what: str, bad: Tensor, *, start: int = 0) -> None:
    """Raise if any observation is bad: a score must not hide a broken posterior."""
    if bad.any():
        first = (bad.nonzero().flatten()[:5] + start).tolist()
        raise InvalidInputError(
            f"The posterior returned {what} for at least {int(bad.sum())} observations "
            f"(first: {first}). Remove these observations, or repair the posterior."
        )


def _chunks(length: int, size: int, text: str, *, show: bool) -> Iterable[slice]:
    return progress_bar(slices(length, size), show=show, desc=text)
