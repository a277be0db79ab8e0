"""A recorded free-space motion leads to the same place in MuJoCo."""

import pytest

from benchmarks.mujoco_motion import MotionComparer


def test_recorded_motion_ends_at_the_same_place() -> None:
    comparison = MotionComparer(seed=61)(0)
    assert comparison.path_length > 0.3
    station, delayed = (comparison.deviations[name] for name in ("station", "delayed"))
    assert station.final_mm == pytest.approx(0.0, abs=0.01)
    # On the way, Drake's arm follows its command by one time step.
    assert station.max_mm < 0.0026 * 1000 * comparison.max_speed + 0.2
    assert delayed.max_mm < 0.3
    assert comparison.deviations["positions only"].final_mm < 5.0
