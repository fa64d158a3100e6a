"""How networks are trained on simulations, by sbi."""

import copy
import functools
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import torch
from sbi.neural_nets import posterior_nn
from torch import Tensor

from sbi_rope._random import seeded
from sbi_rope._sbi import ConditionalDensityEstimator, train_npe
from sbi_rope.errors import InvalidInputError
from sbi_rope.fit import History, Training
from sbi_rope.settings import check

__all__ = [
    "EstimatorBuilder",
    "estimator_builder",
    "train_on_simulations",
]

# Returns an untrained estimator for pairs (theta, x) like those it is shown.
EstimatorBuilder = Callable[[Tensor, Tensor], Any]
MIN_SIMULATIONS = 20


def estimator_builder(density_estimator: Any) -> EstimatorBuilder:
    """Return a builder of untrained estimators, from a name or from a builder.

    sbi's builders put the network they were given into what they build, and training
    then changes it. Ours builds from a copy, so that several methods can share one.

    Raises:
        InvalidInputError: If sbi knows no estimator of that name.
    """
    check("density_estimator", density_estimator, str | Callable)
    if isinstance(density_estimator, str):
        _builder_of_name(density_estimator)
    return _CopyingBuilder(density_estimator)


@dataclass(frozen=True)
class _CopyingBuilder:
    """Builds estimators from copies of the networks that sbi's builder was given.

    It holds the name, because sbi's builders cannot be pickled.
    """

    density_estimator: str | EstimatorBuilder

    def __call__(self, theta: Tensor, x: Tensor) -> Any:
        builder = self.density_estimator
        if isinstance(builder, str):
            builder = _builder_of_name(builder)
        modes: dict[Any, bool] = {}

        def in_evaluation_mode(module: Any, inputs: Any) -> None:
            modes.setdefault(module, module.training)
            module.training = False

        # sbi tries the net on one observation, which moves batch statistics.
        hook = torch.nn.modules.module.register_module_forward_pre_hook(
            in_evaluation_mode
        )
        try:
            built = builder(theta, x)
        finally:
            hook.remove()
            for module, training in modes.items():
                module.training = training
        return copy.deepcopy(built)


@functools.cache
def _builder_of_name(name: str) -> EstimatorBuilder:
    """Return sbi's builder of a name, after it has built something once."""
    builder = posterior_nn(name)
    try:
        with seeded(0):
            some = torch.randn(10, 2)
            builder(some, some)
    except Exception as error:
        raise InvalidInputError(
            "Expected `density_estimator` to be one for continuous parameters that "
            f"`posterior_nn` knows; got {name!r}."
        ) from error
    return builder


def train_on_simulations(
    prior: Any,
    build: EstimatorBuilder,
    theta: Tensor,
    x: Tensor,
    *,
    training: Training,
    show_progress_bars: bool,
    change_x: Callable[[Tensor], Tensor] | None = None,
    penalty: Callable[[Any], Tensor | None] | None = None,
) -> tuple[ConditionalDensityEstimator, History]:
    """Train an estimator on simulations with sbi's trainer of NPE.

    Args:
        prior: The prior.
        build: Returns the untrained estimator.
        theta: Parameters, shape ``(n, d)``.
        x: Simulations, shape ``(n, *event)``, on the device to train on.
        training: Batch size, learning rate and so on.
        show_progress_bars: Whether to show the number of epochs.
        change_x: Applied to the x of every batch before its loss is taken.
        penalty: Of the estimator, a term that is added to the loss of every training
            batch; None adds nothing.
    """
    if len(x) < MIN_SIMULATIONS:
        raise InvalidInputError(
            f"Expected at least {MIN_SIMULATIONS} simulations to train on; got "
            f"{len(x)}."
        )
    return train_npe(
        prior,
        build,
        theta,
        x,
        change_x=change_x,
        penalty=penalty,
        show_progress_bars=show_progress_bars,
        **asdict(training),
    )
