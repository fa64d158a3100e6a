"""The hyper-parameters the paper states for its tasks, as data."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class PaperSettings:
    """What the paper trained a task's models with, or ``None`` where it does not say.

    The estimator is a flow of one unconstrained monotonic autoregressive
    transformation (sbi's ``"zuko_unaf"``) or, in task D, of five affine ones
    (``"maf"``), trained with Adam. RoPE couples as many
    simulations as there are test observations at ``gamma`` and ``tau``, RoPE* at
    ``tau_relaxed``; a fifth of every calibration set is held out.

    Attributes:
        density_estimator: Name of the flow for sbi's ``posterior_nn``.
        conditioner: Widths of the hidden layers of the flow's conditioner.
        integrand: Widths of the hidden layers of the monotonic transformation; empty
            for affine ones.
        learning_rate: Of NPE.
        batch_size: Of NPE.
        num_steps: Gradient steps of NPE; ``None`` is "until convergence".
        num_validation: Simulations that the best NPE was chosen on.
        finetuning_learning_rate: Of RoPE's second step.
        finetuning_steps: Gradient steps of RoPE's second step.
        joint_epochs: Epochs of J-NPE.
        joint_epoch_size: Simulations in an epoch of J-NPE.
        num_test: Test observations.
        gamma: Entropic regularisation, in units of the embedding.
        tau: Trust in the prior of RoPE.
        tau_relaxed: Trust in the prior of RoPE*.
    """

    density_estimator: str = "zuko_unaf"
    conditioner: tuple[int, ...] = (100, 100, 100)
    integrand: tuple[int, ...] = (100, 100, 100)
    learning_rate: float = 5e-4
    batch_size: int | None = 100
    num_steps: int | None = None
    num_validation: int = 10_000
    finetuning_learning_rate: float | None = 1e-4
    finetuning_steps: int | None
    joint_epochs: int | None = 50
    joint_epoch_size: int | None
    num_test: int = 2000
    gamma: float = 0.5
    tau: float = 1.0
    tau_relaxed: float = 0.9


# The paper describes tasks A and B, whose observations are statistics, together.
STATISTICS_SETTINGS = PaperSettings(
    batch_size=None,
    num_steps=1_000_000,
    num_validation=100_000,
    finetuning_learning_rate=None,
    finetuning_steps=None,
    joint_epochs=None,
    joint_epoch_size=None,
)
