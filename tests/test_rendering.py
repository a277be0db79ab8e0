"""The compiled renderer against closed forms, the ray caster and Drake's VTK engine.

Frames: W is the world, C the camera, whose axes are those of W in most tests.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import DEFAULT_CELL, WORLD, random_scene, resting, rng, scene_of
from numpy.typing import NDArray
from pydrake.geometry import (
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    GeometryInstance,
    HalfSpace,
    MakeRenderEngineVtk,
    Mesh,
    PerceptionProperties,
    QueryObject,
    RenderLabel,
    Rgba,
    SceneGraph,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.systems.framework import DiagramBuilder
from scipy.ndimage import binary_erosion

from drake_clutter.cell.camera import Camera, pixel_grid
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.files import InputError
from drake_clutter.grammar import Orientation
from drake_clutter.rendering.lighting import CAMERA_LIGHTING, Lamp, LampKind, Lighting
from drake_clutter.rendering.mesh_renderer import SHADOW_MAP_SIZE, MeshInstances, MeshRenderer
from drake_clutter.rendering.polygon_fill import fill_polygon
from drake_clutter.rendering.scene_rasterizer import SceneRasterizer
from drake_clutter.rendering.visual_mesh import (
    PRIMITIVE_ROUGHNESS,
    VisualMesh,
    box_visual,
    capsule_visual,
    cylinder_visual,
)
from drake_clutter.simulation.camera_renderer import (
    RENDER_ENGINE_PARAMS,
    RENDERER_NAME,
    CameraRenderer,
    RenderCameras,
)
from drake_clutter.simulation.cell_plant import add_work_cell, joint_state_indices
from drake_clutter.simulation.plant_rasterizer import PlantRasterizer
from drake_clutter.simulation.scene_plant import add_scene_plant
from drake_clutter.stability.ray_caster import RayCaster

IDENTITY = np.eye(3, 4)
AMBIENT = Lighting((), ambient=1.0, background=(0, 0, 0))
GRAY = (0.5, 0.5, 0.5)


def camera_of(width: int, height: int, fov_y_deg: float = 60.0) -> Camera:
    """Return a camera at the origin of W, whose axes it shares."""
    return Camera(
        pose=PoseSpec(translation=(0.0, 0.0, 0.0)),
        width=width,
        height=height,
        fov_y_deg=fov_y_deg,
    )


def quad(
    corners: NDArray[np.float64],
    normal: tuple[float, float, float] = (0.0, 0.0, -1.0),
    texture: NDArray[np.uint8] | None = None,
) -> VisualMesh:
    """Return a quadrilateral.

    Args:
        corners: Corners at the texture's upper left, upper right, lower right and lower left [m].
            Shape (4, 3).
        normal: Unit normal.
        texture: The texture, or None for gray.
    """
    picture = np.full((1, 1, 3), 255, np.uint8) if texture is None else texture
    return VisualMesh(
        np.asarray(corners, float),
        np.tile(normal, (4, 1)),
        np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]),
        np.array([[0, 1, 2], [0, 2, 3]]),
        picture,
        GRAY if texture is None else (1.0, 1.0, 1.0),
        PRIMITIVE_ROUGHNESS,
    )


def facing_square(half: float, depth: float) -> NDArray[np.float64]:
    """Return the corners of a square that faces the camera [m]. Shape (4, 3)."""
    corners = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]])
    return np.asarray(corners + np.array([0.0, 0.0, depth]))


def instances_of(*labels: int) -> MeshInstances:
    """Return one instance of each mesh in the frame W."""
    poses = np.repeat(IDENTITY[None], len(labels), axis=0)
    return MeshInstances(np.arange(len(labels)), poses, np.array(labels))


def linear(value: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the linear color of an 8-bit one, for a gamma of 2.2."""
    return (value.astype(float) / 255) ** 2.2


