"""The data that a method was shown, checked and kept on one device."""

from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from sbi_rope._sbi import readable
from sbi_rope._validation import (
    KnownColumns,
    check_columns,
    check_finite,
    check_not_swapped,
    check_readable,
    check_row_order,
)
from sbi_rope.errors import InvalidInputError, warn_user
from sbi_rope.tensors import as_batch, as_numbers, check_in_support, check_same_length

__all__ = ["Data", "Kind", "Pairs"]

Kind = Literal["simulations", "calibration", "observations"]


class Pairs:
    """Parameters, each with its x, which are appended bit by bit."""

    def __init__(self) -> None:
        self._theta: Tensor | None = None
        self._x: Tensor | None = None

    def append(self, theta: Tensor, x: Tensor) -> None:
        """Add some, theta ``(n, d)`` and x ``(n, *event)``."""
        self._theta = _joined(self._theta, theta)
        self._x = _joined(self._x, x)

    def __len__(self) -> int:
        return 0 if self._theta is None else len(self._theta)

    @property
    def tensors(self) -> tuple[Tensor, Tensor]:
        """All theta ``(n, d)`` and x ``(n, *event)``; some were appended."""
        assert self._theta is not None
        assert self._x is not None
        return self._theta, self._x


class Data:
    """Simulations, calibration pairs and observations with x of the same shape.

    All are copied, in float32. What does not fit is refused, and nothing of it is
    added.

    Args:
        prior: Over parameters of shape ``(d,)``, on the device.
        device: Where the data are kept.

    Attributes:
        event_shape: Shape of one x, that of the first which was appended; None before.
        embedding_net: The net that is to read x, if it was trained beforehand. Missing
            entries (NaN) are accepted if it can read them.
        columns: The names of columns of "theta" and "x" in orders that are known.
    """

    def __init__(self, prior: Distribution, device: torch.device) -> None:
        self._prior = prior
        self._device = device
        self.event_shape: torch.Size | None = None
        self.embedding_net: nn.Module = nn.Identity()
        self._simulations, self._calibration = Pairs(), Pairs()
        self._x_o: Tensor | None = None
        self.columns: dict[str, KnownColumns] = {"theta": {}, "x": {}}

    @property
    def simulations(self) -> tuple[Tensor, Tensor]:
        """Theta ``(n, d)`` and simulated x ``(n, *event)``."""
        return self._simulations.tensors

    @property
    def calibration(self) -> tuple[Tensor, Tensor]:
        """Theta ``(n, d)`` and the real x ``(n, *event)`` recorded at them."""
        return self._calibration.tensors

    @property
    def observations(self) -> Tensor:
        """Real x without parameters, ``(n_o, *event)``."""
        assert self._x_o is not None
        return self._x_o

    def count(self, kind: Kind) -> int:
        """Return how many simulations, calibration pairs or observations there are."""
        if kind == "observations":
            return 0 if self._x_o is None else len(self._x_o)
        return len(self._simulations if kind == "simulations" else self._calibration)

    def append_simulations(self, theta: Any, x: Any) -> None:
        """Add simulations; those with NaN or Inf are dropped with a warning."""
        self._check_order(theta, x)
        columns = self._checked_columns(theta=theta, x=x)
        theta = self.checked_theta("theta", theta)
        check_in_support("theta", theta, self._prior)
        x = self._checked_x("x", x)
        check_same_length("theta", theta, "x", x)
        valid = self.readable(x)
        if not valid.any():
            raise InvalidInputError(
                "Expected simulations `x` that are finite; all contain NaN or Inf."
            )
        if not valid.all():
            warn_user(
                f"Dropped {int((~valid).sum())} of {len(x)} simulations because they "
                "contain NaN or Inf."
            )
        self._simulations.append(theta[valid], x[valid])
        self.event_shape, self.columns = x.shape[1:], columns

    def append_calibration(self, theta: Any, x: Any) -> None:
        """Add calibration pairs."""
        self._check_order(theta, x)
        columns = self._checked_columns(theta=theta, x=x)
        theta = self.checked_theta("theta", theta)
        check_in_support("theta", theta, self._prior)
        x = self._checked_x("x", x)
        check_readable("x", x, self.readable(x))
        check_same_length("theta", theta, "x", x)
        self._calibration.append(theta, x)
        self.event_shape, self.columns = x.shape[1:], columns

    def append_observations(self, x_o: Any) -> None:
        """Add observations without parameters."""
        known = check_columns("x_o", x_o, self.columns["x"])
        x_o = self._checked_x("x_o", x_o)
        check_readable("x_o", x_o, self.readable(x_o))
        self._x_o = _joined(self._x_o, x_o)
        self.event_shape, self.columns["x"] = x_o.shape[1:], known

    def readable(self, x: Tensor) -> Tensor:
        """Tell which x are finite, or can be read by the net in spite of NaN."""
        return readable(self.embedding_net, x)

    def checked_theta(self, name: str, theta: Any) -> Tensor:
        """Return a copy of parameters ``(n, d)``, which have to be finite."""
        theta = as_numbers(name, theta)
        theta = as_batch(name, theta, self._prior.event_shape)
        theta = self._copied(theta)
        check_finite(name, theta)  # float32 may hold less
        return theta

    def _check_order(self, theta: Any, x: Any) -> None:
        if self.event_shape is not None:
            check_not_swapped(theta, x, self._prior.event_shape, self.event_shape)
        check_row_order(theta=theta, x=x)

    def _checked_columns(self, **tables: Any) -> dict[str, KnownColumns]:
        """Return the known orders of columns, with those of these tables."""
        return {
            name: check_columns(name, table, self.columns[name])
            for name, table in tables.items()
        }

    def _checked_x(self, name: str, x: Any) -> Tensor:
        x = as_numbers(name, x)
        if self.event_shape is None and x.ndim < 2:
            raise InvalidInputError(
                f"Expected `{name}` of shape (n, *event); got {tuple(x.shape)}. Pass "
                f"`{name}[None]` for one observation of several numbers, and "
                f"`{name}[:, None]` for observations of one number each."
            )
        shape = x.shape[1:] if self.event_shape is None else self.event_shape
        x = as_batch(name, x, shape, finite=False)
        return self._copied(x)

    def _copied(self, tensor: Tensor) -> Tensor:
        return tensor.detach().to(self._device, torch.float32, copy=True)


def _joined(old: Tensor | None, new: Tensor) -> Tensor:
    return new if old is None else torch.cat([old, new])
