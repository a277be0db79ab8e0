"""Margins, supports, objects losing support, and immovable objects."""

import math
from pathlib import Path

import numpy as np
import pytest
from conftest import CLASSES, random_scene, resting, scene_of
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from test_settle import BELOW, MARKER_PAIR, STABLE, STANDING_PAIR
from test_static_judge import ARCH, MARGIN, STATIC_JUDGE, TABLE, TOO_FAR, UPRIGHT

from drake_clutter.catalog import MeshUnit, ObjectClass, Shape
from drake_clutter.scenes.interfaces import InconclusiveVerdict
from drake_clutter.scenes.scene import TRAY, Pose, Scene, SceneObject


@pytest.mark.parametrize(
    ("objects", "margins"),
    [
        # Half the smaller of the sides, 89 mm and 160 mm; below, all of it counts.
        ([BELOW, resting("sugar_box", floor=0.060, name="above")], {"below": 80.0, "above": 44.5}),
        # The overhang's center is 20 mm inside; of both, the center is 52.8 mm off.
        (
            [BELOW, resting("sugar_box", xy=(0.095, 0.0), floor=0.060, name="above")],
            {"below": 115 - 95 * 514 / (514 + 411), "above": 20.0},
        ),
        (
            [BELOW, resting("sugar_box", xy=(0.0, 0.077), floor=0.060, name="above")],
            {"below": 37.2, "above": 3.0},
        ),
        # 5 mm and 20 mm beyond the edge: no contact elsewhere makes up for it.
        (
            [BELOW, resting("sugar_box", xy=(0.120, 0.0), floor=0.060, name="above")],
            {"below": -30.0, "above": -5.0},
        ),
        (
            [BELOW, resting("sugar_box", xy=(0.135, 0.0), floor=0.060, name="above")],
            {"below": -30.0, "above": -20.0},
        ),
        (
            [resting("cracker_box", name="a"), resting("gelatin_box", xy=(0.2, 0.2), name="b")],
            {"a": 80.0, "b": 36.5},
        ),
        ([resting("cereal_box_large", name="a")], {"a": 97.5}),
        (
            [resting("tomato_soup_can", name="a")],
            {"a": 33.0 * math.cos(math.pi / 16)},
        ),  # of 16 corners
        ([resting("large_marker", name="a")], {"a": 6.0}),  # its strip
    ],
)
def test_margins_in_millimetres(objects: list[SceneObject], margins: dict[str, float]) -> None:
    found = STATIC_JUDGE.stability_margins(scene_of(*objects))
    assert not isinstance(found, InconclusiveVerdict)
    assert {name: 1000 * margin for name, margin in found.items()} == pytest.approx(
        margins, abs=0.11
    )


def test_what_rolls_has_no_margin() -> None:
    margins = STATIC_JUDGE.stability_margins(scene_of(*TABLE["a box on a marker"][0]))
    assert not isinstance(margins, InconclusiveVerdict)
    assert min(margins.values()) < MARGIN


