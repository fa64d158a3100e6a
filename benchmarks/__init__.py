"""Experiments behind the numbers in the documentation; not part of the wheel."""
