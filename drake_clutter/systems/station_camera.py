"""RGB-D camera of the simulated station."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import MakeRenderEngineVtk
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import ImageDepth32F, RgbdSensor

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.simulation.camera_renderer import (
    RENDER_ENGINE_PARAMS,
    RENDERER_NAME,
    RenderCameras,
)
from drake_clutter.station.clutter_station import ClutterStation
from drake_clutter.station.station_simulation import TIME_STEP


def add_overhead_camera(builder: DiagramBuilder, station: ClutterStation) -> RgbdSensor:
    """Add the cell's camera to a diagram, and connect it to a station that has visuals."""
    scene_graph = station.camera_scene_graph
    assert scene_graph is not None
    scene_graph.AddRenderer(RENDERER_NAME, MakeRenderEngineVtk(RENDER_ENGINE_PARAMS))
    cameras = RenderCameras.from_camera(station.cell.camera)
    sensor = RgbdSensor(scene_graph.world_frame_id(), cameras.X_TC, cameras.color, cameras.depth)
    builder.AddNamedSystem("overhead_camera", sensor)
    builder.Connect(station.GetOutputPort("query"), sensor.GetInputPort("geometry_query"))
    return sensor


@lru_cache(maxsize=8)
def render_empty_depth(cell: WorkCell) -> NDArray[np.float32]:
    """Return the depth image of a cell without objects, its arm at home [m]. Shape (H, W)."""
    builder = DiagramBuilder()
    station = builder.AddSystem(ClutterStation(cell, [], time_step=TIME_STEP, visuals=True))
    sensor = add_overhead_camera(builder, station)
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    station.set_state(root, np.array(cell.robot.home), [])
    context = sensor.GetMyContextFromRoot(root)
    image: ImageDepth32F = sensor.depth_image_32F_output_port().Eval(context)
    depth: NDArray[np.float32] = image.data[..., 0].copy()
    depth.flags.writeable = False
    return depth
