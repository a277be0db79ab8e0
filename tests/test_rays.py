"""The ray caster against rendered images and geometry, and with fewer objects."""

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from conftest import CLASSES, DEFAULT_CELL, random_scene, resting, rng, scene_of
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion
from scipy.spatial.transform import Rotation

from drake_clutter.cell.camera import Camera
from drake_clutter.grammar import Orientation
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.scenes.scene import Pose, Scene, SceneObject
from drake_clutter.simulation.camera_renderer import CameraRenderer
from drake_clutter.stability.ray_caster import RayCaster
from drake_clutter.stability.shape_table import ShapeTable

CAMERA = DEFAULT_CELL.camera
RAYS = RayCaster(CAMERA)
# Without a visibility threshold, so that the masks form a label image.
RAYS_WITHOUT_THRESHOLD = RayCaster(CAMERA.model_copy(update={"visibility_threshold": 1e-9}))
ALL_SHAPES = (
    "cracker_box",
    "sugar_box",
    "gelatin_box",
    "tomato_soup_can",
    "master_chef_can",
    "large_marker",
)


def labels(scene: Scene, caster: RayCaster = RAYS_WITHOUT_THRESHOLD) -> NDArray[np.int64]:
    """Return the index of the object that each ray meets first, or -1."""
    found = np.full((caster.camera.height, caster.camera.width), -1)
    for detection in caster.observe(scene)[0].detections:
        found[detection.mask] = scene.names.index(detection.name)
    return found


def tumbled(seed: int, spread: float = 0.22) -> Scene:
    """Return two objects of each shape in the air, in any orientation.

    They may intersect, which does not matter to rays.
    """
    generator = rng(seed)
    turns = Rotation.random(2 * len(ALL_SHAPES), rng=generator).as_matrix()
    objects = []
    for index, (class_name, turn) in enumerate(zip(2 * ALL_SHAPES, turns, strict=True)):
        p_TO = (*generator.uniform(-spread, spread, 2), generator.uniform(0.16, 0.40))
        objects.append(
            SceneObject(
                f"{class_name} {index}", CLASSES[class_name], Pose.from_rotation(turn, p_TO)
            )
        )
    return scene_of(*objects)


RESTING = scene_of(
    resting("cracker_box", Orientation.UPRIGHT_90, (-0.2, -0.2), name="tall"),
    resting("cracker_box", Orientation.FLAT_30, name="below"),
    resting("sugar_box", Orientation.SIDE_90, (0.03, 0.0), 0.060, "on it"),
    resting("master_chef_can", xy=(0.2, 0.2), name="chef"),
    resting("tomato_soup_can", xy=(0.21, 0.18), floor=0.139, name="soup"),
    resting("gelatin_box", Orientation.FLAT_60, (-0.2, 0.2), name="gelatin"),
    resting("large_marker", Orientation.FLAT_120, (-0.2, 0.2), 0.028, "marker"),
    resting("sugar_box", Orientation.UPRIGHT_0, (0.25, -0.25), name="wall"),
    resting("gelatin_box", xy=(0.27, -0.31), name="in its shadow"),
)
SCENES: Mapping[str, Scene] = {
    "resting": RESTING,
    "tumbled 0": tumbled(0),
    "tumbled 1": tumbled(1),
    "laid out": random_scene(1),
}


@pytest.mark.parametrize("scene", SCENES.values(), ids=list(SCENES))
def test_the_same_rays_meet_the_same_objects_as_in_the_rendered_picture(
    scene: Scene, detector: LabelDetector
) -> None:
    """Visible fractions agree to 0.003, a third of a pixel of objects of a hundred pixels."""
    look, rendered = detector.perceive(scene), detector.renderer.render_label(scene)
    observation, shares = RAYS.observe(scene)
    assert shares == RAYS.visible_fractions(scene.objects)
    assert shares == pytest.approx(look.visible_fractions, abs=0.003)
    assert min(shares.values()) < 0.9 < 1.0 <= max(shares.values())
    cast = labels(scene)
    assert (cast == rendered).mean() >= 0.9999
    for index, o in enumerate(scene.objects):
        mine, theirs = cast == index, rendered == index
        assert abs(int(mine.sum()) - int(theirs.sum())) <= 3, o.name
    assert [d.name for d in observation.detections] == [d.name for d in look.observation.detections]
    for detection, seen in zip(observation.detections, look.observation.detections, strict=True):
        assert (detection.object_class, detection.X_TO) == (seen.object_class, seen.X_TO)
        assert np.array_equal(detection.mask, cast == scene.names.index(detection.name))
    assert (observation.camera, observation.support) == (
        look.observation.camera,
        look.observation.support,
    )


