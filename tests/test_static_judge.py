"""The static judge against closed-form statics and Drake; inconclusive scenes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import CLASSES, own_mesh_class, resting, rng, scene_of, world_with
from scipy.spatial.transform import Rotation
from test_settle import BELOW, FALLING, MARKER_PAIR, STABLE, STANDING_PAIR
from test_suction import revolved

from drake_clutter.config import ClutterConfig
from drake_clutter.grammar import Orientation
from drake_clutter.scenes.interfaces import (
    InconclusiveReason,
    InconclusiveVerdict,
    Instability,
    InstabilityReason,
    Verdict,
)
from drake_clutter.scenes.scene import Pose, Scene, SceneObject
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.simulation.hybrid import HybridJudge
from drake_clutter.stability.static_judge import StaticStabilityJudge

UPRIGHT = Orientation.UPRIGHT_0
MARGIN = 0.00205
"""Contact margin: two random offsets of 1 mm each, and the margin for rounding [m]."""
STEP = 0.0001
"""Resolution of `stability_margins` [m]."""


STATIC_JUDGE = StaticStabilityJudge(ClutterConfig())
"""The fixture `static_judge` for hypothesis, which warns of function-scoped fixtures."""


def stands(*objects: SceneObject) -> bool:
    found = STATIC_JUDGE.find_instability(scene_of(*objects))
    assert not isinstance(found, InconclusiveVerdict), str(found)
    return found is None


def reason_of(
    found: Instability | InconclusiveVerdict | None,
) -> InstabilityReason | InconclusiveReason | None:
    """Return the reason; the name of one of two identical objects is arbitrary."""
    return None if found is None else found.reason


# --- Known statics ---


@pytest.mark.parametrize(
    "class_name", ["sugar_box", "gelatin_box", "tomato_soup_can", "master_chef_can"]
)
@pytest.mark.parametrize(("axis", "half"), [(0, 0.115), (1, 0.080)], ids=["along", "across"])
def test_the_tipping_point(class_name: str, axis: int, half: float) -> None:
    """A uniform object tips when its center is beyond the edge, less the margin.

    Checked to 1 mm, then to 0.1 mm.
    """
    for millimeters in [*range(-6, 7), *np.arange(-2.4, -1.7, 0.1)]:
        offset = half + millimeters / 1000
        for sign in (-1, 1):
            xy = [0.0, 0.0]
            xy[axis] = sign * offset
            assert stands(BELOW, resting(class_name, xy=xy, floor=0.060, name="above")) == (
                offset <= half - MARGIN
            )


def test_the_margin_grows_with_the_offsets() -> None:
    """With offsets of 3 mm, a box 4 mm inside of the edge may be pushed over it."""
    scene = scene_of(BELOW, resting("sugar_box", xy=(0.111, 0.0), floor=0.060, name="above"))
    wide = world_with("settle.jitter=0.003")
    assert STATIC_JUDGE.find_instability(scene) is None
    fallen = Instability(InstabilityReason.UNBALANCED, "above")
    assert (
        StaticStabilityJudge(wide).find_instability(scene)
        == StaticStabilityJudge(ClutterConfig(), margin=0.0041).find_instability(scene)
        == fallen
    )
    assert StaticStabilityJudge(wide, margin=0.0039).find_instability(scene) is None


# A box of 514 g that reaches 17 mm too far out, and what may hold it.
TOO_FAR = resting("sugar_box", xy=(0.132, 0.0), floor=0.060, name="over")
LYING_PAIR = [
    resting("sugar_box", xy=(0.0, y), name=name)
    for name, y in (("left", -0.0455), ("right", 0.0455))
]
TABLE: dict[str, tuple[list[SceneObject], InstabilityReason | None]] = {
    "a can on a box": ([BELOW, resting("tomato_soup_can", floor=0.060)], None),
    "a can over the edge": (
        [BELOW, resting("tomato_soup_can", xy=(0.114, 0.0), floor=0.060)],
        InstabilityReason.UNBALANCED,
    ),
    "a bridge over a standing pair": ([*STANDING_PAIR, resting("cracker_box", floor=0.175)], None),
    "a bridge that only one of the pair carries": (
        [STANDING_PAIR[0], resting("cracker_box", floor=0.175)],
        InstabilityReason.UNBALANCED,
    ),
    "a bridge on four feet": (
        [
            *(
                resting("tomato_soup_can", xy=(x, y), name=f"{x} {y}")
                for x in (-0.07, 0.07)
                for y in (-0.04, 0.04)
            ),
            resting("cracker_box", floor=0.101),
        ],
        None,
    ),
    "a table on three legs of four, its center on the diagonal": (
        [
            *(
                resting("tomato_soup_can", xy=xy, name=str(xy))
                for xy in ((-0.07, -0.04), (0.07, 0.04))
            ),
            resting("cracker_box", floor=0.101),
        ],
        None,
    ),
    "an overhang without its counterweight": ([BELOW, TOO_FAR], InstabilityReason.UNBALANCED),
    "an overhang with its counterweight": (
        [BELOW, TOO_FAR, resting("granola_box", xy=(0.05, 0.0), floor=0.098)],
        None,
    ),
    "a counterweight on the wrong side": (
        [BELOW, TOO_FAR, resting("granola_box", xy=(0.16, 0.0), floor=0.098)],
        InstabilityReason.UNBALANCED,
    ),
    "a counterweight too light": (
        [BELOW, TOO_FAR, resting("large_marker", xy=(0.09, 0.0), floor=0.098)],
        InstabilityReason.UNBALANCED,
    ),
    "a marker across a marker": (
        [
            resting("large_marker", name="below"),
            resting("large_marker", Orientation.FLAT_90, floor=0.018),
        ],
        InstabilityReason.ROLLS,
    ),
    "a marker along a marker": (
        [resting("large_marker", name="below"), resting("large_marker", floor=0.018, name="above")],
        InstabilityReason.ROLLS,
    ),
    "a box on a marker": (
        [resting("large_marker"), resting("gelatin_box", floor=0.018)],
        InstabilityReason.ROLLS,
    ),
    "a box on a marker on a box": (
        [
            BELOW,
            resting("large_marker", Orientation.FLAT_30, floor=0.060),
            resting("gelatin_box", floor=0.078),
        ],
        InstabilityReason.ROLLS,
    ),
    "a box beside the line on which a marker would carry it": (
        [resting("large_marker"), resting("gelatin_box", xy=(0.0, 0.004), floor=0.018)],
        InstabilityReason.UNBALANCED,
    ),
    "a box on a pair of markers": ([*MARKER_PAIR, resting("gelatin_box", floor=0.018)], None),
    "a marker across a pair of markers": (
        [*MARKER_PAIR, resting("large_marker", Orientation.FLAT_90, floor=0.018)],
        None,
    ),
    "a box on a pair of markers, beyond one": (
        [*MARKER_PAIR, resting("gelatin_box", xy=(0.0, 0.012), floor=0.018)],
        InstabilityReason.UNBALANCED,
    ),
    "a marker over the gap of a lying pair": (
        [*LYING_PAIR, resting("large_marker", floor=0.038)],
        None,
    ),
    "a marker across the gap of a lying pair": (
        [*LYING_PAIR, resting("large_marker", Orientation.FLAT_90, floor=0.038)],
        None,
    ),
    "a marker in the gap of a standing pair": (
        [*STANDING_PAIR, resting("large_marker", floor=0.175)],
        InstabilityReason.UNSUPPORTED,
    ),
    "a marker across the gap of a standing pair": (
        [*STANDING_PAIR, resting("large_marker", Orientation.FLAT_90, floor=0.175)],
        None,
    ),
}


@pytest.mark.parametrize(("objects", "reason"), TABLE.values(), ids=list(TABLE))
def test_known_statics(objects: list[SceneObject], reason: InstabilityReason | None) -> None:
    assert reason_of(STATIC_JUDGE.find_instability(scene_of(*objects))) is reason


@pytest.mark.parametrize(("objects", "reason"), TABLE.values(), ids=list(TABLE))
def test_numerical_noise_is_no_matter(
    objects: list[SceneObject], reason: InstabilityReason | None
) -> None:
    """The verdict tolerates noise of 1 nm and 1 nrad, as after settling."""
    generator = rng(1)
    noisy = []
    for o in objects:
        turn = Rotation.from_rotvec(1e-9 * generator.standard_normal(3)).as_matrix()
        noisy.append(
            replace(
                o,
                X_TO=Pose.from_rotation(
                    turn @ o.X_TO.rotation, o.X_TO.p + 1e-9 * generator.standard_normal(3)
                ),
            )
        )
    assert reason_of(STATIC_JUDGE.find_instability(scene_of(*noisy))) is reason


def test_the_verdict_names_what_falls_in_the_first_stack_that_does() -> None:
    falling = [BELOW, resting("sugar_box", xy=(0.135, 0.0), floor=0.060, name="first")]
    other = [
        resting("cracker_box", xy=(0.0, 0.2), name="foot"),
        resting("gelatin_box", xy=(0.0, 0.29), floor=0.060, name="b"),
    ]
    assert STATIC_JUDGE.find_instability(scene_of(*falling, *other)) == Instability(
        InstabilityReason.UNBALANCED, "first"
    )
    assert STATIC_JUDGE.find_instability(scene_of(*other, *falling)) == Instability(
        InstabilityReason.UNBALANCED, "b"
    )


ARCH = scene_of(
    # Tall boxes whose centers are 3 mm beyond their feet, kept apart by a box on both inner edges.
    *(
        resting("cracker_box", Orientation.FLAT_90, (s * 0.213, 0.0), name=f"foot {s}")
        for s in (-1, 1)
    ),
    *(
        resting("cracker_box", Orientation.UPRIGHT_90, (s * 0.130, 0.0), 0.060, f"leg {s}")
        for s in (-1, 1)
    ),
    resting("cracker_box", floor=0.290, name="bridge"),
)


def test_an_arch_that_friction_holds(config: ClutterConfig, judge: DrakeJudge) -> None:
    """The arch stands only with friction.

    About the edge of its foot, a leg is pulled inwards by its weight (4 N at 3 mm + 2 mm) and by
    half the bridge (2 N at up to 20 mm): 0.06 Nm. The bridge pushes it outwards at 230 mm with up
    to 0.3 x 2 N: 0.14 Nm.
    """
    assert StaticStabilityJudge(config).find_instability(ARCH) is None
    assert judge.judge(ARCH, rng()).stable
    for friction in (0.0, 0.1):  # 0.05 Nm do not suffice either
        assert (
            reason_of(StaticStabilityJudge(config, friction=friction).find_instability(ARCH))
            is InstabilityReason.UNBALANCED
        )
    margins = STATIC_JUDGE.stability_margins(ARCH)  # under vertical forces
    assert not isinstance(margins, InconclusiveVerdict)
    assert max(margins.values()) < 0


# --- What it cannot judge ---


def leaning(o: SceneObject, degrees: float) -> SceneObject:
    """Return the object rotated about the tray's y axis, with its lowest point unchanged."""
    R_TO = Rotation.from_euler("y", degrees, degrees=True).as_matrix() @ o.X_TO.rotation
    lowest = float((o.object_class.corners @ R_TO.T)[:, 2].min())
    return replace(o, X_TO=Pose.from_rotation(R_TO, (*o.X_TO.p[:2], o.bounds_T[0][2] - lowest)))


