"""Appearance of a rendered scene under a `Variation`: lights and colors."""

from dataclasses import replace

import numpy as np
from pydrake.geometry import GeometryId, PerceptionProperties, Rgba, Role, RoleAssign
from scipy.spatial.transform import Rotation

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.recording.randomization import LightVariation, Variation, Vector
from drake_clutter.rendering.lighting import CAMERA_LIGHTING, Lamp, Lighting
from drake_clutter.simulation.cell_plant import fixture_name
from drake_clutter.simulation.plant_rasterizer import TINT
from drake_clutter.simulation.scene_plant import ScenePlant, get_support_body

BACKGROUND = "background"
"""Name of the background among the varied colors."""
SUPPORT = "support"
"""Name of the support among the varied colors."""
NUM_LIGHTS = len(CAMERA_LIGHTING.lamps)
"""Number of lights."""


def colored_parts(cell: WorkCell) -> tuple[str, ...]:
    """Return the names of background, support and fixtures, whose colors are varied."""
    return BACKGROUND, SUPPORT, *(fixture.name for fixture in cell.fixtures)


def vary_lighting(variation: Variation) -> Lighting:
    """Return lights and background of a variation."""
    lamps = CAMERA_LIGHTING.lamps
    if variation.lights:
        pairs = zip(lamps, variation.lights, strict=True)
        lamps = tuple(_vary_lamp(lamp, light) for lamp, light in pairs)
    background = CAMERA_LIGHTING.background
    if BACKGROUND in variation.colors:
        color = [level / 255 for level in background]
        mixed = _blend(color, variation.colors[BACKGROUND], variation.color_fraction)
        red, green, blue = (round(255 * level) for level in mixed)
        background = (red, green, blue)
    return replace(CAMERA_LIGHTING, lamps=lamps, background=background)


def _vary_lamp(lamp: Lamp, variation: LightVariation) -> Lamp:
    """Return a lamp with another intensity and direction."""
    R = Rotation.from_rotvec(variation.rotation_vector)
    x, y, z = R.apply(lamp.vector).tolist()
    return replace(lamp, vector=(x, y, z), intensity=lamp.intensity * variation.intensity)


def _blend(color: list[float], other: Vector, fraction: float) -> list[float]:
    """Return a mixture of two colors. Shape (3,)."""
    return list(((1 - fraction) * np.array(color) + fraction * np.array(other)).tolist())


def vary_colors(scene_plant: ScenePlant, variation: Variation) -> None:
    """Vary the colors of support, fixtures and objects of a finalized plant without a context.

    Textures are multiplied by a tint.
    """
    if not variation.colors:
        return
    plant = scene_plant.plant
    inspector = scene_plant.scene_graph.model_inspector()
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
        if name in variation.colors:  # robot and gripper are not
            color = variation.colors[name]
            _vary_color(scene_plant, geometry, color, variation.color_fraction)


def _vary_color(
    scene_plant: ScenePlant, geometry: GeometryId, color: Vector, fraction: float
) -> None:
    """Mix a color into that of a geometry, or tint its texture."""
    scene_graph = scene_plant.scene_graph
    properties = PerceptionProperties(
        scene_graph.model_inspector().GetPerceptionProperties(geometry)
    )
    if properties.HasProperty("phong", "diffuse"):
        red, green, blue, alpha = properties.GetProperty("phong", "diffuse").rgba.tolist()
        mixed = _blend([red, green, blue], color, fraction)
        properties.UpdateProperty("phong", "diffuse", Rgba(*mixed, alpha))
    else:
        properties.AddProperty(*TINT, Rgba(*_blend([1.0, 1.0, 1.0], color, fraction)))
    source = scene_plant.plant.get_source_id()
    # Drake cannot replace perception properties.
    scene_graph.RemoveRole(source, geometry, Role.kPerception)
    scene_graph.AssignRole(source, geometry, properties, RoleAssign.kNew)
