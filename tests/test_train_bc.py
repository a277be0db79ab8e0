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
from drake_clutter.planning.tool_kinematics import ToolKinematics
from drake_clutter.recording.hdf5_file import save_episode
from drake_clutter.recording.recorded_episode import CameraImages
from drake_clutter.scenes.action_samples import PHASES
from training.reaching_demonstrations import (
    CROP,
    Demonstration,
    common_branch,
    crop_image,
    object_target,
    read_demonstrations,
    read_first_images,
    split,
)
from training.reaching_learner import CloningConfig, CloningLearner, StateSampler
from training.reaching_playback import play
from training.reaching_policy import LOOKAHEAD, ReachingPolicy
from training.train_bc import held_out_moves

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
        X_TG = ToolKinematics(d.cell, d.tool).pose(d.q[-1])
        assert X_TG[:3, 3] == pytest.approx(d.target[:3], abs=0.002)
        assert X_TG[:3, 2] == pytest.approx([0, 0, -1], abs=1e-3)


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


def test_a_policy_turns_with_the_arm() -> None:
    """A scene that is turned about the base of the robot is reached by the same changes."""
    torch.manual_seed(1)
    policy = ReachingPolicy("state", 6)
    policy.base.copy_(torch.tensor([0.8, -0.1, 0.2]))
    q = torch.tensor([[0.3, -1.2, 2.0, -2.3, -1.5, 0.4]])
    positions = torch.tensor([[0.1, 0.2, 0.4], [-0.1, 0.25, 0.15]])
    axis = torch.tensor([[0.1, -0.05, -0.99]])
    rise = torch.tensor([[0.07]])
    c, s = np.cos(0.7), np.sin(0.7)
    R = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float32)
    turned = (positions - policy.base) @ R.T + policy.base
    q_turned = q + torch.tensor([0.7, 0.0, 0.0, 0.0, 0.0, 0.0])
    with torch.inference_mode():
        first = policy(q, positions[:1], axis, torch.cat([positions[1:], rise], dim=1))
        second = policy(q_turned, turned[:1], axis @ R.T, torch.cat([turned[1:], rise], dim=1))
        other = policy(q, turned[:1], axis, torch.cat([positions[1:], rise], dim=1))
    assert second.numpy() == pytest.approx(first.numpy(), abs=1e-5)
    assert np.abs((other - first).numpy()).max() > 1e-3


def test_only_the_common_branch_is_learned(demonstrations: list[Demonstration]) -> None:
    flipped = demonstrations[1].q.copy()
    flipped[-1, 4] += np.pi  # The wrist is turned to the other side.
    turned = demonstrations[2].q.copy()
    turned[-1, [0, 5]] += np.pi  # The arm and the tool about their own axes.
    given = [
        demonstrations[0],
        replace(demonstrations[1], q=flipped),
        replace(demonstrations[2], q=turned),
    ]
    assert common_branch(given) == [given[0], given[2]]


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


def test_held_out_moves_are_recorded_grasps_of_other_scenes(tmp_path: Path) -> None:
    (tmp_path / "episodes").mkdir()
    for index in range(3):
        episode = synthetic_episode(cameras={"overhead": 4}, index=index)
        action = episode.actions[0]
        assert action.samples is not None
        phase = action.samples.phase.copy()
        phase[8:11] = PHASES.index("grasp")  # The object is held from sample 11 on.
        grasping = replace(action, samples=replace(action.samples, phase=phase))
        episode = replace(
            episode, actions=(grasping, *episode.actions[1:]), scene_name=f"s {index}"
        )
        save_episode(tmp_path / "episodes" / f"episode_{index:06d}.h5", episode)
    moves = held_out_moves(tmp_path, "large", 1, 2, {"s 0"})
    assert [d.name for d in moves] == ["episode_000001 1", "episode_000002 1"]
    assert (moves[0].scene_name, moves[0].pick) == ("s 1", "gelatin_box")
    samples = synthetic_episode().actions[0].samples
    assert samples is not None
    assert moves[0].q == pytest.approx(samples.q_commanded[:9])
    assert moves[0].time[-1] == pytest.approx(8 / 20)
    assert moves[0].target[:2] == pytest.approx([0.1, 0.1])
    with pytest.raises(InputError, match=r"--count 3: .* has 2 moves with images from episode 1"):
        held_out_moves(tmp_path, "large", 1, 3, set())
    with pytest.raises(InputError, match="scene s 2 was learned; expected other scenes"):
        held_out_moves(tmp_path, "large", 1, 2, {"s 2", "s 7"})


def test_validation_moves_are_of_other_scenes(demonstrations: list[Demonstration]) -> None:
    learned, validation = split(demonstrations, 1)
    assert [d.name for d in learned] == ["episode_000000 1", "episode_000001 1"]
    assert [d.name for d in validation] == ["episode_000002 1"]
    again = replace(demonstrations[0], name="episode_000003 1")
    learned, validation = split([*demonstrations, again], 1)
    assert [d.name for d in learned] == ["episode_000001 1", "episode_000002 1"]
    assert validation == [again]
    with pytest.raises(InputError, match="validation: 2 of 3 moves; expected at most half"):
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