CANNOT: dict[str, tuple[list[SceneObject], InconclusiveReason]] = {
    "leans": ([leaning(resting("sugar_box", UPRIGHT, name="it"), 3.0)], InconclusiveReason.LEANING),
    "a can that leans": (
        [leaning(resting("tomato_soup_can", name="it"), 3.0)],
        InconclusiveReason.LEANING,
    ),
    "a marker that leans": (
        [leaning(resting("large_marker", name="it"), 3.0)],
        InconclusiveReason.LEANING,
    ),
    "over the rim": (
        [resting("cracker_box", xy=(0.240, 0.0), name="it")],
        InconclusiveReason.OUTSIDE_TRAY,
    ),
    "beside the tray": (
        [resting("large_marker", xy=(0.0, -0.5), name="it")],
        InconclusiveReason.OUTSIDE_TRAY,
    ),
    "in another": (
        [resting("gelatin_box", xy=(0.1, 0.0), floor=0.040, name="it"), BELOW],
        InconclusiveReason.INTERPENETRATING,
    ),
    "beside each other, 2 mm too near": (
        [resting("gelatin_box", xy=(0.0, 0.071), name="it"), resting("gelatin_box", name="other")],
        InconclusiveReason.INTERPENETRATING,
    ),
    "in the tray": (
        [resting("cracker_box", floor=-0.003, name="it")],
        InconclusiveReason.INTERPENETRATING,
    ),
    "floats": ([resting("cracker_box", floor=0.05, name="it")], InconclusiveReason.FLOATING),
    "floats 3 mm above a box": (
        [BELOW, resting("gelatin_box", floor=0.063, name="it")],
        InconclusiveReason.FLOATING,
    ),
    "floats far beside": (
        [BELOW, resting("gelatin_box", xy=(0.0, 0.25), floor=0.060, name="it")],
        InconclusiveReason.FLOATING,
    ),
    "on the side of a marker": (
        [
            resting("large_marker", name="other"),
            resting("gelatin_box", xy=(0.0, 0.044), floor=0.018, name="it"),
        ],
        InconclusiveReason.EDGE_CONTACT,
    ),
    "in the groove of a pair": (
        [*MARKER_PAIR, resting("large_marker", floor=0.0175, name="it")],
        InconclusiveReason.EDGE_CONTACT,
    ),
    "misses": (
        [BELOW, resting("gelatin_box", xy=(0.0, 0.13), floor=0.060, name="it")],
        InconclusiveReason.UNSUPPORTED,
    ),
}


