"""Bad inputs must be refused with an error of the package that says what is wrong."""

import re
from collections.abc import Callable
from typing import Any

from sbi_rope.utils.errors import RoPEError, shown


def assert_refused(
    match: str,
    call: Callable[..., Any],
    *arguments: Any,
    error: type[RoPEError] = RoPEError,
    **options: Any,
) -> None:
    """Fail unless a call raises an error of the package whose message matches."""
    given = f"{call} of {shown(arguments)} and {shown(options)}"
    try:
        call(*arguments, **options)
    except error as raised:
        assert re.search(match, str(raised)), f"{given}: {match!r} is not in {raised}"
    else:
        raise AssertionError(f"{given} was accepted instead of refused for {match!r}")