COUNTERWEIGHT = scene_of(
    BELOW, TOO_FAR, resting("granola_box", xy=(0.05, 0.0), floor=0.098, name="weight")
)
BRIDGE = scene_of(*STANDING_PAIR, resting("cracker_box", floor=0.175, name="bridge"))
TWO_STACKS = scene_of(
    *(
        resting("cracker_box", xy=(0.0, -0.2), name="a"),
        resting("sugar_box", xy=(0.0, -0.2), floor=0.060, name="b"),
    ),
    *(
        resting("cracker_box", xy=(0.0, 0.2), name="c"),
        resting("sugar_box", xy=(0.0, 0.2), floor=0.060, name="d"),
    ),
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
    assert STATIC_JUDGE.find_instability(scene) is None
    assert {
        name: STATIC_JUDGE.objects_losing_support(scene, name) for name in scene.names
    } == losing


def test_losing_support_is_in_the_scenes_order_and_of_one_stack() -> None:
    """Removing the lowest of five objects makes all fall; the stack beside them stays."""
    tower = [resting("gelatin_box", floor=0.028 * k, name=f"{k}") for k in range(5)]
    scene = scene_of(*tower[::-1], resting("cracker_box", xy=(0.2, 0.2), name="beside"))
    assert STATIC_JUDGE.objects_losing_support(scene, "0") == ("4", "3", "2", "1")
    assert STATIC_JUDGE.objects_losing_support(scene, "3") == ("4",)
    assert STATIC_JUDGE.objects_losing_support(scene, "beside") == ()


def test_only_an_object_of_the_scene_can_be_taken() -> None:
    with pytest.raises(KeyError, match="'ghost' is not in the scene; it holds a, b, c, d, e"):
        STATIC_JUDGE.objects_losing_support(TWO_STACKS, "ghost")
    with pytest.raises(KeyError, match="'tray'"):
        STATIC_JUDGE.objects_losing_support(TWO_STACKS, TRAY)


@pytest.mark.parametrize(
    ("scene", "supports"),
    [
        (TWO_STACKS, {"a": {TRAY}, "b": {"a"}, "c": {TRAY}, "d": {"c"}, "e": {"b"}}),
        (BRIDGE, {"left": {TRAY}, "right": {TRAY}, "bridge": {"left", "right"}}),
        # Its lower side is level with the marker's top within 2 mm, but the marker is beside it.
        (
            scene_of(
                resting("large_marker", name="m"), resting("gelatin_box", xy=(0.0, 0.06), name="g")
            ),
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
    assert STATIC_JUDGE.find_supports(scene) == {
        name: frozenset(below) for name, below in supports.items()
    }


# --- What can never be moved ---

# A box on a foot, 32 mm too far out, under a larger one that holds it down and leaves only the part
# beyond the foot free.
HELD_DOWN = scene_of(
    resting("sugar_box", UPRIGHT, (-0.0445, 0.0), name="foot"),
    resting("cracker_box", xy=(0.032, 0.0), floor=0.175, name="held"),
    resting("cereal_box_large", xy=(-0.060, 0.0), floor=0.235, name="weight"),
)


def test_what_only_its_load_holds_down_is_fixed() -> None:
    """The box needs its load to stay, and further loads make it fall earlier."""
    assert STATIC_JUDGE.find_instability(HELD_DOWN) is None
    assert STATIC_JUDGE.immovable_objects(HELD_DOWN) == frozenset({"foot", "held", "weight"})
    assert STATIC_JUDGE.immovable_objects(COUNTERWEIGHT) == frozenset(COUNTERWEIGHT.names)
    beside = scene_of(*HELD_DOWN.objects, resting("gelatin_box", xy=(-0.25, -0.25), name="beside"))
    on_top = scene_of(
        *HELD_DOWN.objects, resting("gelatin_box", xy=(-0.060, 0.0), floor=0.300, name="on top")
    )
    for scene in (beside, on_top):
        assert STATIC_JUDGE.find_instability(scene) is None
        assert STATIC_JUDGE.immovable_objects(scene) == frozenset({"foot", "held", "weight"})


def test_what_can_be_held_by_another_load_is_not_fixed() -> None:
    """A weight of 140 mm leaves strips of a box of 160 mm free over the foot.

    Objects may press there when the weight is removed.
    """
    narrower = scene_of(
        *HELD_DOWN.objects[:2], resting("granola_box", xy=(-0.060, 0.0), floor=0.235, name="weight")
    )
    assert STATIC_JUDGE.find_instability(narrower) is None
    assert STATIC_JUDGE.objects_losing_support(narrower, "weight") == ("held",)
    assert STATIC_JUDGE.immovable_objects(narrower) == frozenset()


def block(name: str, shape: Shape, size: tuple[float, float, float], mass: float) -> ObjectClass:
    """Return a class without assets, which the static judge does not need."""
    return ObjectClass(
        name,
        shape,
        size,
        mass,
        None,
        "",
        (),
        None,
        None,
        MeshUnit.METERS,
        CLASSES["sugar_box"].label,
        Path("nowhere"),
    )


def a_pair_on_a_narrow_foot(class_of_load: ObjectClass, R_TO: NDArray[np.float64]) -> Scene:
    """Return two boxes with centers beyond their feet, held down by a load over the gap.

    The feet are 20 mm x 90 mm.
    """
    foot = SceneObject(
        "foot", block("foot", Shape.BOX, (0.09, 0.02, 0.10), 0.2), Pose((0.0, 0.0, 0.05))
    )
    pair = [
        resting("gelatin_box", xy=(0.0, s * 0.0375), floor=0.10, name=f"half {s}") for s in (-1, 1)
    ]
    half = float(np.abs(R_TO[2] * np.array(class_of_load.size)).sum()) / 2
    return scene_of(
        foot,
        *pair,
        SceneObject("load", class_of_load, Pose.from_rotation(R_TO, (0.0, 0.0, 0.128 + half))),
    )


def test_a_pair_that_its_load_holds_down_is_fixed() -> None:
    """A heavy roll over the gap makes the boxes immovable, a flat load does not.

    The roll covers the free parts over the feet, and objects on it press over the gap. On a flat
    load, an object can first be put on the other half.
    """
    lying = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    rolled = a_pair_on_a_narrow_foot(
        block("roll", Shape.CYLINDER, (0.018, 0.018, 0.12), 3.0), lying
    )
    assert STATIC_JUDGE.find_instability(rolled) is None
    assert STATIC_JUDGE.immovable_objects(rolled) == frozenset(rolled.names)
    flat = a_pair_on_a_narrow_foot(block("bar", Shape.BOX, (0.12, 0.018, 0.018), 3.0), np.eye(3))
    assert STATIC_JUDGE.find_instability(flat) is None
    assert STATIC_JUDGE.immovable_objects(flat) == frozenset()
    assert all(
        STATIC_JUDGE.objects_losing_support(flat, name) for name in flat.names
    )  # though as it is, nothing can be taken


@pytest.mark.parametrize(
    "scene", [TWO_STACKS, BRIDGE, ARCH, *(scene_of(*objects) for objects in STABLE.values())]
)
def test_ordinary_stacks_have_nothing_fixed(scene: Scene) -> None:
    assert STATIC_JUDGE.immovable_objects(scene) == frozenset()


@pytest.mark.parametrize("seed", range(6))
def test_what_can_be_taken_off_a_random_scene_is_not_fixed(seed: int) -> None:
    scene = random_scene(seed, 4, 17)
    fixed = STATIC_JUDGE.immovable_objects(scene)
    if isinstance(fixed, InconclusiveVerdict):
        assert STATIC_JUDGE.find_supports(scene) == fixed
        return
    loose = {name for name in scene.names if STATIC_JUDGE.objects_losing_support(scene, name) == ()}
    if STATIC_JUDGE.find_instability(scene) is None:
        assert loose
        assert loose.isdisjoint(fixed)


def test_a_tower_is_disassembled_from_the_top() -> None:
    tower = [resting("cracker_box", floor=k * 0.060, name=f"box{k}") for k in range(4)]
    assert STATIC_JUDGE.is_disassemblable(scene_of(*tower)) is True
    assert STATIC_JUDGE.is_disassemblable(scene_of()) is True


def test_objects_that_hold_each_other_down_are_not_disassemblable() -> None:
    """Return two sugar boxes on a can, 12.5 mm too far out, held down by two cracker boxes."""
    can = resting("tomato_soup_can", name="can")
    leaning = [
        resting("sugar_box", xy=(0.0, side * 0.0455), floor=0.101, name=f"sugar{side}")
        for side in (-1, 1)
    ]
    load = [
        resting("cracker_box", floor=0.101 + 0.038 + k * 0.060, name=f"load{k}") for k in (0, 1)
    ]
    held = scene_of(can, *leaning, *load)
    assert STATIC_JUDGE.find_instability(held) is None
    assert STATIC_JUDGE.is_disassemblable(held) is False
    assert STATIC_JUDGE.find_instability(scene_of(can, *leaning)) is not None
    beside = resting("cracker_box", xy=(0.22, 0.22), name="beside")
    assert STATIC_JUDGE.is_disassemblable(scene_of(*held.objects, beside)) is False
    assert STATIC_JUDGE.is_disassemblable(scene_of(beside)) is True


def test_disassembly_of_scenes_beyond_the_model_is_inconclusive() -> None:
    assert isinstance(
        STATIC_JUDGE.is_disassemblable(scene_of(resting("cracker_box", floor=0.1))),
        InconclusiveVerdict,
    )
