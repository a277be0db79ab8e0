"""The fast judge against statics done by hand, against itself where nothing may matter, and against Drake."""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from random import Random

import numpy as np
import pytest
import trimesh
from conftest import CLASSES, GRAMMARS, resting, rng, scene_of
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import linprog, nnls
from scipy.spatial.transform import Rotation
from test_settle import BELOW, FALLING, MARKER_PAIR, STABLE, STANDING_PAIR

from drake_clutter.assets import build_assets
from drake_clutter.catalogue import ObjectClass, Shape, load_catalogue
from drake_clutter.config import ClutterConfig, LayoutConfig
from drake_clutter.fast.equilibrium import _nnls
from drake_clutter.fast.judge import FastJudge
from drake_clutter.fast.visibility import RayCaster
from drake_clutter.grammar import NodeBudget, Orientation, uniform_choice
from drake_clutter.scenes.layout import lay_out
from drake_clutter.scenes.scene import TRAY, Pose, Scene, SceneObject
from drake_clutter.scenes.seams import CannotJudge, CannotJudgeReason, Instability, InstabilityReason, Verdict
from drake_clutter.simulation.camera import OverheadCamera
from drake_clutter.simulation.fallback import FastOrDrakeJudge
from drake_clutter.simulation.judge import DrakeJudge

UPRIGHT = Orientation.UPRIGHT_0
MARGIN = 0.00205
"""m: what the offsets of two objects, 1 mm each, can take away, and what is added for rounding."""
STEP = 0.0001
"""m, to which `margins` knows them."""


@pytest.fixture(scope="module")
def fast(config: ClutterConfig) -> FastJudge:
    """One judge for all tests: none of its verdicts may depend on the earlier ones."""
    return FastJudge(config)


FAST = FastJudge(ClutterConfig())
"""Likewise, for hypothesis, which warns of fixtures that it does not make anew."""


def stands(*objects: SceneObject) -> bool:
    found = FAST.stability(scene_of(*objects))
    assert not isinstance(found, CannotJudge), str(found)
    return found is None


def reason_of(found: Instability | CannotJudge | None) -> InstabilityReason | CannotJudgeReason | None:
    """What is wrong. Which of two twins that fall alike is named is not asked."""
    return None if found is None else found.reason


# --- Known statics ---


@pytest.mark.parametrize("class_name", ["sugar_box", "gelatin_box", "tomato_soup_can", "master_chef_can"])
@pytest.mark.parametrize(("axis", "half"), [(0, 0.115), (1, 0.080)], ids=["along", "across"])
def test_the_tipping_point(class_name: str, axis: int, half: float) -> None:
    """What is uniform tips when its middle is beyond the edge; the judge wants the margin more. To 1 mm, and then to 0.1 mm."""
    for millimetres in [*range(-6, 7), *np.arange(-2.4, -1.7, 0.1)]:
        offset = half + millimetres / 1000
        for sign in (-1, 1):
            xy = [0.0, 0.0]
            xy[axis] = sign * offset
            assert stands(BELOW, resting(class_name, xy=xy, floor=0.060, name="above")) == (offset <= half - MARGIN)


def test_the_margin_grows_with_the_offsets() -> None:
    """3 mm instead of 1 mm: a box that is 4 mm inside the edge may be pushed over it."""
    scene = scene_of(BELOW, resting("sugar_box", xy=(0.111, 0.0), floor=0.060, name="above"))
    wide = ClutterConfig()
    wide.settle.jitter = 0.003
    assert FAST.stability(scene) is None
    fallen = Instability(InstabilityReason.UNBALANCED, "above")
    assert FastJudge(wide).stability(scene) == FastJudge(ClutterConfig(), margin=0.0041).stability(scene) == fallen
    assert FastJudge(wide, margin=0.0039).stability(scene) is None


