"""Cloning of a reaching policy: targets from images, waypoints, and playback in the station."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import DEFAULT_CELL, resting, scene_of
from recorded_episodes import synthetic_episode

from drake_clutter.files import InputError
from drake_clutter.planning.motion_plan import MotionPlan
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.recording.hdf5_file import save_episode
from drake_clutter.recording.recorded_episode import CameraImages
from training.reaching_demonstrations import (
    CROP,
    Demonstration,
    ToolKinematics,
    crop_image,
    object_target,
    read_demonstrations,
    read_first_images,
    split,
)
from training.reaching_learner import CloningConfig, CloningLearner, StateSampler
from training.reaching_playback import play
from training.reaching_policy import LOOKAHEAD, ReachingPolicy

PLACES = ((0.1, 0.1), (-0.1, 0.15), (0.05, -0.15))


@pytest.fixture(scope="module")
def demonstrations() -> list[Demonstration]:
    """Return planned approaches to a box at three places."""
    planner = PickPlacePlanner(DEFAULT_CELL, PlannerConfig(optimize=False))
    found = []
    for number, xy in enumerate(PLACES):
        box = resting("sugar_box", xy=xy)
        plan = planner.plan_pick(planner.home_state([box]), "sugar_box")
        assert isinstance(plan, MotionPlan)
        approach = plan.steps[0].trajectory
        time = np.linspace(approach.start_time(), approach.end_time(), 40)
        found.append(
            Demonstration(
                name=f"episode_{number:06d} 1",
                scene_name=f"scene {number}",
                cell=DEFAULT_CELL,
                scene=scene_of(box),
                pick="sugar_box",
                tool="large",
                time=time - time[0],
                q=np.array([approach.value(t).ravel() for t in time]),
                target=object_target(scene_of(box), "sugar_box"),
                image=None,
            )
        )
    return found


def test_demonstrations_end_at_their_target(demonstrations: list[Demonstration]) -> None:
    for d, xy in zip(demonstrations, PLACES, strict=True):
        assert d.target == pytest.approx([*xy, 0.038, 0.0], abs=1e-9)
        p_TG, axis = ToolKinematics(d.cell, d.tool).pose(d.q[-1])
        assert p_TG == pytest.approx(d.target[:3], abs=0.002)
        assert axis == pytest.approx([0, 0, -1], abs=1e-3)


def test_waypoints_are_commands_ahead(demonstrations: list[Demonstration]) -> None:
    demonstration = demonstrations[0]
    states = StateSampler([demonstration], perturb=False).all_states()
    period = demonstration.time[1]
    ahead = LOOKAHEAD / period
    for k in (3, 20):
        position = min(k + ahead, len(demonstration.q) - 1)
        expected = [np.interp(position, range(40), column) for column in demonstration.q.T]
        reached = states.q[k, :-1] + states.change[k]
        assert reached.numpy() == pytest.approx(np.array(expected[:-1]), abs=1e-5)
    assert states.change[-1].abs().max() == pytest.approx(0.0, abs=1e-6)
    # A state next to the demonstration leads to the same waypoint.
    sampler = StateSampler([demonstration], perturb=True)
    near = sampler.sample(64, np.random.default_rng(0))
    waypoints = near.q[:, :-1] + near.change
    all_waypoints = states.q[:, :-1] + states.change
    distances = (waypoints[:, None] - all_waypoints[None]).abs().amax(dim=2).amin(dim=1)
    assert distances.max() < 1e-5
    offsets = (near.q[:, None] - states.q[None]).abs().amax(dim=2).amin(dim=1)
    assert offsets.max() > 0.01


def test_policy_reaches_what_it_has_learned(demonstrations: list[Demonstration]) -> None:
    torch.manual_seed(0)
    policy = ReachingPolicy("state", 6)
    learner = CloningLearner(policy, demonstrations, CloningConfig(steps=120, batch_size=128))
    while learner.step < 120:
        learner.train_iteration()
    playback = play(policy, demonstrations[0])
    assert playback.reached
    assert playback.stopped
    assert playback.distance_mm < 20
    assert playback.tilt_deg < 3


def test_target_from_the_depth_image() -> None:
    """A box of 60 mm height whose top and one side are seen from 1.6 m above the tray."""
    depth = np.full((240, 320), 1600, np.uint16)
    segmentation = np.zeros((240, 320), np.uint8)
    segmentation[100:120, 200:225] = 3
    depth[100:120, 200:220] = 1540
    depth[100:120, 220:225] = 1570
    intrinsics = (309.0, 309.0, 159.0, 119.0)
    X_TC = np.array([[0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.6]])
    images = CameraImages(np.zeros(1), X_TC, intrinsics, None, depth[None], segmentation[None])
    image = crop_image(images, 2)
    assert image is not None
    assert image.shape == (4, CROP, CROP)
    assert image[3].sum() == 20 * 25
    top = (image[3] > 0) & (image[2] > 0.05)
    center = image[:3, top].mean(axis=1)
    x = (209.5 - 159.0) / 309.0 * 1.54
    y = -(109.5 - 119.0) / 309.0 * 1.54
    assert center == pytest.approx([x, y, 0.06], abs=1e-4)
    assert crop_image(images, 0) is None  # The object is not in the image.
    # The target is a mean of points of the object, and moves with the scene.
    policy = ReachingPolicy("depth", 6)
    shifted = image + np.array([0.1, 0.0, 0.2, 0.0], np.float32)[:, None, None]
    with torch.inference_mode():
        first, second = policy.find_target(torch.from_numpy(np.stack([image, shifted])))
    points = image[:3, image[3] > 0]
    assert (first[:3].numpy() >= points.min(axis=1)).all()
    assert (first[:3].numpy() <= points.max(axis=1)).all()
    assert (second - first).numpy() == pytest.approx([0.1, 0.0, 0.2, 0.0], abs=1e-4)
    assert first[3] == 0.0
    # A wall of 160 mm height beside the box.
    image[2, 12, CROP // 2] = 0.16
    with torch.inference_mode():
        beside = policy.find_target(torch.from_numpy(image[None]))[0].numpy()
    assert beside[3] == pytest.approx(0.16 - beside[2], abs=1e-6)


def test_first_images_are_those_of_the_recording(tmp_path: Path) -> None:
    episode = synthetic_episode(cameras={"overhead": 4, "wrist": 5})
    save_episode(tmp_path / "episode.h5", episode)
    images = read_first_images(tmp_path / "episode.h5", 1)
    expected = episode.actions[0].images["overhead"]
    assert images is not None
    assert images.depth is not None
    assert expected.depth is not None
    assert images.intrinsics == expected.intrinsics
    assert np.array_equal(images.X_TC, expected.X_TC[:1])
    assert np.array_equal(images.depth, expected.depth[:1])
    assert read_first_images(tmp_path / "episode.h5", 2) is None  # It was not executed.


def test_held_out_moves_are_of_other_scenes(demonstrations: list[Demonstration]) -> None:
    learned, held_out = split(demonstrations, 1)
    assert [d.name for d in learned] == ["episode_000000 1", "episode_000001 1"]
    assert [d.name for d in held_out] == ["episode_000002 1"]
    again = replace(demonstrations[0], name="episode_000003 1")
    learned, held_out = split([*demonstrations, again], 1)
    assert [d.name for d in learned] == ["episode_000001 1", "episode_000002 1"]
    assert held_out == [again]
    with pytest.raises(InputError, match="held_out: 2 of 3 moves; expected at most half"):
        split(demonstrations, 2)


def test_a_folder_without_episodes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected recorded moves of one cell"):
        read_demonstrations(tmp_path, "large")


def test_lying_marker_has_its_top_at_its_side() -> None:
    marker = resting("large_marker", xy=(0.1, -0.1))
    assert object_target(scene_of(marker), "large_marker") == pytest.approx([0.1, -0.1, 0.018, 0.0])


def test_neighbors_rise_above_the_target() -> None:
    marker = resting("large_marker", xy=(0.1, -0.1))
    box = resting("sugar_box", xy=(0.1, -0.1 + 0.0445 + 0.14))  # 89 mm wide and 38 mm high
    far = resting("cracker_box", xy=(-0.25, 0.25))
    assert object_target(scene_of(marker, far), "large_marker")[3] == 0.0
    target = object_target(scene_of(marker, box, far), "large_marker")
    assert target[3] == pytest.approx(0.038 - 0.018)
