"""The page docs/results/perception.md."""

from collections.abc import Mapping
from typing import Any

from markdown_text import estimate, number, section, table
from results_files import read_training_results

RUNS = (
    ("detector_depth.json", "depth"),
    ("detector_color.json", "depth and color"),
    ("detector_depth_beside_color.json", "depth, as reference for color"),
)
"""Results files of detectors, and the images that they take."""
IMAGES = {"sg_star_25": "sg_star_25", "images": "held-out images"}


def _rows() -> list[tuple[str, str, Mapping[str, Any]]]:
    return [
        (label, IMAGES[name], row)
        for file, label in RUNS
        for name, row in read_training_results(file)["rows"].items()
    ]


def _detectors() -> str:
    text = section(
        "Detectors",
        "Noisy rendered images of frozen SG\\* scenes and of held-out training scenes. *Recall*: "
        "objects with a visible fraction of at least 0.3 that a detection of the right class "
        "covers "
        "with an IoU of 0.5. Errors and times: median / 95th percentile.",
        command="python training/evaluate_detector.py"
        " --detector training/checkpoints/detector_depth.safetensors"
        " --scenes training/scenes/sg_star_25.json --out FILE",
        seed=0,
        results=[f"training/results/{name}" for name, _ in RUNS],
    )
    body = []
    for label, images, row in _rows():
        cells = [label, images, str(row["images"]), estimate(row["in_view"], "recall", "ci95")]
        cells += [number(row["precision"]), number(row["class_accuracy_of_found"])]
        for key in ("translation_mm", "rotation_deg", "ms_per_frame"):
            cells.append(" / ".join(number(value, 1) for value in row[key]))
        body.append(cells)
    head = ["input", "scenes", "images", "recall", "precision", "class accuracy"]
    return text + table([*head, "translation [mm]", "rotation [deg]", "time [ms]"], body)


def _visibility() -> str:
    text = section(
        "Recall by visible fraction",
        "Objects of 100 frozen scenes of sg_star_25, detector on depth images.",
        seed=0,
        results=["training/results/detector_depth.json"],
    )
    rows = read_training_results("detector_depth.json")["rows"]["sg_star_25"]
    return text + table(
        ["visible fraction", "objects", "recall"],
        [
            [label, str(row["objects"]), estimate(row, "recall", "ci95")]
            for label, row in rows["recall_by_visible_fraction"].items()
        ],
    )


def _trainings() -> str:
    text = section(
        "Trainings",
        "Segmentation networks; mean IoU over the 14 classes on held-out images at the end of the "
        "training. Other processes ran on the same two cores.",
        command="python training/train_detector.py --config training/configs/detector.yaml"
        " --set images=runs/images --out runs/detector",
        seed=0,
        results=["training/results/detector_depth.json", "training/results/detector_color.json"],
    )
    body = []
    for file, label in RUNS[:2]:
        trained = read_training_results(file)["trained"]
        body.append(
            [
                label,
                str(trained["step"]),
                number(trained["seconds"] / 60, 0),
                number(trained["iou"]),
                number(trained["median_vote_mm"], 1),
            ]
        )
    head = ["input", "steps", "minutes", "mean IoU", "median error of center votes [mm]"]
    return text + table(head, body)


def page() -> str:
    """Return the page."""
    intro = (
        "# Perception\n\nDetection and pose estimation from single images "
        "([perception](../explanation/perception.md)). Intervals are 95 %.\n\n"
    )
    return intro + "\n".join([_detectors(), _visibility(), _trainings()])
