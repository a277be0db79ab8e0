"""Makes a set of labelled images for networks that learn to see: heaps that were dropped, and scenes that agents generate.

    python training/render_image_dataset.py --out runs/images --count 20000 --workers 2

A work item is one scene, in a folder of its own (see `drake_clutter.perception.image_dataset`):

    a heap       20 objects of random classes, turned at random, that Drake drops on the tray; at one of the last moments of the
                 fall, and with objects taken away from the top
    generated    a graph by `random`, or by a trained generator that knows no other classes, laid out (not settled); with objects
                 taken away from the top, some of which are put elsewhere on the tray

Randomised with every item: two to four lamps (direction, strength, warmth). With every image: the colours of each instance
(hue, contrast, brightness), more strongly those of the tray, and all that lies beyond it. The camera stays where it is.

A run that was stopped goes on where it was; a larger count adds to what is there. The scenes come from --seed alone, by random
generators of their own: no set of scenes that agents are evaluated on is read.
"""

import gc
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from PIL import Image
from pydrake.geometry import LightParameter, RenderEngineVtkParams, Rgba
from rich.console import Console
from rich.progress import track
from scipy.spatial.transform import Rotation

from drake_clutter.agents.generators import GenerationJob, SceneGenerator
from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError, cli_error_handler, prepare_output_directory, write_json
from drake_clutter.perception.image_dataset import LabeledImage, write_images
from drake_clutter.scenes.scene import Pose, Scene, SceneObject
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.camera import ENGINE, Images, OverheadCamera
from drake_clutter.simulation.drop import above_tray, dropped
from drake_clutter.validation import to_plain
from drake_clutter.workers.parallel_map import map_ordered

JOB_FILE = "job.json"
HEAP_IMAGES, GENERATED_IMAGES = 20, 16
"""Of one item."""
HEAP_OBJECTS = 20
MOMENTS = (0.9, 1.1, 1.3, 1.5)
"""s after they were let go."""
NODES = 25
AGENTS = {"random": "", "sg-star": "ycb7", "sg-14": "pantry14"}
"""Generators, and the object set that each has learned; "": any."""
PUT_ELSEWHERE = 0.5
"""Probability that an object of a generated scene is put elsewhere when it is taken away."""
_PLACEMENT_TRIES = 50
_GAP = 0.005
"""m, about what is put elsewhere."""


@dataclass(frozen=True)
class ImageJob:
    """What decides how an item looks.

    Attributes:
        objects: name of an object set.
        dropped_share: of the images, that show heaps.
        seed: of the set.
    """

    objects: str
    dropped_share: float
    seed: int

    def is_heap(self, item: int) -> bool:
        """Whether an item is a heap, drawn so that heaps have their share of the images, not of the items."""
        heaps, generated = (
            self.dropped_share / HEAP_IMAGES,
            (1 - self.dropped_share) / GENERATED_IMAGES,
        )
        return bool(item_rng(self.seed, item, 0).random() < heaps / (heaps + generated))

    def images(self, item: int) -> int:
        """How many an item has."""
        return HEAP_IMAGES if self.is_heap(item) else GENERATED_IMAGES

    def agents(self) -> list[tuple[str, str]]:
        """Generators that know no classes but the job's, each with its object set."""
        catalog = load_catalog()
        own = set(catalog.object_set(self.objects))
        named = [(agent, objects or self.objects) for agent, objects in AGENTS.items()]
        return [
            (agent, objects) for agent, objects in named if set(catalog.object_set(objects)) <= own
        ]


