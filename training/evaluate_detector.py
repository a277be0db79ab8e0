r"""Evaluate a trained detector on shipped scene datasets and on rendered images.

    python training/evaluate_detector.py --scenes training/scenes/sg_star_25.json \
        --detector training/checkpoints/detector_depth.safetensors --out detector.json

The noise of a stereo camera is added to the depth images. With --textures unseen, the objects of
each scene have random prints of kinds that no training image shows.
"""

import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from rich.console import Console
from scipy.optimize import linear_sum_assignment

from drake_clutter.catalog import Catalog, load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError, write_json
from drake_clutter.learning.checkpoint import load_checkpoint
from drake_clutter.perception.calibration import (
    ClassifiedDetection,
    expected_calibration_error,
    reliability_bins,
)
from drake_clutter.perception.depth_noise import add_depth_noise
from drake_clutter.perception.image_dataset import ImageDataset, LabeledImage
from drake_clutter.perception.learned_detector import LearnedDetector
from drake_clutter.perception.pose_fit import pose_error
from drake_clutter.perception.segmentation import HAS_FAST_BFLOAT16, SegmentationNetwork
from drake_clutter.rendering.scene_rasterizer import SceneRasterizer
from drake_clutter.scenes.scene import Scene
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.camera_renderer import CameraRenderer
from drake_clutter.simulation.image_renderer import ImageRenderer, RendererKind
from drake_clutter.statistics import wilson_interval
from drake_clutter.validation import to_plain
from training.image_randomization import TextureSet, TextureVariation
from training.results_file import provenance
from training.script import CatalogOption, SeedOption, progress, run_script

VISIBILITY_BINS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.01)
"""Bounds of the visible fractions for which recall is given separately."""
MAX_CONFUSIONS = 10
"""Largest number of pairs of confused classes in a results file."""
MIN_IOU = 0.5
"""Smallest intersection over union of the masks of a detection and of its object."""


@dataclass(frozen=True)
class ObjectDetection:
    """Detection result of an object that is at least partly in view.

    Attributes:
        visible_fraction: Fraction of its pixels that are in view.
        is_found: Whether a detection is matched to it by the masks; see `MIN_IOU`.
        is_recognized: Whether the class of that detection is correct.
        translation_error: Error of the detected position [m]; NaN if it is not recognized.
        rotation_error: Error of the detected rotation [rad]; NaN if it is not recognized.
    """

    visible_fraction: float
    is_found: bool
    is_recognized: bool
    translation_error: float
    rotation_error: float


@dataclass(frozen=True)
class DetectionMetrics:
    """Detection results of a set of images.

    Attributes:
        objects: The objects of the images that are in view.
        detections: The detections with their true classes.
        seconds: Computing time of the detector for each image [s].
    """

    objects: Sequence[ObjectDetection]
    detections: Sequence[ClassifiedDetection]
    seconds: Sequence[float]

    def to_dict(self) -> dict[str, Any]:
        """Return the metrics for a results file."""
        found = [o for o in self.objects if o.is_found]
        recognized = [o for o in self.objects if o.is_recognized]
        threshold = ClutterConfig().cell.camera.visibility_threshold
        by_visibility = defaultdict[str, list[ObjectDetection]](list)
        for o in self.objects:
            k = int(np.searchsorted(VISIBILITY_BINS[:-1], o.visible_fraction, side="right"))
            name = f"{VISIBILITY_BINS[k - 1]:g} to {min(1, VISIBILITY_BINS[k]):g}"
            by_visibility[name].append(o)
        translation_errors = [o.translation_error for o in recognized]
        rotation_errors = [o.rotation_error for o in recognized]
        confusions = Counter(
            (d.true_class, d.reported_class)
            for d in self.detections
            if d.true_class and d.true_class != d.reported_class
        )
        bins = reliability_bins(self.detections, 1.0)
        return {
            "in_view": recall([o for o in self.objects if o.visible_fraction >= threshold]),
            "recall_by_visible_fraction": {
                name: recall(by_visibility[name]) for name in sorted(by_visibility)
            },
            "precision": len(recognized) / max(1, len(self.detections)),
            "class_accuracy_of_found": len(recognized) / max(1, len(found)),
            "confusions": [
                {"true": true, "reported": reported, "count": count}
                for (true, reported), count in confusions.most_common(MAX_CONFUSIONS)
            ],
            "calibration_error": expected_calibration_error(bins),
            "translation_mm": [
                1000 * float(q) for q in np.nanquantile(translation_errors, (0.5, 0.95))
            ],
            "rotation_deg": [
                float(np.degrees(q)) for q in np.nanquantile(rotation_errors, (0.5, 0.95))
            ],
            "ms_per_frame": [1000 * float(q) for q in np.quantile(self.seconds, (0.5, 0.95))],
            "images": len(self.seconds),
        }


