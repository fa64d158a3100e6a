"""The arteries of a man of 25: geometry, walls, vascular beds and blood.

The network joins the aorta and its branches with the arteries of the head and hands; it
has loops (circle of Willis, vertebral arteries, palmar arches). All numbers are facts
published with the pulse wave database, in the units of the names below.

References:
    | Modeling arterial pulse waves in healthy aging: a database for in silico
      evaluation of hemodynamics and pulse wave indexes (Charlton et al., 2019)
    | https://doi.org/10.1152/ajpheart.00218.2019
    | https://github.com/peterhcharlton/pwdb, commit 5a0d4727 (MIT licence)
    | One-dimensional haemodynamic modeling and wave dynamics in the entire adult
      circulation (Mynard and Smolich, 2015), which the geometry is adapted from
    | https://doi.org/10.1007/s10439-015-1313-8
"""

from pathlib import Path

import numpy as np

MMHG = 133.322  # Pa

DENSITY = 1060.0  # of blood, kg m^-3
VISCOSITY = 2.5e-3  # of blood, Pa s
PROFILE_EXPONENT = 2.0  # of the velocity profile that friction is calculated for

# Stiffness of a wall: Eh = R (k1 exp(k2 R) + k3), with k3 from the wave velocity.
WALL_K1 = 3e5  # kg s^-2 m^-1
WALL_K2 = -1350.0  # m^-1
# Viscosity of a wall: Gamma = b0 + b1 / D.
WALL_VISCOSITY = 0.6  # b0, kg s^-1
WALL_VISCOSITY_SLOPE = 1.5e-3  # b1, kg m s^-1
MIN_VISCOUS_LENGTH = 0.011  # walls of segments up to this length are elastic, m

# Large arteries, whose diameter varies between persons: mean radius from here on, m.
LARGE_RADIUS = 3.462e-3 * 1.5**0.5

# Segments count from 1, as in the publications.
AORTIC_ROOT = 1
LEFT_BRACHIAL = 21
LEFT_RADIAL = 22
# From the heart to the sites of the wave velocity, in the middle of the last segment.
CAROTID_PATH = (1, 2, 15)
FEMORAL_PATH = (1, 2, 14, 18, 27, 28, 35, 37, 39, 41, 42, 44, 46)

# Vascular beds: segments that end in it, resistance in mmHg s/ml, compliance in
# ml/mmHg. Resistances matter relative to each other only. Beds are named by their
# arteries; the publication calls 32 the liver's, 33 the spleen's, 31 the stomach's.
BEDS = (
    ((62, 63, 69, 70, 72, 73, 74, 76, 93, 95), 6.904, 0.021726),  # brain
    ((78, 80, 82, 84, 86, 88, 89, 90, 91, 92), 20.755, 0.026499),  # face and neck
    ((10, 102, 103, 104, 105), 16.852, 0.032637),  # right arm
    ((24, 112, 113, 114, 115), 16.852, 0.032637),  # left arm
    ((26,), 10.824, 0.050811),  # chest
    ((36,), 8.368, 0.065727),  # kidney
    ((38,), 8.368, 0.065727),  # kidney
    ((32,), 21.252, 0.02606),  # spleen
    ((33,), 27.832, 0.019761),  # stomach
    ((31,), 54.084, 0.010169),  # liver
    ((34, 40), 10.374, 0.053018),  # intestines
    ((45, 51), 26.119, 0.021057),  # pelvis
    ((53,), 32.29, 0.017033),  # right upper leg
    ((47,), 32.29, 0.017033),  # left upper leg
    ((54, 55), 14.786, 0.037197),  # right lower leg
    ((48, 49), 14.824, 0.037102),  # left lower leg
)

# Inlet and outlet node, length, radius at inlet and outlet (mm), shape ``(5, 116)``.
SEGMENTS = np.genfromtxt(
    Path(__file__).parent / "data" / "segments.csv",
    delimiter=",",
    skip_header=1,
    usecols=range(1, 6),
).T