# A box of 514 g that reaches 17 mm too far out, and what may hold it.
TOO_FAR = resting("sugar_box", xy=(0.132, 0.0), floor=0.060, name="over")
LYING_PAIR = [resting("sugar_box", xy=(0.0, y), name=name) for name, y in (("left", -0.0455), ("right", 0.0455))]
TABLE: dict[str, tuple[list[SceneObject], InstabilityReason | None]] = {
    "a can on a box": ([BELOW, resting("tomato_soup_can", floor=0.060)], None),
    "a can over the edge": ([BELOW, resting("tomato_soup_can", xy=(0.114, 0.0), floor=0.060)], InstabilityReason.UNBALANCED),
    "a bridge over a standing pair": ([*STANDING_PAIR, resting("cracker_box", floor=0.175)], None),
    "a bridge that only one of the pair carries": (
        [STANDING_PAIR[0], resting("cracker_box", floor=0.175)],
        InstabilityReason.UNBALANCED,
    ),
    "a bridge on four feet": (
        [
            *(resting("tomato_soup_can", xy=(x, y), name=f"{x} {y}") for x in (-0.07, 0.07) for y in (-0.04, 0.04)),
            resting("cracker_box", floor=0.101),
        ],
        None,
    ),
    "a table on three legs of four, its middle on the diagonal": (
        [
            *(resting("tomato_soup_can", xy=xy, name=str(xy)) for xy in ((-0.07, -0.04), (0.07, 0.04))),
            resting("cracker_box", floor=0.101),
        ],
        None,
    ),
    "an overhang without its counterweight": ([BELOW, TOO_FAR], InstabilityReason.UNBALANCED),
    "an overhang with its counterweight": ([BELOW, TOO_FAR, resting("granola_box", xy=(0.05, 0.0), floor=0.098)], None),
    "a counterweight on the wrong side": (
        [BELOW, TOO_FAR, resting("granola_box", xy=(0.16, 0.0), floor=0.098)],
        InstabilityReason.UNBALANCED,
    ),
    "a counterweight too light": (
        [BELOW, TOO_FAR, resting("large_marker", xy=(0.09, 0.0), floor=0.098)],
        InstabilityReason.UNBALANCED,
    ),
    "a marker across a marker": (
        [resting("large_marker", name="below"), resting("large_marker", Orientation.FLAT_90, floor=0.018)],
        InstabilityReason.ROLLS,
    ),
    "a marker along a marker": (
        [resting("large_marker", name="below"), resting("large_marker", floor=0.018, name="above")],
        InstabilityReason.ROLLS,
    ),
    "a box on a marker": ([resting("large_marker"), resting("gelatin_box", floor=0.018)], InstabilityReason.ROLLS),
    "a box on a marker on a box": (
        [BELOW, resting("large_marker", Orientation.FLAT_30, floor=0.060), resting("gelatin_box", floor=0.078)],
        InstabilityReason.ROLLS,
    ),
    "a box beside the line on which a marker would carry it": (
        [resting("large_marker"), resting("gelatin_box", xy=(0.0, 0.004), floor=0.018)],
        InstabilityReason.UNBALANCED,
    ),
    "a box on a pair of markers": ([*MARKER_PAIR, resting("gelatin_box", floor=0.018)], None),
    "a marker across a pair of markers": ([*MARKER_PAIR, resting("large_marker", Orientation.FLAT_90, floor=0.018)], None),
    "a box on a pair of markers, beyond one": (
        [*MARKER_PAIR, resting("gelatin_box", xy=(0.0, 0.012), floor=0.018)],
        InstabilityReason.UNBALANCED,
    ),
    "a marker over the gap of a lying pair": ([*LYING_PAIR, resting("large_marker", floor=0.038)], None),
    "a marker across the gap of a lying pair": ([*LYING_PAIR, resting("large_marker", Orientation.FLAT_90, floor=0.038)], None),
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
    assert reason_of(FAST.stability(scene_of(*objects))) is reason


@pytest.mark.parametrize(("objects", "reason"), TABLE.values(), ids=list(TABLE))
def test_numerical_noise_is_no_matter(objects: list[SceneObject], reason: InstabilityReason | None) -> None:
    """As settling leaves it: 1 nm and 1 nrad."""
    generator = rng(1)
    noisy = []
    for o in objects:
        turn = Rotation.from_rotvec(1e-9 * generator.standard_normal(3)).as_matrix()
        noisy.append(replace(o, X_TO=Pose.of(turn @ o.X_TO.rotation, o.X_TO.p + 1e-9 * generator.standard_normal(3))))
    assert reason_of(FAST.stability(scene_of(*noisy))) is reason


def test_the_verdict_names_what_falls_in_the_first_stack_that_does() -> None:
    falling = [BELOW, resting("sugar_box", xy=(0.135, 0.0), floor=0.060, name="first")]
    other = [resting("cracker_box", xy=(0.0, 0.2), name="foot"), resting("gelatin_box", xy=(0.0, 0.29), floor=0.060, name="b")]
    assert FAST.stability(scene_of(*falling, *other)) == Instability(InstabilityReason.UNBALANCED, "first")
    assert FAST.stability(scene_of(*other, *falling)) == Instability(InstabilityReason.UNBALANCED, "b")


ARCH = scene_of(
    # Tall boxes whose middles are 3 mm beyond their feet, kept apart by a box on both their inner edges.
    *(resting("cracker_box", Orientation.FLAT_90, (s * 0.213, 0.0), name=f"foot {s}") for s in (-1, 1)),
    *(resting("cracker_box", Orientation.UPRIGHT_90, (s * 0.130, 0.0), 0.060, f"leg {s}") for s in (-1, 1)),
    resting("cracker_box", floor=0.290, name="bridge"),
)


def test_an_arch_that_friction_holds(config: ClutterConfig, judge: DrakeJudge) -> None:
    """About the edge of its foot a leg is pulled inwards by its weight, 4 N at 3 mm + 2 mm, and by half the bridge, 2 N at up to
    20 mm: 0.06 Nm. The bridge pushes it out at 230 mm with up to 0.3 x 2 N: 0.14 Nm. Without friction nothing does."""
    assert FastJudge(config).stability(ARCH) is None
    assert judge.judge(ARCH, rng()).stable
    for friction in (0.0, 0.1):  # 0.05 Nm do not suffice either
        assert reason_of(FastJudge(config, friction=friction).stability(ARCH)) is InstabilityReason.UNBALANCED
    margins = FAST.margins(ARCH)  # under vertical forces
    assert not isinstance(margins, CannotJudge)
    assert max(margins.values()) < 0


# --- Columns, for which there is a formula ---

BOXES = ["cracker_box", "sugar_box", "pudding_box", "gelatin_box", "granola_box"]
MILLIMETRE = 0.001013
"""m. Sizes are round, so that no outline begins just where another one ends."""
OFFSETS = st.integers(-60, 60).map(lambda k: k * MILLIMETRE)
LAYERS = st.lists(st.tuples(st.sampled_from(BOXES), st.sampled_from(list(Orientation)), OFFSETS, OFFSETS), min_size=2, max_size=4)
Layers = list[tuple[str, Orientation, float, float]]


def column(layers: Layers) -> list[SceneObject]:
    """Each object on the one before, its middle off that one's by the offset."""
    objects: list[SceneObject] = []
    x = y = floor = 0.0
    for class_name, orientation, dx, dy in layers:
        x, y = (x + dx, y + dy) if objects else (0.0, 0.0)
        objects.append(resting(class_name, orientation, (x, y), floor, f"{class_name} {len(objects)}"))
        floor = objects[-1].top
    return objects


def how_far_inside(box: SceneObject, p_T: NDArray[np.float64]) -> float:
    """m from a point to the nearest side of a box's outline seen from above; negative outside."""
    R_TO = box.X_TO.rotation
    level = [axis for axis in range(3) if abs(R_TO[2, axis]) < 0.5]
    sizes = box.object_class.size
    return min(sizes[axis] / 2 - abs(float(R_TO[:2, axis] @ (p_T - box.X_TO.p)[:2])) for axis in level)


def column_margins(objects: Sequence[SceneObject]) -> list[float]:
    """m, for each object: how far the centre of mass of all from it upwards is inside the outlines that meet below it."""
    masses = np.array([o.object_class.mass for o in objects])
    middles = np.array([o.X_TO.p for o in objects])
    found = []
    for k, o in enumerate(objects):
        p_TC = masses[k:] @ middles[k:] / masses[k:].sum()
        found.append(min(how_far_inside(met, p_TC) for met in ([o] if k == 0 else [objects[k - 1], o])))
    return found


@given(LAYERS)
@example([("cracker_box", Orientation.FLAT_0, 0.0, 0.0), ("sugar_box", Orientation.FLAT_0, 0.110, 0.0)])
@example([("cracker_box", Orientation.FLAT_0, 0.0, 0.0), ("sugar_box", Orientation.FLAT_0, 0.1125, 0.0)])
@settings(max_examples=100)
def test_a_column_stands_while_every_centre_of_mass_is_inside(layers: Layers) -> None:
    """And the margins are how far inside it is, in steps of 0.1 mm; where another contact fails, nothing helps."""
    objects = column(layers)
    scene = scene_of(*objects)
    margins = FAST.margins(scene)
    assume(not isinstance(margins, CannotJudge))  # out of the tray, or beside what should carry it
    assert not isinstance(margins, CannotJudge)
    expected = column_margins(objects)
    assume(all(abs(e) > STEP for e in expected) and abs(min(expected) - MARGIN) > 1e-5)
    found = FAST.stability(scene)
    assert reason_of(found) is (None if min(expected) > MARGIN else InstabilityReason.UNBALANCED)
    for k, o in enumerate(objects):
        hopeless = any(other < 0 for other in expected[:k] + expected[k + 1 :])
        wanted = -0.030 if hopeless else min(max(expected[k], -0.030), 0.150)
        assert margins[o.name] == pytest.approx(wanted, abs=1.01 * STEP)


@given(LAYERS, st.integers(0, 3))
@settings(max_examples=60)
def test_losing_support_is_what_the_rest_cannot_do_without(layers: Layers, which: int) -> None:
    """Of a column that stands, what is left without an object stands exactly if nothing loses its support."""
    objects = column(layers)
    scene = scene_of(*objects)
    assume(FAST.stability(scene) is None)
    taken = objects[which % len(objects)].name
    rest = [o for o in objects if o.name != taken]
    losing = FAST.losing_support(scene, taken)
    above = tuple(o.name for o in objects[objects.index(scene[taken]) + 1 :])
    assert not isinstance(losing, CannotJudge)
    assert set(above) <= set(losing)
    if not above:  # what lies on the rest may have been its counterweight
        assert (losing == ()) == stands(*rest)


FEET = [(-0.12, -0.12), (-0.12, 0.0), (-0.12, 0.12), (0.0, -0.12), (0.0, 0.12), (0.12, -0.12), (0.12, 0.0), (0.12, 0.12)]


def on_feet(feet: Sequence[tuple[float, float]], top: SceneObject, margin: float) -> bool:
    """Whether the middle of a box lies in the hull of what is left of its contacts: by a linear programme."""
    low, high = top.bounds_T[0][:2] + margin, top.bounds_T[1][:2] - margin
    corners = []
    for foot in feet:
        half = np.array([0.089, 0.038]) / 2 - margin
        lower, upper = np.maximum(low, np.array(foot) - half), np.minimum(high, np.array(foot) + half)
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
def test_a_box_on_feet_stands_while_its_middle_is_between_them(
    feet: list[tuple[float, float]], orientation: Orientation, xy: tuple[float, float]
) -> None:
    """Statically indeterminate from two feet on. The feet are alike at top and bottom: they carry what is put on them."""
    top = resting("cereal_box_large", orientation, xy, 0.175, "top")
    expected = on_feet(feet, top, MARGIN)
    assume(on_feet(feet, top, MARGIN - 1e-5) == expected == on_feet(feet, top, MARGIN + 1e-5))
    found = FAST.stability(scene_of(*(resting("sugar_box", UPRIGHT, foot, name=f"{foot}") for foot in feet), top))
    assume(reason_of(found) is not CannotJudgeReason.FLOATING)
    assert not isinstance(found, CannotJudge)
    assert (found is None) == expected


# --- What must not matter ---

ANYTHING = st.lists(
    st.tuples(st.sampled_from([*BOXES, "tomato_soup_can", "large_marker"]), st.sampled_from(list(Orientation)), OFFSETS, OFFSETS),
    min_size=2,
    max_size=5,
)


def shifted(scene: Scene, x: float, y: float) -> Scene:
    return scene.at({o.name: o.X_TO.moved((x, y, 0.0)) for o in scene.objects})


def turned(scene: Scene, quarters: int) -> Scene:
    turn = np.rint(Rotation.from_euler("z", 90 * quarters, degrees=True).as_matrix())
    return scene.at({o.name: Pose.of(turn @ o.X_TO.rotation, turn @ o.X_TO.p) for o in scene.objects})


@given(ANYTHING, st.integers(-99, 99), st.integers(-99, 99))
@settings(max_examples=60)
def test_the_place_on_the_tray_is_no_matter(layers: Layers, x: int, y: int) -> None:
    scene = scene_of(*column(layers), tray_side=2.0)
    assert reason_of(FAST.stability(shifted(scene, x * MILLIMETRE, y * MILLIMETRE))) is reason_of(FAST.stability(scene))


@given(ANYTHING, st.integers(1, 3))
@settings(max_examples=60)
def test_quarter_turns_are_no_matter(layers: Layers, quarters: int) -> None:
    scene = scene_of(*column(layers), tray_side=2.0)
    assert reason_of(FAST.stability(turned(scene, quarters))) is reason_of(FAST.stability(scene))


@given(ANYTHING, st.randoms(use_true_random=False))
@settings(max_examples=60)
def test_the_order_of_the_objects_is_no_matter(layers: Layers, shuffle: Random) -> None:
    """Unless two objects cannot be judged, of which the first is named."""
    scene = scene_of(*column(layers), tray_side=2.0)
    supports = FAST.supports(scene)
    assume(not isinstance(supports, CannotJudge))
    objects = list(scene.objects)
    shuffle.shuffle(objects)
    other = replace(scene, objects=tuple(objects))
    assert reason_of(FAST.stability(other)) is reason_of(FAST.stability(scene))
    assert FAST.supports(other) == supports
    assert FAST.margins(other) == pytest.approx(FAST.margins(scene), abs=1.01 * STEP)
    for name in scene.names:
        one, same = FAST.losing_support(scene, name), FAST.losing_support(other, name)
        assert not isinstance(one, CannotJudge)
        assert not isinstance(same, CannotJudge)
        assert set(one) == set(same)


@given(ANYTHING)
@settings(max_examples=60)
def test_a_stack_far_away_is_no_matter(layers: Layers) -> None:
    scene = scene_of(*column(layers), tray_side=2.0)
    far = [resting("cracker_box", xy=(0.8, 0.8), name="foot"), resting("sugar_box", xy=(0.8, 0.8), floor=0.060, name="far")]
    for objects in ((*scene.objects, *far), (*far, *scene.objects)):
        assert FAST.stability(replace(scene, objects=objects)) == FAST.stability(scene)


def random_scene(seed: int) -> Scene:
    generator = rng(seed)
    while True:
        derivation = GRAMMARS["ycb7"].derive(NodeBudget(int(generator.integers(4, 18))), uniform_choice(generator))
        scene = lay_out(derivation, CLASSES, LayoutConfig(), generator)
        if isinstance(scene, Scene):
            return scene


def test_what_was_judged_before_is_no_matter(config: ClutterConfig) -> None:
    """The same verdicts, bit for bit, as those of a judge that has seen nothing, over scenes that come back, changed a little."""
    used = FastJudge(config)
    scenes = [random_scene(seed) for seed in range(12)]
    generator = rng(7)
    kinds = set()
    for step in range(24):
        scene = scenes[generator.integers(len(scenes))]
        if step % 3 == 1:
            scene = replace(scene, objects=tuple(scene.objects[k] for k in generator.permutation(len(scene.objects))))
        if step % 3 == 2:
            o = scene.objects[generator.integers(len(scene.objects))]
            scene = scene.at({o.name: o.X_TO.moved((*generator.uniform(-0.02, 0.02, 2), 0.0))})
        verdict = used.judge(scene, rng(step))
        assert FastJudge(config).judge(scene, rng(step)) == verdict
        kinds.add(type(verdict) if isinstance(verdict, CannotJudge) else verdict.stable)
    assert kinds >= {True, False}


def test_which_of_two_twins_falls_does_not_depend_on_what_was_judged_before(config: ClutterConfig) -> None:
    used = FastJudge(config)
    scene = scene_of(BELOW, *(resting("sugar_box", xy=(0.0, s * 0.1), floor=0.060, name=f"{s}") for s in (-1, 1)))
    for x, y in ((0.0, 0.0), (0.1, 0.05), (-0.1, -0.1)):
        assert FastJudge(config).stability(shifted(scene, x, y)) == used.stability(shifted(scene, x, y))


def test_a_force_that_ends_at_zero_ends_no_search() -> None:
    layers = [("pudding_box", 0.0, 0.0), ("pudding_box", 0.051663, -0.045585), ("sugar_box", 0.004052, 0.001013)]
    layers.append(("sugar_box", 0.001013, 0.001013))
    scene = scene_of(*column([(name, Orientation.FLAT_0, x, y) for name, x, y in layers]))
    assert reason_of(FAST.stability(scene)) is InstabilityReason.UNBALANCED


def test_any_number_of_orientations(config: ClutterConfig) -> None:
    """A box has 6 faces of 4 corners, fewer than the table expects: its rows run out first."""
    used = FastJudge(config)
    for degrees in range(150):
        turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        o = resting("sugar_box", name="box")
        assert used.stability(scene_of(replace(o, X_TO=Pose.of(turn @ o.X_TO.rotation, o.X_TO.p)))) is None


def test_an_empty_tray_is_stable(config: ClutterConfig, judge: DrakeJudge) -> None:
    assert judge.judge(scene_of(), rng()) == Verdict(None, {}, {}, ())
    assert FastJudge(config).judge(scene_of(), rng()) == Verdict(None, {}, {}, ())


# --- Margins, supports, what falls when something goes ---


@pytest.mark.parametrize(
    ("objects", "margins"),
    [
        # Half the smaller of the sides, 89 mm and 160 mm; below, all of it counts.
        ([BELOW, resting("sugar_box", floor=0.060, name="above")], {"below": 80.0, "above": 44.5}),
        # The overhang's middle is 20 mm inside; of both, the middle is 52.8 mm off.
        (
            [BELOW, resting("sugar_box", xy=(0.095, 0.0), floor=0.060, name="above")],
            {"below": 115 - 95 * 514 / (514 + 411), "above": 20.0},
        ),
        ([BELOW, resting("sugar_box", xy=(0.0, 0.077), floor=0.060, name="above")], {"below": 37.2, "above": 3.0}),
        # 5 mm and 20 mm beyond the edge: no contact elsewhere makes up for it.
        ([BELOW, resting("sugar_box", xy=(0.120, 0.0), floor=0.060, name="above")], {"below": -30.0, "above": -5.0}),
        ([BELOW, resting("sugar_box", xy=(0.135, 0.0), floor=0.060, name="above")], {"below": -30.0, "above": -20.0}),
        ([resting("cracker_box", name="a"), resting("gelatin_box", xy=(0.2, 0.2), name="b")], {"a": 80.0, "b": 36.5}),
        ([resting("cereal_box_large", name="a")], {"a": 97.5}),
        ([resting("tomato_soup_can", name="a")], {"a": 33.0 * math.cos(math.pi / 16)}),  # of 16 corners
        ([resting("large_marker", name="a")], {"a": 6.0}),  # its strip
    ],
)
def test_margins_in_millimetres(objects: list[SceneObject], margins: dict[str, float]) -> None:
    found = FAST.margins(scene_of(*objects))
    assert not isinstance(found, CannotJudge)
    assert {name: 1000 * margin for name, margin in found.items()} == pytest.approx(margins, abs=0.11)


def test_what_rolls_has_no_margin() -> None:
    margins = FAST.margins(scene_of(*TABLE["a box on a marker"][0]))
    assert not isinstance(margins, CannotJudge)
    assert min(margins.values()) < MARGIN


COUNTERWEIGHT = scene_of(BELOW, TOO_FAR, resting("granola_box", xy=(0.05, 0.0), floor=0.098, name="weight"))
BRIDGE = scene_of(*STANDING_PAIR, resting("cracker_box", floor=0.175, name="bridge"))
TWO_STACKS = scene_of(
    *(resting("cracker_box", xy=(0.0, -0.2), name="a"), resting("sugar_box", xy=(0.0, -0.2), floor=0.060, name="b")),
    *(resting("cracker_box", xy=(0.0, 0.2), name="c"), resting("sugar_box", xy=(0.0, 0.2), floor=0.060, name="d")),
    resting("gelatin_box", xy=(0.0, -0.2), floor=0.098, name="e"),
)


@pytest.mark.parametrize(
    ("scene", "losing"),
    [
        (TWO_STACKS, {"a": ("b", "e"), "b": ("e",), "c": ("d",), "d": (), "e": ()}),
        (BRIDGE, {"left": ("bridge",), "right": ("bridge",), "bridge": ()}),
        (COUNTERWEIGHT, {"below": ("over", "weight"), "over": ("weight",), "weight": ("over",)}),
        (
            scene_of(*MARKER_PAIR, resting("gelatin_box", floor=0.018, name="box")),
            {"left": ("box",), "right": ("box",), "box": ()},
        ),
    ],
    ids=["two stacks", "bridge", "counterweight", "pair of markers"],
)
def test_losing_support(scene: Scene, losing: dict[str, tuple[str, ...]]) -> None:
    assert FAST.stability(scene) is None
    assert {name: FAST.losing_support(scene, name) for name in scene.names} == losing


def test_losing_support_is_in_the_scenes_order_and_of_one_stack() -> None:
    """Taking the lowest of five: all fall, also those that only lie on what falls; the stack beside it stays."""
    tower = [resting("gelatin_box", floor=0.028 * k, name=f"{k}") for k in range(5)]
    scene = scene_of(*tower[::-1], resting("cracker_box", xy=(0.2, 0.2), name="beside"))
    assert FAST.losing_support(scene, "0") == ("4", "3", "2", "1")
    assert FAST.losing_support(scene, "3") == ("4",)
    assert FAST.losing_support(scene, "beside") == ()


def test_only_an_object_of_the_scene_can_be_taken() -> None:
    with pytest.raises(KeyError, match="'ghost' is not in the scene; it holds a, b, c, d, e"):
        FAST.losing_support(TWO_STACKS, "ghost")
    with pytest.raises(KeyError, match="'tray'"):
        FAST.losing_support(TWO_STACKS, TRAY)


@pytest.mark.parametrize(
    ("scene", "supports"),
    [
        (TWO_STACKS, {"a": {TRAY}, "b": {"a"}, "c": {TRAY}, "d": {"c"}, "e": {"b"}}),
        (BRIDGE, {"left": {TRAY}, "right": {TRAY}, "bridge": {"left", "right"}}),
        # Its lower side is level with the marker's top within 2 mm, but the marker is beside it.
        (
            scene_of(resting("large_marker", name="m"), resting("gelatin_box", xy=(0.0, 0.06), name="g")),
            {"m": {TRAY}, "g": {TRAY}},
        ),
        (
            # A step of 1 mm between the two that carry is none: both do.
            scene_of(
                *(
                    resting("sugar_box", xy=(0.0, -0.05), name="low"),
                    resting("sugar_box", xy=(0.0, 0.05), floor=0.001, name="high"),
                ),
                resting("cracker_box", floor=0.039, name="on both"),
            ),
            {"low": {TRAY}, "high": {TRAY}, "on both": {"low", "high"}},
        ),
    ],
    ids=["two stacks", "bridge", "side by side", "a small step"],
)
def test_supports(scene: Scene, supports: dict[str, set[str]]) -> None:
    assert FAST.supports(scene) == {name: frozenset(below) for name, below in supports.items()}


# --- What can never be moved ---

# A box on a foot, 32 mm too far out, under a larger one that holds it down and leaves free only what is beyond the foot.
HELD_DOWN = scene_of(
    resting("sugar_box", UPRIGHT, (-0.0445, 0.0), name="foot"),
    resting("cracker_box", xy=(0.032, 0.0), floor=0.175, name="held"),
    resting("cereal_box_large", xy=(-0.060, 0.0), floor=0.235, name="weight"),
)


def test_what_only_its_load_holds_down_is_fixed() -> None:
    """Whatever is pressed onto the box beyond its load makes it fall sooner: nothing can begin."""
    assert FAST.stability(HELD_DOWN) is None
    assert FAST.never_movable(HELD_DOWN) == frozenset({"foot", "held", "weight"})
    assert FAST.never_movable(COUNTERWEIGHT) == frozenset(COUNTERWEIGHT.names)
    beside = scene_of(*HELD_DOWN.objects, resting("gelatin_box", xy=(-0.25, -0.25), name="beside"))
    on_top = scene_of(*HELD_DOWN.objects, resting("gelatin_box", xy=(-0.060, 0.0), floor=0.300, name="on top"))
    for scene in (beside, on_top):
        assert FAST.stability(scene) is None
        assert FAST.never_movable(scene) == frozenset({"foot", "held", "weight"})


def test_what_can_be_held_by_another_load_is_not_fixed() -> None:
    """A weight of 140 mm leaves strips of a box of 160 mm free over the foot: something may press there when it goes."""
    narrower = scene_of(*HELD_DOWN.objects[:2], resting("granola_box", xy=(-0.060, 0.0), floor=0.235, name="weight"))
    assert FAST.stability(narrower) is None
    assert FAST.losing_support(narrower, "weight") == ("held",)
    assert FAST.never_movable(narrower) == frozenset()


def block(name: str, shape: Shape, size: tuple[float, float, float], mass: float) -> ObjectClass:
    """A class without assets, which the fast judge does not need."""
    return ObjectClass(name, shape, size, mass, "", (), None, None, CLASSES["sugar_box"].label, Path("nowhere"))


def a_pair_on_a_narrow_foot(class_of_load: ObjectClass, R_TO: NDArray[np.float64]) -> Scene:
    """Two boxes, each with its middle beyond a foot of 20 mm x 90 mm, and over the gap between them what holds them down."""
    foot = SceneObject("foot", block("foot", Shape.BOX, (0.09, 0.02, 0.10), 0.2), Pose((0.0, 0.0, 0.05)))
    pair = [resting("gelatin_box", xy=(0.0, s * 0.0375), floor=0.10, name=f"half {s}") for s in (-1, 1)]
    half = float(np.abs(R_TO[2] * np.array(class_of_load.size)).sum()) / 2
    return scene_of(foot, *pair, SceneObject("load", class_of_load, Pose.of(R_TO, (0.0, 0.0, 0.128 + half))))


def test_a_pair_that_its_load_holds_down_is_fixed() -> None:
    """A heavy roll over the gap covers what is free over the foot, and when one of the pair goes, nothing keeps it up: what can
    be put on it presses on its top, over the gap. On a flat load something could be put down first, over the other half."""
    lying = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    rolled = a_pair_on_a_narrow_foot(block("roll", Shape.CYLINDER, (0.018, 0.018, 0.12), 3.0), lying)
    assert FAST.stability(rolled) is None
    assert FAST.never_movable(rolled) == frozenset(rolled.names)
    flat = a_pair_on_a_narrow_foot(block("bar", Shape.BOX, (0.12, 0.018, 0.018), 3.0), np.eye(3))
    assert FAST.stability(flat) is None
    assert FAST.never_movable(flat) == frozenset()
    assert all(FAST.losing_support(flat, name) for name in flat.names)  # though as it is, nothing can be taken


@pytest.mark.parametrize("scene", [TWO_STACKS, BRIDGE, ARCH, *(scene_of(*objects) for objects in STABLE.values())])
def test_ordinary_stacks_have_nothing_fixed(scene: Scene) -> None:
    assert FAST.never_movable(scene) == frozenset()


@pytest.mark.parametrize("seed", range(6))
def test_what_can_be_taken_off_a_random_scene_is_not_fixed(seed: int) -> None:
    scene = random_scene(seed)
    fixed = FAST.never_movable(scene)
    if isinstance(fixed, CannotJudge):
        assert FAST.supports(scene) == fixed
        return
    loose = {name for name in scene.names if FAST.losing_support(scene, name) == ()}
    if FAST.stability(scene) is None:
        assert loose
        assert loose.isdisjoint(fixed)


# --- What it cannot judge ---


def leaning(o: SceneObject, degrees: float) -> SceneObject:
    """Turned about the tray's y, its lowest point at the height where it was."""
    R_TO = Rotation.from_euler("y", degrees, degrees=True).as_matrix() @ o.X_TO.rotation
    lowest = float((o.object_class.corners @ R_TO.T)[:, 2].min())
    return replace(o, X_TO=Pose.of(R_TO, (*o.X_TO.p[:2], o.bounds_T[0][2] - lowest)))


CANNOT: dict[str, tuple[list[SceneObject], CannotJudgeReason]] = {
    "leans": ([leaning(resting("sugar_box", UPRIGHT, name="it"), 3.0)], CannotJudgeReason.LEANING),
    "a can that leans": ([leaning(resting("tomato_soup_can", name="it"), 3.0)], CannotJudgeReason.LEANING),
    "a marker that leans": ([leaning(resting("large_marker", name="it"), 3.0)], CannotJudgeReason.LEANING),
    "over the rim": ([resting("cracker_box", xy=(0.240, 0.0), name="it")], CannotJudgeReason.OUTSIDE_TRAY),
    "beside the tray": ([resting("large_marker", xy=(0.0, -0.5), name="it")], CannotJudgeReason.OUTSIDE_TRAY),
    "in another": (
        [resting("gelatin_box", xy=(0.1, 0.0), floor=0.040, name="it"), BELOW],
        CannotJudgeReason.INTERPENETRATING,
    ),
    "beside each other, 2 mm too near": (
        [resting("gelatin_box", xy=(0.0, 0.071), name="it"), resting("gelatin_box", name="other")],
        CannotJudgeReason.INTERPENETRATING,
    ),
    "in the tray": ([resting("cracker_box", floor=-0.003, name="it")], CannotJudgeReason.INTERPENETRATING),
    "floats": ([resting("cracker_box", floor=0.05, name="it")], CannotJudgeReason.FLOATING),
    "floats 3 mm above a box": ([BELOW, resting("gelatin_box", floor=0.063, name="it")], CannotJudgeReason.FLOATING),
    "floats far beside": ([BELOW, resting("gelatin_box", xy=(0.0, 0.25), floor=0.060, name="it")], CannotJudgeReason.FLOATING),
    "on the side of a marker": (
        [resting("large_marker", name="other"), resting("gelatin_box", xy=(0.0, 0.044), floor=0.018, name="it")],
        CannotJudgeReason.EDGE_CONTACT,
    ),
    "in the groove of a pair": ([*MARKER_PAIR, resting("large_marker", floor=0.0175, name="it")], CannotJudgeReason.EDGE_CONTACT),
    "misses": ([BELOW, resting("gelatin_box", xy=(0.0, 0.13), floor=0.060, name="it")], CannotJudgeReason.UNSUPPORTED),
}


@pytest.mark.parametrize(("objects", "reason"), CANNOT.values(), ids=list(CANNOT))
def test_what_it_cannot_judge(objects: list[SceneObject], reason: CannotJudgeReason, config: ClutterConfig) -> None:
    """Whatever is asked. What misses what should carry it falls; the rest may fall or not."""
    scene = scene_of(*objects)
    answer = CannotJudge(reason, "it")
    assert FAST.supports(scene) == FAST.margins(scene) == FAST.never_movable(scene) == answer
    losing = FAST.losing_support(scene, "it")
    if reason is CannotJudgeReason.UNSUPPORTED:
        assert losing in (answer, CannotJudge(CannotJudgeReason.FLOATING, "it"))  # of its group alone, to which the other is not
        assert FAST.stability(scene) == Instability(InstabilityReason.UNSUPPORTED, "it")
        return
    assert losing == answer
    generator, untouched = rng(), rng()
    assert FAST.stability(scene) == FAST.judge(scene, generator) == answer
    assert generator.random() == untouched.random()  # so that Drake draws the same offsets when it is asked instead
    assert str(answer) == f"it {reason.value}"


@pytest.mark.parametrize("degrees", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("class_name", ["sugar_box", "tomato_soup_can", "large_marker"])
def test_what_hardly_leans_is_judged(class_name: str, degrees: float) -> None:
    assert FAST.stability(scene_of(leaning(resting(class_name, name="it"), degrees))) is None


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
def test_stable_scenes_look_as_drake_says(scene: Scene, config: ClutterConfig, fast: FastJudge, judge: DrakeJudge) -> None:
    """The same offsets are drawn; then a marker, and what lies on markers, rolls by what still counts as rest. What Drake has
    settled, the fast judge takes for settled."""
    mine, drakes = fast.judge(scene, rng(3)), judge.judge(scene, rng(3))
    assert isinstance(mine, Verdict)
    assert mine.stable
    assert drakes.stable
    assert mine.hidden == drakes.hidden
    assert list(mine.visible_share) == list(scene.names)
    assert mine.visible_share == pytest.approx(drakes.visible_share, abs=0.01)
    for name in scene.names:
        assert np.linalg.norm(mine.settled[name].p - drakes.settled[name].p) < config.settle.rest_drift
        assert np.hypot(*(mine.settled[name].p - scene[name].X_TO.p)[:2]) <= 0.001
    assert fast.stability(scene.at(drakes.settled)) is None


@pytest.mark.parametrize(("objects", "reason", "name"), FALLING.values(), ids=list(FALLING))
def test_what_falls_in_drake(objects: list[SceneObject], reason: InstabilityReason, name: str, fast: FastJudge) -> None:
    verdict = fast.judge(scene_of(*objects), rng())
    if isinstance(verdict, CannotJudge):
        assert verdict.reason in (CannotJudgeReason.FLOATING, CannotJudgeReason.OUTSIDE_TRAY)
        assert verdict.object == name
        return
    assert verdict.instability is not None
    assert verdict.instability.object == name
    assert (verdict.instability.displacement, verdict.instability.tilt) == (0.0, 0.0)
    assert str(verdict.instability) == f"{name} {verdict.instability.reason.value}"
    assert (verdict.visible_share, verdict.hidden) == ({}, ())
    assert set(verdict.settled) == {o.name for o in objects}
    assert reason is not InstabilityReason.LEFT_TRAY


def test_the_same_rng_gives_the_same_verdict(config: ClutterConfig, fast: FastJudge) -> None:
    verdict = fast.judge(HIDING, rng(5))
    assert FastJudge(config).judge(HIDING, rng(5)) == verdict
    other = fast.judge(HIDING, rng(6))
    assert isinstance(other, Verdict)
    assert isinstance(verdict, Verdict)
    assert other.settled != verdict.settled


def test_the_threshold_of_hidden_is_the_configs(config: ClutterConfig) -> None:
    open_minded = ClutterConfig()
    open_minded.camera.hidden_below = 0.0
    verdict = FastJudge(open_minded).judge(HIDING, rng())
    assert isinstance(verdict, Verdict)
    assert verdict.hidden == ()
    assert verdict.visible_share["gelatin"] == 0.0


@pytest.mark.parametrize("name", ["a box on its shelf above nothing", "a stack beside the tray"])
def test_what_the_fast_judge_cannot_judge_drake_does(name: str, config: ClutterConfig, judge: DrakeJudge) -> None:
    scene = scene_of(*FALLING[name][0])
    assert FastOrDrakeJudge(config).judge(scene, rng(2)) == judge.judge(scene, rng(2))


def test_what_the_fast_judge_can_judge_drake_is_not_asked(config: ClutterConfig, fast: FastJudge) -> None:
    assert FastOrDrakeJudge(config).judge(HIDING, rng(2)) == fast.judge(HIDING, rng(2))


# --- A user's own meshes ---


def hull(corners: NDArray[np.float64]) -> trimesh.Trimesh:
    made: trimesh.Trimesh = trimesh.convex.convex_hull(corners)
    return made


def regular(sides: int, radius: float, z: float) -> NDArray[np.float64]:
    angle = np.arange(sides) * (2 * math.pi / sides)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(sides, z)])


