"""Compare the images of the compiled renderer with those of Drake's VTK engine.

    python benchmarks/renderer_agreement.py --out benchmarks/results/renderers.json

Both render the same scenes of every shipped object set: graphs of the training datasets in random
layouts, and objects in the air with random rotations. The views are the default camera without the
arm, and the cameras of the default cell and of a cell with a tilted camera with the arm at random
joint angles. Each scene has its own random lamps: two beside the camera, and a point lamp above the
tray. None casts shadows, which Drake's engine does not draw for such lamps.

With `--picture FILE`, a picture of both beside the compiled renderer with shadows is written.

With `--timing`, the CPU times of an image of both are measured, too. VTK uses all cores unless the
environment variable LP_NUM_THREADS is 0.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from PIL import Image
from pydrake.geometry import MakeRenderEngineVtk, RenderLabel
from pydrake.systems.framework import DiagramBuilder

from benchmarks.measurement import describe_machine
from drake_clutter.catalog import load_catalog
from drake_clutter.cell.camera import Camera
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.cell.work_cell import WorkCell, default_cell, load_cell
from drake_clutter.config import ClutterConfig
from drake_clutter.files import write_json
from drake_clutter.rendering.lighting import CAMERA_LIGHTING, Lamp, LampKind, Lighting
from drake_clutter.rendering.mesh_renderer import RenderedImages
from drake_clutter.rendering.scene_rasterizer import SceneRasterizer
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.scene import Scene
from drake_clutter.scenes.scene_dataset import load_scene_dataset, relayout
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.camera_renderer import (
    RENDERER_NAME,
    CameraRenderer,
    RenderCameras,
    make_engine_params,
)
from drake_clutter.simulation.cell_plant import add_work_cell, joint_state_indices
from drake_clutter.simulation.drop import sample_drop_scene
from drake_clutter.simulation.plant_rasterizer import PlantRasterizer
from drake_clutter.simulation.scene_plant import add_scene_plant
from training.image_randomization import sample_lights
from training.results_file import Row, provenance
from training.script import ROOT, SCENES, ResultsOption, SeedOption, print_table, run_script

DATASETS = {"ycb7": "train_sg_star", "pantry14": "train_sg_14"}
"""Datasets of scene graphs by object set."""
NUM_FALLING = 4
"""Number of objects in the air, so few that all are within the clipping range of VTK labels."""
TILTED_CELL = ROOT / "models/cells/ur10_tilted_camera.yaml"
"""Cell with a tilted camera."""
MAX_JOINT_OFFSET = 0.8
"""Largest offset of a joint from the home position [rad]."""
MAX_DEPTH_DIFFERENCE = 1e-3
"""Depths that differ by less count as equal [m]."""
COLOR_PERCENTILES = (50.0, 95.0, 99.0, 99.9)
"""Percentiles of the difference of colors."""
PICTURE_CAMERA = Camera(
    pose=PoseSpec(translation=(0.8, -2.1, 1.45), rpy_deg=(-113.2, 0.0, 24.3)),
    width=480,
    height=480,
    fov_y_deg=42.0,
)
"""Camera of the picture, with a view of the whole cell."""
TIMED_IMAGES = 3
"""Number of times that a timed image is rendered; the least time counts."""

Renderer = Callable[[], RenderedImages]
"""Renders an image."""


@dataclass(frozen=True)
class ImagePair:
    """Images of the same view, and their CPU times [s] or None.

    Attributes:
        drake: Images of Drake's VTK engine.
        compiled: Images of the compiled renderer.
        drake_seconds: CPU time of the former.
        compiled_seconds: CPU time of the latter.
    """

    drake: RenderedImages
    compiled: RenderedImages
    drake_seconds: float | None
    compiled_seconds: float | None


def sample_lighting(rng: np.random.Generator) -> Lighting:
    """Return random lamps that both renderers can draw."""
    x, y = rng.uniform(-0.8, 0.8, 2).tolist()
    point = Lamp(LampKind.POINT, (x, y, float(rng.uniform(1.0, 1.8))), 1.5)
    lamps = sample_lights(rng).lamps[:2]
    return Lighting((*lamps, point), exposure=float(rng.uniform(0.7, 1.2)))


def render_pair(drake: Renderer, compiled: Renderer, *, timing: bool) -> ImagePair:
    """Return the images of both renderers."""
    if not timing:
        return ImagePair(drake(), compiled(), None, None)
    times = dict[str, list[float]](drake=[], compiled=[])
    images = {}
    for _ in range(1 + TIMED_IMAGES):
        for name, render in (("drake", drake), ("compiled", compiled)):
            start = time.process_time()
            images[name] = render()
            times[name].append(time.process_time() - start)
    # The first call of each prepares its meshes.
    return ImagePair(
        images["drake"], images["compiled"], min(times["drake"][1:]), min(times["compiled"][1:])
    )


def render_scene(scene: Scene, camera: Camera, lighting: Lighting, *, timing: bool) -> ImagePair:
    """Return the images of a scene without an arm."""
    drake = CameraRenderer(camera, make_engine_params(lighting))
    compiled = SceneRasterizer(camera, lighting)
    return render_pair(lambda: drake.render(scene), lambda: compiled.render(scene), timing=timing)


class PosedCell:
    """A scene in a cell, its arm near its home.

    Attributes:
        rasterizer: Compiled renderer of the cell.
        query: Query object of its scene graph, which has a VTK engine.
    """

    def __init__(
        self, scene: Scene, cell: WorkCell, lighting: Lighting, rng: np.random.Generator
    ) -> None:
        """Build the cell.

        Args:
            scene: The objects.
            cell: The work cell.
            lighting: Light of the VTK engine.
            rng: Random generator of the joint angles.
        """
        builder = DiagramBuilder()
        objects = [(o.name, o.object_class) for o in scene.objects]
        scene_plant = add_scene_plant(builder, objects, scene.support, 0.01, visuals=True)
        plant, scene_graph = scene_plant.plant, scene_plant.scene_graph
        arm = add_work_cell(
            plant, scene_graph, cell.with_support(scene.support), compliant=True, visuals=True
        )
        plant.Finalize()
        scene_graph.AddRenderer(RENDERER_NAME, MakeRenderEngineVtk(make_engine_params(lighting)))
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        context = plant.GetMyMutableContextFromRoot(self._context)
        scene_plant.set_poses(context, scene.objects)
        positions = plant.GetPositions(context)
        offset = rng.uniform(-MAX_JOINT_OFFSET, MAX_JOINT_OFFSET, load_robot(cell.robot).num_joints)
        positions[joint_state_indices(plant, arm)[0]] = np.array(cell.robot.home) + offset
        plant.SetPositions(context, positions)
        self.query = scene_graph.get_query_output_port().Eval(
            scene_graph.GetMyContextFromRoot(self._context)
        )
        self._world = scene_graph.world_frame_id()
        self.rasterizer = PlantRasterizer(scene_graph.model_inspector())

    def render_by_drake(self, cameras: RenderCameras) -> RenderedImages:
        """Return the images of the VTK engine."""
        view = self._world, cameras.X_TC
        color = self.query.RenderColorImage(cameras.color, *view).data[..., :3]
        depth = self.query.RenderDepthImage(cameras.depth, *view).data[..., 0]
        label = self.query.RenderLabelImage(cameras.color, *view).data[..., 0].astype(np.int64)
        label[label == int(RenderLabel.kEmpty)] = -1
        return RenderedImages(color.copy(), depth.copy(), label)


def render_cell(cell: PosedCell, camera: Camera, lighting: Lighting, *, timing: bool) -> ImagePair:
    """Return the images of a cell."""
    cameras = RenderCameras.from_camera(camera)
    return render_pair(
        lambda: cell.render_by_drake(cameras),
        lambda: cell.rasterizer.render(camera, cameras.X_TC, cell.query, lighting),
        timing=timing,
    )


def render_view(view: str, scene: Scene, rng: np.random.Generator, *, timing: bool) -> ImagePair:
    """Return the images of a scene in a view of `VIEWS`."""
    lighting = sample_lighting(rng)
    if view == "objects":
        return render_scene(scene, default_cell().camera, lighting, timing=timing)
    cell = default_cell() if view == "arm" else load_cell(TILTED_CELL)
    return render_cell(PosedCell(scene, cell, lighting, rng), cell.camera, lighting, timing=timing)


VIEWS = {
    "objects": "default camera, no arm",
    "arm": "default camera, arm",
    "tilted": "tilted camera, arm",
}
"""Views of the scenes, and what they show."""


def color_differences(pair: ImagePair) -> NDArray[np.int64]:
    """Return the largest difference among the channels, of each of n pixels that show a surface."""
    difference = np.abs(pair.drake.color.astype(np.int64) - pair.compiled.color).max(axis=2)
    return np.asarray(difference[np.isfinite(pair.drake.depth)])


def summarize(pairs: Sequence[ImagePair]) -> Row:
    """Return the agreement of images."""
    equal_labels = labels = equal_depths = depths = same_extent = pixels = 0
    for pair in pairs:
        drake, compiled = pair.drake, pair.compiled
        seen = (drake.label >= 0) | (compiled.label >= 0)
        labels += int(seen.sum())
        equal_labels += int((drake.label == compiled.label)[seen].sum())
        finite, other = np.isfinite(drake.depth), np.isfinite(compiled.depth)
        both = finite & other
        pixels += both.size
        same_extent += int((finite == other).sum())
        depths += int((finite | other).sum())
        difference = np.abs(drake.depth[both] - compiled.depth[both])
        equal_depths += int((difference < MAX_DEPTH_DIFFERENCE).sum())
    colors = np.concatenate([color_differences(pair) for pair in pairs])
    row: Row = {
        "images": len(pairs),
        "equal_label_fraction": equal_labels / labels,
        "equal_depth_fraction": equal_depths / depths,
        "equal_extent_fraction": same_extent / pixels,
        "mean_color_difference": float(colors.mean()),
        "color_difference_percentiles": {
            f"{percentile:g}": float(np.percentile(colors, percentile))
            for percentile in COLOR_PERCENTILES
        },
    }
    for name in ("drake", "compiled"):
        seconds = [getattr(pair, f"{name}_seconds") for pair in pairs]
        if None not in seconds:
            row[f"{name}_median_ms"] = 1e3 * float(np.median(seconds))
    return row


def sample_stacks(objects: str, count: int, seed: int) -> list[Scene]:
    """Return the first graphs of a training dataset in random layouts."""
    dataset = load_scene_dataset(SCENES / f"{DATASETS[objects]}.json", load_catalog())
    grammar = dataset.grammar
    return [
        relayout(dataset.derivation(k, grammar), grammar, ClutterConfig(), item_rng(seed, k))
        for k in range(count)
    ]


def sample_falling(objects: str, count: int, seed: int) -> list[Scene]:
    """Return objects in the air with random rotations."""
    classes = load_catalog().object_set(objects)
    scenes = []
    for k in range(count):
        rng = item_rng(seed, k)
        chosen = [classes[i] for i in rng.integers(len(classes), size=NUM_FALLING)]
        scenes.append(sample_drop_scene(chosen, default_cell().support, rng))
    return scenes


SCENE_KINDS = {"stacks": sample_stacks, "falling": sample_falling}
"""Functions that sample scenes of a kind."""


def draw_picture(path: Path, seed: int) -> None:
    """Write a picture: VTK, the compiled renderer, and the latter with the shadows of a lamp."""
    scene = sample_stacks("pantry14", 3, seed)[2]
    cell = PosedCell(scene, default_cell(), CAMERA_LIGHTING, item_rng(seed, 0))
    pair = render_cell(cell, PICTURE_CAMERA, CAMERA_LIGHTING, timing=False)
    lamp = Lamp(LampKind.POINT, (0.9, -0.7, 1.7), 9.0, casts_shadows=True)
    shadows = cell.rasterizer.render(
        PICTURE_CAMERA, PICTURE_CAMERA.X_TC, cell.query, Lighting((lamp,), ambient=0.3)
    )
    images = np.hstack([pair.drake.color, pair.compiled.color, shadows.color])
    Image.fromarray(images).save(path, optimize=True)


def measure(count: int, seed: int, *, timing: bool) -> Iterator[Row]:
    """Yield the agreement for each object set, kind of scenes and view."""
    for objects in DATASETS:
        for kind, sample_scenes in SCENE_KINDS.items():
            scenes = sample_scenes(objects, count, seed)
            for k, view in enumerate(VIEWS):
                pairs = [
                    render_view(view, scene, item_rng(seed, index, 1 + k), timing=timing)
                    for index, scene in enumerate(scenes)
                ]
                yield {"objects": objects, "scenes": kind, "view": view, **summarize(pairs)}


def main(
    count: Annotated[int, typer.Option(min=1, help="Number of scenes of each kind.")] = 50,
    seed: SeedOption = 0,
    timing: Annotated[bool, typer.Option("--timing", help="Measure CPU times.")] = False,
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Picture to write (PNG).")
    ] = None,
    out: ResultsOption = None,
) -> None:
    """Render the scenes with both renderers, and print and write the agreement."""
    if picture is not None:
        draw_picture(picture, seed)
    rows = list(measure(count, seed, timing=timing))
    document: dict[str, Any] = {**provenance(), "seed": seed, "count": count, "rows": rows}
    if timing:
        document["machine"] = describe_machine("drake", "numba")
    if out is not None:
        write_json(Path(out), document)
    print_table(
        [
            {
                "objects": row["objects"],
                "scenes": row["scenes"],
                "view": VIEWS[row["view"]],
                "labels equal": f"{row['equal_label_fraction']:.5f}",
                "depth within 1 mm": f"{row['equal_depth_fraction']:.5f}",
                "color, mean": f"{row['mean_color_difference']:.3f}",
                "color, 99 %": f"{row['color_difference_percentiles']['99']:g}",
                **{
                    f"{name} [ms]": f"{row[f'{name}_median_ms']:.1f}"
                    for name in ("drake", "compiled")
                    if f"{name}_median_ms" in row
                },
            }
            for row in rows
        ],
        "Compiled renderer and VTK",
    )


if __name__ == "__main__":
    run_script(main)