def recall(objects: Sequence[ObjectDetection]) -> dict[str, Any]:
    """Return the fraction of objects that are recognized, with its 95 % confidence interval."""
    count = sum(o.is_recognized for o in objects)
    return {
        "objects": len(objects),
        "recall": count / len(objects),
        "ci95": wilson_interval(count, len(objects)),
    }


def detect_objects(
    image: LabeledImage, detector: LearnedDetector, catalog: Catalog, rng: np.random.Generator
) -> DetectionMetrics:
    """Detect the objects of a noisy depth image, and compare them with the ground truth.

    Args:
        image: The image with its ground truth.
        detector: The detector.
        catalog: Catalog of the objects in the image.
        rng: Random generator of the noise.
    """
    depth = add_depth_noise(image.depth, rng)
    start = time.perf_counter()
    detections = detector.detect(depth, image.color).detections
    seconds = time.perf_counter() - start
    masks = [image.label == k for k in range(len(image.classes))]
    overlap = np.array([[mask_iou(mask, d.mask) for d in detections] for mask in masks])
    overlap = overlap.reshape(len(masks), len(detections))
    rows, columns = linear_sum_assignment(-overlap)
    detection_of = {
        int(k): detections[d]
        for k, d in zip(rows, columns, strict=True)
        if overlap[k, d] >= MIN_IOU
    }
    objects = []
    for k, (name, fraction) in enumerate(zip(image.classes, image.visible_fractions, strict=True)):
        if not masks[k].any():
            continue
        detection = detection_of.get(k)
        errors = (np.nan, np.nan)
        is_recognized = detection is not None and detection.object_class.name == name
        if is_recognized and detection is not None:
            errors = pose_error(catalog.classes[name], detection.X_TO, image.X_TO[k])
        objects.append(
            ObjectDetection(float(fraction), detection is not None, is_recognized, *errors)
        )
    object_of = {id(detection): k for k, detection in detection_of.items()}
    classified = [
        ClassifiedDetection(
            d.class_probabilities,
            d.object_class.name,
            image.classes[object_of[id(d)]] if id(d) in object_of else "",
        )
        for d in detections
    ]
    return DetectionMetrics(objects, classified, [seconds])


