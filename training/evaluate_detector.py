"""How well a trained detector sees: in scenes of a frozen set, and in images held out of its training.

    python training/evaluate_detector.py --detector training/checkpoints/detector_depth.safetensors --count 100 \
        --images runs/images --out training/results/detector_depth.json
"""

import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from scipy.optimize import linear_sum_assignment

from drake_clutter.catalog import Catalog, load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.files import cli_error_handler, write_json
from drake_clutter.learning.checkpoint import load_checkpoint
from drake_clutter.perception.depth_noise import add_depth_noise
from drake_clutter.perception.image_dataset import ImageDataset, LabeledImage
from drake_clutter.perception.learned_detector import LearnedDetector
from drake_clutter.perception.pose_fit import pose_error
from drake_clutter.perception.segmentation import SegmentationNetwork
from drake_clutter.resources import git_commit
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.camera import OverheadCamera
from drake_clutter.statistics import wilson_interval
from drake_clutter.validation import to_plain

SHARES = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.01)
"""Bounds between which recall is told apart: how much of an object is seen."""


@dataclass(frozen=True)
class Seen:
    """An object that is at least partly in view, and what became of it.

    Attributes:
        share: of its pixels that are seen. found: whether a detection covers it with an IoU of 0.5 or more.
        named: whether that is of its class. translation: m; turn: rad; errors of its pose, NaN if it is not.
    """

    share: float
    found: bool
    named: bool
    translation: float
    turn: float


def compared(
    image: LabeledImage, detector: LearnedDetector, catalog: Catalog, rng: np.random.Generator
) -> tuple[list[Seen], int, float]:
    """The objects of an image, how many detections are none of them, and s that the detector took."""
    depth = add_depth_noise(image.depth, rng)
    begun = time.perf_counter()
    said = detector.detect(depth, image.color).detections
    spent = time.perf_counter() - begun
    masks = [image.label == k for k in range(len(image.classes))]
    overlap = np.array([[_iou(mask, d.mask) for d in said] for mask in masks]).reshape(
        len(masks), len(said)
    )
    rows, columns = linear_sum_assignment(-overlap)
    pairs = {int(k): said[d] for k, d in zip(rows, columns, strict=True) if overlap[k, d] >= 0.5}
    objects = []
    for k, (name, share) in enumerate(zip(image.classes, image.visible_fractions, strict=True)):
        if not masks[k].any():
            continue
        detection = pairs.get(k)
        named = detection is not None and detection.object_class.name == name
        errors = (np.nan, np.nan)
        if named and detection is not None:
            errors = pose_error(catalog.classes[name], detection.X_TO, image.X_TO[k])
        objects.append(Seen(float(share), detection is not None, named, *errors))
    return objects, len(said) - len(pairs), spent


def _iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    return int(np.count_nonzero(a & b)) / max(1, int(np.count_nonzero(a | b)))


def summarised(objects: list[Seen], false: int, seconds: list[float]) -> dict[str, Any]:
    """Figures of many images."""
    by_share: dict[str, list[Seen]] = defaultdict(list)
    for o in objects:
        low = max(bound for bound in SHARES[:-1] if bound <= o.share)
        by_share[f"{low:g} to {min(1, SHARES[SHARES.index(low) + 1]):g}"].append(o)
    found = [o for o in objects if o.found]
    named = [o for o in objects if o.named]

    def recall(of: list[Seen]) -> dict[str, Any]:
        count = sum(o.named for o in of)
        return {
            "objects": len(of),
            "recall": count / len(of),
            "ci95": wilson_interval(count, len(of)),
        }

    in_view = [o for o in objects if o.share >= ClutterConfig().cell.camera.visibility_threshold]
    return {
        "in_view": recall(in_view),
        "recall_by_visible_share": {name: recall(by_share[name]) for name in sorted(by_share)},
        "precision": len(named) / max(1, len(found) + false),
        "class_accuracy_of_found": len(named) / max(1, len(found)),
        "translation_mm": [
            1000 * float(q) for q in np.nanquantile([o.translation for o in named], (0.5, 0.95))
        ],
        "rotation_deg": [
            float(np.degrees(q)) for q in np.nanquantile([o.turn for o in named], (0.5, 0.95))
        ],
        "ms_per_frame": [1000 * float(q) for q in np.quantile(seconds, (0.5, 0.95))],
        "images": len(seconds),
    }


def main(
    detector: Annotated[Path, typer.Option(help="A checkpoint of train_detector.py.")],
    out: Annotated[Path, typer.Option(help="JSON to write.")],
    scenes: Annotated[list[Path], typer.Option(help="Frozen sets.")],
    count: Annotated[int, typer.Option(help="Scenes of each.")] = 100,
    images: Annotated[
        Path | None,
        typer.Option(
            help="Folder of render_image_dataset.py, of another seed than the training's."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the camera's noise.")] = 0,
    threads: Annotated[int, typer.Option(help="Of PyTorch.")] = 2,
) -> None:
    """Compares detections with the truth."""
    torch.set_num_threads(threads)
    config, catalog, console = ClutterConfig(), load_catalog(), Console(stderr=True)
    network, camera, rows = (
        SegmentationNetwork.load(detector),
        OverheadCamera(config.cell.camera),
        dict[str, Any](),
    )

    def shown(path: Path) -> tuple[list[str], list[LabeledImage]]:
        held = load_scene_dataset(path, catalog)
        found = []
        for k in track(range(min(count, len(held.scenes))), path.stem, console=console):
            scene = held.settled_scene(k, held.grammar, config)
            image = camera.render(scene)
            share = camera.visible_shares(scene, image.label)
            seen = np.bincount(image.label.ravel() + 1, minlength=len(scene.objects) + 1)[1:]
            alone = np.array(
                [
                    round(n / share[o.name]) if share[o.name] > 0 else 1
                    for n, o in zip(seen, scene.objects, strict=True)
                ]
            )
            names = tuple(o.object_class.name for o in scene.objects)
            found.append(
                LabeledImage(
                    image.color,
                    image.depth,
                    image.label,
                    names,
                    tuple(o.X_TO for o in scene.objects),
                    alone,
                )
            )
        return [c.name for c in held.classes], found

    def told(names: list[str], given: list[LabeledImage]) -> dict[str, Any]:
        eye = LearnedDetector(
            network, [catalog.classes[n] for n in names], config.cell.camera, config.cell.support
        )
        eye.detect(given[0].depth, given[0].color)  # compiles
        objects, false, seconds = list[Seen](), 0, list[float]()
        for k, image in enumerate(given):
            more, wrong, spent = compared(image, eye, catalog, item_rng(seed, k))
            objects, false, seconds = objects + more, false + wrong, [*seconds, spent]
        return summarised(objects, false, seconds)

    for path in scenes:
        rows[path.stem] = told(*shown(path))
    if images is not None:
        held_out = ImageDataset(images)
        rows["images"] = told(
            list(network.classes), [held_out[k] for k in range(min(count, len(held_out)))]
        )
    fields = {
        "detector": detector.name,
        "trained": load_checkpoint(detector).metadata["metrics"],
        "commit": git_commit(),
        "seed": seed,
        "rows": rows,
    }
    write_json(out, fields | {"config": to_plain(config)})
    console.print_json(data=rows)


if __name__ == "__main__":
    with cli_error_handler():
        typer.run(main)
