"""The data that a method was shown, checked and kept on one device."""

from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from sbi_rope._sbi import readable
from sbi_rope.data import Pairs
from sbi_rope.errors import InvalidInputError, warn_user
from sbi_rope.tensors import as_batch, check_in_support, column_names, rows_with

__all__ = ["Data", "Kind"]

Kind = Literal["simulations", "calibration", "observations"]


class Data:
    """Simulations, calibration pairs and observations with x of the same shape.

    All are copied, in float32. Nothing is added of what does not fit. Tables whose
    columns have the names of an earlier table are put into its order.

    Args:
        prior: Over parameters of shape ``(d,)``, on the device.
        device: Where the data are kept.

    Attributes:
        event_shape: Shape of one x, that of the first which was appended; None before.
        embedding_net: The net that is to read x, if it was trained beforehand. Missing
            entries (NaN) are accepted if it can read them.
        theta_names: The names of the columns of the first table of theta.
        x_names: The names of the columns of the first table of x.
    """

    def __init__(self, prior: Distribution, device: torch.device) -> None:
        self._prior = prior
        self._device = device
        self._tensors: dict[Kind, tuple[Tensor, ...]] = {}
        self.event_shape: torch.Size | None = None
        self.embedding_net: nn.Module = nn.Identity()
        self.theta_names: tuple[str, ...] | None = None
        self.x_names: tuple[str, ...] | None = None

    @property
    def simulations(self) -> tuple[Tensor, Tensor]:
        """Theta ``(n, d)`` and simulated x ``(n, *event)``."""
        theta, x = self._tensors["simulations"]
        return theta, x

    @property
    def calibration(self) -> tuple[Tensor, Tensor]:
        """Theta ``(n, d)`` and the real x ``(n, *event)`` recorded at them."""
        theta, x = self._tensors["calibration"]
        return theta, x

    @property
    def pairs(self) -> Pairs:
        """The calibration pairs, whose labels are exact."""
        return Pairs.exact(*self.calibration)

    @property
    def observations(self) -> Tensor:
        """Real x without parameters, ``(n_o, *event)``."""
        return self._tensors["observations"][0]

    def count(self, kind: Kind) -> int:
        """Return how many simulations, calibration pairs or observations there are."""
        return len(self._tensors[kind][0]) if kind in self._tensors else 0

    def append_simulations(self, theta: Any, x: Any) -> None:
        """Add simulations; those with NaN or Inf are dropped with a warning."""
        theta_s, x_s, valid = self._read(theta, x)
        if not valid.any():
            raise InvalidInputError(
                "Expected simulations `x` that are finite; all contain NaN or Inf."
            )
        if not valid.all():
            warn_user(
                f"Dropped {int((~valid).sum())} of {len(x)} simulations because they "
                "contain NaN or Inf."
            )
        self._add("simulations", theta_s[valid], x_s[valid])
        self._remember_names(theta, x)

    def append_calibration(self, theta: Any, x: Any) -> None:
        """Add calibration pairs."""
        theta_cal, x_cal, valid = self._read(theta, x)
        self._add("calibration", theta_cal, _finite("x", x_cal, valid))
        self._remember_names(theta, x)

    def append_observations(self, x_o: Any) -> None:
        """Add observations without parameters."""
        x, valid = self._read_x("x_o", x_o)
        self._add("observations", _finite("x_o", x, valid))
        self._remember_names(None, x_o)

    def readable(self, x: Tensor) -> Tensor:
        """Tell which x are finite, or can be read by the net in spite of NaN."""
        return readable(self.embedding_net, x)

    def read_theta(self, theta: Any) -> Tensor:
        """Return a copy of parameters of a user, shape ``(n, d)``."""
        shape = self._prior.event_shape
        return self._copied(as_batch("theta", theta, shape, names=self.theta_names))

    def _read(self, theta: Any, x: Any) -> tuple[Tensor, Tensor, Tensor]:
        """Return copies of theta and x, and which x can be read."""
        theta = self.read_theta(theta)
        check_in_support("theta", theta, self._prior)
        return theta, *self._read_x("x", x, rows=len(theta))

    def _read_x(
        self, name: str, x: Any, rows: int | None = None
    ) -> tuple[Tensor, Tensor]:
        x = as_batch(
            name, x, self.event_shape, rows=rows, names=self.x_names, finite=False
        )
        if x.ndim < 2:
            raise InvalidInputError(
                f"Expected `{name}` of shape (n, *event); got {tuple(x.shape)}. For "
                f"one number in each row pass `{name}[:, None]`."
            )
        x = self._copied(x)
        return x, self.readable(x)

    def _add(self, kind: Kind, *new: Tensor) -> None:
        old = self._tensors.get(kind, tuple(one[:0] for one in new))
        self._tensors[kind] = tuple(map(torch.cat, zip(old, new, strict=True)))
        self.event_shape = new[-1].shape[1:]

    def _remember_names(self, theta: Any, x: Any) -> None:
        self.theta_names = self.theta_names or column_names(theta)
        self.x_names = self.x_names or column_names(x)

    def _copied(self, tensor: Tensor) -> Tensor:
        return tensor.to(self._device, torch.float32, copy=True)


def _finite(name: str, x: Tensor, valid: Tensor) -> Tensor:
    """Return x if all rows can be read; some nets can read missing trials (NaN)."""
    if valid.all():
        return x
    raise InvalidInputError(
        f"Expected `{name}` to be finite; got NaN or Inf in {rows_with(~valid)}."
    )