def mask_iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Return the intersection over union of two masks (H, W)."""
    return int(np.count_nonzero(a & b)) / max(1, int(np.count_nonzero(a | b)))


def render_image(renderer: ImageRenderer, scene: Scene) -> LabeledImage:
    """Return an image of a scene with its ground truth."""
    images = renderer.render(scene)
    return LabeledImage(
        images.color,
        images.depth,
        images.label,
        tuple(o.object_class.name for o in scene.objects),
        tuple(o.X_TO for o in scene.objects),
        np.count_nonzero(renderer.silhouettes(scene), axis=(1, 2)),
    )


def evaluate_images(
    network: SegmentationNetwork,
    class_names: Iterable[str],
    images: Sequence[LabeledImage],
    catalog: Catalog,
    seed: int,
) -> dict[str, Any]:
    """Return the metrics of a network on images.

    Args:
        network: The network.
        class_names: Object classes that the detector may find.
        images: The images with their ground truth.
        catalog: Catalog of the object classes.
        seed: Seed of the camera's noise.
    """
    cell = ClutterConfig().cell
    classes = [catalog.classes[name] for name in class_names]
    detector = LearnedDetector(network, classes, cell.camera, cell.support)
    detector.detect(images[0].depth, images[0].color)  # The first call compiles code.
    parts = [
        detect_objects(image, detector, catalog, item_rng(seed, k))
        for k, image in enumerate(progress(images, "detections"))
    ]
    return DetectionMetrics(
        [o for part in parts for o in part.objects],
        [d for part in parts for d in part.detections],
        [s for part in parts for s in part.seconds],
    ).to_dict()


def main(
    detector: Annotated[
        Path, typer.Option(metavar="FILE", help="Checkpoint that train_detector.py wrote.")
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="Results file to write (JSON).")],
    scenes: Annotated[
        list[Path], typer.Option(metavar="FILE", help="Scene dataset with poses. May be repeated.")
    ],
    count: Annotated[
        int, typer.Option(min=1, help="Number of scenes of each dataset, and of images.")
    ] = 100,
    first: Annotated[int, typer.Option(min=0, help="First scene of each dataset.")] = 0,
    images: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder that render_image_dataset.py wrote with another seed than the training's.",
        ),
    ] = None,
    seed: SeedOption = 0,
    catalog: CatalogOption = None,
    renderer: Annotated[
        RendererKind, typer.Option(help="Renderer of the images of the scenes.")
    ] = RendererKind.VTK,
    textures: Annotated[
        TextureSet | None, typer.Option(help="Random textures, by --renderer raster alone.")
    ] = None,
    bfloat16: Annotated[
        bool,
        typer.Option("--bfloat16/--float32", help="Precision of the network on a CPU."),
    ] = HAS_FAST_BFLOAT16,
    threads: Annotated[int, typer.Option(min=1, help="Threads of PyTorch.")] = 2,
) -> None:
    """Evaluate a detector, and print and write its metrics."""
    torch.set_num_threads(threads)
    config = ClutterConfig()
    all_classes = load_catalog(catalog)
    if textures is not None and renderer is RendererKind.VTK:
        raise InputError(f"--textures {textures.value}: expected --renderer raster")
    network = SegmentationNetwork.load(detector)
    network.use_bfloat16 = bfloat16
    camera = config.cell.camera
    vtk = CameraRenderer(camera) if renderer is RendererKind.VTK else None

    def make_renderer(number: int) -> ImageRenderer:
        """Return the renderer of a scene."""
        vary = None if textures is None else TextureVariation(number, textures)
        return vtk or SceneRasterizer(camera, vary_mesh=vary)

    rows = dict[str, Any]()
    for path in scenes:
        dataset = load_scene_dataset(path, all_classes)
        numbers = range(first, min(first + count, len(dataset.scenes)))
        if not numbers:
            raise InputError(
                f"--first {first}: expected less than the {len(dataset.scenes)} scenes of {path}"
            )
        rendered = [
            render_image(make_renderer(k), dataset.settled_scene(k, dataset.grammar, config))
            for k in progress(numbers, path.stem)
        ]
        class_names = [c.name for c in dataset.classes]
        rows[path.stem] = evaluate_images(network, class_names, rendered, all_classes, seed)
    if images is not None:
        image_dataset = ImageDataset(images)
        held_out = [image_dataset[k] for k in range(min(count, len(image_dataset)))]
        rows["images"] = evaluate_images(network, network.classes, held_out, all_classes, seed)
    write_json(
        out,
        {
            "detector": detector.name,
            "trained": load_checkpoint(detector).metadata["metrics"],
            **provenance(),
            "seed": seed,
            "first": first,
            "count": count,
            "renderer": renderer.value,
            "textures": None if textures is None else textures.value,
            "bfloat16": bfloat16,
            "threads": threads,
            "rows": rows,
            "config": to_plain(config),
        },
    )
    Console().print_json(data=rows)


if __name__ == "__main__":
    run_script(main)
