"""RGB-D camera of the simulated station."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import QueryObject, SceneGraph
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem, ValueProducer
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from drake_clutter.cell.camera import Camera
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.rendering.lighting import CAMERA_LIGHTING
from drake_clutter.rendering.mesh_renderer import RenderedImages
from drake_clutter.simulation.plant_rasterizer import PlantRasterizer
from drake_clutter.station.clutter_station import ClutterStation
from drake_clutter.station.station_simulation import TIME_STEP


class RasterCamera(LeafSystem):
    """RGB-D camera whose images the compiled renderer draws; ports as those of `RgbdSensor`.

    .. pydrake_system::

        name: RasterCamera
        input_ports:
        - geometry_query
        output_ports:
        - color_image
        - depth_image_32f

    Input ports:
        geometry_query: `QueryObject` of the scene graph.

    Output ports:
        color_image: `ImageRgba8U`.
        depth_image_32f: `ImageDepth32F` [m].
    """

    def __init__(self, scene_graph: SceneGraph, camera: Camera) -> None:
        """Prepare the meshes of a scene graph.

        Args:
            scene_graph: Scene graph with all geometry.
            camera: The camera, fixed to the world.
        """
        super().__init__()
        self._camera = camera
        self._rasterizer = PlantRasterizer(scene_graph.model_inspector())
        self._query = self.DeclareAbstractInputPort(
            "geometry_query", AbstractValue.Make(QueryObject())
        )
        size = camera.width, camera.height
        nothing = RenderedImages(
            np.zeros((0, 0, 3), np.uint8), np.zeros((0, 0), np.float32), np.zeros((0, 0), np.int64)
        )
        # Both images are drawn at once.
        self._images = self.DeclareCacheEntry(
            "images",
            ValueProducer(lambda: AbstractValue.Make(nothing), self._calc_images),
            {self._query.ticket()},
        )
        prerequisites = {self._images.ticket()}
        self.DeclareAbstractOutputPort(
            "color_image",
            lambda: AbstractValue.Make(ImageRgba8U(*size)),
            self._calc_color,
            prerequisites,
        )
        self.DeclareAbstractOutputPort(
            "depth_image_32f",
            lambda: AbstractValue.Make(ImageDepth32F(*size)),
            self._calc_depth,
            prerequisites,
        )

    def _calc_images(self, context: Context, cache: AbstractValue) -> None:
        query = self._query.Eval(context)
        cache.set_value(
            self._rasterizer.render(self._camera, self._camera.X_TC, query, CAMERA_LIGHTING)
        )

    def _calc_color(self, context: Context, output: AbstractValue) -> None:
        images: RenderedImages = self._images.Eval(context)
        data = output.get_mutable_value().mutable_data
        data[..., :3] = images.color
        data[..., 3] = 255

    def _calc_depth(self, context: Context, output: AbstractValue) -> None:
        images: RenderedImages = self._images.Eval(context)
        output.get_mutable_value().mutable_data[..., 0] = images.depth


def add_overhead_camera(builder: DiagramBuilder, station: ClutterStation) -> RasterCamera:
    """Add the cell's camera to a diagram, and connect it to a station that has visuals."""
    assert station.camera_scene_graph is not None
    camera: RasterCamera = builder.AddNamedSystem(
        "overhead_camera", RasterCamera(station.camera_scene_graph, station.cell.camera)
    )
    builder.Connect(station.GetOutputPort("query"), camera.GetInputPort("geometry_query"))
    return camera


@lru_cache(maxsize=8)
def render_empty_depth(cell: WorkCell) -> NDArray[np.float32]:
    """Return the depth image of a cell without objects, its arm at home [m]. Shape (H, W)."""
    builder = DiagramBuilder()
    station = builder.AddSystem(ClutterStation(cell, [], time_step=TIME_STEP, visuals=True))
    camera = add_overhead_camera(builder, station)
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    station.set_state(root, np.array(cell.robot.home), [])
    context = camera.GetMyContextFromRoot(root)
    image: ImageDepth32F = camera.GetOutputPort("depth_image_32f").Eval(context)
    depth: NDArray[np.float32] = image.data[..., 0].copy()
    depth.flags.writeable = False
    return depth
