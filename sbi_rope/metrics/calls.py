"""How metrics call a posterior: never in a loop without a bound.

Of sbi's own posteriors, samples are not rejected and ``log_prob`` is not normalised,
although it is minus infinity outside the prior. Posteriors that bound these loops, such
as those of this package, are called as they are.
"""

import warnings
from typing import Annotated, Any

import torch
from sbi.inference import DirectPosterior, EnsemblePosterior, VectorFieldPosterior
from torch import Tensor, nn

from sbi_rope.density import Density, MixturePosterior, PriorPosterior
from sbi_rope.npe.sbi import NeuralPosterior, readable
from sbi_rope.utils.errors import InvalidInputError
from sbi_rope.utils.settings import Range, check
from sbi_rope.utils.tensors import as_batch, as_numbers, rows_with

# sbi warns of samples that are not rejected, and of whole chunks that are sampled at
# once. Both are done here on purpose.
EXPECTED_WARNINGS = (
    ".*lie outside the prior support|Capping max_sampling_batch_size|"
    "Note that for batched sampling"
)


def draw_samples(posterior: Any, x: Tensor, *, num_samples: int) -> Tensor:
    """Draw posterior samples as the scores do, without sbi's unbounded rejection.

    ``sample`` and ``sample_batched`` of an sbi posterior reject samples outside the
    prior until enough lie inside. On real observations all may lie outside, and the
    call does not return unless ``max_sampling_time`` bounds it. This function returns
    what the network draws.

    Args:
        posterior: Any posterior with ``sample_batched``.
        x: Observations, shape ``(n, *event_shape)``.
        num_samples: The number of samples for each observation.

    Returns:
        The samples, shape ``(num_samples, n, d)``. Samples of sbi's own posteriors may
        lie outside the prior.

    Raises:
        InvalidInputError: If the posterior returns NaN or a wrong shape, ``x`` is empty
            or cannot be read, or ``num_samples`` is below 1.
    """
    check("num_samples", num_samples, Annotated[int, Range(1)])
    return samples_of(posterior, read_x(posterior, x), num_samples)


def samples_of(
    posterior: Any, x: Tensor, num_samples: int, dim: int | None = None
) -> Tensor:
    """Draw samples of ``dim`` parameters at observations that :func:`read_x` read."""
    arguments = {"reject_outside_prior": False} if _is_unbounded(posterior) else {}
    with torch.no_grad(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=EXPECTED_WARNINGS)
        samples = posterior.sample_batched(
            torch.Size((num_samples,)),
            x=x.clone(),  # because an embedding net may change its argument
            show_progress_bars=False,
            **arguments,
        )
    shape = tuple(samples.shape)
    if shape != (num_samples, len(x), dim or shape[-1]) or samples.isnan().any():
        found = "NaN" if samples.isnan().any() else shape
        raise InvalidInputError(
            f"Expected samples of shape ({num_samples}, {len(x)}, {dim or 'd'}); "
            f"`sample_batched` returned {found}."
        )
    return samples


def log_probs_of(posterior: Any, theta: Tensor, x: Tensor) -> Tensor:
    """Return the log density of each true parameter, float64, shape ``(n,)``."""
    of_sbi = isinstance(posterior, DirectPosterior)
    is_unbounded = of_sbi and not isinstance(posterior, MixturePosterior)
    arguments: Any = {"norm_posterior": False} if is_unbounded else {}
    with torch.no_grad():
        found = posterior.log_prob_batched(theta, x=x.clone(), **arguments)
    if found.numel() != len(theta):
        raise InvalidInputError(
            f"Expected `log_prob_batched` to return {len(theta)} values, one for each "
            f"observation; got shape {tuple(found.shape)}."
        )
    return found.reshape(-1).double()


def read_theta(posterior: Any, theta: Any) -> Tensor:
    """Return true parameters in the dtype of the posterior, shape ``(n, d)``."""
    names = getattr(posterior, "parameter_names", None)
    theta = as_numbers("theta", theta, names=names)
    shape = theta.shape[-1:]
    if isinstance(posterior, DirectPosterior):
        shape = posterior.posterior_estimator.input_shape
    theta = as_batch("theta", theta, shape)
    # sbi's estimators use float32.
    return theta.float() if isinstance(posterior, NeuralPosterior) else theta


def read_x(posterior: Any, x: Any, rows: int | None = None) -> Tensor:
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


def _is_unbounded(posterior: Any) -> bool:
    """Say whether sbi would reject without a bound, and can be told not to."""
    if isinstance(posterior, EnsemblePosterior):
        return any(_is_unbounded(member) for member in posterior.posteriors)
    if isinstance(posterior, DirectPosterior):
        return not isinstance(posterior, MixturePosterior)
    return isinstance(posterior, VectorFieldPosterior)
