"""Settling and judging small scenes with known outcomes; determinism; early stops."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from conftest import CLASSES, TRAY, resting, rng, scene_of, tray
from scipy.spatial.transform import Rotation

from drake_clutter.config import ClutterConfig, SettleConfig
from drake_clutter.grammar import Orientation
from drake_clutter.scenes.interfaces import Instability, InstabilityReason, Verdict
from drake_clutter.scenes.scene import Pose, SceneObject, perturb_poses, tilt_between
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.simulation.settle import SettleResult, _may_roll_slowly, find_instability, settle

UPRIGHT = Orientation.UPRIGHT_0
# Cracker boxes are 230 mm long (x) and 60 mm high; a sugar box is 175 mm long, so half of it
# overhangs when it is shifted by 115 mm.
BELOW = resting("cracker_box", name="below")
STANDING_PAIR = [
    resting("sugar_box", UPRIGHT, (0.0, y), name=name)
    for name, y in (("left", -0.039), ("right", 0.039))
]
MARKER_PAIR = [
    resting("large_marker", xy=(0.0, y), name=name)
    for name, y in (("left", -0.010), ("right", 0.010))
]

STABLE: dict[str, list[SceneObject]] = {
    "box on box": [BELOW, resting("sugar_box", floor=0.060, name="above")],
    "overhang of less than half": [
        BELOW,
        resting("sugar_box", xy=(0.095, 0.0), floor=0.060, name="above"),
    ],
    "a box bridges a standing pair": [
        *STANDING_PAIR,
        resting("cracker_box", floor=0.175, name="above"),
    ],
    "a marker that lies": [resting("large_marker", name="marker")],
    "a pair of markers bears a box": [
        *MARKER_PAIR,
        resting("gelatin_box", floor=0.018, name="above"),
    ],
}
FALLING: dict[str, tuple[list[SceneObject], InstabilityReason, str]] = {
    "overhang of more than half": (
        [BELOW, resting("sugar_box", xy=(0.135, 0.0), floor=0.060, name="above")],
        *(InstabilityReason.TOPPLED, "above"),
    ),
    "a marker falls through the gap of a pair": (
        [*STANDING_PAIR, resting("large_marker", floor=0.175, name="above")],
        *(InstabilityReason.SLID, "above"),
    ),
    "a lying marker rolls away under a box": (
        [resting("large_marker", name="below"), resting("gelatin_box", floor=0.018, name="above")],
        *(InstabilityReason.TOPPLED, "above"),
    ),
    "a box on its shelf above nothing": (
        [resting("gelatin_box", floor=0.2, name="above")],
        InstabilityReason.SLID,
        "above",
    ),
    "a stack beside the tray": (
        [
            resting("cracker_box", xy=(0.6, 0.0), name="a"),
            resting("sugar_box", xy=(0.6, 0.0), floor=0.060, name="b"),
        ],
        *(InstabilityReason.LEFT_TRAY, "a"),
    ),
    "a tall box beyond the edge of its foot": (
        [
            resting("gelatin_box", name="foot"),
            resting("cracker_box", UPRIGHT, (0.060, 0.0), floor=0.028, name="above"),
        ],
        *(InstabilityReason.TOPPLED, "above"),
    ),
}


@pytest.mark.parametrize("objects", STABLE.values(), ids=list(STABLE))
def test_what_stands(objects: list[SceneObject], judge: DrakeJudge) -> None:
    scene = scene_of(*objects)
    verdict = judge.judge(scene, rng())
    assert verdict.stable, str(verdict.instability)
    assert set(verdict.settled) == set(verdict.visible_fractions) == set(scene.names)
    for o in objects:
        assert np.linalg.norm(verdict.settled[o.name].p - o.X_TO.p) < 0.003
    assert [name for name, share in verdict.visible_fractions.items() if share < 0.30] == list(
        verdict.hidden
    )


@pytest.mark.parametrize(("objects", "reason", "name"), FALLING.values(), ids=list(FALLING))
def test_what_falls(
    objects: list[SceneObject], reason: InstabilityReason, name: str, judge: DrakeJudge
) -> None:
    verdict = judge.judge(scene_of(*objects), rng())
    assert verdict.instability is not None
    assert (verdict.instability.reason, verdict.instability.object) == (reason, name)
    assert set(verdict.settled) == {o.name for o in objects}
    assert (verdict.visible_fractions, verdict.hidden) == ({}, ())
    start = next(o for o in objects if o.name == name)
    moved = np.linalg.norm(verdict.settled[name].p - start.X_TO.p)
    assert verdict.instability.displacement == pytest.approx(
        moved, abs=0.0011
    )  # the random offset comes before
    limits = SettleConfig()
    assert (
        verdict.instability.displacement >= limits.max_displacement
        or verdict.instability.tilt >= math.radians(limits.max_tilt_deg)
    )


@pytest.mark.parametrize(
    ("displacement", "tilt_deg", "reason"),
    [
        (0.0099, 7.9, None),
        (0.0101, 0.0, InstabilityReason.SLID),
        (0.0101, 7.9, InstabilityReason.SLID),
        (0.0, 8.1, InstabilityReason.TOPPLED),
        (0.0101, 8.1, InstabilityReason.TOPPLED),
    ],
)
def test_a_stable_object_moves_less_than_10_mm_and_turns_less_than_8_deg(
    displacement: float, tilt_deg: float, reason: InstabilityReason | None
) -> None:
    before = resting("cracker_box")
    R_TO = Rotation.from_euler("x", tilt_deg, degrees=True).as_matrix() @ before.X_TO.rotation
    p_TO = before.X_TO.p + displacement * np.array([0.36, 0.48, 0.8])
    found = find_instability(before, Pose.from_rotation(R_TO, p_TO), TRAY, SettleConfig())
    if reason is None:
        assert found is None
        return
    assert found is not None
    assert (found.reason, found.object) == (reason, "cracker_box")
    assert found.displacement == pytest.approx(displacement)
    assert found.tilt == pytest.approx(math.radians(tilt_deg), abs=1e-7)


@pytest.mark.parametrize("p_TO", [(0.351, 0.0, 0.03), (0.0, -0.351, 0.03), (0.0, 0.0, -0.001)])
def test_an_object_beside_or_below_the_tray_has_left_it(p_TO: tuple[float, float, float]) -> None:
    before = resting("cracker_box")
    found = find_instability(before, Pose(p_TO, before.X_TO.quaternion), tray(0.70), SettleConfig())
    assert found is not None
    assert found.reason is InstabilityReason.LEFT_TRAY
    inside = Pose((0.349, -0.349, 0.0), before.X_TO.quaternion)
    found = find_instability(before, inside, tray(0.70), SettleConfig())
    assert found is not None
    assert found.reason is InstabilityReason.SLID


@pytest.mark.parametrize(
    ("objects", "expected"),
    [
        ([resting("large_marker")], False),
        ([resting("large_marker"), resting("gelatin_box", floor=0.018)], True),
        ([resting("gelatin_box", floor=0.018), resting("large_marker")], True),
        ([resting("large_marker"), resting("gelatin_box", xy=(0.0, 0.048))], False),
        ([resting("large_marker"), resting("gelatin_box", xy=(0.0, 0.044), floor=0.018)], True),
        ([resting("large_marker", floor=0.028), resting("gelatin_box")], False),
        ([resting("large_marker"), resting("large_marker", xy=(0.1, 0.0), name="level")], False),
        ([resting("tomato_soup_can", UPRIGHT), resting("gelatin_box", floor=0.101)], False),
        ([resting("cracker_box"), resting("gelatin_box", floor=0.06)], False),
    ],
)
def test_a_lying_cylinder_rolls_slowly_only_if_it_carries_something(
    objects: list[SceneObject], expected: bool
) -> None:
    assert _may_roll_slowly(objects) == expected


def test_the_same_rng_gives_the_same_poses_bit_for_bit(
    config: ClutterConfig, judge: DrakeJudge
) -> None:
    scene = scene_of(*STABLE["box on box"], resting("large_marker", xy=(0.2, 0.2), name="marker"))
    verdict = judge.judge(scene, rng(3))
    assert judge.judge(scene, rng(3)) == verdict
    assert DrakeJudge(config).judge(scene, rng(3)) == verdict
    assert judge.judge(scene, rng(4)).settled != verdict.settled


def test_an_object_on_its_own_settles_alike_wherever_it_stands(config: ClutterConfig) -> None:
    places = [(0.0, 0.0), (0.21, -0.13), (-0.3, 0.3)]
    ended = []
    for order in (places, places[::-1]):
        judge = DrakeJudge(config)
        verdicts = {
            xy: judge.judge(scene_of(resting("sugar_box", UPRIGHT, xy, name="box")), rng(1))
            for xy in order
        }
        ended.append({xy: verdict.settled["box"] for xy, verdict in verdicts.items()})
    assert ended[0] == ended[1]  # whichever place was simulated
    offsets = {xy: np.subtract(pose.translation[:2], xy) for xy, pose in ended[0].items()}
    for xy in places:
        assert ended[0][xy].quaternion == ended[0][places[0]].quaternion
        assert ended[0][xy].translation[2] == ended[0][places[0]].translation[2]
        assert offsets[xy] == pytest.approx(offsets[places[0]], abs=1e-12)


def test_single_objects_keep_their_names(judge: DrakeJudge) -> None:
    """The result of the first of two equal falls is used for the second one."""
    for name in ("one", "two"):
        verdict = judge.judge(scene_of(resting("gelatin_box", floor=0.15, name=name)), rng())
        assert verdict.instability is not None
        assert verdict.instability.object == name
        assert list(verdict.settled) == [name]


@pytest.mark.parametrize("x", [0.6, 0.36])
def test_a_single_object_beside_the_tray_has_left_it(x: float, judge: DrakeJudge) -> None:
    """An object beside the tray is simulated although an equal one settled on the tray."""
    assert judge.judge(scene_of(resting("cracker_box", name="box")), rng()).stable
    verdict = judge.judge(scene_of(resting("cracker_box", xy=(x, 0.0), name="box")), rng())
    assert verdict.instability is not None
    assert verdict.instability.reason is InstabilityReason.LEFT_TRAY


def moved_aside(objects: Sequence[SceneObject], y: float, prefix: str) -> list[SceneObject]:
    return [
        replace(o, name=prefix + o.name, X_TO=o.X_TO.translated((0.0, y, 0.0))) for o in objects
    ]


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (STABLE["box on box"], STABLE["overhang of less than half"]),
        (STABLE["box on box"], FALLING["overhang of more than half"][0]),
        (STABLE["a marker that lies"], FALLING["a marker falls through the gap of a pair"][0]),
    ],
)
def test_groups_settled_separately_give_the_same_verdict(
    first: list[SceneObject], second: list[SceneObject], config: ClutterConfig, judge: DrakeJudge
) -> None:
    objects = [*moved_aside(first, -0.2, "first "), *moved_aside(second, 0.2, "second ")]
    apart = judge.judge(scene_of(*objects), rng(5))
    together = settle(perturb_poses(objects, config.settle.jitter, rng(5)), TRAY, config.settle)
    assert (apart.instability is None) == (together.instability is None)
    if apart.instability is not None and together.instability is not None:
        assert (apart.instability.reason, apart.instability.object) == (
            together.instability.reason,
            together.instability.object,
        )
    else:
        for name, pose in together.poses.items():
            assert np.linalg.norm(apart.settled[name].p - pose.p) < 0.0005


def test_the_first_stack_that_falls_decides(judge: DrakeJudge) -> None:
    """Groups that were not simulated keep their poses."""
    falling = moved_aside(FALLING["overhang of more than half"][0], -0.2, "first ")
    standing = moved_aside(STABLE["box on box"], 0.2, "second ")
    scene = scene_of(*falling, *standing)
    verdict = judge.judge(scene, rng())
    assert verdict.instability is not None
    assert verdict.instability.object == "first above"
    assert all(verdict.settled[o.name] == o.X_TO for o in standing)


def test_not_at_rest() -> None:
    """A box in free fall with very wide limits has not fallen over: it is still moving."""
    config = SettleConfig(max_time=0.1, max_displacement=1.0)
    result = settle(
        [
            resting("sugar_box", floor=0.2, name="box"),
            resting("large_marker", xy=(0, 0.2), name="m"),
        ],
        TRAY,
        config,
    )
    assert result.instability is not None
    assert (result.instability.reason, result.instability.object) == (
        InstabilityReason.NOT_AT_REST,
        "box",
    )
    steps, dt = (
        51,
        config.time_step,
    )  # it looks half a step after 0.1 s, when the step that began at 0.1 s is done
    assert result.instability.displacement == pytest.approx(
        9.81 * dt**2 * steps * (steps + 1) / 2, rel=1e-3
    )  # implicit Euler
    assert result.instability.tilt == pytest.approx(0.0, abs=1e-6)


def test_the_end_comes_when_all_are_calm_or_still() -> None:
    box = resting("sugar_box", name="box")
    calm = settle([box], TRAY, SettleConfig(), record=True)
    assert calm.instability is None
    assert calm.motion[-1].time == pytest.approx(0.2)  # four calm samples
    still = settle([box], TRAY, SettleConfig(max_time=0.8, early_stop_samples=100), record=True)
    assert still.motion[-1].time == pytest.approx(0.5), (
        "half a second in which nothing left its place"
    )
    patient = settle(
        [box],
        TRAY,
        SettleConfig(max_time=0.8, early_stop_samples=100, chatter_displacement=0.0),
        record=True,
    )
    assert patient.motion[-1].time == pytest.approx(0.8)


def check_motion(result: SettleResult, start: list[SceneObject]) -> None:
    times = np.array([frame.time for frame in result.motion])
    assert np.diff(times) == pytest.approx(np.full(len(times) - 1, 1 / 40), abs=0.002)
    assert result.motion[0].poses == {o.name: o.X_TO for o in start}
    assert result.motion[-1].poses == result.poses


def test_motion_and_collapse_are_simulated_on_demand() -> None:
    falling = FALLING["overhang of more than half"][0]
    config = SettleConfig(time_step=0.005)
    stopped = settle(falling, TRAY, config, record=True)
    followed = settle(falling, TRAY, config, record=True, simulate_collapse=True)
    assert settle(falling, TRAY, config).motion == ()
    check_motion(stopped, falling)
    check_motion(followed, falling)
    assert stopped.instability == followed.instability
    assert len(followed.motion) > len(stopped.motion)
    assert followed.motion[: len(stopped.motion)] == stopped.motion
    assert followed.poses["above"].p[2] < stopped.poses["above"].p[2]


def test_jitter_is_uniform_over_a_disc_in_the_trays_plane() -> None:
    box = resting("sugar_box", xy=(0.1, 0.2), name="box")
    generator = rng(0)
    moved = perturb_poses([box] * 2000, 0.001, generator)
    offsets = np.array([o.X_TO.p - box.X_TO.p for o in moved])
    assert (offsets[:, 2] == 0).all()
    assert all(o.X_TO.quaternion == box.X_TO.quaternion for o in moved)
    distances = np.linalg.norm(offsets, axis=1)
    assert distances.max() <= 0.001 + 1e-12
    assert (distances**2).mean() == pytest.approx(0.5e-6, rel=0.05)  # uniform over the area
    assert abs(offsets.mean(axis=0)).max() < 4e-5
    assert perturb_poses([box], 0.001, rng(0))[0] == moved[0]


@pytest.mark.parametrize(
    ("class_name", "axis", "degrees", "tilt"),
    [
        ("sugar_box", "x", 10, 10),
        ("sugar_box", "z", 25, 25),  # a box that turns on the spot has turned
        ("sugar_box", "y", 180, 180),
        ("large_marker", "z", 70, 0),  # a marker that rolls about its axis has not
        ("large_marker", "x", 20, 20),
        ("large_marker", "y", 180, 180),
        ("tomato_soup_can", "y", 0, 0),
    ],
)
def test_tilt_between(class_name: str, axis: str, degrees: float, tilt: float) -> None:
    start = resting(class_name, Orientation.FLAT_30).X_TO
    turn = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    end = Pose.from_rotation(start.rotation @ turn, (1.0, 2.0, 3.0))
    assert math.degrees(tilt_between(CLASSES[class_name], start, end)) == pytest.approx(
        tilt, abs=1e-5
    )


def test_an_instability_says_what_happened() -> None:
    assert (
        str(Instability(InstabilityReason.TOPPLED, "can_3", 0.0123, math.radians(20)))
        == "can_3 toppled (12 mm, 20 deg)"
    )
    assert not Verdict(Instability(InstabilityReason.SLID, "a", 0.02, 0.0), {}, {}, ()).stable
