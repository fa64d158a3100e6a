r"""Flow out of the heart, from the timing and the volumes of a beat."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from sbi_rope.tasks.hemodynamics.subject import Subject

# Flow through the aortic valve in arbitrary units, every 3 ms from its opening on: the
# waveform of Mynard and Smolich (2015, https://doi.org/10.1007/s10439-015-1313-8) as
# published with pwdb (see arteries.py), which has a value every ms. A cubic spline
# through these reproduces the others to 0.2 % of the peak.
TEMPLATE_STEP = 3.0  # ms
TEMPLATE = (
    *(0.0, 4.6, 30.1, 77.9, 127.9, 172.0, 211.9, 249.4, 284.8, 317.1, 345.6, 370.1),
    *(391.4, 410.4, 427.5, 443.3, 457.9, 471.3, 483.2, 493.4, 501.8, 508.6, 514.2),
    *(518.8, 522.5, 525.1, 526.5, 526.7, 525.8, 524.1, 521.6, 518.4, 514.5, 509.8),
    *(504.1, 497.5, 490.1, 481.8, 472.8, 463.1, 452.8, 442.2, 431.3, 420.3, 409.3),
    *(398.3, 387.6, 377.0, 366.7, 356.5, 346.5, 336.7, 327.1, 317.6, 308.3, 299.1),
    *(290.1, 281.2, 272.5, 263.9, 255.4, 247.1, 238.9, 230.8, 222.9, 215.2, 207.7),
    *(200.4, 193.3, 186.6, 180.0, 173.8, 167.8, 162.1, 156.7, 151.4, 146.3, 141.3),
    *(136.4, 131.5, 126.6, 121.5, 116.2, 110.7, 104.8, 98.4, 91.4, 83.8, 75.4, 66.0),
    *(55.5, 43.7, 30.5, 15.7, -0.7, -18.9, -38.2, -57.7, -75.0, -85.5, -80.6, -52.1),
    *(-15.8, 0.0),
)
TEMPLATE_PEAK, TEMPLATE_CLOSURE, TEMPLATE_END = 80.0, 282.0, 309.0  # ms, as published


def aortic_inflow(subject: Subject, num_samples: int) -> np.ndarray:
    r"""Return the flow from the heart into the aorta over one beat.

    The published waveform :math:`q(s)` rises until 80 ms, changes its sign at 282 ms
    and ends at 309 ms. Its three parts are stretched to the times of the subject,

    .. math:: s(t): \quad [0, t_p, t_e, \tfrac{309}{282} t_e] \to
        [0, 80, 282, 309]~\mathrm{ms},

    linearly in between, with :math:`t_p` the peak flow time and :math:`t_e` the
    ejection time; the flow is zero during the rest of the beat. Its positive part is
    then scaled to stroke volume plus regurgitant volume, its negative part to the
    regurgitant volume. Should a beat be too short for the reverse flow to end in it,
    the reverse flow is shortened.

    Returns:
        Flow in ml/s, shape ``(num_samples,)``, at equally spaced times from the opening
        of the valve, the end of the beat excluded.
    """
    template = _template()
    time = 1000.0 * subject.period * np.arange(num_samples) / num_samples
    reverse_end = subject.ejection_time * TEMPLATE_END / TEMPLATE_CLOSURE
    edges = np.array(
        [
            0.0,
            subject.peak_flow_time,
            subject.ejection_time,
            min(reverse_end, 1000.0 * subject.period),
        ]
    )
    flow = template.spline(np.interp(time, edges, template.edges))
    flow[time >= edges[-1]] = 0.0
    # A stretched part has its volume times the ratio of its lengths.
    rise, fall, reverse = (
        template.volumes * np.diff(edges) / np.diff(template.edges) / 1000.0
    )
    forward_scale = (subject.stroke_volume + subject.regurgitant_volume) / (rise + fall)
    reverse_scale = subject.regurgitant_volume / -reverse
    return flow * np.where(time < subject.ejection_time, forward_scale, reverse_scale)


@dataclass(frozen=True)
class _Template:
    spline: Any
    edges: np.ndarray  # opening, peak, closure and end of the reverse flow, in ms
    volumes: np.ndarray  # of the three parts


@lru_cache(maxsize=1)
def _template() -> _Template:
    from scipy.interpolate import CubicSpline

    time = TEMPLATE_STEP * np.arange(len(TEMPLATE))
    spline = CubicSpline(time, TEMPLATE, bc_type="clamped")
    # The tabulated curve is turned at 80.0 ms and crosses zero at 281.9 ms; with the
    # exact times, a subject's flow peaks and changes its sign when it should.
    peak = _nearest(spline.derivative().roots(extrapolate=False), TEMPLATE_PEAK)
    closure = _nearest(spline.roots(extrapolate=False), TEMPLATE_CLOSURE)
    edges = np.array([0.0, peak, closure, TEMPLATE_END])
    return _Template(spline, edges, np.diff(spline.antiderivative()(edges)))


def _nearest(values: np.ndarray, target: float) -> float:
    return float(values[np.abs(values - target).argmin()])