@pytest.mark.parametrize(("objects", "reason"), CANNOT.values(), ids=list(CANNOT))
def test_what_it_cannot_judge(
    objects: list[SceneObject], reason: InconclusiveReason, config: ClutterConfig
) -> None:
    """All queries are inconclusive; an object that misses its support falls."""
    scene = scene_of(*objects)
    answer = InconclusiveVerdict(reason, "it")
    assert (
        STATIC_JUDGE.find_supports(scene)
        == STATIC_JUDGE.stability_margins(scene)
        == STATIC_JUDGE.immovable_objects(scene)
        == answer
    )
    losing = STATIC_JUDGE.objects_losing_support(scene, "it")
    if reason is InconclusiveReason.UNSUPPORTED:
        assert losing in (
            answer,
            InconclusiveVerdict(InconclusiveReason.FLOATING, "it"),
        )  # of its group alone, to which the other is not
        assert STATIC_JUDGE.find_instability(scene) == Instability(
            InstabilityReason.UNSUPPORTED, "it"
        )
        return
    assert losing == answer
    generator, untouched = rng(), rng()
    assert STATIC_JUDGE.find_instability(scene) == STATIC_JUDGE.judge(scene, generator) == answer
    assert (
        generator.random() == untouched.random()
    )  # so that Drake draws the same offsets when it is asked instead
    assert str(answer) == f"it {reason.value}"