@pytest.mark.parametrize("scene", SCENES.values(), ids=list(SCENES))
def test_depth_is_the_rendered_depth(scene: Scene, detector: LabelDetector) -> None:
    """Depths agree within the precision of 32-bit floats.

    A depth of 1.6 m is exact to 0.12 um, and its inverse gives 1 um. On a face that is seen at a
    grazing angle, the depth changes by centimeters from pixel to pixel, so the precision of the
    pixel's center gives 0.1 mm.
    """
    look = detector.perceive(scene)
    observation, _ = RAYS.observe(scene)
    rendered, cast = detector.renderer.render_label(scene), labels(scene)
    assert observation.depth.dtype == look.observation.depth.dtype == np.float32
    errors = []
    for index in range(len(scene.objects)):
        inside = binary_erosion((rendered == index) & (cast == index))
        errors.append(np.abs(observation.depth - look.observation.depth)[inside])
    error = np.concatenate(errors)
    assert error.size > 5000
    assert np.quantile(error, 0.99) < 1.5e-6
    assert error.max() < 1e-4
    nothing = (rendered == -1) & (cast == -1)
    assert (observation.depth[nothing] == np.float32(CAMERA.X_TC.translation()[2])).all()


@pytest.mark.parametrize(
    "config",
    [
        Camera.overhead(1.1, width=320, height=240, fov_y_deg=60.0),
        Camera.overhead(1.6, width=200, height=300, fov_y_deg=20.0),
    ],
    ids=["wide", "narrow"],
)
def test_another_camera(config: Camera) -> None:
    """A narrow camera sees 0.38 m x 0.56 m of the tray and cuts objects off.

    The fraction refers to the pixels within the image.
    """
    scene = tumbled(2)
    camera, caster = CameraRenderer(config), RayCaster(config)
    assert caster.visible_fractions(scene.objects) == pytest.approx(
        camera.visible_fractions(scene), abs=0.02
    )
    rendered = camera.render_label(scene)
    assert (
        labels(scene, RayCaster(config.model_copy(update={"visibility_threshold": 1e-9})))
        == rendered
    ).mean() >= 0.9995
    cut = [
        np.concatenate([m[0], m[-1], m[:, 0], m[:, -1]]).any()
        for m in (rendered == k for k in range(len(scene.objects)))
    ]
    assert any(cut) == (config.fov_y_deg == 20.0)


@pytest.mark.parametrize(
    ("name", "length", "width", "height"),
    [
        ("cracker_box", 0.230, 0.160, 0.060),
        ("sugar_box", 0.175, 0.089, 0.038),
        ("gelatin_box", 0.085, 0.073, 0.028),
    ],
)
@pytest.mark.parametrize(
    "orientation", [Orientation.FLAT_0, Orientation.FLAT_30, Orientation.FLAT_90]
)
def test_a_box_from_straight_above_covers_its_top(
    name: str, length: float, width: float, height: float, orientation: Orientation
) -> None:
    """The visible top has the size of the pinhole model.

    Pixels at its outline may count or not: less than half its length in pixels.
    """
    scene = scene_of(resting(name, orientation, name="box"))
    scale = CAMERA.focal_length / (CAMERA.X_TC.translation()[2] - height)
    pixels = int((labels(scene) == 0).sum())
    assert pixels == pytest.approx(length * width * scale**2, abs=(length + width) * scale)
    depth = RAYS.observe(scene)[0].depth[labels(scene) == 0]
    assert depth == pytest.approx(np.full(pixels, CAMERA.X_TC.translation()[2] - height), abs=1e-6)


def test_faces_whose_plane_contains_the_camera_are_not_seen() -> None:
    """A box with a side exactly below the camera shows its top alone."""
    x, y, z = CAMERA.X_TC.translation()
    scale = CAMERA.focal_length / (z - 0.060)
    for direction in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        xy = np.array([x, y]) + np.array(direction) * (0.115, 0.080)
        box = resting("cracker_box", xy=xy.tolist())
        pixels = int((labels(scene_of(box)) == 0).sum())
        assert pixels == pytest.approx(0.230 * 0.160 * scale**2, abs=(0.230 + 0.160) * scale)
        assert RAYS.visible_fractions(scene_of(box).objects) == {"cracker_box": 1.0}


