"""Exact replays: recorded commands through the station reproduce the recording."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import DEFAULT_CELL, cell_with, resting, scene_of

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.config import SettleConfig
from drake_clutter.files import InputError
from drake_clutter.grammar import Orientation
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.recording.exact_replay import compare_samples, replay_action
from drake_clutter.scenes.action_samples import PHASES, ActionSamples
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.station.station_simulation import COARSE_TIME_STEP, StationSimulation

SCENE = scene_of(resting("sugar_box", Orientation.UPRIGHT_0), resting("pudding_box", xy=(0.2, 0.2)))
PICKED = SCENE.names.index("sugar_box")


def record(cell: WorkCell, config: PlannerConfig, height: float) -> ActionSamples:
    """Return the samples of a move whose place pose is too high [m]."""
    box = SCENE["sugar_box"].X_TO
    place = Pose((0.2, -0.2, box.translation[2] + height), box.quaternion)
    plan = PickPlacePlanner(DEFAULT_CELL, replace(config, optimize=False)).plan(
        SCENE.objects, "sugar_box", place
    )
    assert isinstance(plan, PickPlacePlan)
    simulation = StationSimulation(cell, SCENE, time_step=COARSE_TIME_STEP, rate=100.0)
    samples = simulation.execute(plan).samples
    assert samples is not None
    return samples


def replay(cell: WorkCell, samples: ActionSamples, scene: Scene = SCENE) -> ActionSamples:
    return replay_action(scene, cell, samples, 100.0)


def test_a_grasp_that_waits_for_the_vacuum_is_replayed() -> None:
    """The pump is slower than the plan assumes; waiting is not decided anew."""
    slow = cell_with("gripper.pump_time_constant=0.25")
    samples = record(slow, PlannerConfig(), 0.001)
    assert samples.executed is not None
    waits = samples.executed.wait_time
    assert len(waits) > 1
    assert np.diff(waits) == pytest.approx(0.025)
    errors = compare_samples(samples, replay(slow, samples))
    assert (errors.joint, errors.object) == (0.0, 0.0)
    # With a quick pump, which needs no waiting, the arm moves at the same times.
    quick = replay(cell_with("gripper.pump_time_constant=0.02"), samples)
    assert quick.q_commanded == pytest.approx(samples.q_commanded, abs=1e-12)
    assert not np.array_equal(quick.vacuum, samples.vacuum)


def test_a_guarded_descent_is_replayed_to_the_recorded_contact() -> None:
    samples = record(DEFAULT_CELL, PlannerConfig(max_guarded_descent=0.08), 0.02)
    assert PHASES.index("descend") in samples.phase
    errors = compare_samples(samples, replay(DEFAULT_CELL, samples))
    assert errors.joint < 1e-5
    assert errors.object < 1e-4
    lower = samples.X_TO[-1, PICKED, 6] - samples.X_TO[0, PICKED, 6]
    assert lower == pytest.approx(0.0, abs=1e-3), "it stands again"


def test_errors_are_those_of_the_worst_joint_and_object() -> None:
    samples = record(DEFAULT_CELL, PlannerConfig(), 0.001)
    moved = samples.X_TO.copy()
    moved[50:, PICKED, 4] += 0.002
    q = samples.q.copy()
    q[10, 3] += 6e-4
    errors = compare_samples(samples, replace(samples, X_TO=moved, q=q))
    assert errors.joint == pytest.approx(6e-4)
    assert errors.object == pytest.approx(0.002)
    assert (errors.object_index, errors.time) == (PICKED, 0.5)
    assert not errors.is_exact
    with pytest.raises(InputError, match="no executed commands; expected a recording of version 2"):
        replay(DEFAULT_CELL, replace(samples, executed=None))


def test_a_collapse_is_replayed() -> None:
    """The plan does not know of the box at its place, and collides with it."""
    box, unknown = SCENE["sugar_box"], resting("cracker_box", xy=(0.2, -0.2))
    scene = scene_of(box, unknown)
    place = Pose((0.2, -0.21, box.X_TO.translation[2]), box.X_TO.quaternion)
    plan = PickPlacePlanner(DEFAULT_CELL, PlannerConfig(optimize=False)).plan(
        [box], box.name, place
    )
    assert isinstance(plan, PickPlacePlan)
    result = StationSimulation(DEFAULT_CELL, scene, rate=100.0).execute(plan)
    assert result.displacements[unknown.name] > SettleConfig().max_displacement
    assert result.samples is not None
    errors = compare_samples(result.samples, replay(DEFAULT_CELL, result.samples, scene))
    assert (errors.joint, errors.object) == (0.0, 0.0)