@pytest.mark.parametrize("degrees", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("class_name", ["sugar_box", "tomato_soup_can", "large_marker"])
def test_a_slight_lean_is_judged(class_name: str, degrees: float) -> None:
    assert (
        STATIC_JUDGE.find_instability(scene_of(leaning(resting(class_name, name="it"), degrees)))
        is None
    )


# --- The whole verdict, and Drake's ---

HIDING = scene_of(
    *(resting("gelatin_box", name="gelatin"), resting("cracker_box", floor=0.028, name="cover")),
    resting("tomato_soup_can", xy=(0.2, 0.2), name="can"),
    resting("large_marker", Orientation.FLAT_60, (-0.2, 0.2), name="marker"),
)
PARTLY = scene_of(
    *(
        resting("pudding_box", Orientation.FLAT_30, name="pudding"),
        resting("sugar_box", xy=(0.02, 0.01), floor=0.035, name="sugar"),
    ),
    resting("cracker_box", UPRIGHT, (-0.2, -0.1), name="wall"),
)


@pytest.mark.parametrize(
    "scene",
    [HIDING, PARTLY, *(scene_of(*objects) for objects in STABLE.values())],
    ids=["hiding", "partly", *STABLE],
)
def test_stable_scenes_agree_with_drake(
    scene: Scene, config: ClutterConfig, static_judge: StaticStabilityJudge, judge: DrakeJudge
) -> None:
    """The static verdict agrees with Drake's for equal random offsets.

    In Drake, a marker and objects on markers may roll within the limits. A scene that Drake has
    settled is stable for the static judge.
    """
    mine, drakes = static_judge.judge(scene, rng(3)), judge.judge(scene, rng(3))
    assert isinstance(mine, Verdict)
    assert mine.stable
    assert drakes.stable
    assert mine.hidden == drakes.hidden
    assert list(mine.visible_fractions) == list(scene.names)
    assert mine.visible_fractions == pytest.approx(drakes.visible_fractions, abs=0.01)
    for name in scene.names:
        assert (
            np.linalg.norm(mine.settled[name].p - drakes.settled[name].p)
            < config.settle.max_rest_displacement
        )
        assert np.hypot(*(mine.settled[name].p - scene[name].X_TO.p)[:2]) <= 0.001
    assert static_judge.find_instability(scene.with_poses(drakes.settled)) is None


@pytest.mark.parametrize(("objects", "reason", "name"), FALLING.values(), ids=list(FALLING))
def test_what_falls_in_drake(
    objects: list[SceneObject],
    reason: InstabilityReason,
    name: str,
    static_judge: StaticStabilityJudge,
) -> None:
    verdict = static_judge.judge(scene_of(*objects), rng())
    if isinstance(verdict, InconclusiveVerdict):
        assert verdict.reason in (InconclusiveReason.FLOATING, InconclusiveReason.OUTSIDE_TRAY)
        assert verdict.object == name
        return
    assert verdict.instability is not None
    assert verdict.instability.object == name
    assert (verdict.instability.displacement, verdict.instability.tilt) == (0.0, 0.0)
    assert str(verdict.instability) == f"{name} {verdict.instability.reason.value}"
    assert (verdict.visible_fractions, verdict.hidden) == ({}, ())
    assert set(verdict.settled) == {o.name for o in objects}
    assert reason is not InstabilityReason.LEFT_TRAY


def test_the_same_rng_gives_the_same_verdict(
    config: ClutterConfig, static_judge: StaticStabilityJudge
) -> None:
    verdict = static_judge.judge(HIDING, rng(5))
    assert StaticStabilityJudge(config).judge(HIDING, rng(5)) == verdict
    other = static_judge.judge(HIDING, rng(6))
    assert isinstance(other, Verdict)
    assert isinstance(verdict, Verdict)
    assert other.settled != verdict.settled


def test_the_threshold_of_hidden_is_the_configs(config: ClutterConfig) -> None:
    open_minded = world_with("camera.visibility_threshold=0")
    verdict = StaticStabilityJudge(open_minded).judge(HIDING, rng())
    assert isinstance(verdict, Verdict)
    assert verdict.hidden == ()
    assert verdict.visible_fractions["gelatin"] == 0.0


@pytest.mark.parametrize("name", ["a box on its shelf above nothing", "a stack beside the tray"])
def test_inconclusive_scenes_are_judged_in_drake(
    name: str, config: ClutterConfig, judge: DrakeJudge
) -> None:
    scene = scene_of(*FALLING[name][0])
    assert HybridJudge(config).judge(scene, rng(2)) == judge.judge(scene, rng(2))


def test_conclusive_scenes_are_not_judged_in_drake(
    config: ClutterConfig, static_judge: StaticStabilityJudge
) -> None:
    assert HybridJudge(config).judge(HIDING, rng(2)) == static_judge.judge(HIDING, rng(2))


def test_an_object_tips_on_its_narrow_foot_under_an_eccentric_load(tmp_path: Path) -> None:
    """A cone with its foot of radius 15 mm below carries a box beyond its foot.

    The common center of mass leaves the foot at an offset of the box of 15 mm (1 + m / M), where m
    is the mass of the cone and M that of the box.
    """
    cone = own_mesh_class(tmp_path, revolved([(0, 0), (0.015, 0), (0.060, 0.05), (0, 0.05)]))
    lower = SceneObject("cone", cone, Pose((0.0, 0.0, float(-cone.corners[:, 2].min()))))
    ratio = cone.mass / CLASSES["gelatin_box"].mass
    for x, y in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)):
        for factor in (0.95, 1.05):
            offset = factor * (0.015 - MARGIN) * (1 + ratio)
            upper = resting("gelatin_box", xy=(x * offset, y * offset), floor=0.05)
            assert stands(upper, lower) == (factor < 1)