ASKEW = Rotation.from_euler("zyx", (40, 40, 40), degrees=True).as_matrix()


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> dict[str, ObjectClass]:
    """A hexagonal prism, a frustum, a wedge that is high at -x, a box askew in its frame, and a bracket, not convex."""
    folder = tmp_path_factory.mktemp("user") / "own"
    folder.mkdir()
    wedge = [[x, y, z] for y in (-0.03, 0.03) for x, z in ((-0.06, 0.0), (0.06, 0.0), (-0.06, 0.08))]
    outline = [[0.0, 0.0], [0.10, 0.0], [0.10, 0.03], [0.03, 0.03], [0.03, 0.08], [0.0, 0.08]]
    corners = [[x, y, z] for y in (-0.03, 0.03) for x, z in outline]
    front = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]
    sides = [triangle for i in range(6) for j in [(i + 1) % 6] for triangle in ([i, i + 6, j], [j, i + 6, j + 6])]
    bracket = trimesh.Trimesh(corners, front + [[6 + c, 6 + b, 6 + a] for a, b, c in front] + sides)
    bracket.fix_normals()
    meshes = {
        "prism": hull(np.vstack([regular(6, 0.05, z) for z in (0.0, 0.07)])),
        "frustum": hull(np.vstack([regular(4, 0.06, 0.0), regular(4, 0.03, 0.06)])),
        "wedge": hull(np.array(wedge)),
        "bracket": bracket,
        "askew": hull(np.array(list(product((-0.025, 0.025), (-0.030, 0.030), (-0.035, 0.035)))) @ ASKEW.T),
    }
    for name, mesh in meshes.items():
        mesh.export(folder / f"{name}.stl")
    entries = [f"  {name}: {{shape: mesh, mesh: {name}.stl, mass_g: 200}}\n" for name in meshes]
    (folder / "catalogue.yaml").write_text("classes:\n" + "".join(entries))
    build_assets(folder)
    catalogue = load_catalogue(folder)
    return {name: catalogue.classes[name] for name in meshes}


