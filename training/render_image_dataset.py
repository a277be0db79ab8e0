"""Render a dataset of labeled images for object detectors: dropped heaps and generated scenes.

    python training/render_image_dataset.py --out runs/images --count 20000 --workers 2

An item of the dataset is a sequence of scenes, each with one object less or moved, in a folder of
its own (see `drake_clutter.perception.image_dataset`). It is one of

    heap       20 objects of random classes in random rotations, which Drake drops on the tray; the
               images show late moments of the fall, and objects are removed from the top
    generated  a scene of the random generator, or of a trained generator that has no other
               classes, laid out but not settled; objects are removed from the top, and some of
               them are placed elsewhere on the tray

Randomized per image: the colors of each instance and of the tray, and the background beyond it.
Randomized per item, by the renderer:

    vtk     two to four lamps beside the camera (direction, intensity, color temperature); the
            camera does not move
    raster  one to three lamps of a room that cast shadows, ambient light, exposure, patches on the
            textures of objects and tray, and the pose of the camera about that of the work cell

The dataset has the layout of BOP: the BOP toolkit reads it as split `train`. An interrupted run is
resumed by the same command; a larger count extends the dataset. The scenes depend on --seed
alone: no scene dataset for evaluation is read.
"""

import gc
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from drake_clutter.agents.generators import GenerationJob, SceneGenerator
from drake_clutter.catalog import load_catalog
from drake_clutter.cell.camera import Camera
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.commands.job_file import open_job_folder
from drake_clutter.config import ClutterConfig
from drake_clutter.limits import MAX_SEED
from drake_clutter.perception.bop_models import (
    write_dataset_camera,
    write_models,
)
from drake_clutter.perception.image_dataset import (
    TRAIN_FOLDER,
    AnnotatedImage,
    LabeledImage,
    write_images,
)
from drake_clutter.rendering.lighting import Lamp, LampKind, Lighting
from drake_clutter.rendering.mesh_renderer import RenderedImages
from drake_clutter.rendering.scene_rasterizer import SceneRasterizer
from drake_clutter.rendering.visual_mesh import VisualMesh
from drake_clutter.scenes.scene import Pose, Scene, SceneObject
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.camera_renderer import CameraRenderer, make_engine_params
from drake_clutter.simulation.drop import sample_drop_scene, simulate_drop
from drake_clutter.simulation.image_renderer import ImageRenderer, RendererKind
from drake_clutter.validation import to_plain
from drake_clutter.workers.parallel_map import map_ordered
from training.script import CatalogOption, SeedOption, WorkersOption, progress, run_script

HEAP_IMAGES = 20
"""Number of images of a heap."""
GENERATED_IMAGES = 16
"""Number of images of a generated scene."""
HEAP_OBJECTS = 20
"""Number of objects of a heap."""
DROP_TIMES = (0.9, 1.1, 1.3, 1.5)
"""Times after the release at which a heap is rendered [s]; most objects have landed by then."""
NODES = 25
"""Number of nodes of the generated scene graphs."""
GENERATORS = {"random": "", "sg-star": "ycb7", "sg-14": "pantry14"}
"""Scene generators by name, and the object set that each was trained with; "" for any."""
MOVE_PROBABILITY = 0.5
"""Probability that an object removed from a generated scene is placed elsewhere."""
MAX_LAMP_DISTANCE = 1.5
"""Largest distance of a room's lamp from the tray along x and y [m]."""
LAMP_HEIGHTS = (1.7, 2.8)
"""Smallest and largest height of a room's lamp above the tray [m]."""
POSITION_SPREAD = 0.003
"""Standard deviation of each coordinate of the camera's position [m]; assumed."""
ROTATION_SPREAD_DEG = 0.2
"""Standard deviation of each angle of the camera's rotation [deg]; assumed."""
MAX_PATCH_CONTRAST = 0.25
"""Largest standard deviation of the patches on textures, as a factor; assumed."""
PLAIN_TEXTURE_SIDE = 64
"""Side of the texture with patches of a surface without a larger one [px]."""
_PLACEMENT_TRIES = 50
_PLACEMENT_GAP = 0.005
"""Distance to other objects, seen from above, that a placement keeps [m]."""


