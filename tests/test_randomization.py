"""Randomization: rigid stacks, masses and friction in the plant, appearance, mounting errors."""

from itertools import combinations

import numpy as np
import pytest
from conftest import CLASSES, DEFAULT_CELL, resting, rng, scene_of
from pydrake.systems.framework import DiagramBuilder
from test_camera_recorder import SCENE, make_recorder, samples_of

from drake_clutter.files import InputError
from drake_clutter.recording.appearance import NUM_LIGHTS, colored_parts
from drake_clutter.recording.randomization import (
    CameraVariation,
    Factor,
    LightVariation,
    RandomizationConfig,
    Variation,
    draw_variation,
    load_randomization,
    varied_physics,
    vary_poses,
)
from drake_clutter.scenes.scene import SceneObject
from drake_clutter.simulation.scene_plant import add_scene_plant

STACKS = scene_of(
    resting("sugar_box", xy=(-0.2, -0.2), name="below"),
    resting("gelatin_box", xy=(-0.19, -0.21), floor=0.038, name="above"),
    resting("master_chef_can", xy=(0.2, 0.2), name="can"),
)
STILL = samples_of(SCENE, DEFAULT_CELL, np.zeros(1))


def gap(first: SceneObject, second: SceneObject) -> float:
    """Return the largest distance of two bounding boxes along an axis [m]."""
    (lower_a, upper_a), (lower_b, upper_b) = first.bounds_T, second.bounds_T
    return float(np.maximum(lower_a - upper_b, lower_b - upper_a).max())


def test_stacks_move_as_rigid_bodies_within_the_support() -> None:
    config = load_randomization("poses")
    turns = set()
    for seed in range(30):
        scene = vary_poses(STACKS, config, np.random.default_rng(seed))
        below, above, can = scene.objects
        before = STACKS["below"]
        relative = below.X_TO.rotation.T @ (above.X_TO.p - below.X_TO.p)
        expected = before.X_TO.rotation.T @ (STACKS["above"].X_TO.p - before.X_TO.p)
        assert relative == pytest.approx(expected, abs=1e-12)
        heights = [[o.X_TO.p[2] for o in s.objects] for s in (scene, STACKS)]
        assert heights[0] == pytest.approx(heights[1], abs=1e-12)
        assert min(gap(a, can) for a in (below, above)) > 0.01
        for o in scene.objects:
            assert np.abs(o.corners_T[:, :2]).max() <= 0.35 - 0.01 + 1e-12
        turns.add(round(np.degrees(np.arctan2(*below.X_TO.rotation[1::-1, 2])) / 90) % 4)
    assert turns == {0, 1, 2, 3}
    again = [vary_poses(STACKS, config, np.random.default_rng(7)) for _ in range(2)]
    assert again[0] == again[1]


def test_a_stack_without_room_stays() -> None:
    full = scene_of(
        *(
            resting("cracker_box", xy=(x, y), name=f"{x} {y}")
            for x in (-0.23, 0.0, 0.23)
            for y in (-0.26, -0.087, 0.087, 0.26)
        )
    )
    moved = vary_poses(full, RandomizationConfig(stack_turn_deg=180.0), rng())
    for first, second in combinations(moved.objects, 2):
        assert gap(first, second) > -1e-9
    assert sum(a == b for a, b in zip(moved.objects, full.objects, strict=True)) > 6


def test_mass_and_friction_reach_the_plant() -> None:
    variation = Variation(mass={"box": 0.5, "can": 0.3}, friction={"box": 1.5, "can": 0.5})
    with varied_physics(SCENE, variation) as scene:
        assert [o.object_class.name for o in scene.objects] == ["cracker_box", "master_chef_can"]
        builder = DiagramBuilder()
        classes = [(o.name, o.object_class) for o in scene.objects]
        plant = add_scene_plant(builder, classes, scene.support, 0.01, visuals=True)
        plant.plant.Finalize()
        inspector = plant.scene_graph.model_inspector()
        for name, mass, friction in (("box", 0.5, 0.75), ("can", 0.3, 0.25)):
            body = plant.bodies[name]
            inertia = body.default_spatial_inertia()
            assert inertia.get_mass() == pytest.approx(mass)
            assert body.default_mass() == pytest.approx(mass)
            for geometry in plant.plant.GetCollisionGeometriesForBody(body):
                properties = inspector.GetProximityProperties(geometry)
                coulomb = properties.GetProperty("material", "coulomb_friction")
                assert coulomb.static_friction() == pytest.approx(friction)
                assert coulomb.dynamic_friction() == pytest.approx(friction)
        # A box of 60 x 160 x 230 mm.
        moments = plant.bodies["box"].default_spatial_inertia().CalcRotationalInertia()
        assert moments.get_moments()[0] == pytest.approx(0.5 / 12 * (0.16**2 + 0.23**2))
        folder = scene.objects[0].object_class.folder
    assert not folder.exists()
    assert CLASSES["cracker_box"].mass == 0.411


def draw(groups: str, seed: int = 0) -> Variation:
    """Return a variation of named groups."""
    parts = colored_parts(DEFAULT_CELL)
    return draw_variation(
        load_randomization(groups), SCENE.objects, parts, ["wrist"], NUM_LIGHTS, rng(seed)
    )


