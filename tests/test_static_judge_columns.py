"""The static judge on random columns, against a formula and its own symmetries."""

from collections.abc import Sequence
from dataclasses import replace
from random import Random

import numpy as np
import pytest
from conftest import random_scene, resting, rng, scene_of
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation
from test_settle import BELOW
from test_static_judge import MARGIN, STATIC_JUDGE, STEP, UPRIGHT, reason_of, stands

from drake_clutter.config import ClutterConfig
from drake_clutter.grammar import Orientation
from drake_clutter.scenes.interfaces import (
    InconclusiveReason,
    InconclusiveVerdict,
    InstabilityReason,
    Verdict,
)
from drake_clutter.scenes.scene import Pose, Scene, SceneObject
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.stability.static_judge import StaticStabilityJudge

# --- Columns, for which there is a formula ---

BOXES = ["cracker_box", "sugar_box", "pudding_box", "gelatin_box", "granola_box"]
MILLIMETER = 0.001013
"""A millimeter plus a fraction [m], so that no outlines coincide."""
OFFSETS = st.integers(-60, 60).map(lambda k: k * MILLIMETER)
LAYERS = st.lists(
    st.tuples(st.sampled_from(BOXES), st.sampled_from(list(Orientation)), OFFSETS, OFFSETS),
    min_size=2,
    max_size=4,
)
Layers = list[tuple[str, Orientation, float, float]]


def column(layers: Layers) -> list[SceneObject]:
    """Return a column; the offsets are relative to the object below."""
    objects: list[SceneObject] = []
    x = y = floor = 0.0
    for class_name, orientation, dx, dy in layers:
        x, y = (x + dx, y + dy) if objects else (0.0, 0.0)
        objects.append(
            resting(class_name, orientation, (x, y), floor, f"{class_name} {len(objects)}")
        )
        floor = objects[-1].top_height
    return objects


def how_far_inside(box: SceneObject, p_T: NDArray[np.float64]) -> float:
    """Return the distance from a point to a box's outline [m]; negative outside."""
    R_TO = box.X_TO.rotation
    level = [axis for axis in range(3) if abs(R_TO[2, axis]) < 0.5]
    sizes = box.object_class.size
    return min(
        sizes[axis] / 2 - abs(float(R_TO[:2, axis] @ (p_T - box.X_TO.p)[:2])) for axis in level
    )


def column_margins(objects: Sequence[SceneObject]) -> list[float]:
    """Return for each object the margin of the center of mass of the column above it [m].

    It is measured in the outlines that meet below the object.
    """
    masses = np.array([o.object_class.mass for o in objects])
    centers = np.array([o.X_TO.p for o in objects])
    found = []
    for k, o in enumerate(objects):
        p_TC = masses[k:] @ centers[k:] / masses[k:].sum()
        found.append(
            min(how_far_inside(met, p_TC) for met in ([o] if k == 0 else [objects[k - 1], o]))
        )
    return found


@given(LAYERS)
@example(
    [("cracker_box", Orientation.FLAT_0, 0.0, 0.0), ("sugar_box", Orientation.FLAT_0, 0.110, 0.0)]
)
@example(
    [("cracker_box", Orientation.FLAT_0, 0.0, 0.0), ("sugar_box", Orientation.FLAT_0, 0.1125, 0.0)]
)
@settings(max_examples=100)
def test_a_column_stands_while_every_center_of_mass_is_inside(layers: Layers) -> None:
    """Margins are the distances to the edge, in steps of 0.1 mm.

    If another contact of the column fails, the margin is the smallest value.
    """
    objects = column(layers)
    scene = scene_of(*objects)
    margins = STATIC_JUDGE.stability_margins(scene)
    assume(
        not isinstance(margins, InconclusiveVerdict)
    )  # out of the tray, or beside what should carry it
    assert not isinstance(margins, InconclusiveVerdict)
    expected = column_margins(objects)
    assume(all(abs(e) > STEP for e in expected) and abs(min(expected) - MARGIN) > 1e-5)
    found = STATIC_JUDGE.find_instability(scene)
    assert reason_of(found) is (None if min(expected) > MARGIN else InstabilityReason.UNBALANCED)
    for k, o in enumerate(objects):
        hopeless = any(other < 0 for other in expected[:k] + expected[k + 1 :])
        wanted = -0.030 if hopeless else min(max(expected[k], -0.030), 0.150)
        assert margins[o.name] == pytest.approx(wanted, abs=1.01 * STEP)


