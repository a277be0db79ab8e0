"""Calibrate the class probabilities of a trained detector on rendered images.

    python training/render_image_dataset.py --out runs/images_calibration --count 600 --seed 2 \
        --renderer raster --compact
    python training/calibrate_detector.py --detector runs/detector/detector.safetensors \
        --images runs/images_calibration --out runs/detector/calibration.json

The images must be of another seed than those of the training. The temperature is fitted to the
images of even numbers and written to the .json file beside the weights. The reliability is that on
the other images.
"""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import torch
import typer

from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError, read_json, write_json
from drake_clutter.perception.calibration import (
    ClassifiedDetection,
    expected_calibration_error,
    fit_temperature,
    negative_log_likelihood,
    reliability_bins,
)
from drake_clutter.perception.image_dataset import ImageDataset
from drake_clutter.perception.learned_detector import LearnedDetector
from drake_clutter.perception.segmentation import SegmentationNetwork
from drake_clutter.seeding import item_rng
from training.evaluate_detector import detect_objects
from training.results_file import Row, provenance
from training.script import CatalogOption, SeedOption, print_table, progress, run_script


def summarize_reliability(
    detections: Sequence[ClassifiedDetection], temperature: float
) -> dict[str, Any]:
    """Return the reliability of class probabilities with a temperature, for a results file."""
    bins = reliability_bins(detections, temperature)
    return {
        "temperature": temperature,
        "negative_log_likelihood": negative_log_likelihood(detections, temperature),
        "expected_calibration_error": expected_calibration_error(bins),
        "bins": [asdict(b) for b in bins if b.count],
    }


def main(
    detector: Annotated[
        Path, typer.Option(metavar="FILE", help="Checkpoint, which gets the temperature.")
    ],
    images: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder that render_image_dataset.py wrote.")
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="Results file to write (JSON).")],
    count: Annotated[int, typer.Option(min=2, help="Number of images at most.")] = 600,
    seed: SeedOption = 0,
    catalog: CatalogOption = None,
    threads: Annotated[int, typer.Option(min=1, help="Threads of PyTorch.")] = 2,
) -> None:
    """Fit the temperature of a detector, and write it with its reliability."""
    torch.set_num_threads(threads)
    cell = ClutterConfig().cell
    all_classes = load_catalog(catalog)
    network = SegmentationNetwork.load(detector)
    network.temperature = 1.0
    classes = [all_classes.classes[name] for name in network.classes]
    learned = LearnedDetector(network, classes, cell.camera, cell.support)
    dataset = ImageDataset(images)
    halves = list[ClassifiedDetection](), list[ClassifiedDetection]()
    numbers = range(min(count, len(dataset)))
    for k in progress(numbers, "detections"):
        found = detect_objects(dataset[k], learned, all_classes, item_rng(seed, k)).detections
        halves[k % 2].extend(d for d in found if d.probabilities)
    fitted, held_out = halves
    if not fitted or not held_out:
        raise InputError(f"{images}: no detections in {len(numbers)} images; expected some")
    temperature = fit_temperature(fitted)
    path = detector.with_suffix(".json")
    write_json(path, read_json(path, "metadata of a checkpoint") | {"temperature": temperature})
    rows = [summarize_reliability(held_out, T) for T in (1.0, temperature)]
    write_json(
        out,
        {
            "detector": detector.name,
            **provenance(),
            "seed": seed,
            "images": len(numbers),
            "fitted_detections": len(fitted),
            "held_out_detections": len(held_out),
            "rows": rows,
        },
    )
    table: list[Row] = [
        {
            "temperature": f"{row['temperature']:.2f}",
            "negative log likelihood": f"{row['negative_log_likelihood']:.4f}",
            "expected calibration error": f"{row['expected_calibration_error']:.4f}",
        }
        for row in rows
    ]
    print_table(table)


if __name__ == "__main__":
    run_script(main)
