"""Placements are free, far from the center, supported, and found in the image alone."""

from collections.abc import Sequence

import numpy as np
import pytest
from conftest import CLASSES, DEFAULT_CELL, random_scene, resting, rng, scene_of
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drake_clutter.config import ExplorationConfig, PlacementConfig
from drake_clutter.grammar import Orientation
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.scenes.free_space import (
    CELL_SIZE,
    Footprint,
    best_fits,
    is_observed_free,
    levels_above,
    next_free_cell,
    visible_top_cells,
)
from drake_clutter.scenes.geometry import penetration_depth
from drake_clutter.scenes.interfaces import Move, Observation
from drake_clutter.scenes.placement import (
    find_free_placements,
    has_clear_top,
    resolve_placement,
    top_height,
)
from drake_clutter.scenes.scene import TRAY, Pose, Scene, SceneObject
from drake_clutter.tasks.belief import legal_moves

CONFIG = ExplorationConfig()
UPRIGHT = Orientation.UPRIGHT_0


def seen(detector: LabelDetector, scene: Scene) -> Observation:
    return detector.perceive(scene).observation


def placement(
    detector: LabelDetector,
    scene: Scene,
    pick: str,
    place: str = TRAY,
    seed: int = 0,
    config: ExplorationConfig = CONFIG,
) -> Pose | None:
    return placed_at(seen(detector, scene), Move(pick, place), rng(seed), config)


def placed_at(
    observation: Observation,
    move: Move,
    generator: np.random.Generator,
    config: ExplorationConfig = CONFIG,
) -> Pose | None:
    command = resolve_placement(move, observation, config, generator)
    return command.X_TO_place if command else None


def carried_by(scene: Scene, name: str) -> set[str]:
    """Return the objects above the picked one, which fall when it is removed."""
    start = scene[name]
    return {
        o.name
        for o in scene.objects
        if o.X_TO.p[2] > start.X_TO.p[2]
        and (
            np.minimum(o.bounds_T[1], start.bounds_T[1])
            > np.maximum(o.bounds_T[0], start.bounds_T[0])
        )[:2].all()
    }


def deepest_with(scene: Scene, name: str, X_TO: Pose, besides: Sequence[str] = ()) -> float:
    """Return how deep the object at its new pose penetrates any other one [m]."""
    placed = SceneObject(name, scene[name].object_class, X_TO)
    return max(
        (penetration_depth(placed, o) for o in scene.objects if o.name not in (name, *besides)),
        default=-np.inf,
    )


def test_on_an_empty_tray_the_object_goes_into_a_corner(detector: LabelDetector) -> None:
    """A box of 175 mm x 89 mm on 700 mm keeps 10 mm from two rims, up to a cell."""
    box = resting("sugar_box", name="box")
    X_TO = placement(detector, scene_of(box), "box")
    assert X_TO is not None
    furthest = 0.350 - 0.010 - 0.089 / 2  # of the center, along y
    assert furthest - 1.5 * CELL_SIZE <= abs(X_TO.p[1]) <= furthest
    furthest = 0.350 - 0.010 - 0.175 / 2  # of the center, along x
    assert furthest - 1.5 * CELL_SIZE <= abs(X_TO.p[0]) <= furthest
    assert X_TO.rotation == pytest.approx(box.X_TO.rotation)
    assert X_TO.p[2] == pytest.approx(box.X_TO.p[2] + CONFIG.release_height)


def test_the_same_seed_gives_the_same_place_and_chance_breaks_ties(detector: LabelDetector) -> None:
    scene = scene_of(resting("sugar_box", name="box"))
    places = [placement(detector, scene, "box", seed=seed) for seed in (0, 0, 1, 2, 3, 4)]
    assert places[0] == places[1]
    assert len({pose.translation for pose in places if pose}) > 2
    assert len({round(abs(pose.p[:2]).max(), 9) for pose in places if pose}) == 1