@given(LAYERS, st.integers(0, 3))
@settings(max_examples=60)
def test_losing_support_is_what_the_rest_cannot_do_without(layers: Layers, which: int) -> None:
    """The rest of a stable column stands exactly if no object loses its support."""
    objects = column(layers)
    scene = scene_of(*objects)
    assume(STATIC_JUDGE.find_instability(scene) is None)
    taken = objects[which % len(objects)].name
    rest = [o for o in objects if o.name != taken]
    losing = STATIC_JUDGE.objects_losing_support(scene, taken)
    above = tuple(o.name for o in objects[objects.index(scene[taken]) + 1 :])
    assert not isinstance(losing, InconclusiveVerdict)
    assert set(above) <= set(losing)
    if not above:  # what lies on the rest may have been its counterweight
        assert (losing == ()) == stands(*rest)


FEET = [
    (-0.12, -0.12),
    (-0.12, 0.0),
    (-0.12, 0.12),
    (0.0, -0.12),
    (0.0, 0.12),
    (0.12, -0.12),
    (0.12, 0.0),
    (0.12, 0.12),
]


def on_feet(feet: Sequence[tuple[float, float]], top: SceneObject, margin: float) -> bool:
    """Return whether a box's center is in the hull of its shrunk contacts.

    Computed by a linear program.
    """
    low, high = top.bounds_T[0][:2] + margin, top.bounds_T[1][:2] - margin
    corners = []
    for foot in feet:
        half = np.array([0.089, 0.038]) / 2 - margin
        lower, upper = (
            np.maximum(low, np.array(foot) - half),
            np.minimum(high, np.array(foot) + half),
        )
        if (lower < upper).all():
            corners += [(x, y, 1.0) for x in (lower[0], upper[0]) for y in (lower[1], upper[1])]
    if not corners:
        return False
    A = np.array(corners).T
    return bool(linprog(np.zeros(A.shape[1]), A_eq=A, b_eq=[*top.X_TO.p[:2], 1.0]).status == 0)


@given(
    st.lists(st.sampled_from(FEET), min_size=1, max_size=4, unique=True),
    st.sampled_from([Orientation.FLAT_0, Orientation.FLAT_90]),
    st.tuples(OFFSETS, OFFSETS),
)
@settings(max_examples=100)
def test_a_box_on_feet_stands_while_its_center_is_between_them(
    feet: list[tuple[float, float]], orientation: Orientation, xy: tuple[float, float]
) -> None:
    """Boxes on several feet, a statically indeterminate problem.

    Top and bottom of the feet are alike: they carry what is put on them.
    """
    top = resting("cereal_box_large", orientation, xy, 0.175, "top")
    expected = on_feet(feet, top, MARGIN)
    assume(on_feet(feet, top, MARGIN - 1e-5) == expected == on_feet(feet, top, MARGIN + 1e-5))
    found = STATIC_JUDGE.find_instability(
        scene_of(*(resting("sugar_box", UPRIGHT, foot, name=f"{foot}") for foot in feet), top)
    )
    assume(reason_of(found) is not InconclusiveReason.FLOATING)
    assert not isinstance(found, InconclusiveVerdict)
    assert (found is None) == expected


# --- Invariance ---

ANYTHING = st.lists(
    st.tuples(
        st.sampled_from([*BOXES, "tomato_soup_can", "large_marker"]),
        st.sampled_from(list(Orientation)),
        OFFSETS,
        OFFSETS,
    ),
    min_size=2,
    max_size=5,
)


def shifted(scene: Scene, x: float, y: float) -> Scene:
    return scene.with_poses({o.name: o.X_TO.translated((x, y, 0.0)) for o in scene.objects})


def turned(scene: Scene, quarters: int) -> Scene:
    turn = np.rint(Rotation.from_euler("z", 90 * quarters, degrees=True).as_matrix())
    return scene.with_poses(
        {o.name: Pose.from_rotation(turn @ o.X_TO.rotation, turn @ o.X_TO.p) for o in scene.objects}
    )


@given(ANYTHING, st.integers(-99, 99), st.integers(-99, 99))
@settings(max_examples=60)
def test_the_place_on_the_tray_is_no_matter(layers: Layers, x: int, y: int) -> None:
    scene = scene_of(*column(layers), side=2.0)
    assert reason_of(
        STATIC_JUDGE.find_instability(shifted(scene, x * MILLIMETER, y * MILLIMETER))
    ) is reason_of(STATIC_JUDGE.find_instability(scene))


@given(ANYTHING, st.integers(1, 3))
@settings(max_examples=60)
def test_quarter_turns_are_no_matter(layers: Layers, quarters: int) -> None:
    scene = scene_of(*column(layers), side=2.0)
    assert reason_of(STATIC_JUDGE.find_instability(turned(scene, quarters))) is reason_of(
        STATIC_JUDGE.find_instability(scene)
    )