def test_texture_and_labels_of_a_square_that_faces_the_camera() -> None:
    camera = camera_of(96, 80)
    u0, v0 = camera.principal_point
    half = 36 / camera.focal_length  # 72 pixels a side at a depth of 1 m
    # The contrast is below that of edges, which are smoothed.
    texture = np.array(
        [
            [[200, 150, 150], [150, 180, 150], [150, 150, 200]],
            [[140, 160, 180], [160, 160, 160], [180, 160, 140]],
            [[150, 150, 150], [170, 170, 170], [190, 190, 190]],
        ],
        np.uint8,
    )
    renderer = MeshRenderer([quad(facing_square(half, 1.0), texture=texture)])
    images = renderer.render(camera, IDENTITY, instances_of(7), AMBIENT)
    rows, columns = np.nonzero(images.label == 7)
    # Pixels on the left and upper edge belong to the square, those on the others do not.
    assert (columns.min(), columns.max()) == (u0 - 36, u0 + 35)
    assert (rows.min(), rows.max()) == (v0 - 36, v0 + 35)
    assert len(rows) == 72 * 72
    assert (images.label[(images.label != 7)] == -1).all()
    for row in range(3):
        for column in range(3):
            seen = images.color[int(v0) - 24 + 24 * row, int(u0) - 24 + 24 * column]
            srgb = texture[row, column] / 255
            decoded = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
            assert linear(seen) == pytest.approx(decoded, abs=0.005)
    assert images.depth[40, 48] == np.float32(1.0)
    assert np.isinf(images.depth[0, 0])


def test_texture_is_perspective_correct_and_depth_that_of_a_tilted_plane() -> None:
    camera = camera_of(96, 64)
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 2, axis=0).repeat(3, axis=2)
    # The right side is four times as far as the left one.
    corners = np.array([[-0.4, -0.3, 0.5], [1.2, -0.3, 2.0], [1.2, 0.3, 2.0], [-0.4, 0.3, 0.5]])
    renderer = MeshRenderer([quad(corners, texture=ramp)])
    images = renderer.render(camera, IDENTITY, instances_of(0), AMBIENT)
    normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
    rays = camera.rays(pixel_grid((64, 96)))
    depth = (normal @ corners[0]) / (rays @ normal)
    share = ((rays * depth[..., None])[..., 0] + 0.4) / 1.6
    seen = images.label == 0
    assert seen.sum() > 1000
    assert images.depth[seen] == pytest.approx(depth[seen], rel=1e-6)
    interior = binary_erosion(seen, np.ones((5, 5)))  # edges are smoothed
    value = np.clip(share[interior] * 256 - 0.5, 0, 255) / 255
    decoded = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    assert linear(images.color[interior])[:, 0] == pytest.approx(decoded, abs=0.012)


def test_a_texture_repeats_beyond_its_edges() -> None:
    """A ramp that is shown twice: the gray of a pixel returns after half of the square."""
    camera = camera_of(64, 64)
    half = 24 / camera.focal_length
    ramp = np.linspace(100, 160, 16).astype(np.uint8)[None, :, None].repeat(3, axis=2)
    square = quad(facing_square(half, 1.0), texture=ramp)
    twice = replace(square, uv=square.uv * np.array([2.0, 1.0]))
    row = MeshRenderer([twice]).render(camera, IDENTITY, instances_of(0), AMBIENT).color[31, :, 0]
    first = int(camera.principal_point[0]) - 24
    assert np.array_equal(row[first + 3 : first + 21], row[first + 27 : first + 45])
    assert np.all(np.diff(row[first + 3 : first + 21].astype(int)) > 0)
    # Shown once, it rises from edge to edge.
    once = MeshRenderer([square]).render(camera, IDENTITY, instances_of(0), AMBIENT).color[31, :, 0]
    assert np.all(np.diff(once[first + 3 : first + 45].astype(int)) >= 0)