@dataclass(frozen=True)
class ImageJob:
    """Parameters that determine the images of an item.

    Attributes:
        objects: Name of the object set.
        catalog: Asset folder with additional object classes, or None.
        heap_fraction: Fraction of the images that show heaps.
        seed: Seed of the dataset.
        renderer: Renderer of the images.
    """

    objects: str
    catalog: Path | None
    heap_fraction: float
    seed: int
    renderer: RendererKind = RendererKind.VTK

    def is_heap(self, item: int) -> bool:
        """Return whether an item is a heap.

        It is drawn so that `heap_fraction` holds for the images, not for the items.
        """
        heaps = self.heap_fraction / HEAP_IMAGES
        generated = (1 - self.heap_fraction) / GENERATED_IMAGES
        return bool(item_rng(self.seed, item, 0).random() < heaps / (heaps + generated))

    def num_images(self, item: int) -> int:
        """Return the number of images of an item."""
        return HEAP_IMAGES if self.is_heap(item) else GENERATED_IMAGES

    def generators(self) -> list[tuple[str, str]]:
        """Return the generators that have no classes but the job's, each with its object set."""
        catalog = load_catalog(self.catalog)
        classes = set(catalog.object_set(self.objects))
        candidates = [(agent, objects or self.objects) for agent, objects in GENERATORS.items()]
        return [
            (agent, objects)
            for agent, objects in candidates
            if set(catalog.object_set(objects)) <= classes
        ]


class ItemRenderer:
    """Renders the items of a job; a worker for `map_ordered`."""

    def __init__(self, job: ImageJob, out: Path) -> None:
        """Load the data that all items share.

        Args:
            job: What is rendered.
            out: Folder of the dataset.
        """
        self._job = job
        self._out = out
        self._config = ClutterConfig()
        self._classes = load_catalog(job.catalog).object_set(job.objects)
        self._generators = dict[str, SceneGenerator]()

    def __call__(self, item: int) -> None:
        """Write the folder of an item."""
        rng = item_rng(self._job.seed, item)
        count = self._job.num_images(item)
        is_heap = self._job.is_heap(item)
        scenes = self._heaps(count, rng) if is_heap else self._generated_scenes(count, rng)
        camera = self._config.cell.camera
        renderer: ImageRenderer
        if self._job.renderer is RendererKind.VTK:
            renderer = CameraRenderer(camera, make_engine_params(sample_lights(rng)))
        else:
            camera = sample_camera(camera, rng)
            vary_texture = TextureVariation(int(rng.integers(MAX_SEED)))
            renderer = SceneRasterizer(camera, sample_room_lighting(rng), vary_texture)
        silhouettes = dict[SceneObject, NDArray[np.bool_]]()
        images = (render_image(renderer, scene, silhouettes, rng) for scene in scenes)
        write_images(
            self._out / TRAIN_FOLDER / f"{item:06d}",
            images,
            camera,
            list(load_catalog(self._job.catalog).classes),
        )
        if self._job.renderer is RendererKind.VTK:
            # The process can abort when another thread collects the renderer.
            del renderer, images
            gc.collect()

    def _heaps(self, count: int, rng: np.random.Generator) -> Iterator[Scene]:
        """Yield a heap with fewer and fewer objects, down to one, at random times of the drop."""
        classes = [self._classes[k] for k in rng.integers(len(self._classes), size=HEAP_OBJECTS)]
        moments = simulate_drop(
            sample_drop_scene(classes, self._config.cell.support, rng),
            self._config.settle.time_step,
            DROP_TIMES,
        )
        remaining = moments[-1]
        for max_objects in np.linspace(len(remaining.objects), 1, count).round():
            while len(remaining.objects) > max_objects:
                remaining = remove_object(remaining, sample_top_object(remaining, rng))
            moment = moments[rng.integers(len(moments))]
            yield replace(
                moment, objects=tuple(o for o in moment.objects if o.name in remaining.names)
            )

    def _generated_scenes(self, count: int, rng: np.random.Generator) -> Iterator[Scene]:
        """Yield a generated scene, and the scene after each removal or move of an object."""
        generators = self._job.generators()
        agent, objects = generators[rng.integers(len(generators))]
        if agent not in self._generators:
            job = GenerationJob(
                agent, objects, self._job.catalog, NODES, self._job.seed, self._config
            )
            self._generators[agent] = SceneGenerator(job)
        scene, _ = self._generators[agent].lay_out(rng)
        yield scene
        for _ in range(count - 1):
            for _ in range(rng.integers(1, 3)):
                top_object = sample_top_object(scene, rng)
                rest = remove_object(scene, top_object)
                moved = None
                if rng.random() < MOVE_PROBABILITY or not rest.objects:
                    moved = place_on_tray(top_object, rest, rng)
                scene = rest if moved is None else replace(rest, objects=(*rest.objects, moved))
            yield scene