def test_a_draw_takes_one_of_the_free_places(detector: LabelDetector) -> None:
    """Placements are cached, and a search draws no random numbers."""
    observation, move = seen(detector, scene_of(resting("sugar_box", name="box"))), Move("box")
    generator = rng(3)
    places = find_free_placements(observation, move, CONFIG)
    assert places is not None
    assert generator.bit_generator.state == rng(3).bit_generator.state
    command = resolve_placement(move, observation, CONFIG, generator)
    assert command is not None
    assert (command.move, command.X_TO_pick) == (move, observation["box"].X_TO)
    assert list(command.X_TO_place.translation) in places.translations.tolist()
    assert find_free_placements(observation, move, CONFIG) is places


def test_an_object_does_not_go_onto_itself(detector: LabelDetector) -> None:
    observation = seen(detector, scene_of(resting("sugar_box", name="box")))
    with pytest.raises(ValueError, match="expected another object, or tray"):
        placed_at(observation, Move("box", "box"), rng())


@pytest.mark.parametrize("seed", range(3))
def test_places_in_random_scenes_are_free(seed: int, detector: LabelDetector) -> None:
    """A placement is free of visible and hidden objects, and its center of mass is supported."""
    scene = random_scene(seed)
    observation = seen(detector, scene)
    generator = rng(seed)
    moves = legal_moves(observation)
    checked = 0
    for move in [moves[i] for i in generator.permutation(len(moves))[:25]] + [
        m for m in moves if m.place == TRAY
    ]:
        X_TO = placed_at(observation, move, generator)
        if X_TO is None:
            continue
        checked += 1
        assert deepest_with(scene, move.pick, X_TO, tuple(carried_by(scene, move.pick))) <= 0
        placed = SceneObject(move.pick, scene[move.pick].object_class, X_TO)
        assert np.abs(placed.bounds_T)[:, :2].max() <= scene.support.size[0] / 2 - CONFIG.clearance
        floor = 0.0 if move.place == TRAY else top_height(observation[move.place])
        assert placed.bounds_T[0][2] == pytest.approx(floor + CONFIG.release_height, abs=1e-9)
        if move.place != TRAY:
            assert inside_outline(scene[move.place], X_TO.p[:2])
    assert checked >= 5


def inside_outline(o: SceneObject, xy: NDArray[np.float64]) -> bool:
    """Return whether a point is over an object of any orientation."""
    heights = np.linspace(o.bounds_T[0][2], o.bounds_T[1][2], 60)
    points = np.column_stack([np.full(60, xy[0]), np.full(60, xy[1]), heights])
    p_O = (points - o.X_TO.p) @ o.X_TO.rotation
    half = np.asarray(o.object_class.size) / 2 + 1e-9
    if o.object_class.shape.value == "cylinder":
        return bool(
            ((np.hypot(p_O[:, 0], p_O[:, 1]) < half[0]) & (np.abs(p_O[:, 2]) < half[2])).any()
        )
    return bool((np.abs(p_O) < half).all(axis=1).any())


def test_no_room_on_the_tray(detector: LabelDetector) -> None:
    """The only free space for the box is where it stands, which is hidden."""
    scene = scene_of(resting("cracker_box", name="box"), side=0.26)
    assert placement(detector, scene, "box") is None
    # 50 mm are left beside it: enough for the marker of 18 mm with 10 mm of clearance on either
    # side.
    with_marker = scene_of(
        resting("cracker_box", name="box"),
        resting("large_marker", floor=0.060, name="m"),
        side=0.26,
    )
    X_TO = placement(detector, with_marker, "m")
    assert X_TO is not None
    assert 0.080 + 0.010 + 0.009 <= abs(X_TO.p[1]) <= 0.130 - 0.010 - 0.009


BELOW = resting("cracker_box", xy=(0.05, 0.05), name="below")


@pytest.mark.parametrize("name", ["gelatin_box", "sugar_box", "tomato_soup_can", "large_marker"])
def test_on_a_free_top_the_object_goes_to_its_center(name: str, detector: LabelDetector) -> None:
    scene = scene_of(BELOW, resting(name, xy=(-0.2, -0.2), name="picked"))
    X_TO = placement(detector, scene, "picked", "below")
    assert X_TO is not None
    assert X_TO.p[:2] == pytest.approx([0.05, 0.05], abs=1.5 * CELL_SIZE)
    assert SceneObject("picked", CLASSES[name], X_TO).bounds_T[0][2] == pytest.approx(
        0.060 + CONFIG.release_height, abs=1e-9
    )
    assert deepest_with(scene, "picked", X_TO) <= 0