def test_a_box_in_a_corner_shows_its_sides() -> None:
    """Return the area of the hull of a box's corners in the image (shoelace formula)."""
    box = resting("cracker_box", Orientation.UPRIGHT_0, (0.2, 0.15), name="box")
    low, high = (
        CAMERA.project(np.array([[x, y, z] for x in (0.12, 0.28) for y in (0.12, 0.18)]))
        for z in (0.0, 0.23)
    )
    # The top is nearer and appears larger: of the bottom, the corner beyond the top's corner is
    # inside.
    outline = np.array([low[0], low[1], high[1], high[3], high[2], low[2]])
    following = np.roll(outline, -1, axis=0)
    area = abs((outline[:, 0] * following[:, 1] - outline[:, 1] * following[:, 0]).sum()) / 2
    perimeter = np.linalg.norm(outline - following, axis=1).sum()
    assert (labels(scene_of(box)) == 0).sum() == pytest.approx(area, abs=perimeter / 4)


def test_every_ray_meets_an_object_once() -> None:
    """No ray is lost or counted twice at edges: the rays of a convex object fill every row."""
    for seed in range(3):
        for o in tumbled(seed).objects:
            mask = labels(scene_of(o)) == 0
            columns = [np.flatnonzero(row) for row in mask if row.any()]
            assert len(columns) > 5
            assert all(np.array_equal(row, np.arange(row[0], row[-1] + 1)) for row in columns)
            cover = RAYS.occluder_sets(scene_of(o), o.name)
            assert cover == {frozenset(): int(mask.sum())}
            assert RAYS.visible_fractions([o]) == {o.name: 1.0}


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_the_objects_is_no_matter(seed: int) -> None:
    scene = tumbled(seed)
    order = rng(seed).permutation(len(scene.objects))
    other = replace(scene, objects=tuple(scene.objects[k] for k in order))
    assert RAYS.visible_fractions(other.objects) == RAYS.visible_fractions(scene.objects)
    one, same = RAYS.observe(scene)[0], RAYS.observe(other)[0]
    assert np.array_equal(one.depth, same.depth)
    for detection in one.detections:
        assert np.array_equal(detection.mask, same[detection.name].mask)
    name = scene.names[seed]
    assert RAYS.occluder_sets(other, name) == RAYS.occluder_sets(scene, name)


def test_what_was_cast_before_is_no_matter() -> None:
    """Buffers that are reused hold nothing of earlier scenes."""
    caster = RayCaster(CAMERA)
    before = caster.observe(scene_of(resting("gelatin_box", name="box")))
    for seed in range(2):
        caster.observe(tumbled(seed))
        caster.occluder_sets(tumbled(seed), tumbled(seed).names[0])
    after = caster.observe(scene_of(resting("gelatin_box", name="box")))
    assert np.array_equal(before[0].depth, after[0].depth)
    assert np.array_equal(before[0]["box"].mask, after[0]["box"].mask)
    assert before[1] == after[1]


def test_other_places_than_those_of_the_poses() -> None:
    scene = tumbled(1)
    offsets = rng(3).uniform(-0.05, 0.05, (len(scene.objects), 3))
    moved = scene.with_poses(
        {
            o.name: o.X_TO.translated(offset)
            for o, offset in zip(scene.objects, offsets, strict=True)
        }
    )
    shapes = ShapeTable()
    caster = RayCaster(CAMERA, shapes)
    rows = shapes.find_rows(scene.objects)
    p_T = np.array([o.X_TO.p for o in moved.objects])
    assert caster.visible_fractions_of_rows(rows, p_T) == list(
        RAYS.visible_fractions(moved.objects).values()
    )
    assert caster.visible_fractions_of_rows(rows, p_T) != list(
        RAYS.visible_fractions(scene.objects).values()
    )


FAR = scene_of(resting("gelatin_box", name="near"), resting("sugar_box", xy=(5.0, 0.0), name="far"))


