"""Flow out of the heart."""

from dataclasses import replace

import numpy as np
import pytest

from sbi_rope.tasks.hemodynamics import inflow
from sbi_rope.tasks.hemodynamics.inflow import aortic_inflow
from tests.blood_flow import BASELINE
from tests.conftest import TEST_DATA

SUBJECTS = [
    BASELINE,
    replace(BASELINE, heart_rate=48.0, stroke_volume=95.0, ejection_time=345.0),
    replace(BASELINE, heart_rate=120.0, stroke_volume=25.0, ejection_time=220.0),
    replace(BASELINE, peak_flow_time=110.0, regurgitant_volume=2.5),
    replace(BASELINE, regurgitant_volume=0.0),
]


def test_a_beat_ejects_the_stroke_volume_and_the_reverse_flow_comes_back() -> None:
    for subject in SUBJECTS:
        flow = aortic_inflow(subject, 4000)
        net = flow.mean() * subject.period
        assert net == pytest.approx(subject.stroke_volume, rel=1e-5)
        returned = -flow.clip(max=0.0).mean() * subject.period
        expected = subject.regurgitant_volume
        assert returned == pytest.approx(expected, rel=1e-3, abs=1e-12)


def test_flow_peaks_turns_and_ends_when_it_should() -> None:
    for subject in SUBJECTS:
        flow = aortic_inflow(subject, 20_000)
        time = 1000 * subject.period * np.arange(20_000) / 20_000
        step, last = time[1], subject.ejection_time
        peak = time[flow.argmax()]
        assert peak == pytest.approx(subject.peak_flow_time, abs=2 * step)
        ejected = time[flow > 0]
        assert ejected[0] == pytest.approx(0.0, abs=2 * step)
        assert ejected[-1] == pytest.approx(last, abs=2 * step)
        assert len(ejected) * step == pytest.approx(last, abs=2 * step)
        end = 309 / 282 * last
        assert (flow[(time > last) & (time < end)] <= 0).all()
        assert (flow[time >= end] == 0).all()


def test_the_table_reproduces_the_published_waveform() -> None:
    path = TEST_DATA / "hemodynamics" / "inflow_template_mynard2015.csv"
    time, published = np.loadtxt(path, delimiter=",", skiprows=2, unpack=True)
    ours = inflow._template().spline(time)
    np.testing.assert_allclose(ours, published, rtol=0, atol=0.002 * published.max())
    forward = published.clip(min=0.0).sum()
    assert ours.clip(min=0.0).sum() == pytest.approx(forward, rel=1e-4)