def remove_object(scene: Scene, removed: SceneObject) -> Scene:
    """Return a scene without one of its objects."""
    return replace(scene, objects=tuple(o for o in scene.objects if o is not removed))


def sample_top_object(scene: Scene, rng: np.random.Generator) -> SceneObject:
    """Return a random object of a scene that no higher object covers, seen from above."""
    top_objects = [
        o
        for o in scene.objects
        if not any(
            over.top_height > o.top_height and _overlap(o, over, 0.0) for over in scene.objects
        )
    ]
    return top_objects[rng.integers(len(top_objects))]


def place_on_tray(
    removed: SceneObject, rest: Scene, rng: np.random.Generator
) -> SceneObject | None:
    """Return an object at a random free place of the tray, with a random yaw.

    Args:
        removed: The object in its earlier pose.
        rest: The scene without the object.
        rng: Random generator.

    Returns:
        The object; None if no free place was found.
    """
    for _ in range(_PLACEMENT_TRIES):
        R_yaw = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix()
        R_TO = R_yaw @ removed.X_TO.rotation
        rotated = replace(removed, X_TO=Pose.from_rotation(R_TO, (0.0, 0.0, 0.0)))
        lower, upper = rotated.bounds_T
        half_size = rest.support.half_size
        lowest_xy = -half_size - lower[:2]
        highest_xy = half_size - upper[:2]
        if (lowest_xy < highest_xy).all():
            x, y = rng.uniform(lowest_xy, highest_xy)
            placed = replace(removed, X_TO=Pose.from_rotation(R_TO, (x, y, -lower[2])))
            if not any(_overlap(placed, other, _PLACEMENT_GAP) for other in rest.objects):
                return placed
    return None


def _overlap(one: SceneObject, other: SceneObject, gap: float) -> bool:
    """Return whether the bounding boxes, seen from above, are closer than `gap` [m]."""
    lower, upper = one.bounds_T
    other_lower, other_upper = other.bounds_T
    return bool((np.minimum(upper, other_upper) > np.maximum(lower, other_lower) - gap)[:2].all())


def sample_lights(rng: np.random.Generator) -> Lighting:
    """Return two to four random directional lamps beside the camera, without shadows."""
    count = rng.integers(2, 5)
    intensities = rng.dirichlet(np.full(count, 2.0)) * rng.uniform(2.0, 4.5)
    lamps = []
    for intensity in intensities.tolist():
        x, y = rng.uniform(-0.9, 0.9, 2).tolist()
        warmth = rng.uniform(-0.12, 0.12)
        color = min(1.0, 1 + warmth), 1 - abs(warmth) / 2, min(1.0, 1 - warmth)
        lamps.append(Lamp(LampKind.DIRECTIONAL, (x, y, 1.0), intensity, color, is_on_camera=True))
    return Lighting(tuple(lamps))


