"""Checks of user input, and the only place where messages about it are written.

Each check raises an error that says the argument's name, what was expected, what came
and, where there is something to do about it, what to do next. Public functions call the
checks once. Private code trusts what it is given.
"""

from sbi_rope._validation.settings import (
    LARGEST_SETTING,
    as_shape,
    check_choice,
    check_default_dtype,
    check_gradients,
    check_instance,
    check_integer,
    check_mapping,
    check_names,
    check_not_negative,
    check_number,
    check_numbers,
    check_path,
    check_positive,
    check_unit_interval,
    check_weights,
    usable_device,
)
from sbi_rope._validation.tensors import (
    as_float32,
    as_numbers,
    check_batch,
    check_device,
    check_finite,
    check_in_support,
    check_not_nan,
    check_prior,
    check_rows,
    check_same_length,
    check_tensor,
    check_theta,
    check_values,
)

__all__ = [
    "LARGEST_SETTING",
    "as_float32",
    "as_numbers",
    "as_shape",
    "check_batch",
    "check_choice",
    "check_default_dtype",
    "check_device",
    "check_finite",
    "check_gradients",
    "check_in_support",
    "check_instance",
    "check_integer",
    "check_mapping",
    "check_names",
    "check_not_nan",
    "check_not_negative",
    "check_number",
    "check_numbers",
    "check_path",
    "check_positive",
    "check_prior",
    "check_rows",
    "check_same_length",
    "check_tensor",
    "check_theta",
    "check_unit_interval",
    "check_values",
    "check_weights",
    "usable_device",
]
