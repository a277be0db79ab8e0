"""Train the segmentation network of the detector on rendered images.

    python training/render_image_dataset.py --out runs/images --count 20000 --workers 2
    python training/train_detector.py --config training/configs/detector.yaml --out runs/detector

An interrupted run is resumed by the same command, and ends with the same weights as an
uninterrupted one. With --minutes it interrupts itself after that time, so that a training of hours
is done in several sessions.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer

from drake_clutter.catalog import load_catalog
from drake_clutter.cell.work_cell import WorkCell, default_cell
from drake_clutter.config import upgrade_config
from drake_clutter.files import InputError
from drake_clutter.learning.training_run import TrainingRun, resolve_device
from drake_clutter.perception.image_dataset import ImageDataset
from drake_clutter.perception.segmentation import CHECKPOINT_KIND, ImageWindow, SegmentationNetwork
from drake_clutter.perception.segmentation_training import (
    SegmentationConfig,
    SegmentationLearner,
    make_example,
)
from drake_clutter.seeding import item_rng
from drake_clutter.validation import (
    Count,
    CountOrZero,
    Flag,
    Seed,
    config_class,
    load_config_as,
    renamed_fields,
)
from training.script import (
    CatalogOption,
    ConfigOption,
    SettingsOption,
    run_script,
    settings_with_catalog,
)
from training.training_loop import (
    CheckpointSpec,
    DeviceOption,
    Metrics,
    OutOption,
    train_to_end,
)

CHECKPOINT = "detector.safetensors"
"""File name of the trained network in the folder of the run."""


@config_class
@renamed_fields(catalogue="catalog", looks_at_color="use_color")
class DetectorTrainingConfig:
    """Configuration of a detector's training.

    Attributes:
        images: Folder that `render_image_dataset.py` wrote.
        held_out: Number of images, the last of the folder, that are only used for evaluations.
        objects: Name of the object set.
        catalog: Folder with additional object classes; "" for none.
        use_color: Whether the network sees color besides depth.
        warm_start: Checkpoint whose weights the training starts from; "" for random weights. It may
            have other object classes, and no color.
        seed: Random seed; equal seeds give equal weights on the same kind of machine.
        evaluate_every: Steps between two evaluations.
        save_every: Steps between two saved states, the last of which an interrupted run resumes.
        learning: Hyperparameters of the training.
        cell: Work cell, whose camera and support the images show.
    """

    images: str = "runs/images"
    held_out: CountOrZero = 200
    objects: str = "pantry14"
    catalog: str = ""
    use_color: Flag = False
    warm_start: str = ""
    seed: Seed = 0
    evaluate_every: Count = 250
    save_every: Count = 100
    learning: SegmentationConfig = field(default_factory=SegmentationConfig)
    cell: WorkCell = field(default_factory=default_cell)


CONFIG = DetectorTrainingConfig()
"""Default configuration of the training."""


@dataclass(frozen=True)
class HeldOutImages:
    """Images that a network is evaluated on while it is trained.

    Attributes:
        images: All images.
        numbers: Numbers of the images that are held out.
        classes: Names of the object classes that the network distinguishes.
        training: Configuration of the training.
        device: Where the network is.
    """

    images: ImageDataset
    numbers: range
    classes: Sequence[str]
    training: DetectorTrainingConfig
    device: torch.device

    def evaluate(self, network: SegmentationNetwork) -> Metrics:
        """Return the mean IoU of the classes, and the median error of the center votes [mm]."""
        network.eval()
        training = self.training
        window = ImageWindow.around_support(training.cell.camera, training.cell.support)
        intersections = np.zeros(len(self.classes))
        unions = np.zeros(len(self.classes))
        vote_errors = list[float]()
        for k in self.numbers:
            shown = make_example(
                self.images[k],
                self.classes,
                training.cell.camera,
                window,
                item_rng(training.seed, 1, k),
                training.use_color,
            )
            with torch.inference_mode():
                logits, votes = network(torch.from_numpy(shown.image)[None].to(self.device))
            predicted = logits[0].argmax(dim=0).cpu().numpy()
            for c in range(len(self.classes)):
                is_class = shown.class_map == c + 1
                is_predicted = predicted == c + 1
                intersections[c] += (is_class & is_predicted).sum()
                unions[c] += (is_class | is_predicted).sum()
            errors = np.linalg.norm(votes[0].cpu().numpy() - shown.center_offsets, axis=0)[
                predicted > 0
            ]
            has_error = bool(np.isfinite(errors).any())
            vote_errors.append(float(np.nanmedian(errors)) if has_error else np.nan)
        metrics = {"iou": float(np.mean(intersections / np.maximum(unions, 1)))}
        if np.isfinite(vote_errors).any():  # False for a network that detects no object yet.
            metrics["median_vote_mm"] = 1000 * float(np.nanmean(vote_errors))
        return metrics


def main(
    out: OutOption,
    config: ConfigOption = None,
    settings: SettingsOption = None,
    catalog: CatalogOption = None,
    device: DeviceOption = "auto",
    threads: Annotated[int, typer.Option(min=1, help="Threads of PyTorch on a CPU.")] = 2,
    minutes: Annotated[
        float | None, typer.Option(min=0, help="Interrupt the training after this time.")
    ] = None,
) -> None:
    """Train a detector and write detector.safetensors."""
    training = load_config_as(
        CONFIG, config, settings_with_catalog(settings, catalog), upgrade_config
    )
    torch.set_num_threads(threads)
    torch_device = resolve_device(device)
    all_classes = load_catalog(Path(training.catalog) if training.catalog else None)
    classes = [c.name for c in all_classes.object_set(training.objects)]
    images = ImageDataset(Path(training.images))
    num_training_images = len(images) - training.held_out
    if num_training_images < 1:
        raise InputError(
            f"held_out: {training.held_out}; expected fewer than the {len(images)} images of "
            f"{training.images}"
        )
    torch.manual_seed(training.seed)
    network = SegmentationNetwork(classes, training.use_color)
    if training.warm_start:
        network.warm_start(SegmentationNetwork.load(Path(training.warm_start)))
    learner = SegmentationLearner(
        network,
        images.__getitem__,
        num_training_images,
        training.learning,
        training.cell.camera,
        training.cell.support,
        training.seed,
        torch_device,
    )
    run = TrainingRun(out, training, learner, training.learning.steps, steps_field="learning.steps")
    metadata = {
        "kind": CHECKPOINT_KIND,
        "classes": classes,
        "use_color": training.use_color,
        "images": num_training_images,
    }
    held_out = HeldOutImages(
        images, range(num_training_images, len(images)), classes, training, torch_device
    )

    def evaluate() -> tuple[Metrics, Metrics]:
        return held_out.evaluate(network), learner.losses

    train_to_end(
        run,
        learner,
        training.learning.steps,
        CheckpointSpec(CHECKPOINT, metadata, lambda metrics: metrics["iou"]),
        train_iteration=learner.train_iteration,
        evaluate=evaluate,
        evaluate_every=training.evaluate_every,
        save_every=training.save_every,
        max_minutes=minutes,
    )


if __name__ == "__main__":
    run_script(main)