def test_a_floor_that_reaches_behind_the_camera() -> None:
    camera = camera_of(64, 48)
    floor = np.array([[-50.0, 0.3, -50.0], [50.0, 0.3, -50.0], [50.0, 0.3, 50.0], [-50, 0.3, 50]])
    renderer = MeshRenderer([quad(floor, normal=(0.0, -1.0, 0.0))])
    depth, label = renderer.render_depth_and_label(camera, IDENTITY, instances_of(0))
    down = camera.rays(pixel_grid((48, 64)))[..., 1]
    expected = np.divide(0.3, down, out=np.full(down.shape, np.inf), where=down > 0)
    visible = (expected < 50) & (expected > 0.05)
    assert np.array_equal(label == 0, visible)
    expected[expected > 10] = np.inf
    assert depth == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_triangles_of_a_polygon_share_no_pixel_and_miss_none(seed: int) -> None:
    """Corners at centers of pixels are the ties that the rule decides."""
    generator = rng(seed)
    angle = np.sort(generator.uniform(0, 2 * np.pi, 9))[::-1]
    outline = 20 + 15 * np.column_stack([np.cos(angle), np.sin(angle)])
    outline = np.round(outline, seed % 2)  # whole pixels in every second case
    inside = np.round(outline.mean(axis=0), seed % 2)

    def pixels(corners: NDArray[np.float64]) -> NDArray[np.bool_]:
        nearest = np.zeros((40, 40), np.float32)
        hit = np.full((40, 40), -1, np.int32)
        begin, end = np.zeros(40, np.int64), np.zeros(40, np.int64)
        u, v = np.ascontiguousarray(corners[:, 0]), np.ascontiguousarray(corners[:, 1])
        plane = (0.0, 0.0, 1.0)
        count = fill_polygon(u, v, len(u), plane, np.int32(0), nearest, hit, begin, end)
        assert count == (hit == 0).sum()
        return np.asarray(hit == 0)

    following = np.roll(outline, -1, axis=0)
    parts = [pixels(np.array([inside, a, b])) for a, b in zip(outline, following, strict=True)]
    assert np.array_equal(np.sum(parts, axis=0), pixels(outline).astype(int))
    assert pixels(outline).sum() > 300


def test_the_nearer_surface_hides_the_farther_one_in_any_order() -> None:
    camera = camera_of(48, 48)
    near, far = quad(facing_square(0.1, 0.8)), quad(facing_square(0.5, 1.5))
    one = MeshRenderer([near, far]).render_depth_and_label(camera, IDENTITY, instances_of(1, 2))
    other = MeshRenderer([far, near]).render_depth_and_label(camera, IDENTITY, instances_of(2, 1))
    assert one[1][23, 23] == 1
    assert one[0][23, 23] == np.float32(0.8)
    assert one[1][23, 12] == 2
    assert np.array_equal(one[1], other[1])
    assert np.array_equal(one[0], other[0])


def test_too_close_and_too_far_are_marked_as_by_drake() -> None:
    camera = camera_of(16, 16)
    for depth, expected in ((0.09, 0.0), (0.11, 0.11), (9.9, 9.9), (10.1, np.inf)):
        renderer = MeshRenderer([quad(facing_square(10.0, depth))])
        image, label = renderer.render_depth_and_label(camera, IDENTITY, instances_of(0))
        assert image == pytest.approx(np.full((16, 16), expected), rel=1e-6)
        assert (label == 0).all()


def reflected(intensity: float, albedo: float) -> float:
    """Return the radiance of a surface that faces both lamp and camera.

    All cosines are 1: Lambert's albedo / pi of what is not mirrored, and GGX's 1 / (pi a^2) with
    a visibility of 1 / 4.
    """
    a2 = PRIMITIVE_ROUGHNESS**4
    return intensity * (0.96 * albedo / np.pi + 0.04 * 0.25 / (np.pi * a2))


@pytest.mark.parametrize(
    ("lamp", "expected"),
    [
        (Lamp(LampKind.DIRECTIONAL, (0.0, 0.0, 1.0), 1.5), reflected(1.5, 0.5)),
        (Lamp(LampKind.DIRECTIONAL, (0.0, 0.0, -1.0), 1.5), 0.0),
        (Lamp(LampKind.POINT, (0.0, 0.0, -1.0), 4.0), reflected(1.0, 0.5)),
        (Lamp(LampKind.POINT, (0.0, 0.0, 0.5), 0.3, (1.0, 0.5, 0.0)), reflected(1.2, 0.5)),
    ],
)
def test_radiance_of_a_surface_that_faces_lamp_and_camera(lamp: Lamp, expected: float) -> None:
    camera = camera_of(32, 32, fov_y_deg=2.0)
    renderer = MeshRenderer([quad(facing_square(1.0, 1.0))])
    images = renderer.render(camera, IDENTITY, instances_of(0), Lighting((lamp,), exposure=0.8))
    radiance = 0.8 * expected * np.array(lamp.color)
    assert linear(images.color[15, 15]) == pytest.approx(radiance, abs=0.005)


