"""Appearance of a rendered scene under a `Variation`: lights, colors, labels of the objects."""

import json

import numpy as np
from numpy.typing import NDArray
from pydrake.common import MemoryFile
from pydrake.geometry import (
    GeometryId,
    GeometryInstance,
    InMemoryMesh,
    LightParameter,
    Mesh,
    PerceptionProperties,
    RenderEngineVtkParams,
    Rgba,
    Role,
    RoleAssign,
)
from scipy.spatial.transform import Rotation

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.recording.randomization import LightVariation, Variation, Vector
from drake_clutter.simulation.camera_renderer import RENDER_ENGINE_PARAMS
from drake_clutter.simulation.cell_plant import fixture_name
from drake_clutter.simulation.scene_plant import ScenePlant, get_support_body

BACKGROUND = "background"
"""Name of the background among the varied colors."""
SUPPORT = "support"
"""Name of the support among the varied colors."""
NUM_LIGHTS = len(RENDER_ENGINE_PARAMS.lights)
"""Number of lights."""


def colored_parts(cell: WorkCell) -> tuple[str, ...]:
    """Return the names of background, support and fixtures, whose colors are varied."""
    return BACKGROUND, SUPPORT, *(fixture.name for fixture in cell.fixtures)


def engine_params(variation: Variation) -> RenderEngineVtkParams:
    """Return the parameters of the render engine: lights and background."""
    default = RENDER_ENGINE_PARAMS
    lights = default.lights
    if variation.lights:
        lights = [_vary_light(*pair) for pair in zip(lights, variation.lights, strict=True)]
    background = np.asarray(default.default_clear_color)
    if BACKGROUND in variation.colors:
        background = _blend(background, variation.colors[BACKGROUND], variation.color_fraction)
    return RenderEngineVtkParams(
        backend=default.backend, lights=lights, default_clear_color=background
    )


def _vary_light(light: LightParameter, variation: LightVariation) -> LightParameter:
    """Return a light with another intensity and direction."""
    R = Rotation.from_rotvec(variation.rotation_vector)
    return LightParameter(
        type=light.type,
        frame=light.frame,
        direction=R.as_matrix() @ light.direction,
        intensity=light.intensity * variation.intensity,
    )


def _blend(color: NDArray[np.float64], other: Vector, fraction: float) -> NDArray[np.float64]:
    """Return a mixture of two colors. Shape (3,)."""
    return np.asarray((1 - fraction) * color + fraction * np.array(other))


def apply_colors(scene_plant: ScenePlant, variation: Variation) -> None:
    """Vary the colors of support, fixtures and objects of a finalized plant without a context."""
    if not variation.colors:
        return
    plant, scene_graph = scene_plant.plant, scene_plant.scene_graph
    inspector = scene_graph.model_inspector()
    objects = {int(body.index()): name for name, body in scene_plant.bodies.items()}
    support = get_support_body(plant)
    for geometry in inspector.GetAllGeometryIds(Role.kPerception):
        body = plant.GetBodyFromFrameId(inspector.GetFrameId(geometry))
        name = inspector.GetName(geometry)
        if int(body.index()) in objects:
            name = objects[int(body.index())]
        elif body.index() == support.index():
            name = SUPPORT
        elif body.index() != plant.world_body().index():
            name = fixture_name(plant, body)
        if name not in variation.colors:
            continue  # robot and gripper
        color = variation.colors[name]
        properties = inspector.GetPerceptionProperties(geometry)
        if properties.HasProperty("phong", "diffuse"):
            _blend_diffuse(scene_plant, geometry, color, variation.color_fraction)
        elif isinstance(inspector.GetShape(geometry), Mesh):
            _tint_mesh(scene_plant, geometry, color, variation.color_fraction)


def _blend_diffuse(
    scene_plant: ScenePlant, geometry: GeometryId, color: Vector, fraction: float
) -> None:
    """Mix a color into that of a geometry without texture."""
    scene_graph = scene_plant.scene_graph
    properties = PerceptionProperties(
        scene_graph.model_inspector().GetPerceptionProperties(geometry)
    )
    rgba = np.asarray(properties.GetProperty("phong", "diffuse").rgba)
    properties.UpdateProperty(
        "phong", "diffuse", Rgba(*_blend(rgba[:3], color, fraction).tolist(), float(rgba[3]))
    )
    source = scene_plant.plant.get_source_id()
    # Drake cannot replace perception properties.
    scene_graph.RemoveRole(source, geometry, Role.kPerception)
    scene_graph.AssignRole(source, geometry, properties, RoleAssign.kNew)


def _tint_mesh(
    scene_plant: ScenePlant, geometry: GeometryId, color: Vector, fraction: float
) -> None:
    """Replace a textured glTF mesh by one whose texture is multiplied with a tint."""
    scene_graph = scene_plant.scene_graph
    inspector = scene_graph.model_inspector()
    shape = inspector.GetShape(geometry)
    document = json.loads(shape.source().path().read_text(encoding="utf-8"))
    tint = _blend(np.ones(3), color, fraction).tolist()
    for material in document["materials"]:
        material.setdefault("pbrMetallicRoughness", {})["baseColorFactor"] = [*tint, 1.0]
    name = inspector.GetName(geometry)
    file = MemoryFile(json.dumps(document), ".gltf", name)
    mesh = Mesh(InMemoryMesh(mesh_file=file))
    instance = GeometryInstance(inspector.GetPoseInFrame(geometry), mesh, f"{name}_tinted")
    instance.set_perception_properties(
        PerceptionProperties(inspector.GetPerceptionProperties(geometry))
    )
    source = scene_plant.plant.get_source_id()
    scene_graph.RegisterGeometry(source, inspector.GetFrameId(geometry), instance)
    scene_graph.RemoveRole(source, geometry, Role.kPerception)
