"""Bad inputs must be refused with an error of the package that says what is wrong."""

import re
from collections.abc import Callable
from typing import Any

from sbi_rope.utils.errors import RoPEError, shown

__all__ = ["assert_refused"]


def assert_refused(
    match: str,
    call: Callable[..., Any],
    *arguments: Any,
    error: type[RoPEError] = RoPEError,
    **options: Any,
) -> None:
    """Fail unless a call raises an error of the package whose message matches.

    Args:
        match: A regular expression that the message contains.
        call: What is called.
        arguments: The arguments of the call, at least one of which is bad.
        error: The class of the error.
        options: The arguments of the call by name.
    """
    given = f"{call} of {shown(arguments)} and {shown(options)}"
    try:
        call(*arguments, **options)
    except error as raised:
        if not re.search(match, str(raised)):
            raise AssertionError(f"{given}: {match!r} is not in {raised}") from raised
    else:
        raise AssertionError(f"{given} was accepted instead of refused for {match!r}")