def sample_room_lighting(rng: np.random.Generator) -> Lighting:
    """Return one to three random lamps of a room with shadows, ambient light and an exposure.

    Point lamps hang beside the camera or above it, and directional ones are windows.
    """
    count = int(rng.integers(1, 4))
    irradiances = rng.dirichlet(np.full(count, 2.0)) * rng.uniform(1.5, 4.0)
    lamps = []
    for irradiance in irradiances.tolist():
        x, y = rng.uniform(-MAX_LAMP_DISTANCE, MAX_LAMP_DISTANCE, 2).tolist()
        height = float(rng.uniform(*LAMP_HEIGHTS))
        warmth = float(rng.uniform(-0.12, 0.12))
        color = min(1.0, 1 + warmth), 1 - abs(warmth) / 2, min(1.0, 1 - warmth)
        squared_distance = x**2 + y**2 + height**2
        if rng.random() < 0.5:
            lamp = Lamp(
                LampKind.POINT,
                (x, y, height),
                irradiance * squared_distance,
                color,
                casts_shadows=True,
            )
        else:
            lamp = Lamp(
                LampKind.DIRECTIONAL, (-x, -y, -height), irradiance, color, casts_shadows=True
            )
        lamps.append(lamp)
    ambient = float(rng.uniform(0.05, 0.4))
    return Lighting(tuple(lamps), ambient=ambient, exposure=float(rng.uniform(0.7, 1.3)))


@dataclass(frozen=True)
class TextureVariation:
    """Multiplies textures by random smooth patches of color, such as stains and faded print.

    Attributes:
        seed: Seed of the patches; those of a name are always the same.
    """

    seed: int

    def __call__(self, name: str, mesh: VisualMesh) -> VisualMesh:
        """Return a mesh with patches on its texture.

        Args:
            name: Name of the class, or of the part of the tray.
            mesh: The mesh.
        """
        rng = np.random.default_rng([self.seed, zlib.crc32(name.encode())])
        patches = rng.normal(
            1.0, rng.uniform(0.0, MAX_PATCH_CONTRAST), (*rng.integers(2, 12, 2), 3)
        )
        height, width, _ = mesh.texture.shape
        size = max(width, PLAIN_TEXTURE_SIDE), max(height, PLAIN_TEXTURE_SIDE)
        bytes_of_patches = (128 * patches).clip(0, 255).astype(np.uint8)
        factor = np.asarray(
            Image.fromarray(bytes_of_patches).resize(size, Image.Resampling.BICUBIC), float
        )
        picture = np.asarray(Image.fromarray(mesh.texture).resize(size, Image.Resampling.NEAREST))
        texture = (picture * factor / 128).clip(0, 255).astype(np.uint8)
        return replace(mesh, texture=texture)


def sample_camera(camera: Camera, rng: np.random.Generator) -> Camera:
    """Return a camera whose pose differs by what a calibration leaves."""
    translation = np.array(camera.pose.translation) + rng.normal(0.0, POSITION_SPREAD, 3)
    rpy_deg = np.array(camera.pose.rpy_deg) + rng.normal(0.0, ROTATION_SPREAD_DEG, 3)
    pose = PoseSpec(translation=tuple(translation.tolist()), rpy_deg=tuple(rpy_deg.tolist()))
    return camera.model_copy(update={"pose": pose})


def render_image(
    camera: ImageRenderer,
    scene: Scene,
    silhouettes: dict[SceneObject, NDArray[np.bool_]],
    rng: np.random.Generator,
) -> AnnotatedImage:
    """Return an image of a scene in random colors, with its ground truth.

    Args:
        camera: Renderer of the camera's images.
        scene: The scene.
        silhouettes: Pixels that an object covers when nothing occludes it. Objects that are not in
            it are added. Shape (H, W) each.
        rng: Random generator of the colors.
    """
    images = camera.render(scene)
    new = tuple(o for o in scene.objects if o not in silhouettes)
    masks = camera.silhouettes(replace(scene, objects=new))
    silhouettes |= dict(zip(new, masks, strict=True))
    scene_silhouettes = np.array([silhouettes[o] for o in scene.objects])
    image = LabeledImage(
        randomize_colors(images, len(scene.objects), rng),
        images.depth,
        images.label,
        tuple(o.object_class.name for o in scene.objects),
        tuple(o.X_TO for o in scene.objects),
        np.count_nonzero(scene_silhouettes, axis=(1, 2)),
    )
    return AnnotatedImage(image, scene_silhouettes)


