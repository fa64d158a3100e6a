"""Benchmarks of inference under a misspecified simulator.

Each task is a prior, a simulator, an embedding network, and real observations with
known parameters; see :class:`Task`. "The paper" is Addressing Misspecification in
Simulation-based Inference through Data-driven Calibration (Wehenkel et al.,
https://arxiv.org/abs/2405.08719). What is not as printed there is listed in
``docs/background/paper.md``.
"""

from pathlib import Path
from typing import Any

from sbi_rope.tasks.base import Task
from sbi_rope.tasks.cs import CancerStroma
from sbi_rope.tasks.hemodynamics.task import Hemodynamics
from sbi_rope.tasks.light_tunnel import LightTunnel
from sbi_rope.tasks.light_tunnel_sensors import LightTunnelSensors
from sbi_rope.tasks.linear_gaussian import LinearGaussian
from sbi_rope.tasks.near_infrared import NearInfrared
from sbi_rope.tasks.ocean_colour import OceanColour
from sbi_rope.tasks.pendulum import Pendulum
from sbi_rope.tasks.sir import SIR
from sbi_rope.tasks.wind_tunnel import WindTunnel
from sbi_rope.utils.settings import check, one_of

__all__ = ["TASKS", "Task", "get_task", "list_tasks"]

TASKS: dict[str, type[Task]] = {
    "cs": CancerStroma,
    "hemodynamics": Hemodynamics,
    "light_tunnel": LightTunnel,
    "light_tunnel_sensors": LightTunnelSensors,
    "linear_gaussian": LinearGaussian,
    "near_infrared": NearInfrared,
    "ocean_colour": OceanColour,
    "pendulum": Pendulum,
    "sir": SIR,
    "wind_tunnel": WindTunnel,
}


def list_tasks() -> list[str]:
    """Return the names of all tasks, in alphabetical order.

    Example:
        >>> "pendulum" in list_tasks()
        True
    """
    return sorted(TASKS)


def get_task(
    name: str,
    *,
    variant: str | None = None,
    root: str | Path | None = None,
    **options: Any,
) -> Task:
    """Return a task by its name.

    Args:
        name: One of :func:`list_tasks`.
        variant: A kind of real process, one of the task's ``variants``.
        root: Folder that holds recorded data. Synthetic tasks do not read it.
        **options: The task's own options, see the documentation of its class.

    Raises:
        InvalidInputError: If the task or the variant does not exist.

    Example:
        >>> get_task("pendulum", variant="misspecified_prior").parameter_names
        ('omega_0', 'A')
    """
    check("name", name, one_of(list_tasks()))
    return TASKS[name](variant=variant, root=root, **options)