class ItemMaker:
    """Makes item after item of a job; a worker for the runner."""

    def __init__(self, job: ImageJob, out: Path) -> None:
        self._job, self._out, self._config = job, out, ClutterConfig()
        self._classes = load_catalog().object_set(job.objects)
        self._generators = dict[str, SceneGenerator]()

    def __call__(self, item: int) -> None:
        """Writes an item's folder."""
        rng = item_rng(self._job.seed, item)
        count = self._job.images(item)
        scenes = self._heaps(count, rng) if self._job.is_heap(item) else self._generated(count, rng)
        camera = OverheadCamera(self._config.cell.camera, random_lamps(rng))
        known = dict[SceneObject, int]()
        images = (photograph(camera, scene, known, rng) for scene in scenes)
        write_images(
            self._out / f"{item:06d}",
            images,
            self._config.cell.camera,
            list(load_catalog().classes),
        )
        del camera
        gc.collect()  # in this thread: a renderer that another one collects can abort the process

    def _heaps(self, count: int, rng: np.random.Generator) -> Iterator[Scene]:
        """Heaps of all objects down to one, at any of the moments."""
        classes = [self._classes[k] for k in rng.integers(len(self._classes), size=HEAP_OBJECTS)]
        moments = dropped(
            above_tray(classes, self._config.cell.support, rng),
            self._config.settle.time_step,
            MOMENTS,
        )
        names = set(moments[-1].names)
        left = moments[-1]
        for most in np.linspace(len(names), 1, count).round():
            while len(left.objects) > most:
                left = without(left, pick_free(left, rng))
            moment = moments[rng.integers(len(moments))]
            yield replace(moment, objects=tuple(o for o in moment.objects if o.name in left.names))

    def _generated(self, count: int, rng: np.random.Generator) -> Iterator[Scene]:
        agents = self._job.agents()
        agent, objects = agents[rng.integers(len(agents))]
        if agent not in self._generators:
            self._generators[agent] = SceneGenerator(
                GenerationJob(agent, objects, None, NODES, self._job.seed, self._config)
            )
        scene, _ = self._generators[agent].lay_out(rng)
        yield scene
        for _ in range(count - 1):
            for _ in range(rng.integers(1, 3)):
                taken = pick_free(scene, rng)
                rest = without(scene, taken)
                moved = (
                    put_elsewhere(taken, rest, rng)
                    if rng.random() < PUT_ELSEWHERE or not rest.objects
                    else None
                )
                scene = rest if moved is None else replace(rest, objects=(*rest.objects, moved))
            yield scene


def without(scene: Scene, taken: SceneObject) -> Scene:
    """The scene with an object taken away."""
    return replace(scene, objects=tuple(o for o in scene.objects if o is not taken))


def pick_free(scene: Scene, rng: np.random.Generator) -> SceneObject:
    """An object of the scene over which nothing reaches higher."""
    free = [
        o
        for o in scene.objects
        if not any(
            over.top_height > o.top_height and _overlap(o, over, 0.0) for over in scene.objects
        )
    ]
    return free[rng.integers(len(free))]


def put_elsewhere(taken: SceneObject, rest: Scene, rng: np.random.Generator) -> SceneObject | None:
    """The object on the tray's floor, turned about the vertical, clear of the rest; None if no place was found."""
    for _ in range(_PLACEMENT_TRIES):
        R_TO = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix() @ taken.X_TO.rotation
        turned = replace(taken, X_TO=Pose.from_rotation(R_TO, (0.0, 0.0, 0.0)))
        lower, upper = turned.bounds_T
        half_size = rest.support.half_size
        least, most = -half_size - lower[:2], half_size - upper[:2]
        if (least < most).all():
            x, y = rng.uniform(least, most)
            placed = replace(taken, X_TO=Pose.from_rotation(R_TO, (x, y, -lower[2])))
            if not any(_overlap(placed, other, _GAP) for other in rest.objects):
                return placed
    return None


def _overlap(one: SceneObject, other: SceneObject, gap: float) -> bool:
    """Whether their boxes, seen from above, come closer than a gap (m)."""
    (lower, upper), (other_lower, other_upper) = one.bounds_T, other.bounds_T
    return bool((np.minimum(upper, other_upper) > np.maximum(lower, other_lower) - gap)[:2].all())


def random_lamps(rng: np.random.Generator) -> RenderEngineVtkParams:
    """A rendering engine with two to four lamps beside the camera."""
    count = rng.integers(2, 5)
    strengths = rng.dirichlet(np.full(count, 2.0)) * rng.uniform(2.0, 4.5)
    lights = []
    for strength in strengths:
        x, y = rng.uniform(-0.9, 0.9, 2)
        warmth = rng.uniform(-0.12, 0.12)
        colour = Rgba(min(1.0, 1 + warmth), 1 - abs(warmth) / 2, min(1.0, 1 - warmth))
        lights.append(
            LightParameter(
                type="directional",
                direction=[x, y, 1.0],
                frame="camera",
                intensity=strength,
                color=colour,
            )
        )
    return RenderEngineVtkParams(backend=ENGINE.backend, lights=lights)


