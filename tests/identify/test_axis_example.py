"""The model of a drifting drive, which the example of the measured axis defines."""

import importlib.util
from pathlib import Path

import pytest

from jaxmodsim.identify import axis_scene, estimate_axis, fit

from ..cli.test_fit_command import FRAME, record_of

EXAMPLE = Path(__file__).parents[2] / "examples" / "b0_positioning_axis.py"


def test_the_clock_of_a_record_makes_no_difference():
    """A drift dies away from the first sample on, whatever the clock says there."""
    spec = importlib.util.spec_from_file_location("positioning_axis", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    model, t = example.models()["drifting"], FRAME["time"].to_numpy() - 10.0

    def values(start: float) -> dict[str, float]:
        record = record_of(FRAME, time=t + start)
        scene = axis_scene(model, estimate_axis(record), {"tau": 1.0})
        limits = {"m": (0.0, 50.0)}
        return fit(scene, record, model.free, limits=limits, substeps=2, max_steps=4).values

    expected = values(0.0)
    for start in (1300.0, -40.0):
        assert values(start) == pytest.approx(expected, rel=1e-5, abs=1e-8)
