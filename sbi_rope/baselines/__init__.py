"""The methods RoPE is compared with, each used like an sbi trainer or posterior.

When to prefer which, and where they differ from the original code, is on the page about
:doc:`the methods </background/methods>`.
"""

from sbi_rope.baselines.calibration_mlp import CalibrationMLP
from sbi_rope.baselines.error_model import SpikeAndSlab
from sbi_rope.baselines.fmcpe import FMCPE
from sbi_rope.baselines.frisbi import FRISBI
from sbi_rope.baselines.hvae import HVAE
from sbi_rope.baselines.joint_npe import JointNPE
from sbi_rope.baselines.nnpe import NNPE
from sbi_rope.baselines.npe import PlainNPE, PriorBaseline, ReferenceNPE
from sbi_rope.baselines.npe_rs import NPERS
from sbi_rope.baselines.regression import Regression
from sbi_rope.baselines.rnpe import RNPE
from sbi_rope.baselines.rope_parts import OTOnly, TuningOnly
from sbi_rope.baselines.rvnp import RVNP

__all__ = [
    "FMCPE",
    "FRISBI",
    "HVAE",
    "NNPE",
    "NPERS",
    "RNPE",
    "RVNP",
    "CalibrationMLP",
    "JointNPE",
    "OTOnly",
    "PlainNPE",
    "PriorBaseline",
    "ReferenceNPE",
    "Regression",
    "SpikeAndSlab",
    "TuningOnly",
]