def photograph(
    camera: OverheadCamera, scene: Scene, known: dict[SceneObject, int], rng: np.random.Generator
) -> LabeledImage:
    """An image of a scene, with colours drawn anew.

    Args:
        camera: the camera.
        scene: the scene.
        known: pixels that an object covers alone, for those that were counted; the others are added.
        rng: of the colours.
    """
    images = camera.render(scene)
    uncounted = tuple(o for o in scene.objects if o not in known)
    # As if one pixel of each were seen: the visible share is then one over all its pixels.
    shares = camera.visible_shares(replace(scene, objects=uncounted), np.arange(len(uncounted)))
    known |= {o: round(1 / shares[o.name]) for o in uncounted}
    classes = tuple(o.object_class.name for o in scene.objects)
    alone = np.array([known[o] for o in scene.objects], np.int64)
    color = recoloured(images, len(classes), rng)
    return LabeledImage(
        color, images.depth, images.label, classes, tuple(o.X_TO for o in scene.objects), alone
    )


def recoloured(images: Images, count: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    """(H, W, 3) the colour image with an affine change of the colours of each instance and the tray, before something else."""
    color = images.color.astype(np.float32)
    beyond = ~np.isfinite(images.depth)
    for instance in range(-1, count):
        mask = (images.label == instance) & ~beyond
        hue = rng.uniform(-np.pi, np.pi) if instance < 0 else rng.normal(0, 0.15)
        turn = Rotation.from_rotvec(np.full(3, hue / np.sqrt(3))).as_matrix()  # about grey
        gain, shift = rng.uniform(0.75, 1.25) * rng.uniform(0.93, 1.07, 3), rng.uniform(-15, 15)
        color[mask] = color[mask] @ (gain[:, None] * turn).T.astype(np.float32) + np.float32(shift)
    patches = rng.uniform(0, 255, 3) + rng.normal(
        0, rng.uniform(0, 50), (*rng.integers(2, 24, 2), 3)
    )
    height, width = beyond.shape
    background = Image.fromarray(patches.clip(0, 255).astype(np.uint8)).resize(
        (width, height), Image.Resampling.BICUBIC
    )
    color[beyond] = np.asarray(background)[beyond]
    return color.clip(0, 255).astype(np.uint8)


def main(
    out: Annotated[
        Path,
        typer.Option(
            metavar="DIR", help="Folder of the set; new, or an earlier run's of the same job."
        ),
    ],
    count: Annotated[
        int, typer.Option(min=1, help="Images at least; the last item is made in full.")
    ] = 20000,
    dropped_share: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Of the images, that show dropped heaps.")
    ] = 0.3,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    workers: Annotated[int, typer.Option(min=1)] = 1,
    objects: str = "pantry14",
) -> None:
    """Makes a set of images."""
    job = ImageJob(objects, dropped_share, seed)
    agents = [agent for agent, _ in job.agents()]
    there = [path.name for path in out.iterdir()] if out.is_dir() else []
    prepare_output_directory(
        out,
        allowed_entries=frozenset(
            {JOB_FILE, *(name for name in there if re.fullmatch(r"\.?\d{6}", name))}
        ),
    )
    about = {**to_plain(job), "agents": agents}
    if JOB_FILE in there and json.loads((out / JOB_FILE).read_text()) != about:
        raise InputError(
            f"--out {out}: holds images of another job; allowed is a folder that is new or of the same options"
        )
    write_json(out / JOB_FILE, about)
    items, images = list[int](), 0
    while images < count:
        images += job.images(len(items))
        items.append(len(items))
    missing = [item for item in items if f"{item:06d}" not in there]
    console = Console(stderr=True)
    made = map_ordered(partial(ItemMaker, job, out), missing, workers=workers)
    for _ in track(
        made, f"{images} images", len(items), len(items) - len(missing), console=console
    ):
        pass


if __name__ == "__main__":
    with cli_error_handler():
        typer.run(main)