def as_made(
    object_class: ObjectClass, xy: tuple[float, float], floor: float, degrees: float = 0.0, name: str = "own"
) -> SceneObject:
    """On its z, turned about it."""
    R_TO = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return SceneObject(name, object_class, Pose.of(R_TO, (*xy, floor - float(object_class.corners[:, 2].min()))))


@pytest.mark.parametrize(
    ("class_name", "x", "degrees", "stable"),
    [
        ("prism", 0.105, 10.0, True),
        ("prism", 0.125, 10.0, False),
        ("frustum", 0.123, 0.0, False),
        # A wedge's centre of mass is a third of the way from its high end: 20 mm off its middle.
        ("wedge", 0.123, 0.0, True),
        ("wedge", 0.107, 180.0, False),
    ],
)
def test_own_meshes_near_the_edge_of_a_box(
    class_name: str, x: float, degrees: float, stable: bool, own: dict[str, ObjectClass], fast: FastJudge, judge: DrakeJudge
) -> None:
    """The edge is at 115 mm."""
    scene = scene_of(BELOW, as_made(own[class_name], (x, 0.0), 0.060, degrees))
    mine, drakes = fast.judge(scene, rng(1)), judge.judge(scene, rng(1))
    assert isinstance(mine, Verdict)
    assert mine.stable is drakes.stable is stable
    assert mine.visible_share == pytest.approx(drakes.visible_share, abs=0.01)


