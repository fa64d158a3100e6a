"""Bad inputs must be refused with an error of the package that says what is wrong."""

from typing import Any

import pytest

from sbi_rope.utils.errors import RoPEError


def assert_refused(
    match: str, call: Any, *arguments: Any, error: Any = RoPEError, **options: Any
) -> None:
    """Fail unless a call raises an error of the package whose message matches."""
    with pytest.raises(error, match=match):
        call(*arguments, **options)