@given(ANYTHING, st.randoms(use_true_random=False))
@settings(max_examples=60)
def test_the_order_of_the_objects_is_no_matter(layers: Layers, shuffle: Random) -> None:
    """The verdict is independent of the order of objects, unless two are inconclusive."""
    scene = scene_of(*column(layers), side=2.0)
    supports = STATIC_JUDGE.find_supports(scene)
    assume(not isinstance(supports, InconclusiveVerdict))
    objects = list(scene.objects)
    shuffle.shuffle(objects)
    other = replace(scene, objects=tuple(objects))
    assert reason_of(STATIC_JUDGE.find_instability(other)) is reason_of(
        STATIC_JUDGE.find_instability(scene)
    )
    assert STATIC_JUDGE.find_supports(other) == supports
    assert STATIC_JUDGE.stability_margins(other) == pytest.approx(
        STATIC_JUDGE.stability_margins(scene), abs=1.01 * STEP
    )
    for name in scene.names:
        one, same = (
            STATIC_JUDGE.objects_losing_support(scene, name),
            STATIC_JUDGE.objects_losing_support(other, name),
        )
        assert not isinstance(one, InconclusiveVerdict)
        assert not isinstance(same, InconclusiveVerdict)
        assert set(one) == set(same)


@given(ANYTHING)
@settings(max_examples=60)
def test_a_stack_far_away_is_no_matter(layers: Layers) -> None:
    scene = scene_of(*column(layers), side=2.0)
    far = [
        resting("cracker_box", xy=(0.8, 0.8), name="foot"),
        resting("sugar_box", xy=(0.8, 0.8), floor=0.060, name="far"),
    ]
    for objects in ((*scene.objects, *far), (*far, *scene.objects)):
        assert STATIC_JUDGE.find_instability(
            replace(scene, objects=objects)
        ) == STATIC_JUDGE.find_instability(scene)


def test_verdicts_do_not_depend_on_earlier_ones(config: ClutterConfig) -> None:
    """Cached verdicts equal those of a new judge, bit for bit, in slowly changing scenes."""
    used = StaticStabilityJudge(config)
    scenes = [random_scene(seed, 4, 17) for seed in range(12)]
    generator = rng(7)
    kinds = set()
    for step in range(24):
        scene = scenes[generator.integers(len(scenes))]
        if step % 3 == 1:
            scene = replace(
                scene,
                objects=tuple(scene.objects[k] for k in generator.permutation(len(scene.objects))),
            )
        if step % 3 == 2:
            o = scene.objects[generator.integers(len(scene.objects))]
            scene = scene.with_poses(
                {o.name: o.X_TO.translated((*generator.uniform(-0.02, 0.02, 2), 0.0))}
            )
        verdict = used.judge(scene, rng(step))
        assert StaticStabilityJudge(config).judge(scene, rng(step)) == verdict
        kinds.add(type(verdict) if isinstance(verdict, InconclusiveVerdict) else verdict.stable)
    assert kinds >= {True, False}


def test_the_first_of_two_identical_objects_falls_whatever_was_judged_before(
    config: ClutterConfig,
) -> None:
    used = StaticStabilityJudge(config)
    scene = scene_of(
        BELOW, *(resting("sugar_box", xy=(0.0, s * 0.1), floor=0.060, name=f"{s}") for s in (-1, 1))
    )
    for x, y in ((0.0, 0.0), (0.1, 0.05), (-0.1, -0.1)):
        assert StaticStabilityJudge(config).find_instability(
            shifted(scene, x, y)
        ) == used.find_instability(shifted(scene, x, y))


def test_a_force_that_ends_at_zero_ends_no_search() -> None:
    layers = [
        ("pudding_box", 0.0, 0.0),
        ("pudding_box", 0.051663, -0.045585),
        ("sugar_box", 0.004052, 0.001013),
    ]
    layers.append(("sugar_box", 0.001013, 0.001013))
    scene = scene_of(*column([(name, Orientation.FLAT_0, x, y) for name, x, y in layers]))
    assert reason_of(STATIC_JUDGE.find_instability(scene)) is InstabilityReason.UNBALANCED


def test_any_number_of_orientations(config: ClutterConfig) -> None:
    """The table grows in rows first: a box has fewer corners than it expects."""
    used = StaticStabilityJudge(config)
    for degrees in range(150):
        turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        o = resting("sugar_box", name="box")
        assert (
            used.find_instability(
                scene_of(replace(o, X_TO=Pose.from_rotation(turn @ o.X_TO.rotation, o.X_TO.p)))
            )
            is None
        )


def test_an_empty_tray_is_stable(config: ClutterConfig, judge: DrakeJudge) -> None:
    assert judge.judge(scene_of(), rng()) == Verdict(None, {}, {}, ())
    assert StaticStabilityJudge(config).judge(scene_of(), rng()) == Verdict(None, {}, {}, ())