def randomize_colors(
    images: RenderedImages, num_objects: int, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Return the color image with random colors and background.

    The colors of each instance and of the tray undergo a random affine map: a rotation of the hue
    about the gray axis, a gain and an offset.

    Args:
        images: Color, depth and label image of a scene.
        num_objects: Number of objects in the scene.
        rng: Random generator.

    Returns:
        The color image. Shape (H, W, 3).
    """
    color = images.color.astype(np.float32)
    is_background = ~np.isfinite(images.depth)
    for instance in range(-1, num_objects):  # -1 is the tray.
        mask = (images.label == instance) & ~is_background
        hue_angle = rng.uniform(-np.pi, np.pi) if instance < 0 else rng.normal(0, 0.15)
        hue_rotation = Rotation.from_rotvec(np.full(3, hue_angle / np.sqrt(3))).as_matrix()
        gain = rng.uniform(0.75, 1.25) * rng.uniform(0.93, 1.07, 3)
        offset = rng.uniform(-15, 15)
        color_map = (gain[:, None] * hue_rotation).T.astype(np.float32)
        color[mask] = color[mask] @ color_map + np.float32(offset)
    patches = rng.uniform(0, 255, 3) + rng.normal(
        0, rng.uniform(0, 50), (*rng.integers(2, 24, 2), 3)
    )
    height, width = is_background.shape
    background = Image.fromarray(patches.clip(0, 255).astype(np.uint8)).resize(
        (width, height), Image.Resampling.BICUBIC
    )
    color[is_background] = np.asarray(background)[is_background]
    return color.clip(0, 255).astype(np.uint8)


def main(
    out: Annotated[
        Path,
        typer.Option(
            metavar="DIR", help="Folder of the dataset. One of the same options is extended."
        ),
    ],
    count: Annotated[
        int, typer.Option(min=1, help="Number of images at least; the last item is completed.")
    ] = 20000,
    heap_fraction: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Fraction of the images that show heaps.")
    ] = 0.3,
    seed: SeedOption = 0,
    workers: WorkersOption = 1,
    objects: Annotated[str, typer.Option(help="Name of the object set.")] = "pantry14",
    catalog: CatalogOption = None,
    renderer: Annotated[
        RendererKind, typer.Option(help="Renderer; each has its own lamps, see the script.")
    ] = RendererKind.VTK,
) -> None:
    """Render a dataset of labeled images."""
    folder = catalog.resolve() if catalog else None
    job = ImageJob(objects, folder, heap_fraction, seed, renderer)
    job_fields = {**to_plain(job), "agents": [agent for agent, _ in job.generators()]}
    with open_job_folder(out, job_fields):
        write_dataset_camera(out, ClutterConfig().cell.camera)
        write_models(out, list(load_catalog(job.catalog).classes.values()))
        (out / TRAIN_FOLDER).mkdir(exist_ok=True)
        present = {path.name for path in (out / TRAIN_FOLDER).iterdir()}
        num_items = num_images = 0
        while num_images < count:
            num_images += job.num_images(num_items)
            num_items += 1
        missing = [item for item in range(num_items) if f"{item:06d}" not in present]
        rendered = map_ordered(partial(ItemRenderer, job, out), missing, workers=workers)
        for _ in progress(rendered, f"{num_images} images", num_items, num_items - len(missing)):
            pass


if __name__ == "__main__":
    run_script(main)
