r"""Networks of openBF, the solver that the pressure waves are compared with.

References:
    | openBF: Julia software for 1D blood flow modelling (Melis, 2018)
    | https://github.com/INSIGNEO/openBF, commit 0376f4dc (Apache-2.0)
    | Gaussian process emulators for 1D vascular models (Melis, 2017), PhD thesis,
      University of Sheffield
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sbi_rope.errors import DataNotFoundError, InvalidInputError
from sbi_rope.tasks.hemodynamics.network import Network, Outlets
from sbi_rope.tasks.hemodynamics.solver import solve

__all__ = ["CASES", "OpenBFCase", "openbf_error", "read_case"]

CASES = ("cca", "ibif", "adan56")
NUM_SAMPLES = 2000  # of the inflow
POISSON_RATIO = 0.5
# Thickness of walls that have none: h = R (a exp(b R) + c exp(d R)).
THICKNESS = (0.2802, -505.3, 0.1324, -11.14)


@dataclass(frozen=True, kw_only=True)
class OpenBFCase:
    """A network, its inflow, and the pressures that openBF found.

    Attributes:
        network: The network.
        labels: Name of each vessel.
        period: Length of a beat, in s.
        num_cycles: Beats that openBF simulated, from its own start.
        inflow_time: When the inflow is given, in s.
        inflow: In m^3 s^-1.
        time: When the pressures are given, in s since the start of the last beat.
        pressure: In the middle of each vessel, in Pa, shape ``(m, n)``.
    """

    network: Network
    labels: list[str]
    period: float
    num_cycles: int
    inflow_time: np.ndarray
    inflow: np.ndarray
    time: np.ndarray
    pressure: np.ndarray


def read_case(folder: Path, name: str) -> OpenBFCase:
    r"""Read a case of openBF.

    Walls follow :math:`p = p_{ext} + \beta (\sqrt{A / A_0} - 1)` with :math:`\beta =
    \sqrt{\pi / A_0} h_0 E / (1 - \sigma^2)`, which is the tube law of
    :class:`Network`. The taper of version 2 of openBF multiplies by the length of a
    cell twice and so has no effect: vessels are cylinders of their proximal radius.

    Args:
        folder: Where ``<name>.yaml``, ``<name>_inlet.dat`` and ``ref_<name>.npz`` are.
        name: ``"cca"``, ``"ibif"`` or ``"adan56"``.

    Raises:
        DataNotFoundError: If a file is not there.
        InvalidInputError: If the network cannot be read.
    """
    paths = [folder / f"{name}.yaml", folder / f"{name}_inlet.dat"]
    paths.append(folder / f"ref_{name}.npz")
    for path in paths:
        if not path.is_file():
            raise DataNotFoundError(f"Expected the openBF case {name!r} at {path}.")
    text = paths[0].read_text()
    inlet = np.loadtxt(paths[1], ndmin=2)
    vessels = _vessels(text, paths[0])
    labels = [vessel["label"] for vessel in vessels]
    with np.load(paths[2]) as reference:
        waves = [reference[f"{label}__P"] for label in labels]
    period = float(inlet[-1, 0])
    num_cycles = round(float(waves[0][-1, 0]) / period)
    return OpenBFCase(
        network=_network(vessels, text, paths[0]),
        labels=labels,
        period=period,
        num_cycles=num_cycles,
        inflow_time=inlet[:, 0],
        inflow=inlet[:, 1],
        time=waves[0][:, 0] - (num_cycles - 1) * period,
        pressure=np.stack([wave[:, 3] for wave in waves]),
    )


def openbf_error(reference: Path, case: str, *, cell_length: float = 0.01) -> float:
    """Return the difference from openBF, in % of the mean pressure.

    It is the root mean square over the last beat in the middle of a vessel, averaged
    over vessels. Both start from an empty network and simulate as many beats.
    """
    given = read_case(reference, case)
    time = np.arange(NUM_SAMPLES) / NUM_SAMPLES * given.period
    flow = solve(
        given.network,
        np.interp(time, given.inflow_time, given.inflow),
        given.period,
        sites=[(segment, 0.5) for segment in range(len(given.labels))],
        start_pressure=float(given.network.reference_pressure[0]),
        stored_pressure=np.zeros(len(given.network.outlets.segment)),
        cell_length=cell_length,
        courant=0.6,
        num_cycles=given.num_cycles,
        convection=1.0,
    )
    waves = flow.at(given.time / given.period)
    error = np.sqrt(((waves - given.pressure) ** 2).mean(axis=1))
    return float(100 * (error / given.pressure.mean(axis=1)).mean())


def _vessels(text: str, path: Path) -> list[dict[str, str]]:
    """Return the settings of each vessel: the list after ``network:``."""
    network = text.split("network:", 1)[-1]
    vessels = [
        dict(re.findall(r"(\w+):\s*(\S+)", entry))
        for entry in re.split(r"^\s*-\s", network, flags=re.MULTILINE)[1:]
    ]
    required = {"label", "sn", "tn", "L", "E"}
    if not vessels or not all(required <= vessel.keys() for vessel in vessels):
        raise InvalidInputError(
            f"Expected vessels with {sorted(required)} under `network:` in {path}."
        )
    return vessels


def _network(vessels: list[dict[str, str]], text: str, path: Path) -> Network:
    def column(key: str, default: float | None = None) -> np.ndarray:
        return np.array([float(vessel.get(key, default)) for vessel in vessels])  # type: ignore[arg-type]

    blood = dict(re.findall(r"^\s+(rho|mu):\s*(\S+)", text, flags=re.MULTILINE))
    if len(blood) != 2:
        raise InvalidInputError(f"Expected `rho` and `mu` of blood in {path}.")
    density, viscosity = float(blood["rho"]), float(blood["mu"])
    radius = np.array([float(v.get("Rp", v.get("R0", "nan"))) for v in vessels])
    a, b, c, d = THICKNESS
    thickness = radius * (a * np.exp(b * radius) + c * np.exp(d * radius))
    thickness = np.where(column("h0", 0) > 0, column("h0", 0), thickness)
    # beta of the tube law is 4/3 sqrt(pi) E h: the factor is in 1 / (1 - sigma^2).
    stiffness = 0.75 * column("E") * thickness / (1 - POISSON_RATIO**2)
    zeros = np.zeros(len(vessels))
    source = set(column("sn").astype(int)) - set(column("tn").astype(int))
    segment = np.flatnonzero(column("Cc", 0) > 0)
    return Network(
        inlet_node=column("sn").astype(int) - 1,
        outlet_node=column("tn").astype(int) - 1,
        length=column("L"),
        inlet_radius=radius,
        outlet_radius=radius,
        stiffness=np.stack([zeros, zeros, stiffness / radius]),
        wall_viscosity=np.stack([zeros, zeros]),
        reference_pressure=column("Pext", 0),
        friction=2 * (column("gamma_profile", 2) + 2) * np.pi * viscosity / density,
        density=density,
        source_node=source.pop() - 1,
        outlets=Outlets(
            segment=segment,
            proximal_resistance=column("R1", 0)[segment],
            distal_resistance=column("R2", 0)[segment],
            compliance=column("Cc", 0)[segment],
            pressure=0.0,
        ),
    )
