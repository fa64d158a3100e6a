"""How networks are trained on simulations, by sbi."""

import copy
import functools
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from sbi.neural_nets import posterior_nn
from torch import Tensor
from torch.nn.modules.module import register_module_forward_pre_hook

from sbi_rope._sbi import ConditionalDensityEstimator, SimulationTrainer
from sbi_rope.errors import InvalidInputError
from sbi_rope.fit import History, Training
from sbi_rope.settings import check

# Returns an untrained estimator for pairs (theta, x) like those it is shown.
EstimatorBuilder = Callable[[Tensor, Tensor], Any]
MIN_SIMULATIONS = 20


def estimator_builder(density_estimator: Any) -> EstimatorBuilder:
    """Return a builder of untrained estimators, with copies of the given network."""
    check("density_estimator", density_estimator, str | Callable)
    # It holds the name, because sbi's builders cannot be pickled.
    return functools.partial(_build, density_estimator)


def _build(density_estimator: Any, theta: Tensor, x: Tensor) -> Any:
    builder = density_estimator
    if isinstance(builder, str):
        builder = posterior_nn(builder)
    modes: dict[Any, bool] = {}

    def in_evaluation_mode(module: Any, inputs: Any) -> None:
        modes.setdefault(module, module.training)
        module.training = False

    # sbi tries the net on one observation, which moves batch statistics.
    hook = register_module_forward_pre_hook(in_evaluation_mode)
    try:
        built = builder(theta, x)
    finally:
        hook.remove()
        for module, training in modes.items():
            module.training = training
    return copy.deepcopy(built)


def train_on_simulations(
    prior: Any,
    build: EstimatorBuilder,
    theta: Tensor,
    x: Tensor,
    *,
    training: Training,
    show_progress_bars: bool,
    **options: Any,
) -> tuple[ConditionalDensityEstimator, History]:
    """Train what ``build`` returns on simulations, with sbi's trainer of NPE.

    ``theta`` has the shape ``(n, d)``, and x, ``(n, *event)``, is on the device to
    train on. Other options are those of :class:`~sbi_rope._sbi.SimulationTrainer`.
    """
    if len(x) < MIN_SIMULATIONS:
        raise InvalidInputError(
            f"Expected at least {MIN_SIMULATIONS} simulations to train on; got "
            f"{len(x)}."
        )
    trainer = SimulationTrainer(
        prior=prior,
        density_estimator=build,
        device=str(x.device),
        show_progress_bars=show_progress_bars,
        **options,
    )
    trainer.append_simulations(theta, x)
    settings = asdict(training)
    # sbi trains one epoch more than it is told, and at least two.
    settings["max_num_epochs"] = max(1, training.max_num_epochs - 1)
    estimator = trainer.train(**settings)
    losses = trainer.summary["validation_loss"]
    best = min(range(len(losses)), key=losses.__getitem__)
    history = History(
        trainer.summary["training_loss"], losses, best, training.learning_rate
    )
    return estimator.eval(), history
