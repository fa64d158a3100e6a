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

__all__ = [
    "AORTIC_ROOT",
    "BEDS",
    "CAROTID_PATH",
    "DENSITY",
    "FEMORAL_PATH",
    "LARGE_RADIUS",
    "LEFT_BRACHIAL",
    "LEFT_RADIAL",
    "MIN_VISCOUS_LENGTH",
    "MMHG",
    "PROFILE_EXPONENT",
    "SEGMENTS",
    "VISCOSITY",
    "WALL_K1",
    "WALL_K2",
    "WALL_VISCOSITY",
    "WALL_VISCOSITY_SLOPE",
]

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

# Name, inlet node, outlet node, length in mm, radius at the inlet and outlet in mm.
SEGMENTS = (
    ("ascending aorta", 1, 2, 60.0, 18.206, 18.004),
    ("aortic arch I", 2, 3, 20.0, 15.799, 15.799),
    ("brachiocephalic", 2, 4, 34.0, 8.561, 8.561),
    ("right subclavian I", 4, 5, 34.0, 7.348, 6.736),
    ("right common carotid", 4, 6, 94.0, 4.899, 4.225),
    ("right vertebral", 5, 7, 149.0, 2.266, 1.715),
    ("right brachial", 5, 8, 422.0, 6.736, 2.89),
    ("right radial", 8, 9, 235.0, 1.592, 1.31),
    ("right ulnar I", 8, 10, 67.0, 2.633, 2.633),
    ("right interosseous", 10, 11, 79.0, 1.115, 1.115),
    ("right ulnar II", 10, 12, 171.0, 2.449, 2.241),
    ("right internal carotid", 6, 13, 178.0, 3.491, 2.633),
    ("right external carotid I", 6, 14, 41.0, 3.062, 2.756),
    ("aortic arch II", 3, 15, 39.0, 15.187, 15.187),
    ("left common carotid", 3, 16, 139.0, 4.532, 3.95),
    ("left internal carotid", 16, 17, 178.0, 3.246, 2.511),
    ("left external carotid I", 16, 18, 41.0, 2.878, 2.633),
    ("descending thoracic aorta I", 15, 19, 52.0, 13.472, 12.235),
    ("left subclavian I", 15, 20, 34.0, 6.736, 6.124),
    ("left vertebral", 20, 7, 148.0, 2.266, 1.715),
    ("left brachial", 20, 22, 422.0, 5.695, 2.89),
    ("left radial", 22, 23, 235.0, 1.592, 1.31),
    ("left ulnar I", 22, 24, 67.0, 2.633, 2.633),
    ("left interosseous", 24, 25, 79.0, 1.115, 1.115),
    ("left ulnar II", 24, 26, 171.0, 2.449, 2.241),
    ("intercostal", 19, 27, 80.0, 1.47, 1.47),
    ("descending thoracic aorta II", 19, 28, 104.0, 10.655, 8.696),
    ("abdominal aorta I", 28, 29, 53.0, 7.471, 7.471),
    ("celiac", 28, 30, 20.0, 4.654, 4.654),
    ("celiac II", 30, 31, 10.0, 3.674, 3.674),
    ("hepatic", 30, 32, 71.0, 3.552, 3.368),
    ("splenic", 31, 33, 66.0, 2.939, 2.939),
    ("gastric", 31, 34, 63.0, 2.449, 2.449),
    ("superior mesenteric", 29, 35, 59.0, 3.674, 3.674),
    ("abdominal aorta II", 29, 36, 10.0, 7.226, 7.226),
    ("left renal", 36, 37, 32.0, 3.184, 3.184),
    ("abdominal aorta III", 36, 38, 10.0, 6.981, 6.981),
    ("right renal", 38, 39, 32.0, 3.184, 3.184),
    ("abdominal aorta IV", 38, 40, 106.0, 6.736, 6.491),
    ("inferior mesenteric", 40, 41, 50.0, 1.96, 1.96),
    ("abdominal aorta V", 40, 42, 10.0, 6.369, 6.124),
    ("left common iliac", 42, 44, 58.0, 4.507, 4.287),
    ("right common iliac", 42, 43, 59.0, 4.507, 4.287),
    ("left external iliac", 44, 45, 144.0, 3.429, 3.307),
    ("left internal iliac", 44, 46, 50.0, 3.226, 3.226),
    ("left femoral", 45, 47, 443.0, 3.062, 2.327),
    ("left deep femoral", 45, 48, 126.0, 1.837, 1.527),
    ("left posterior tibial", 47, 49, 321.0, 1.898, 1.715),
    ("left anterior tibial", 47, 50, 343.0, 1.592, 1.408),
    ("right external iliac", 43, 51, 145.0, 3.429, 3.307),
    ("right internal iliac", 43, 52, 50.0, 3.226, 3.226),
    ("right femoral", 51, 53, 444.0, 3.062, 2.327),
    ("right deep femoral", 51, 54, 127.0, 1.837, 1.527),
    ("right posterior tibial", 53, 55, 322.0, 1.898, 1.715),
    ("right anterior tibial", 53, 56, 344.0, 1.592, 1.408),
    ("basilar II", 7, 21, 15.0, 2.449, 2.327),
    ("basilar I", 21, 57, 10.0, 2.327, 1.653),
    ("right posterior cerebral I", 57, 58, 4.0, 1.164, 1.164),
    ("left posterior cerebral I", 57, 59, 4.0, 1.164, 1.164),
    ("right posterior communicating", 58, 60, 4.0, 0.919, 0.919),
    ("left posterior communicating", 59, 61, 4.0, 0.919, 0.919),
    ("right posterior cerebral II", 58, 62, 59.0, 1.225, 1.102),
    ("left posterior cerebral II", 59, 63, 59.0, 1.225, 1.102),
    ("right distal internal carotid I", 60, 64, 4.0, 2.388, 2.327),
    ("left distal internal carotid I", 61, 65, 4.0, 2.388, 2.327),
    ("right anterior cerebral I", 66, 67, 12.0, 1.286, 1.225),
    ("left anterior cerebral I", 68, 69, 12.0, 1.286, 1.225),
    ("right middle cerebral", 66, 70, 8.0, 1.837, 1.715),
    ("right superior middle cerebral", 70, 71, 71.0, 1.225, 1.225),
    ("right inferior middle cerebral", 70, 72, 70.0, 1.225, 1.225),
    ("left middle cerebral", 68, 73, 8.0, 1.837, 1.715),
    ("left superior middle cerebral", 73, 74, 71.0, 1.225, 1.225),
    ("left inferior middle cerebral", 73, 75, 70.0, 1.225, 1.225),
    ("right anterior cerebral II", 67, 76, 24.0, 1.102, 1.041),
    ("anterior communicating", 67, 69, 4.0, 0.796, 0.796),
    ("left anterior cerebral II", 69, 77, 24.0, 1.102, 1.041),
    ("right internal carotid sinus", 13, 60, 11.0, 2.633, 2.388),
    ("right ophthalmic", 13, 78, 11.0, 0.612, 0.306),
    ("left internal carotid sinus", 17, 61, 11.0, 2.633, 2.388),
    ("left ophthalmic", 17, 79, 11.0, 0.612, 0.306),
    ("right external carotid II", 14, 80, 61.0, 2.449, 2.143),
    ("right superior thyroid and neighbours", 14, 81, 101.0, 1.715, 1.715),
    ("left external carotid II", 18, 82, 61.0, 2.449, 2.143),
    ("left superior thyroid and neighbours", 18, 83, 101.0, 1.347, 0.98),
    ("right superior temporal", 80, 84, 61.0, 1.96, 1.837),
    ("right maxillary", 80, 85, 91.0, 1.347, 0.612),
    ("left superior temporal", 82, 86, 61.0, 1.96, 1.837),
    ("left maxillary", 82, 87, 91.0, 1.347, 0.612),
    ("right superior temporal frontal", 84, 88, 100.0, 1.347, 0.857),
    ("right superior temporal parietal", 84, 89, 101.0, 1.347, 0.857),
    ("left superior temporal frontal", 86, 90, 100.0, 1.347, 0.857),
    ("left superior temporal parietal", 86, 91, 101.0, 1.347, 0.857),
    ("right anterior choroidal", 64, 92, 36.0, 0.919, 0.796),
    ("right distal internal carotid II", 64, 66, 4.0, 2.327, 2.327),
    ("left anterior choroidal", 65, 93, 36.0, 0.919, 0.796),
    ("left distal internal carotid II", 65, 68, 4.0, 2.327, 2.327),
    ("right deep palmar arch III", 9, 94, 30.0, 0.703, 0.703),
    ("right superficial palmar arch III", 9, 95, 10.0, 1.217, 1.217),
    ("right deep palmar arch I", 12, 96, 30.0, 1.47, 1.47),
    ("right superficial palmar arch I", 12, 97, 10.0, 1.911, 1.911),
    ("right superficial palmar arch II", 95, 97, 10.0, 1.106, 1.106),
    ("right digital III", 95, 98, 30.0, 0.998, 0.998),
    ("right digital II", 97, 99, 30.0, 1.531, 1.531),
    ("right digital IV", 94, 100, 15.0, 0.703, 0.703),
    ("right digital I", 96, 101, 25.0, 1.47, 1.47),
    ("right deep palmar arch II", 94, 96, 30.0, 0.806, 0.806),
    ("left deep palmar arch III", 23, 102, 30.0, 0.703, 0.703),
    ("left superficial palmar arch III", 23, 103, 10.0, 1.217, 1.217),
    ("left deep palmar arch I", 26, 104, 30.0, 1.47, 1.47),
    ("left superficial palmar arch I", 26, 105, 10.0, 1.911, 1.911),
    ("left superficial palmar arch II", 103, 105, 10.0, 1.106, 1.106),
    ("left digital III", 103, 106, 30.0, 0.998, 0.998),
    ("left digital II", 105, 107, 30.0, 1.531, 1.531),
    ("left digital IV", 102, 108, 15.0, 0.703, 0.703),
    ("left digital I", 104, 109, 25.0, 1.47, 1.47),
    ("left deep palmar arch II", 102, 104, 30.0, 0.806, 0.806),
)