@pytest.mark.parametrize(("x", "stable"), [(0.012, True), (0.030, False)])
def test_a_box_on_a_frustums_small_top(
    x: float, stable: bool, own: dict[str, ObjectClass], fast: FastJudge, judge: DrakeJudge
) -> None:
    """Its top is a square of 42 mm on its corner; its outline would carry the box at 30 mm."""
    scene = scene_of(as_made(own["frustum"], (0.0, 0.0), 0.0), resting("gelatin_box", xy=(x, 0.0), floor=0.060, name="box"))
    mine = fast.judge(scene, rng(1))
    assert isinstance(mine, Verdict)
    assert mine.stable is judge.judge(scene, rng(1)).stable is stable


def test_margins_of_own_meshes(own: dict[str, ObjectClass], fast: FastJudge) -> None:
    """From the centre of mass to the nearest side: of a hexagon, its inner radius; of the wedge, 40 mm from its high end."""
    for class_name, margin in (
        ("prism", 0.050 * math.cos(math.pi / 6)),
        ("frustum", 0.060 * math.cos(math.pi / 4)),
        ("wedge", 0.03),
    ):
        found = fast.margins(scene_of(as_made(own[class_name], (0.1, 0.0), 0.0, 20.0)))
        assert not isinstance(found, CannotJudge)
        assert found["own"] == pytest.approx(margin, abs=1.01 * STEP)
    over = fast.margins(scene_of(BELOW, as_made(own["wedge"], (0.123, 0.0), 0.060)))
    assert not isinstance(over, CannotJudge)
    assert over["own"] == pytest.approx(0.115 - (0.123 - 0.020), abs=1.01 * STEP)


