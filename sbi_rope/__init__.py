"""Robust posterior estimation for misspecified simulators, on top of sbi."""

from sbi_rope.coupling import Coupling, SinkhornCoupler
from sbi_rope.data.simulate import parallel
from sbi_rope.density import MixturePosterior
from sbi_rope.diagnosis import Diagnosis, diagnose
from sbi_rope.rope.finetuning import CalibrationFinetuner
from sbi_rope.rope.rope import RoPE
from sbi_rope.saving import load, save
from sbi_rope.stacking import StackedPosterior, stack

__all__ = [
    "CalibrationFinetuner",
    "Coupling",
    "Diagnosis",
    "MixturePosterior",
    "RoPE",
    "SinkhornCoupler",
    "StackedPosterior",
    "diagnose",
    "load",
    "parallel",
    "save",
    "stack",
]

__version__ = "0.1.0"
