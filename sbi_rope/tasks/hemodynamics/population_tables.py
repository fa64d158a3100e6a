"""How hearts, pressures and arteries vary between healthy men of 25 to 75 years.

Numbers as used by pwdb; the studies that they come from are named with each.

References:
    | Modeling arterial pulse waves in healthy aging: a database for in silico
      evaluation of hemodynamics and pulse wave indexes (Charlton et al., 2019)
    | https://doi.org/10.1152/ajpheart.00218.2019
    | https://github.com/peterhcharlton/pwdb, commit 5a0d4727 (MIT licence)
"""

import numpy as np

AGES = (25.0, 75.0)  # years
MODEL_AGE = 25.0  # whose arteries are those of the table of segments

# Stroke volume by age in ml, 5 and 95 % quantile; Poppe et al. 2015.
SV_LOW, SV_HIGH = (42.94, -0.1193), (102.35, -0.3856)
QUANTILE_SPAN = 3.2897  # standard deviations between the two

# Heart rate: where the curve of Yashin et al. 2006 runs on an axis of 94 units, from 66
# at 5 units on, with 12 beats per minute for 94 units; spread of Petersen et al. 2017.
HR_AGES = np.arange(32.5, 95.0, 5.0)
HR_CURVE = np.array([80, 95, 97.5, 96, 94, 93, 90, 84, 76, 66, 57, 51, 51])
HR_MEANS = 66.0 + 12.0 * (HR_CURVE - 5.0) / 94.0
HEART_RATE_SD = 11.0

# Ejection time in ms: mean of Mynard and Smolich 2015, relative spread of Gerstenblith
# et al. 1977.
EJECTION_TIME = (282.0, 282.0 * 24.43 / 295.29)
# Time of the peak flow in ms, Kamimura et al. 2016; reverse flow in ml, Bensalah et al.
# 2014; pressure behind the microcirculation in mmHg, Parazynski et al. 1993.
PEAK_FLOW_TIME = (79.0, 11.0)
REGURGITANT_VOLUME = (0.73, 0.63)
OUTFLOW_PRESSURE = (33.2, 1.5 * 13.0**0.5)

# Pressures in mmHg, McEniery et al. 2005.
PRESSURE_AGES = np.arange(15.5, 86.0, 10.0)
MEAN_PRESSURES = np.array([88, 89, 92, 95, 95, 94, 93, 92])
MEAN_PRESSURE_SDS = np.array([8, 8, 8, 7, 7, 7, 7, 8])
DIASTOLIC_PRESSURES = np.array([73, 75, 77, 79, 79, 78, 76, 75])

# Carotid-femoral pulse-wave velocity in m/s, Mattace-Raso et al. 2010: quantiles by age
# at optimal pressure, and a age + b age^2 + c in five classes of pressure.
VELOCITY_AGES = np.arange(25.0, 80.0, 10.0)
VELOCITY_QUANTILES = np.array(
    [
        [5.2, 5.4, 5.8, 6.2, 7.0, 7.6],  # 10 %
        [6.0, 6.5, 6.8, 7.5, 8.7, 10.1],  # 50 %
        [7.0, 7.9, 8.5, 9.2, 11.4, 13.8],  # 90 %
    ]
)
CLASS_SYSTOLIC = np.array([115.0, 125.0, 135.0, 150.0, 170.0])
CLASS_DIASTOLIC = np.array([77.5, 82.5, 87.5, 95.0, 105.0])
CLASS_PRESSURES = CLASS_DIASTOLIC + 0.4 * (CLASS_SYSTOLIC - CLASS_DIASTOLIC)
CLASS_TRENDS = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.044],
        [0.00083, 0.00099, 0.00105, 0.00118, 0.00085],
        [5.55, 5.69, 5.91, 6.17, 5.73],
    ]
)

