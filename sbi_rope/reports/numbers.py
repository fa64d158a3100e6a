"""Numbers as they are printed on a page."""

import math

__all__ = ["number", "percent"]


def number(value: float, *, sign: bool = False, digits: int = 2) -> str:
    """Return a number with a true minus sign, or "unknown" for NaN.

    Args:
        value: The number.
        sign: Whether positive numbers have a plus sign.
        digits: How many digits follow the point.
    """
    if math.isnan(value):
        return "unknown"
    text = f"{value:+.{digits}f}" if sign else f"{value:.{digits}f}"
    return text.replace("-", "\N{MINUS SIGN}").replace("inf", "infinite")


def percent(share: float) -> str:
    """Return a share in per cent, "below 1 %" included."""
    if 0 < share < 0.005:
        return "<1 %"
    return f"{100 * share:.0f} %"
