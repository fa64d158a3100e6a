"""The exceptions and warnings of the package.

Every error derives from :class:`RoPEError` and from the built-in error that fits, so
that both ``except RoPEError`` and, for instance, ``except ValueError`` catch it.
"""

import inspect
import warnings
from typing import Any

# Warnings point at no line of these packages.
PASSED_OVER = ("sbi_rope", "sbi", "torch", "contextlib", "functools")


class RoPEError(Exception):
    """Base of all errors raised by this package."""


class InvalidInputError(RoPEError, ValueError, TypeError):
    """An argument has a value, type, shape or device that cannot be used."""


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


class LogProbUnavailableError(RoPEError, NotImplementedError):
    """The estimator has no tractable density."""


class DataNotFoundError(RoPEError, FileNotFoundError):
    """The files of a data set are not where they were looked for."""


class FileFormatError(RoPEError, ValueError):
    """A file is no saved posterior, is damaged, or is of other versions."""


class RoPEWarning(UserWarning):
    """Something works, but not as well as the caller may think."""


def shown(value: Any) -> str:
    """Return a value as it is written in code, shortened if it is long."""
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:200]}... ({type(value).__name__})"


def warn_user(message: str) -> None:
    """Issue a :class:`RoPEWarning` that points at the line of the user's code."""
    level, frame = 1, inspect.currentframe()
    while frame and frame.f_globals.get("__name__", "").split(".")[0] in PASSED_OVER:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, RoPEWarning, stacklevel=level)