# Diameters in mm of ascending, descending thoracic and abdominal aorta, and length of
# the proximal aorta in mm, Hickson et al. 2010.
AORTA_AGES = np.array([24.0, 34.0, 45.0, 57.0, 63.0, 73.0])
AORTA_DIAMETERS = np.array(
    [
        [28.9, 30.5, 32.2, 32.3, 33.4, 33.7],
        [21.1, 22.4, 23.5, 23.4, 25.0, 24.9],
        [16.8, 18.1, 18.8, 18.6, 19.8, 20.2],
    ]
)
DIAMETER_SD = 0.090  # relative, mean of four sites of Hansen 1995 and Agmon 2003
AORTA_LENGTHS = np.array([90.0, 100.0, 100.0, 108.0, 118.0, 128.0])
AORTA_LENGTH_SD = 0.134  # relative, Bensalah et al. 2014

# Peripheral compliance, McVeigh et al. 1999 and Resnick et al. 2000.
COMPLIANCE_SD = 0.274  # relative


def stroke_volume_law(age: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation of the stroke volume, in ml."""
    age = np.asarray(age)
    low, high = SV_LOW[0] + SV_LOW[1] * age, SV_HIGH[0] + SV_HIGH[1] * age
    return (low + high) / 2, (high - low) / QUANTILE_SPAN


def heart_rate_mean(age: np.ndarray | float) -> np.ndarray:
    """Return the mean heart rate in beats per minute, constant below 32.5 years."""
    return np.asarray(np.interp(age, HR_AGES, HR_MEANS))


def weissler_time(
    stroke_volume: np.ndarray | float, heart_rate: np.ndarray | float
) -> np.ndarray:
    """Return the ejection time that goes with a heart's action, in ms.

    References:
        Relationships between left ventricular ejection time, stroke volume, and heart
        rate in normal individuals and patients with cardiovascular disease (Weissler
        et al., 1961), https://doi.org/10.1016/0002-8703(61)90403-3
    """
    volume_term = 1.1 * (np.asarray(stroke_volume) - 82.0)
    return 266.0 + volume_term - 0.9 * (np.asarray(heart_rate) - 73.0)


def pressure_law(age: float) -> tuple[float, float]:
    """Return mean and standard deviation of the mean arterial pressure, in mmHg."""
    mean = np.interp(age, PRESSURE_AGES, MEAN_PRESSURES)
    return float(mean), float(np.interp(age, PRESSURE_AGES, MEAN_PRESSURE_SDS))


def diastolic_pressure(age: float) -> float:
    """Return the mean diastolic pressure, in mmHg."""
    return float(np.interp(age, PRESSURE_AGES, DIASTOLIC_PRESSURES))


def velocity_quantiles(age: float) -> tuple[float, float, float]:
    """Return quantiles (0.1, 0.5, 0.9) of the pulse-wave velocity, in m/s."""
    low, median, high = (
        float(np.interp(age, VELOCITY_AGES, row)) for row in VELOCITY_QUANTILES
    )
    return low, median, high


def velocity_trend(age: float, mean_pressure: float) -> float:
    """Return the velocity that is usual at an age and a mean pressure, in m/s.

    Linear in pressure between the classes, and below the lowest with the slope between
    the lowest two.
    """
    by_class = np.array([age, age**2, 1.0]) @ CLASS_TRENDS
    if mean_pressure < CLASS_PRESSURES[0]:
        steps = (by_class[1] - by_class[0]) / (CLASS_PRESSURES[1] - CLASS_PRESSURES[0])
        return float(by_class[0] + steps * (mean_pressure - CLASS_PRESSURES[0]))
    return float(np.interp(mean_pressure, CLASS_PRESSURES, by_class))


def diameter_growth(age: float) -> float:
    """Return the diameter of large arteries relative to that at 25 years."""
    sites = [
        np.interp([age, MODEL_AGE], AORTA_AGES, diameters)
        for diameters in AORTA_DIAMETERS
    ]
    return float(np.mean([now / then for now, then in sites]))


def aorta_growth(age: float) -> float:
    """Return the length of the proximal aorta relative to that at 25 years."""
    now, then = np.interp([age, MODEL_AGE], AORTA_AGES, AORTA_LENGTHS)
    return float(now / then)


def compliance_mean(age: float) -> float:
    """Return the mean peripheral compliance relative to that at 25 years."""
    return (0.113 - 0.001 * age) / (0.113 - 0.001 * MODEL_AGE)
