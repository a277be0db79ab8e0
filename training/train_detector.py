"""Trains the network that finds objects in images of `render_image_dataset.py`.

    python training/render_image_dataset.py --out runs/images --count 20000 --workers 2
    python training/train_detector.py --config training/configs/detector.yaml --out runs/detector

A run that was stopped, at any moment, goes on with the same command, and ends with the same weights as one that was not.
"""

from dataclasses import field
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer

from drake_clutter.catalog import load_catalog
from drake_clutter.cell.work_cell import WorkCell, default_cell
from drake_clutter.config import upgrade
from drake_clutter.files import cli_error_handler
from drake_clutter.learning.training_run import TrainingRun, resolve_device
from drake_clutter.perception.image_dataset import ImageDataset
from drake_clutter.perception.segmentation import CHECKPOINT_KIND, ImageWindow, SegmentationNetwork
from drake_clutter.perception.segmentation_training import (
    SegmentationConfig,
    SegmentationLearner,
    make_example,
)
from drake_clutter.seeding import item_rng
from drake_clutter.validation import Flag, InRange, config_class, load_config_as, renamed_fields

CHECKPOINT = "detector.safetensors"


@config_class
@renamed_fields(catalogue="catalog", looks_at_color="use_color")
class DetectorTrainingConfig:
    """A training.

    Attributes:
        images: folder of `render_image_dataset.py`; held_out: of its last images are not learned from, but looked at as it goes.
        objects: name of the object set; catalog: a folder with object classes of one's own, or "".
        use_color: whether the network is given colour beside depth.
        warm_start: a checkpoint to begin with, of other classes or without colour if need be, or "".
        seed: same seed, same weights (on the same kind of machine).
        evaluate_every: steps.
        learning, cell: see there.
    """

    images: str = "runs/images"
    held_out: Annotated[int, InRange(0)] = 200
    objects: str = "pantry14"
    catalog: str = ""
    use_color: Flag = False
    warm_start: str = ""
    seed: Annotated[int, InRange(0)] = 0
    evaluate_every: Annotated[int, InRange(1)] = 250
    learning: SegmentationConfig = field(default_factory=SegmentationConfig)
    cell: WorkCell = field(default_factory=default_cell)


CONFIG = DetectorTrainingConfig()
"""Default configuration of the training."""


def main(
    out: Annotated[
        Path,
        typer.Option(metavar="DIR", help="Folder of the run; one of the same config is taken up."),
    ],
    config: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="YAML with fields of DetectorTrainingConfig."),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="FIELD=VALUE", help="A field over the file's."),
    ] = None,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    threads: Annotated[int, typer.Option(min=1, help="Of PyTorch, on a CPU.")] = 2,
) -> None:
    """Trains, evaluates as it goes, and writes detector.safetensors."""
    given = load_config_as(CONFIG, config, settings or [], upgrade)
    torch.set_num_threads(threads)
    chosen, camera, support = resolve_device(device), given.cell.camera, given.cell.support
    classes = [
        c.name
        for c in load_catalog(Path(given.catalog) if given.catalog else None).object_set(
            given.objects
        )
    ]
    images = ImageDataset(Path(given.images))
    learned = len(images) - given.held_out
    torch.manual_seed(given.seed)
    network = SegmentationNetwork(classes, given.use_color)
    if given.warm_start:
        network.warm_start(SegmentationNetwork.load(Path(given.warm_start)))
    learner = SegmentationLearner(
        network, images.__getitem__, learned, given.learning, camera, support, given.seed, chosen
    )
    run, window = (
        TrainingRun(out, given, learner, given.learning.steps),
        ImageWindow.around_support(camera, support),
    )

    def figures() -> dict[str, float]:
        """Of the images held out: share of the pixels whose class is right, over the union, mean of classes; error of votes."""
        network.eval()
        both, either, errors = np.zeros(len(classes)), np.zeros(len(classes)), list[float]()
        for k in range(learned, len(images)):
            shown = make_example(
                images[k], classes, camera, window, item_rng(given.seed, 1, k), given.use_color
            )
            with torch.inference_mode():
                logits, votes = network(torch.from_numpy(shown.image)[None].to(chosen))
            kind = logits[0].argmax(dim=0).cpu().numpy()
            for c in range(len(classes)):
                is_, said = shown.class_map == c + 1, kind == c + 1
                both[c], either[c] = both[c] + (is_ & said).sum(), either[c] + (is_ | said).sum()
            error = np.linalg.norm(votes[0].cpu().numpy() - shown.center_offsets, axis=0)[kind > 0]
            errors.append(float(np.nanmedian(error)) if np.isfinite(error).any() else np.nan)
        return {
            "iou": float(np.mean(both / np.maximum(either, 1))),
            "median_vote_mm": 1000 * float(np.nanmean(errors)),
        }

    while learner.step < given.learning.steps:
        learner.train_iteration()
        if learner.step == given.learning.steps or learner.step % given.evaluate_every == 0:
            run.report(figures(), learner.losses)
            run.save()
    about = {
        "kind": CHECKPOINT_KIND,
        "classes": classes,
        "use_color": given.use_color,
        "images": learned,
    }
    run.finish(CHECKPOINT, network, about)


if __name__ == "__main__":
    with cli_error_handler():
        typer.run(main)