def test_out_of_the_frame_nothing_is_hidden() -> None:
    assert RAYS.visible_fractions(FAR.objects) == {"near": 1.0, "far": 1.0}
    assert RAYS.visible_fractions([FAR["far"]]) == {"far": 1.0}
    assert RAYS.occluder_sets(FAR, "far") == {}
    assert (
        RAYS.observe(scene_of(FAR["far"]))[0].depth == np.float32(CAMERA.X_TC.translation()[2])
    ).all()


def test_only_what_a_ray_meets_is_detected() -> None:
    """The observation equals that of `LabelDetector`, from which policies know what is in view."""
    assert [d.name for d in LabelDetector(CAMERA).perceive(FAR).observation.detections] == ["near"]
    assert [d.name for d in RAYS.observe(FAR)[0].detections] == ["near"]


def test_half_covered() -> None:
    """The upper box ends below the camera's axis, so it hides exactly what lies to its right."""
    objects = [
        resting("cracker_box", name="below"),
        resting("cracker_box", xy=(0.115, 0.0), floor=0.060, name="above"),
    ]
    shares = RAYS.visible_fractions(objects)
    assert shares["below"] == pytest.approx(0.5, abs=1 / 92)  # the box is 92 pixels long
    assert shares["above"] == 1.0


# --- What is before an object ---

HEAP = scene_of(
    resting("gelatin_box", name="hidden"),
    resting("sugar_box", Orientation.FLAT_30, (0.03, 0.02), 0.028, "one"),
    resting("pudding_box", Orientation.FLAT_60, (-0.03, 0.0), 0.066, "two"),
    resting("large_marker", Orientation.FLAT_150, (0.0, -0.02), 0.101, "three"),
    resting("tomato_soup_can", xy=(-0.01, 0.02), floor=0.119, name="four"),
    resting("cracker_box", Orientation.UPRIGHT_0, (0.2, 0.2), name="far"),
)


@pytest.mark.parametrize(
    ("scene", "name"),
    [(HEAP, "hidden"), (HEAP, "one"), (tumbled(0, 0.08), "sugar_box 1")],
    ids=["0", "1", "2"],
)
def test_occluder_sets_are_the_rays_that_removed_subsets_uncover(scene: Scene, name: str) -> None:
    """Removing a set of objects uncovers exactly the rays occluded by its subsets.

    All subsets of five objects are tried.
    """
    cover = RAYS.occluder_sets(scene, name)
    total = sum(cover.values())
    assert total == int((labels(scene_of(scene[name])) == 0).sum())
    before_most = sorted(
        (o for o in scene.objects if o.name != name),
        key=lambda o: -sum(cover[c] for c in cover if o.name in c),
    )
    others, kept = before_most[:5], before_most[5:]
    free = []
    for count in range(len(others) + 1):
        for gone in combinations([o.name for o in others], count):
            left = scene_of(scene[name], *kept, *(o for o in others if o.name not in gone))
            met = sum(rays for before, rays in cover.items() if before <= set(gone))
            assert int((labels(left) == 0).sum()) == met
            assert RAYS.visible_fractions(left.objects)[name] == pytest.approx(
                met / total, abs=1e-12
            )
            free.append(met)
    assert min(free) < max(free)


def test_occluder_set_of_a_single_occluder() -> None:
    scene = scene_of(
        resting("gelatin_box", name="box"), resting("cracker_box", floor=0.028, name="cover")
    )
    pixels = 0.085 * 0.073 * (CAMERA.focal_length / (CAMERA.X_TC.translation()[2] - 0.028)) ** 2
    cover = RAYS.occluder_sets(scene, "box")
    assert cover == {frozenset({"cover"}): pytest.approx(pixels, rel=0.05)}
    assert set(RAYS.occluder_sets(scene, "cover")) == {frozenset()}


def test_occluder_sets_take_64_objects_at_most() -> None:
    """Objects lie on each other like cards; the lowest is covered by all, one bit for each."""
    cards = [resting("gelatin_box", floor=0.005 * k, name=f"{k}") for k in range(65)]
    cover = RAYS.occluder_sets(scene_of(*cards[:64]), "0")
    assert max(cover, key=lambda before: cover[before]) == frozenset(str(k) for k in range(1, 64))
    assert math.isclose(sum(cover.values()), int((labels(scene_of(cards[0])) == 0).sum()))
    with pytest.raises(ValueError, match="65 objects; expected at most 64"):
        RAYS.occluder_sets(scene_of(*cards), "0")