def test_beside_what_stands_on_the_top(detector: LabelDetector) -> None:
    """A placement on a top keeps the clearance from a can in its center."""
    scene = scene_of(
        *(BELOW, resting("tomato_soup_can", xy=(0.05, 0.05), floor=0.060, name="can")),
        resting("gelatin_box", xy=(-0.2, -0.2), name="picked"),
    )
    assert placement(detector, scene, "picked", "below") is None  # too far from the middle
    anywhere = ExplorationConfig(placement=PlacementConfig(max_offset_fraction=1.0))
    X_TO = placement(detector, scene, "picked", "below", config=anywhere)
    assert X_TO is not None
    assert deepest_with(scene, "picked", X_TO, ["below"]) <= -CONFIG.clearance
    aside = np.abs(X_TO.p[:2] - 0.05)
    assert 0.033 + 0.010 + 0.0365 <= aside[0] <= 0.115 - 0.005
    assert aside[1] <= 0.080 - 0.005


def test_no_room_on_an_occupied_top(detector: LabelDetector) -> None:
    """Beside a sugar box in the center, 27 mm and 35 mm of the top are free."""
    scene = scene_of(
        *(BELOW, resting("sugar_box", xy=(0.05, 0.05), floor=0.060, name="on top")),
        resting("sugar_box", xy=(-0.2, -0.25), name="picked"),
    )
    observation = seen(detector, scene)
    assert observation["below"].mask.any()
    assert placed_at(observation, Move("picked", "below"), rng()) is None


def test_a_quarter_turn_if_only_that_fits(detector: LabelDetector) -> None:
    """A free strip of 150 mm x 300 mm is too narrow for a pasta box of 262 mm x 72 mm."""
    walls = [
        resting("cracker_box", xy=(-0.07, -0.015), name="one wall"),
        resting("lasagna_box", xy=(-0.07, 0.12), name="another"),
    ]
    box = resting("pasta_box", xy=(0.0, -0.15), name="picked")
    scene = scene_of(*walls, box, side=0.40)
    X_TO = placement(detector, scene, "picked")
    assert X_TO is not None
    turn = box.X_TO.rotation.T @ X_TO.rotation
    assert np.linalg.norm(Rotation.from_matrix(turn).as_rotvec()) == pytest.approx(np.pi / 2)
    placed = SceneObject("picked", box.object_class, X_TO)
    assert placed.bounds_T[1] - placed.bounds_T[0] == pytest.approx([0.072, 0.262, 0.035])
    assert deepest_with(scene, "picked", X_TO) <= -CONFIG.clearance
    assert placed.bounds_T[0][0] > 0.045
    without_walls = placement(detector, scene_of(box), "picked")
    assert without_walls is not None
    assert without_walls.rotation == pytest.approx(box.X_TO.rotation)


def test_an_eighth_of_a_turn_if_only_that_fits(detector: LabelDetector) -> None:
    """On a tray of 270 mm, 10 mm from the rim, a box of 262 mm x 72 mm fits only across.

    At 45 degrees it is (262 + 72) / sqrt(2) = 236 mm wide; at 30 degrees, 263 mm.
    """
    box = resting("pasta_box", xy=(0.0, 0.26), name="picked")  # beside the tray
    X_TO = placement(detector, scene_of(box, side=0.27), "picked")
    assert X_TO is not None
    placed = SceneObject("picked", box.object_class, X_TO)
    assert (placed.bounds_T[1] - placed.bounds_T[0])[:2] == pytest.approx([0.2362] * 2, abs=1e-4)
    assert np.abs(placed.bounds_T)[:, :2].max() <= 0.135 - CONFIG.clearance


def test_objects_are_packed_side_by_side(detector: LabelDetector) -> None:
    """The second of two boxes goes beside the first, into the same or another corner."""
    first = resting("sugar_box", xy=(-0.2475, -0.29), name="first")
    scene = scene_of(first, resting("sugar_box", xy=(0.0, 0.0), name="picked"), side=0.70)
    for seed in range(5):
        X_TO = placement(detector, scene, "picked", seed=seed)
        assert X_TO is not None
        bounds = np.array(SceneObject("picked", first.object_class, X_TO).bounds_T)
        gaps = 0.350 - np.abs(bounds[:, :2]).max(axis=0)
        assert gaps.max() <= 0.010 + 1.5 * CELL_SIZE


