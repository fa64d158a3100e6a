"""What methods are run with, task by task."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from sbi.neural_nets import posterior_nn

from sbi_rope import CalibrationFinetuner
from sbi_rope.methods import Training
from sbi_rope.tasks import Task


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Simulations, flow and training of one task; the same for all methods.

    Attributes:
        num_simulations: Pairs that NPE and the methods like it are trained on.
        training: How these are trained.
        n_test: Test observations, or all there are if that is less.
        num_samples: Posterior samples of each behind the calibration scores.
        light_net: Whether the small embedding net of the task is used.
        flow: Name of the flow for sbi's ``posterior_nn``.
        flow_options: Its options.
        finetuner: Settings of the fine-tuning of RoPE.
        own_training: How methods are trained whose papers, or whose goals, ask for a
            training of their own; None for that.
        num_folds: Folds of the pairs of a stack.
    """

    num_simulations: int
    training: Training
    n_test: int = 1000
    num_samples: int = 500
    light_net: bool = True
    flow: str = "nsf"
    flow_options: dict[str, Any] = field(default_factory=lambda: {"num_transforms": 2})
    finetuner: CalibrationFinetuner = field(default_factory=CalibrationFinetuner)
    own_training: Training | None = None
    num_folds: int = 5

    def builder(self, task: Task) -> Any:
        """Return the builder of untrained estimators."""
        return posterior_nn(
            self.flow,
            embedding_net=task.get_embedding_net(light=self.light_net),
            z_score_x=task.z_score_x,
            **self.flow_options,
        )


def smoke(task: Task) -> Settings:
    """Return settings that show that everything runs, and nothing else."""
    training = Training(training_batch_size=50, max_num_epochs=3)
    return Settings(
        num_simulations=300,
        training=training,
        n_test=40,
        num_samples=50,
        flow="maf",
        flow_options={"num_transforms": 1, "hidden_features": 10},
        finetuner=CalibrationFinetuner(max_num_epochs=20, simulations_per_target=5),
        own_training=training,
        num_folds=2,
    )


def standard(task: Task) -> Settings:
    """Return spline flows and light nets, for two cores and an afternoon."""
    num_simulations, batch_size, max_num_epochs = {
        "light_tunnel": (5_000, 100, 20),
        "pendulum": (10_000, 100, 30),
        "hemodynamics": (18_000, 100, 30),
    }.get(task.name, (20_000, 200, 40))
    return Settings(
        num_simulations=num_simulations,
        training=Training(
            training_batch_size=batch_size,
            learning_rate=1e-3,
            stop_after_epochs=10,
            max_num_epochs=max_num_epochs,
        ),
    )


def paper(task: Task) -> Settings:
    """Return the paper's networks, flows and steps, for a GPU."""
    stated = task.paper_settings
    if stated is None:
        raise ValueError(f"{task.name} is not in the paper; use another preset.")
    batch_size = stated.batch_size or 100
    num_simulations = 100_000
    steps_per_epoch = num_simulations // batch_size
    return Settings(
        num_simulations=num_simulations,
        training=Training(
            training_batch_size=batch_size,
            learning_rate=stated.learning_rate,
            max_num_epochs=(stated.num_steps or 1_000_000) // steps_per_epoch,
        ),
        n_test=stated.num_test,
        num_samples=5000,
        light_net=False,
        flow=stated.density_estimator,
        flow_options=(
            {
                "num_transforms": 1,
                "hidden_features": list(stated.conditioner),
                "network": {"hidden_features": list(stated.integrand)},
            }
            if stated.density_estimator == "zuko_unaf"
            # sbi's affine flow has one width for all hidden layers.
            else {
                "num_transforms": 5,
                "hidden_features": stated.conditioner[0],
                "num_blocks": len(stated.conditioner),
            }
        ),
        finetuner=CalibrationFinetuner(
            learning_rate=stated.finetuning_learning_rate or 1e-4,
            max_num_epochs=stated.finetuning_steps or 5000,
            stop_after_epochs=stated.finetuning_steps or 5000,
        ),
    )


PRESETS: dict[str, Callable[[Task], Settings]] = {
    "smoke": smoke,
    "standard": standard,
    "paper": paper,
}
