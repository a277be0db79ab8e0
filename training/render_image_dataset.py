"""Render a dataset of labeled images for object detectors: dropped heaps and generated scenes.

    python training/render_image_dataset.py --out runs/images --count 20000 --workers 2

An item of the dataset is a scene that is dismantled several times, each time in another order and
under other light. Each dismantling is a sequence of scenes with one object less or moved, in a
folder of its own (see `drake_clutter.perception.image_dataset`). The scene is one of

    heap       20 objects of random classes in random rotations, which Drake drops on the tray; the
               images show late moments of the fall, and objects are removed from the top
    generated  a scene of the random generator, or of a trained generator that has no other
               classes, laid out but not settled; in half of the dismantlings each stack is turned
               by a random yaw; objects are removed from the top, and some of them are placed
               elsewhere on the tray or on another object

Randomized per image: the colors of each instance and of the tray, and the background beyond it.
Randomized per dismantling, by the renderer:

    vtk     two to four lamps beside the camera (direction, intensity, color temperature); the
            camera does not move
    raster  one to three lamps of a room that cast shadows, ambient light, exposure, patches and
            random prints on the textures of objects and tray, and the pose of the camera about
            that of the work cell

With --textures unseen, all textures are prints of kinds that other datasets never show, to test a
detector with.

The dataset has the layout of BOP: the BOP toolkit reads it as split `train`. With --compact, color
images are JPEG files and there are no mask images, which takes a fifth of the space; that is the
format for hundreds of thousands of images. An interrupted run is resumed by the same command; a
larger count extends the dataset. The images depend on --seed alone, not on the number of
processes, and no scene dataset for evaluation is read.
"""

import gc
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from drake_clutter.agents.generators import GenerationJob, SceneGenerator
from drake_clutter.catalog import load_catalog
from drake_clutter.commands.job_file import open_job_folder
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
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
from drake_clutter.rendering.scene_rasterizer import SceneRasterizer
from drake_clutter.scenes.scene import Scene, SceneObject
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.camera_renderer import CameraRenderer, make_engine_params
from drake_clutter.simulation.drop import sample_drop_scene, simulate_drop
from drake_clutter.simulation.image_renderer import ImageRenderer, RendererKind
from drake_clutter.validation import to_plain
from drake_clutter.workers.parallel_map import map_ordered
from training.image_randomization import (
    TextureSet,
    TextureVariation,
    randomize_colors,
    sample_camera,
    sample_lights,
    sample_room_lighting,
)
from training.scene_dismantling import dismantle_generated, dismantle_heap
from training.script import CatalogOption, SeedOption, WorkersOption, progress, run_script

DISMANTLINGS = 3
"""Number of times that a scene is dismantled: to simulate a heap takes as long as its images."""
HEAP_IMAGES = 20
"""Number of images of a dismantled heap."""
GENERATED_IMAGES = 16
"""Number of images of a dismantled generated scene."""
HEAP_OBJECTS = 20
"""Number of objects of a heap."""
DROP_TIMES = (0.9, 1.1, 1.3, 1.5)
"""Times after the release at which a heap is rendered [s]; most objects have landed by then."""
NODES = 25
"""Number of nodes of the generated scene graphs."""
GENERATORS = {"random": "", "sg-star": "ycb7", "sg-14": "pantry14"}
"""Scene generators by name, and the object set that each was trained with; "" for any."""