def test_nothing_is_put_on_a_lying_cylinder(detector: LabelDetector) -> None:
    """Its top is a line; a can that stands upright carries a gelatin box."""
    picked = resting("gelatin_box", xy=(-0.2, -0.2), name="picked")
    for name, carries in (("tomato_soup_can", True), ("large_marker", False)):
        scene = scene_of(resting(name, name="below"), picked)
        assert (placement(detector, scene, "picked", "below") is not None) == carries


@pytest.mark.parametrize(
    "move", [Move("ghost"), Move("below", "ghost"), Move("gelatin"), Move("below", "gelatin")]
)
def test_only_what_is_in_view_can_be_moved(move: Move, detector: LabelDetector) -> None:
    hidden = resting("gelatin_box", xy=(0.05, 0.05), name="gelatin")
    scene = scene_of(hidden, resting("cracker_box", xy=(0.05, 0.05), floor=0.028, name="below"))
    name = move.pick if move.pick != "below" else move.place
    with pytest.raises(KeyError, match=f"object '{name}' is not in view; in view are below"):
        placed_at(seen(detector, scene), move, rng())


def test_the_air_above_the_picked_object_is_free(detector: LabelDetector) -> None:
    scene = scene_of(
        resting("tomato_soup_can", name="can"),
        resting("gelatin_box", xy=(0.0805, 0.0), name="picked"),
    )
    X_TO = placed_at(detector.perceive(scene).observation, Move("picked", "can"), rng())
    assert X_TO is not None
    assert X_TO.p[:2] == pytest.approx([0.0, 0.0], abs=0.0075)


def test_what_stands_in_a_shadow_is_not_free(detector: LabelDetector) -> None:
    """No placement is chosen on the hidden floor behind a wall."""
    wall = [
        resting("cereal_box_large", Orientation.UPRIGHT_90, (0.22, y), name=f"wall {y}")
        for y in (-0.1, 0.1)
    ]
    scene = scene_of(*wall, resting("tomato_soup_can", xy=(-0.2, 0.0), name="picked"))
    observation = seen(detector, scene)
    for seed in range(10):
        X_TO = placed_at(observation, Move("picked"), rng(seed))
        assert X_TO is not None
        # The ray over the wall's top at x = 0.22 + 0.0325 meets the floor 300 / 1300 further out.
        in_shadow = 0.2525 < X_TO.p[0] < 0.2525 * 1.60 / 1.30 and abs(X_TO.p[1]) < 0.19
        assert not in_shadow


def test_clear_tops(detector: LabelDetector) -> None:
    scene = scene_of(
        *(BELOW, resting("sugar_box", xy=(0.05, 0.05), floor=0.060, name="above")),
        resting("large_marker", xy=(-0.2, 0.2), name="marker"),
        resting("tomato_soup_can", xy=(-0.2, -0.2), name="can"),
        resting("large_marker", xy=(-0.2, -0.2), floor=0.101, name="on the can"),
        resting("cracker_box", UPRIGHT, (0.25, -0.25), name="far"),
    )
    observation = seen(detector, scene)
    clear = {d.name: has_clear_top(observation, d) for d in observation.detections}
    assert clear == {
        "below": False,
        "above": True,
        "marker": True,
        "can": False,
        "on the can": True,
        "far": True,
    }


@pytest.mark.parametrize(
    "orientation", list(Orientation), ids=lambda orientation: str(orientation.name)
)
def test_an_object_alone_has_a_clear_top_and_its_height(
    orientation: Orientation, detector: LabelDetector
) -> None:
    objects = [
        resting(name, orientation, xy)
        for name, xy in (("cracker_box", (-0.15, 0.0)), ("large_marker", (0.2, 0.1)))
    ]
    observation = seen(detector, scene_of(*objects))
    for o in objects:
        assert has_clear_top(observation, observation[o.name])
        assert top_height(observation[o.name]) == pytest.approx(o.top_height)