@pytest.mark.parametrize("is_on_camera", [False, True])
def test_lamps_of_the_camera_turn_with_it(is_on_camera: bool) -> None:
    """The camera is turned by 180 degrees about its x axis, and looks at a surface from behind."""
    camera = camera_of(16, 16)
    X_WC = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 2.0]])
    lamp = Lamp(LampKind.DIRECTIONAL, (0.0, 0.0, 1.0), 1.0, is_on_camera=is_on_camera)
    renderer = MeshRenderer([quad(facing_square(1.0, 1.0))])
    color = renderer.render(camera, X_WC, instances_of(0), Lighting((lamp,))).color
    assert (color[8, 8] > 100).all() if is_on_camera else (color[8, 8] == 0).all()


@pytest.mark.parametrize("kind", list(LampKind))
def test_position_of_the_edge_of_a_shadow(kind: LampKind) -> None:
    """A plate 0.5 m in front of a wall casts a shadow along the light, or away from the lamp."""
    camera = camera_of(160, 120, fov_y_deg=50.0)
    wall, plate = quad(facing_square(1.0, 1.5)), quad(facing_square(0.1, 1.0))
    if kind is LampKind.DIRECTIONAL:
        vector, shadow = (0.6, 0.0, 1.0), (-0.1 + 0.3, 0.1 + 0.3)
    else:
        vector = (-1.0, 0.0, 0.0)  # twice the plate's distance to the wall: rays go on by a half
        shadow = (-0.1 + 0.5 * 0.9, 0.1 + 0.5 * 1.1)
    dark, lit = (
        MeshRenderer([wall, plate]).render(
            camera,
            IDENTITY,
            instances_of(0, 1),
            Lighting((Lamp(kind, vector, 2.0, casts_shadows=casts_shadows),)),
        )
        for casts_shadows in (True, False)
    )
    row = 59
    u0, _ = camera.principal_point
    x = 1.5 * (np.arange(160) - u0) / camera.focal_length
    is_wall = dark.label[row] == 0
    in_shadow = dark.color[row, :, 0] < lit.color[row, :, 0] / 2
    # Edges are smoothed over a pixel of the image and two of the shadow map.
    tolerance = 1.5 / camera.focal_length + 2 * 2.0 / SHADOW_MAP_SIZE
    inside = is_wall & (x > shadow[0] + tolerance) & (x < shadow[1] - tolerance)
    outside = is_wall & ((x < shadow[0] - tolerance) | (x > shadow[1] + tolerance))
    assert inside.sum() > 10
    assert in_shadow[inside].all()
    assert outside.sum() > 60
    assert not in_shadow[outside].any()
    # No surface shadows itself: without an occluder, light is as without shadows.
    far = outside & (np.abs(x) < 0.9)
    assert np.array_equal(dark.color[row, far], lit.color[row, far])


def test_boxes_equal_those_of_the_ray_caster() -> None:
    camera = Camera.overhead(1.6, width=160, height=120)
    scene = scene_of(
        resting("cracker_box", Orientation.FLAT_30, (-0.11, 0.12), name="below"),
        resting("sugar_box", Orientation.UPRIGHT_0, (0.203, 0.197), name="sugar"),
        resting("gelatin_box", Orientation.FLAT_60, (-0.1, 0.1), floor=0.06, name="above"),
        resting("pudding_box", Orientation.SIDE_0, (0.03, -0.2), name="pudding"),
    )
    depth, label = SceneRasterizer(camera).render_depth_and_label(scene)
    observation, _ = RayCaster(camera).observe(scene)
    cast = np.full(label.shape, -1)
    for detection in observation.detections:
        cast[detection.mask] = scene.names.index(detection.name)
    assert np.array_equal(label, cast)
    on_objects = label >= 0
    assert on_objects.sum() > 400
    assert depth[on_objects] == pytest.approx(observation.depth[on_objects], rel=1e-6)


