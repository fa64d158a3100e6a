"""The exceptions and warnings of the package.

Every error derives from :class:`RoPEError` and from the builtin a caller would
expect, so that both ``except RoPEError`` and ``except ValueError`` work.
"""

import inspect
import warnings

__all__ = [
    "CouplingError",
    "DataNotFoundError",
    "InvalidInputError",
    "InvalidTypeError",
    "LogProbUnavailableError",
    "NotReadyError",
    "NotWritableError",
    "RoPEError",
    "RoPEWarning",
    "SamplingError",
    "SimulationError",
    "UnseenObservationError",
    "UnsupportedPosteriorError",
    "warn_user",
]


class RoPEError(Exception):
    """Base of all errors raised by this package."""


class InvalidInputError(RoPEError, ValueError):
    """An argument has a value, shape, dtype or device that cannot be used."""


class InvalidTypeError(RoPEError, TypeError):
    """An argument has a type that cannot be used."""


class NotReadyError(RoPEError, RuntimeError):
    """A step was called before the step it depends on."""


class UnsupportedPosteriorError(RoPEError, TypeError):
    """The sbi posterior cannot be split into an embedding net and a density."""


class SimulationError(RoPEError, RuntimeError):
    """The simulator raised, or returned something that cannot be used."""


class CouplingError(RoPEError, RuntimeError):
    """The optimal transport problem could not be solved as asked."""


class SamplingError(RoPEError, RuntimeError):
    """Rejection sampling found too little mass inside the prior's support."""


class UnseenObservationError(RoPEError, ValueError):
    """An observation does not belong to the batch the posterior was built for."""


class LogProbUnavailableError(RoPEError, NotImplementedError):
    """The estimator has no tractable density."""


class DataNotFoundError(RoPEError, FileNotFoundError):
    """The files of a data set are not where they were looked for."""


class NotWritableError(RoPEError, OSError):
    """Nothing can be written where results are to be kept."""


class RoPEWarning(UserWarning):
    """Something works, but not as well as the caller may think."""


def warn_user(message: str) -> None:
    """Issue a :class:`RoPEWarning` that points at the caller's own line.

    The line is the first one up the stack outside of this package, sbi and torch.
    """
    level, frame = 1, inspect.currentframe()
    while frame is not None:
        package = frame.f_globals.get("__name__", "").split(".")[0]
        if package not in ("sbi_rope", "sbi", "torch", "contextlib"):
            break
        level, frame = level + 1, frame.f_back
    warnings.warn(message, RoPEWarning, stacklevel=level)