@dataclass(frozen=True)
class ImageJob:
    """Parameters that determine the images of an item.

    Attributes:
        objects: Name of the object set.
        catalog: Asset folder with additional object classes, or None.
        heap_fraction: Fraction of the images that show heaps.
        seed: Seed of the dataset.
        renderer: Renderer of the images.
        textures: Textures of the images.
        compact: See `write_images`.
        dismantlings: Number of times that each scene is dismantled.
    """

    objects: str
    catalog: Path | None
    heap_fraction: float
    seed: int
    renderer: RendererKind
    textures: TextureSet
    compact: bool
    dismantlings: int

    def is_heap(self, item: int) -> bool:
        """Return whether an item is a heap.

        It is drawn so that `heap_fraction` holds for the images, not for the items.
        """
        heaps = self.heap_fraction / HEAP_IMAGES
        generated = (1 - self.heap_fraction) / GENERATED_IMAGES
        return bool(item_rng(self.seed, item, 0).random() < heaps / (heaps + generated))

    def num_images(self, item: int) -> int:
        """Return the number of images of an item."""
        return self.dismantlings * (HEAP_IMAGES if self.is_heap(item) else GENERATED_IMAGES)

    def folders(self, item: int) -> list[str]:
        """Return the names of an item's folders, one for each dismantling."""
        first = self.dismantlings * item
        return [f"{number:06d}" for number in range(first, first + self.dismantlings)]

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

    def __call__(self, item: int) -> int:
        """Write the folders of an item, and return the number of new images."""
        rng = item_rng(self._job.seed, item)
        source = self._drop_heap(rng) if self._job.is_heap(item) else [self._generate_scene(rng)]
        num_images = 0
        for number, name in enumerate(self._job.folders(item), start=1):
            folder = self._out / TRAIN_FOLDER / name
            if not folder.exists():
                num_images += self._write_dismantling(
                    folder, source, item_rng(self._job.seed, item, number)
                )
        return num_images

    def _write_dismantling(
        self, folder: Path, source: Sequence[Scene], rng: np.random.Generator
    ) -> int:
        """Write the images of a scene that is dismantled, and return their number.

        Args:
            folder: Folder of the images.
            source: A heap at several times, or a generated scene.
            rng: Random generator of objects, light and colors.
        """
        is_heap = len(source) > 1
        count = HEAP_IMAGES if is_heap else GENERATED_IMAGES
        scenes = (
            dismantle_heap(source, count, rng)
            if is_heap
            else dismantle_generated(source[0], count, rng)
        )
        camera = self._config.cell.camera
        renderer: ImageRenderer
        if self._job.renderer is RendererKind.VTK:
            renderer = CameraRenderer(camera, make_engine_params(sample_lights(rng)))
        else:
            camera = sample_camera(camera, rng)
            vary_texture = TextureVariation(int(rng.integers(MAX_SEED)), self._job.textures)
            renderer = SceneRasterizer(camera, sample_room_lighting(rng), vary_texture)
        silhouettes = dict[SceneObject, NDArray[np.bool_]]()
        images = (render_image(renderer, scene, silhouettes, rng) for scene in scenes)
        write_images(
            folder,
            images,
            camera,
            list(load_catalog(self._job.catalog).classes),
            compact=self._job.compact,
        )
        if self._job.renderer is RendererKind.VTK:
            # The process can abort when another thread collects the renderer.
            del renderer, images
            gc.collect()
        return count

    def _drop_heap(self, rng: np.random.Generator) -> list[Scene]:
        """Return a random heap at each of `DROP_TIMES`."""
        classes = [self._classes[k] for k in rng.integers(len(self._classes), size=HEAP_OBJECTS)]
        return simulate_drop(
            sample_drop_scene(classes, self._config.cell.support, rng),
            self._config.settle.time_step,
            DROP_TIMES,
        )

    def _generate_scene(self, rng: np.random.Generator) -> Scene:
        """Return a scene of a random generator."""
        generators = self._job.generators()
        agent, objects = generators[rng.integers(len(generators))]
        if agent not in self._generators:
            job = GenerationJob(
                agent, objects, self._job.catalog, NODES, self._job.seed, self._config
            )
            self._generators[agent] = SceneGenerator(job)
        scene, _ = self._generators[agent].lay_out(rng)
        return scene


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
    textures: Annotated[
        TextureSet, typer.Option(help="Textures; unseen ones need --renderer raster.")
    ] = TextureSet.TRAINING,
    compact: Annotated[
        bool, typer.Option("--compact", help="Compress colors with losses, write no mask images.")
    ] = False,
) -> None:
    """Render a dataset of labeled images."""
    if textures is TextureSet.UNSEEN and renderer is RendererKind.VTK:
        raise InputError("--textures unseen: expected --renderer raster; VTK draws no others")
    folder = catalog.resolve() if catalog else None
    job = ImageJob(objects, folder, heap_fraction, seed, renderer, textures, compact, DISMANTLINGS)
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
        missing = [item for item in range(num_items) if not present.issuperset(job.folders(item))]
        rendered = map_ordered(partial(ItemRenderer, job, out), missing, workers=workers)
        start = time.monotonic()
        num_new = sum(
            progress(rendered, f"{num_images} images", num_items, num_items - len(missing))
        )
        hours = (time.monotonic() - start) / 3600
        print(f"{num_images} images, {num_new} of them new: {num_new / hours:.0f} images per hour")


if __name__ == "__main__":
    run_script(main)