@pytest.mark.parametrize("edge", [0.030, 0.045])
def test_an_object_alone_topples_if_its_center_of_mass_is_beyond_its_foot(
    edge: float, tmp_path: Path
) -> None:
    """Its section is a trapezoid, whose center of mass is 36 or 42 mm from the straight side."""
    section = np.array([(0.0, 0.0), (edge, 0.0), (0.100, 0.05), (0.0, 0.05)])
    hull = np.array([(x, y, z) for x, z in section for y in (-0.03, 0.03)])
    own = own_mesh_class(tmp_path, trimesh.convex.convex_hull(hull))
    low, high = own.corners.min(axis=0), own.corners.max(axis=0)
    center = own.center_of_mass[0] - low[0]
    widths = np.array([edge, 0.100])
    assert center == pytest.approx(
        (widths[0] ** 2 + widths.prod() + widths[1] ** 2) / (3 * widths.sum()), rel=1e-3
    )
    assert (center < edge) == (edge > 0.04)
    alone = SceneObject("own", own, Pose((0.1, 0.2, float(-low[2]))))
    assert high[0] - low[0] == pytest.approx(0.1)
    assert stands(alone) == (center < edge)


@pytest.mark.parametrize("millimeters", [-4.7, 3.1, 15.2, 15.3])
def test_stability_margins_are_multiples_of_a_tenth_of_a_millimeter(millimeters: float) -> None:
    """Of a box that lies with its center this far inside of the edge."""
    above = resting("sugar_box", xy=(0.115 - millimeters / 1000, 0.0), floor=0.060, name="above")
    margins = STATIC_JUDGE.stability_margins(scene_of(BELOW, above))
    assert not isinstance(margins, InconclusiveVerdict)
    assert margins["above"] == pytest.approx(millimeters / 1000, abs=1e-9)
