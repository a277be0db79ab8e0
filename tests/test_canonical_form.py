"""The canonical form of graphs and the symmetries of orientations."""

from collections import Counter

import numpy as np
import pytest
from conftest import CLASSES, GRAMMARS

from drake_clutter.catalog import ObjectClass, RestOrientation
from drake_clutter.grammar import Orientation, canonical_form, resting_rotation

YCB = GRAMMARS["ycb7"]


def form(rules: tuple[str, ...]) -> str:
    return canonical_form(YCB.replay(rules), CLASSES)


def single(class_name: str, orientation: str) -> tuple[str, ...]:
    return ("drop_object", "end", f"insert_{class_name}", f"orient_{orientation}")


def test_canonical_form_ignores_the_order_of_siblings() -> None:
    first, second = single("sugar_box", "flat_0"), single("cracker_box", "side_90")
    assert YCB.replay(first + second).kind(1) != YCB.replay(second + first).kind(1)
    assert form(first + second) == form(second + first)
    assert form(first) != form(first + first)


@pytest.mark.parametrize("class_name", ["tomato_soup_can", "master_chef_can"])
def test_a_can_looks_the_same_in_all_ten(class_name: str) -> None:
    assert (
        len({form(single(class_name, orientation.name.lower())) for orientation in Orientation})
        == 1
    )


def test_a_markers_symmetric_orientations() -> None:
    """The marker lies in all ten orientations, which differ by the axis only."""
    by_form: dict[str, set[str]] = {}
    for orientation in Orientation:
        by_form.setdefault(form(single("large_marker", orientation.name.lower())), set()).add(
            orientation.name.lower()
        )
    assert sorted(map(sorted, by_form.values())) == [
        *(["flat_0", "side_0", "upright_0"], ["flat_120"], ["flat_150"], ["flat_30"], ["flat_60"]),
        ["flat_90", "side_90", "upright_90"],
    ]


@pytest.mark.parametrize(
    "class_name", [name for name, entry in CLASSES.items() if entry.shape.value == "box"]
)
def test_a_boxs_ten_orientations_differ(class_name: str) -> None:
    grammar = GRAMMARS["pantry14"]
    forms = {
        canonical_form(grammar.replay(single(class_name, orientation.name.lower())), CLASSES)
        for orientation in Orientation
    }
    assert len(forms) == 10


def test_canonical_form_distinguishes_structures() -> None:
    two, pair = "insert_gelatin_box", "insert_meta_gelatin_box_1"
    one_flat = single("gelatin_box", "flat_0")
    forms = [
        form(one_flat + one_flat),  # side by side
        form(
            ("drop_object", "stack_object", "end", two, two, "orient_flat_0", "orient_flat_0")
        ),  # one on the other
        form(("drop_object", "end", pair)),  # side by side, as a pair
        form(("drop_object", "stack_object", "end", pair, two, "orient_flat_0")),  # on a pair
        form(("drop_object", "stack_object", "end", two, pair, "orient_flat_0")),  # a pair on top
        form(("drop_object", "end", "insert_meta_sugar_box_1")),
        form(("drop_object", "end", "insert_meta_sugar_box_2")),
    ]
    assert len(set(forms)) == len(forms)


def test_canonical_form_of_a_tower_of_pairs_stays_short() -> None:
    rules = ["drop_object", *["stack_object"] * 9, "end", *["insert_meta_large_marker_1"] * 10]
    assert len(canonical_form(YCB.replay(tuple(rules)), CLASSES)) < 5000


# --- Orientations ---


@pytest.mark.parametrize("entry", CLASSES.values(), ids=list(CLASSES))
def test_resting_rotations(entry: ObjectClass) -> None:
    shortest, middle, longest = sorted(entry.size)
    extents = {
        RestOrientation.FLAT: (longest, shortest),
        RestOrientation.SIDE: (longest, middle),
        RestOrientation.UPRIGHT: (middle, longest),
    }
    for orientation in Orientation:
        R_TO = resting_rotation(entry, orientation)
        assert np.allclose(R_TO @ R_TO.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R_TO) == pytest.approx(1.0)
        along, up = extents[entry.only_rest or orientation.rest]
        longer = np.array([np.cos(orientation.yaw), np.sin(orientation.yaw), 0.0])
        assert np.abs(longer @ R_TO) @ np.asarray(entry.size) == pytest.approx(along)
        assert np.abs(R_TO[2]) @ np.asarray(entry.size) == pytest.approx(up)


def test_orientations_are_ten() -> None:
    assert Counter(orientation.rest for orientation in Orientation) == {
        RestOrientation.FLAT: 6,
        RestOrientation.SIDE: 2,
        RestOrientation.UPRIGHT: 2,
    }
    assert [
        np.degrees(o.yaw) for o in Orientation if o.rest is RestOrientation.FLAT
    ] == pytest.approx([0, 30, 60, 90, 120, 150])


def test_objects_are_counted_by_stack() -> None:
    two = "insert_gelatin_box"
    stack = ("drop_object", "stack_object", "end", two, two, "orient_flat_0", "orient_flat_0")
    pair = ("drop_object", "end", "insert_meta_sugar_box_1")
    for rules, stacks, fraction in (
        ((), [], 0.0),
        (single("sugar_box", "flat_0"), [["sugar_box"]], 1.0),
        (
            (*single("sugar_box", "flat_0"), *stack),
            [["gelatin_box", "gelatin_box"], ["sugar_box"]],
            2 / 3,
        ),
        (
            (*pair, *stack, *single("sugar_box", "flat_0")),
            [["gelatin_box", "gelatin_box"], ["sugar_box"], ["sugar_box", "sugar_box"]],
            2 / 5,
        ),
    ):
        graph = YCB.replay(rules)
        kinds = [[graph.kind(node) for node in nodes] for nodes in graph.stack_objects()]
        assert sorted(kinds) == stacks
        assert graph.largest_stack_fraction() == fraction