def test_silhouettes_are_those_of_objects_alone() -> None:
    camera = Camera.overhead(1.6, width=80, height=60)
    rasterizer = SceneRasterizer(camera)
    scene = scene_of(
        resting("gelatin_box", name="below"), resting("cracker_box", floor=0.028, name="cover")
    )
    masks = rasterizer.silhouettes(scene)
    for index, o in enumerate(scene.objects):
        alone = rasterizer.render(scene_of(o)).label == 0
        assert np.array_equal(masks[index], alone)
        assert alone.any()


def test_an_image_is_independent_of_earlier_ones() -> None:
    camera = Camera.overhead(1.6, width=80, height=60)
    scenes = [random_scene(seed) for seed in (1, 2)]
    used = SceneRasterizer(camera)
    used.render(scenes[0])
    again, fresh = used.render(scenes[1]), SceneRasterizer(camera).render(scenes[1])
    assert np.array_equal(again.color, fresh.color)
    assert np.array_equal(again.depth, fresh.depth)
    assert np.array_equal(again.label, fresh.label)


@pytest.mark.parametrize(
    ("mesh", "volume"),
    [
        (box_visual((0.1, 0.2, 0.3), GRAY), 0.006),
        (cylinder_visual(0.1, 0.3, GRAY), 0.3 * np.pi * 0.01),
        (capsule_visual(0.1, 0.3, GRAY), 0.3 * np.pi * 0.01 + 4 / 3 * np.pi * 0.001),
        (capsule_visual(0.1, 0.0, GRAY), 4 / 3 * np.pi * 0.001),
    ],
    ids=["box", "cylinder", "capsule", "sphere"],
)
def test_primitive_shapes(mesh: VisualMesh, volume: float) -> None:
    a, b, c = mesh.points[mesh.triangles].transpose(1, 0, 2)
    assert (np.cross(a, b) * c).sum() / 6 == pytest.approx(volume, rel=0.01)
    assert np.linalg.norm(mesh.normals, axis=1) == pytest.approx(1.0)
    # Normals point outwards, as the triangles do.
    outward = np.cross(b - a, c - a)
    assert ((outward * mesh.normals[mesh.triangles].mean(axis=1)).sum(axis=1) >= 0).all()


def registered(*shapes: tuple[Shape, RigidTransform, Rgba]) -> tuple[SceneGraph, QueryObject]:
    """Return a scene graph with anchored shapes of labels 0, 1, ..., and its query object."""
    scene_graph = SceneGraph()
    source = scene_graph.RegisterSource("test")
    for label, (shape, X_WG, color) in enumerate(shapes):
        geometry = GeometryInstance(X_WG, shape, f"shape {label}")
        properties = PerceptionProperties()
        properties.AddProperty("label", "id", RenderLabel(label))
        properties.AddProperty("phong", "diffuse", color)
        geometry.set_perception_properties(properties)
        scene_graph.RegisterAnchoredGeometry(source, geometry)
    context = scene_graph.CreateDefaultContext()
    return scene_graph, scene_graph.get_query_output_port().Eval(context)


def test_shapes_of_a_scene_graph(tmp_path: Path) -> None:
    """Depths and labels along the axis of shapes of known size, and colors by ambient light."""
    cube = tmp_path / "cube.obj"
    (tmp_path / "cube.mtl").write_text("newmtl paint\nKd 0.2 0.4 0.6\n")
    corners = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
    faces = ["1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4"]
    lines = ["mtllib cube.mtl", *(f"v {x} {y} {z}" for x, y, z in corners), "usemtl paint"]
    cube.write_text("\n".join([*lines, *(f"f {face}" for face in faces), ""]))
    red = Rgba(0.8, 0.1, 0.1)
    shapes = [
        (Box(0.2, 0.2, 0.4), 0.2),
        (Sphere(0.1), 0.1),
        (Cylinder(0.1, 0.3), 0.15),
        (Capsule(0.1, 0.3), 0.25),
        (Ellipsoid(0.1, 0.1, 0.2), 0.2),
        (Mesh(str(cube), np.array([0.2, 0.2, 0.6])), 0.3),
    ]
    placed = [
        (shape, RigidTransform([0.4 * k - 1.0, 0.0, 2.0]), red)
        for k, (shape, _) in enumerate(shapes)
    ]
    invisible = (Box(9.0, 9.0, 0.1), RigidTransform([0.0, 0.0, 0.5]), Rgba(0.0, 0.0, 0.0, 0.0))
    scene_graph, query = registered(*placed, invisible)
    rasterizer = PlantRasterizer(scene_graph.model_inspector())
    camera = camera_of(33, 33, fov_y_deg=4.0)
    column, row = (int(value) for value in camera.principal_point)
    for k, (_, half) in enumerate(shapes):
        X_WC = RigidTransform([0.4 * k - 1.0, 0.0, 0.0])
        images = rasterizer.render(camera, X_WC, query, AMBIENT)
        assert images.label[row, column] == k
        assert images.depth[row, column] == pytest.approx(2.0 - half, abs=2e-4)
        expected = (0.2, 0.4, 0.6) if k == len(shapes) - 1 else (0.8, 0.1, 0.1)
        assert linear(images.color[row, column]) == pytest.approx(expected, abs=0.01)