def test_a_mesh_stands_on_a_face_askew_in_its_frame(own: dict[str, ObjectClass], fast: FastJudge) -> None:
    """On each of its six faces."""
    for turn in ("x", 0), ("x", 90), ("x", 180), ("x", 270), ("y", 90), ("y", 270):
        R_TO = Rotation.from_euler(*turn, degrees=True).as_matrix() @ ASKEW.T
        lowest = float((own["askew"].corners @ R_TO.T)[:, 2].min())
        margins = fast.margins(scene_of(SceneObject("own", own["askew"], Pose.of(R_TO, (0.0, 0.0, -lowest)))))
        assert not isinstance(margins, CannotJudge)
        assert margins["own"] >= 0.025 - 1.01 * STEP, turn


def test_nothing_stands_on_a_slope(own: dict[str, ObjectClass], fast: FastJudge) -> None:
    found = fast.stability(scene_of(as_made(own["wedge"], (0.0, 0.0), 0.0), resting("gelatin_box", floor=0.080, name="box")))
    assert found == CannotJudge(CannotJudgeReason.EDGE_CONTACT, "box")


def test_the_caster_sees_own_meshes_as_the_camera_does(own: dict[str, ObjectClass], config: ClutterConfig) -> None:
    """Turned any way. Of a few hundred pixels hardly one is judged otherwise."""
    turns = Rotation.random(4, rng=rng(2)).as_matrix()
    tumbled = [
        SceneObject(name, own[name], Pose.of(turn, (x, 0.02, 0.15)))
        for name, turn, x in zip(("prism", "frustum", "wedge"), turns, (-0.12, 0.0, 0.11), strict=False)
    ]
    scene = scene_of(*tumbled, resting("sugar_box", xy=(0.05, 0.0), floor=0.25, name="before"))
    shares = RayCaster(config.camera).visible_shares(scene.objects)
    assert shares == pytest.approx(OverheadCamera(config.camera).visible_shares(scene), abs=0.01)
    assert sum(0.02 < share < 0.98 for share in shares.values()) >= 2