def pixels_at_the_border() -> tuple[NDArray[np.int64], list[bool]]:
    """Return pixels (column, row) at the corners of the image, and whether they are in it."""
    width, height = DEFAULT_CELL.camera.width, DEFAULT_CELL.camera.height
    pixels = [(0, 0), (width - 1, height - 1), (-1, 0), (0, -1)]
    pixels += [(width, height - 1), (width - 1, height)]
    return np.array(pixels), [True, True, False, False, False, False]


def test_only_points_in_the_image_are_seen_to_be_free() -> None:
    camera = DEFAULT_CELL.camera
    depth = np.full((camera.height, camera.width), np.inf, np.float32)
    pixels, expected = pixels_at_the_border()
    p_T = camera.backproject(pixels, np.full(len(pixels), 0.5))
    observation = Observation(depth, (), camera, DEFAULT_CELL.support)
    assert is_observed_free(observation, p_T).tolist() == expected
    cell = np.zeros((1, 2), np.int64)
    for (x, y, z), is_in_image in zip(p_T.tolist(), expected, strict=True):
        grid = (np.array([x]), np.array([y]), np.array([z]))
        rows, state = np.zeros((1, 3), np.int64), np.zeros((1, 1), np.int8)
        found = next_free_cell(depth, camera.pinhole, *grid, rows, cell, 0, state)
        assert found == (0 if is_in_image else 1)


def test_a_top_is_seen_up_to_the_border_of_the_image() -> None:
    camera = DEFAULT_CELL.camera
    depth = np.full((camera.height, camera.width), 0.5, np.float32)
    mask = np.full(depth.shape, True)
    outline = 0.001 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    pixels, expected = pixels_at_the_border()
    p_T = camera.backproject(pixels, np.full(len(pixels), 0.5))
    for p, is_in_image in zip(p_T, expected, strict=True):
        view = (depth, mask, camera.pinhole, p[:1], p[1:2], p[2], p[:2], outline)
        assert len(visible_top_cells(*view)) == is_in_image


def scores_of_fits(
    free: NDArray[np.bool_], footprint: Footprint, distance: NDArray[np.floating], weight: float
) -> dict[tuple[int, int], float]:
    """Return the scores of all cells at which a footprint fits, cell by cell."""
    n, m = free.shape
    taken = np.ones((3 * n, 3 * m), np.bool_)
    taken[n : 2 * n, m : 2 * m] = ~free

    def cells(part: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.array([(k, c) for k, first, last in part for c in range(first, last + 1)])

    inside, border = (cells(part) for part in footprint)
    found = dict[tuple[int, int], float]()
    for i, j in np.ndindex(n, m):
        at = np.array([n + i, m + j])
        if not taken[tuple((inside + at).T)].any():
            touching = np.count_nonzero(taken[tuple((border + at).T)])
            share = touching / (len(border) - len(inside))
            found[i, j] = share + weight * float(distance[i, j])
    return found


@pytest.mark.parametrize("seed", range(6))
def test_the_best_fits_are_those_of_a_search_over_all_cells(seed: int) -> None:
    """Cells are taken at random, and the footprint is not symmetric."""
    rows = np.array([[-1, -1, 2], [1, 0, 1], [0, -2, 2]])
    border = np.array([[-2, -2, 3], [2, -1, 2], [-1, -3, 3], [1, -2, 3], [0, -3, 3]])
    footprint = Footprint(rows, border)
    free = rng(seed).random((12, 15)) < 0.95
    distance = 0.1 * rng(seed).integers(0, 3, free.shape)
    for weight in (0.0, 0.5):
        scores = scores_of_fits(free, footprint, distance, weight)
        cells, score = best_fits(free, rows, border, distance, weight, -np.inf)
        highest = max(scores.values())
        assert score == pytest.approx(highest)
        best = [cell for cell, value in scores.items() if value > highest - 1e-9]
        assert cells.tolist() == [[*cell] for cell in best]
        assert len(best_fits(free, rows, border, distance, weight, score)[0]) == 0


def test_the_space_of_an_object_is_seen_through_every_20_mm() -> None:
    """The lowest level is 4 mm above the floor, the largest difference of equal depths."""
    camera = DEFAULT_CELL.camera
    assert camera.is_vertical
    assert levels_above(0.1, 0.05, camera) == pytest.approx([0.104, 0.124, 0.144])