def test_a_shape_that_is_not_drawn_is_named() -> None:
    scene_graph, _ = registered((HalfSpace(), RigidTransform(), Rgba(1.0, 1.0, 1.0)))
    with pytest.raises(InputError, match="shape 0: the compiled renderer draws no HalfSpace"):
        PlantRasterizer(scene_graph.model_inspector())


def test_images_of_objects_equal_those_of_drake(camera: CameraRenderer) -> None:
    """What remains are pixels whose centers are on edges, and the rounding of colors."""
    scene = random_scene(5, objects="pantry14")
    drake, compiled = camera.render(scene), SceneRasterizer(camera.camera).render(scene)
    assert (drake.label == compiled.label).mean() > 0.9995
    both = (drake.label == compiled.label) & np.isfinite(drake.depth)
    assert np.array_equal(np.isfinite(drake.depth), np.isfinite(compiled.depth))
    assert (np.abs(drake.depth[both] - compiled.depth[both]) < 1e-3).mean() > 0.999
    difference = np.abs(drake.color.astype(int) - compiled.color)[compiled.label >= 0]
    assert difference.mean() < 1.0
    assert np.percentile(difference, 99) <= 3


def test_images_of_the_arm_equal_those_of_drake() -> None:
    config = WORLD.cell.camera.model_copy(update={"width": 320, "height": 240, "fov_y_deg": 60.0})
    scene = random_scene(5)
    builder = DiagramBuilder()
    objects = [(o.name, o.object_class) for o in scene.objects]
    scene_plant = add_scene_plant(builder, objects, scene.support, 0.01, visuals=True)
    scene_graph = scene_plant.scene_graph
    plant = scene_plant.plant
    arm = add_work_cell(plant, scene_graph, DEFAULT_CELL, compliant=True, visuals=True)
    plant.Finalize()
    scene_graph.AddRenderer(RENDERER_NAME, MakeRenderEngineVtk(RENDER_ENGINE_PARAMS))
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    context = plant.GetMyMutableContextFromRoot(root)
    scene_plant.set_poses(context, scene.objects)
    positions = plant.GetPositions(context)
    positions[joint_state_indices(plant, arm)[0]] = np.array([0.1, -1.4, 1.2, -1.4, -1.6, 0.2])
    plant.SetPositions(context, positions)
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(root))
    cameras, world = RenderCameras.from_camera(config), scene_graph.world_frame_id()
    color = query.RenderColorImage(cameras.color, world, cameras.X_TC).data[..., :3]
    depth = query.RenderDepthImage(cameras.depth, world, cameras.X_TC).data[..., 0]
    label = query.RenderLabelImage(cameras.label, world, cameras.X_TC).data[..., 0].astype(int)
    rasterizer = PlantRasterizer(scene_graph.model_inspector())
    images = rasterizer.render(config, cameras.X_TC, query, CAMERA_LIGHTING)
    arm_labels = [int(body.index()) for body in arm.bodies]
    assert np.isin(label, arm_labels).sum() > 1000
    seen = np.isfinite(depth) & np.isfinite(images.depth)
    assert (np.isfinite(depth) == np.isfinite(images.depth)).mean() > 0.999
    assert (label[seen] == images.label[seen]).mean() > 0.999
    assert (np.abs(depth[seen] - images.depth[seen]) < 1e-3).mean() > 0.995
    assert np.percentile(np.abs(color.astype(int) - images.color), 99) <= 3