def test_what_is_not_convex_is_left_to_drake(own: dict[str, ObjectClass], config: ClutterConfig, judge: DrakeJudge) -> None:
    scene = scene_of(as_made(own["bracket"], (0.1, 0.0), 0.0, name="bracket"))
    answer = CannotJudge(CannotJudgeReason.NOT_CONVEX, "bracket")
    fast = FastJudge(config)
    assert fast.stability(scene) == fast.supports(scene) == fast.judge(scene, rng()) == answer
    verdict = FastOrDrakeJudge(config).judge(scene, rng(4))
    assert verdict == judge.judge(scene, rng(4))
    assert verdict.stable


# --- The solver ---


def optimal(A: NDArray[np.float64], b: NDArray[np.float64], x: NDArray[np.float64]) -> bool:
    """Karush, Kuhn and Tucker: no coordinate could grow, and none that is not 0 could shrink, to any use."""
    gradient = A.T @ (b - A @ x)
    return bool((x >= 0).all() and gradient.max() < 1e-8 and np.abs(gradient * x).max() < 1e-8)


@pytest.mark.parametrize("kind", ["full rank", "low rank", "twin columns", "small whole numbers", "one direction"])
@pytest.mark.parametrize("within_reach", [True, False])
def test_nnls(kind: str, within_reach: bool) -> None:
    """As good as SciPy's, where that one's answer has not grown so large (of a low rank, beyond 1e13) that it means nothing."""
    generator = rng(0)
    compared = 0
    for _ in range(150):
        rows, columns = int(generator.integers(1, 25)), int(generator.integers(1, 60))
        A = generator.standard_normal((rows, columns))
        if kind == "low rank":
            rank = max(1, min(rows, columns) // 2)
            A = generator.standard_normal((rows, rank)) @ generator.standard_normal((rank, columns))
        elif kind == "twin columns":
            A[:, generator.integers(columns, size=columns // 2)] = A[:, generator.integers(columns, size=columns // 2)]
        elif kind == "small whole numbers":
            A = np.round(A)
        elif kind == "one direction":
            A += 3 * generator.standard_normal((rows, 1))
        b = A @ np.maximum(generator.standard_normal(columns), 0) if within_reach else generator.standard_normal(rows)
        b /= max(1.0, float(np.linalg.norm(b)))
        x = _nnls(A, b, 1e-9)
        assert optimal(A, b, x)
        theirs, residual = nnls(A, b, maxiter=3000)
        if theirs.max() < 1e6:
            compared += 1
            assert np.linalg.norm(A @ x - b) == pytest.approx(residual, abs=1e-8)
    assert compared > 140