def test_groups_are_drawn_independently_from_their_ranges() -> None:
    assert draw("") == Variation()
    masses = [draw("mass", seed).mass["can"] / 0.414 for seed in range(200)]
    assert 0.8 <= min(masses) < 0.82
    assert 1.18 < max(masses) <= 1.2
    everything = draw("mass,friction,lights,textures,camera,noise")
    assert everything.mass == draw("mass").mass
    assert everything.cameras == draw("camera").cameras
    assert everything.colors == draw("textures").colors
    assert len(everything.lights) == NUM_LIGHTS
    assert set(everything.colors) == {"background", "support", "table", "box", "can"}


def test_colors_and_lights_change_only_the_color_images() -> None:
    plain = make_recorder(["overhead"]).record(STILL, 10)["overhead"]
    colors = {"background": (1.0, 0.0, 0.0), "support": (0.0, 1.0, 0.0), "box": (0.0, 0.0, 0.0)}
    variation = Variation(
        colors=colors,
        color_fraction=1.0,
        lights=(LightVariation(0.5, (0.1, 0.0, 0.0)), LightVariation(0.5, (0.0, 0.0, 0.0))),
    )
    varied = make_recorder(["overhead"], variation=variation).record(STILL, 10)["overhead"]
    assert plain.depth is not None
    assert plain.segmentation is not None
    assert varied.rgb is not None
    assert plain.rgb is not None
    assert np.array_equal(varied.depth, plain.depth)  # type: ignore[arg-type]
    assert np.array_equal(varied.segmentation, plain.segmentation)  # type: ignore[arg-type]
    labels = plain.segmentation[0]
    nothing = plain.depth[0] == 0
    assert (varied.rgb[0][nothing] == [255, 0, 0]).all(axis=-1).mean() > 0.99
    floor = (plain.depth[0] == 1600) & (labels == 0)
    red, green, blue = varied.rgb[0][floor].astype(int).T
    # Red and blue are the white reflection alone, but at edges.
    assert (np.abs(red - blue) <= 1).mean() > 0.98
    assert (green - red > 20).mean() > 0.98
    assert np.percentile(varied.rgb[0][labels == 1], 95) < 40  # but for reflections
    can = labels == 2
    assert varied.rgb[0][can].mean() < 0.8 * plain.rgb[0][can].mean()


def test_mounting_error_moves_the_camera() -> None:
    variation = Variation(cameras={"overhead": CameraVariation((0.05, 0.0, 0.0), (0.0, 0.0, 0.0))})
    plain = make_recorder(["overhead"]).record(STILL, 10)["overhead"]
    moved = make_recorder(["overhead"], variation=variation).record(STILL, 10)["overhead"]
    assert moved.X_TC[0, 4:] == pytest.approx([0.05, 0.0, 1.6])
    centers = [
        np.argwhere((i.segmentation[0] == 1) & (i.depth[0] == 1540)).mean(axis=0)  # type: ignore[index]
        for i in (plain, moved)
    ]
    # The camera moves along x of its image.
    shift = 0.05 * DEFAULT_CELL.camera.focal_length / 1.54
    assert centers[0] - centers[1] == pytest.approx([0.0, shift], abs=0.6)


def test_noise_has_the_stated_amount_and_is_reproducible() -> None:
    variation = Variation(color_noise=4.0, depth_noise=True)
    plain = make_recorder(["overhead"]).record(STILL, 10)["overhead"]
    noisy = [
        make_recorder(["overhead"], variation=variation).record(STILL, 10)["overhead"]
        for _ in range(2)
    ]
    assert np.array_equal(noisy[0].rgb, noisy[1].rgb)  # type: ignore[arg-type]
    assert np.array_equal(noisy[0].depth, noisy[1].depth)  # type: ignore[arg-type]
    assert plain.rgb is not None
    assert noisy[0].rgb is not None
    middle = (plain.rgb > 30) & (plain.rgb < 225)
    difference = noisy[0].rgb[middle].astype(float) - plain.rgb[middle]
    assert difference.std() == pytest.approx(4.0, rel=0.02)
    assert plain.depth is not None
    assert noisy[0].depth is not None
    floor = (plain.depth == 1600) & (noisy[0].depth > 0)
    assert noisy[0].depth[floor].std() == pytest.approx(2.5, rel=0.2)  # see DepthNoise


@pytest.mark.parametrize("text", ["pose", "mass,lamps"])
def test_an_unknown_group_is_named(text: str) -> None:
    with pytest.raises(InputError, match=rf"--randomize {text.split(',')[-1]}: expected some of"):
        load_randomization(text)


def test_a_file_states_ranges(tmp_path) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "ranges.yaml"
    path.write_text("mass: {low: 0.5, high: 2.0}\nstack_offset: 0.01\n")
    expected = RandomizationConfig(mass=Factor(low=0.5, high=2.0), stack_offset=0.01)
    assert load_randomization(str(path)) == expected
    path.write_text("mass: {low: 2.0, high: 0.5}\n")
    with pytest.raises(InputError, match=r"mass: .*expected `low` not above `high`"):
        load_randomization(str(path))
