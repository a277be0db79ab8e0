"""The page docs/results/rendering.md."""

from collections.abc import Mapping
from typing import Any

from markdown_text import estimate, figure, number, section, table
from results_files import read_benchmark_results, read_training_results

VIEWS = {
    "objects": "default camera, no arm",
    "arm": "default camera, arm",
    "tilted": "tilted camera, arm",
}
"""Views of the scenes, by their names in the results file."""
RENDERERS = {"vtk": "VTK", "raster": "raster"}
"""Renderers, by their names in the results files."""
INPUTS = {"depth": "depth", "color": "depth and color"}
"""Input of the detectors, by their names in the results files."""
IMAGES = {"sg_star_25": "sg_star_25", "images": "random lamps and colors"}
"""Images of the detectors, by their names in the results files."""


def _agreement() -> str:
    results = read_benchmark_results("renderers.json")
    text = section(
        "Agreement of the renderers",
        "The same scenes, rendered by VTK and by the raster renderer with the same random lamps: "
        "graphs of the training datasets in random layouts, and objects in the air with random "
        "rotations. *Labels equal*: of the pixels that show an object or the arm in one of them. "
        "*Depth equal*: within 1 mm, of the pixels that show a surface in one of them. "
        "*Difference of color*: largest difference of a channel of [0, 255] in such a pixel; mean, "
        "99th percentile and 99.9th percentile. Without the arm, VTK draws no labels of what is "
        "higher than 0.7 m above the tray, as some falling objects are.",
        command="python benchmarks/renderer_agreement.py --count 25 --out FILE",
        seed=results["seed"],
        results=["benchmarks/results/renderers.json"],
    )
    head = ["objects", "scenes", "view", "images", "labels equal", "depth equal"]
    return text + table(
        [*head, "difference of color"],
        [
            [
                row["objects"],
                row["scenes"],
                VIEWS[row["view"]],
                str(row["images"]),
                number(row["equal_label_fraction"], 5),
                number(row["equal_depth_fraction"], 5),
                " / ".join(
                    [
                        number(row["mean_color_difference"], 2),
                        number(row["color_difference_percentiles"]["99"], 0),
                        number(row["color_difference_percentiles"]["99.9"], 0),
                    ]
                ),
            ]
            for row in results["rows"]
        ],
    )


def _detector_row(kind: str, renderer: str, images: str, row: Mapping[str, Any]) -> list[str]:
    cells = [INPUTS[kind], IMAGES[images], RENDERERS[renderer], str(row["images"])]
    cells += [estimate(row["in_view"], "recall", "ci95"), number(row["precision"])]
    cells.append(number(row["class_accuracy_of_found"]))
    return [*cells, number(row["translation_mm"][0], 1)]


def _detectors() -> str:
    files = {
        (kind, renderer): f"detector_{kind}_on_{renderer}.json"
        for kind in INPUTS
        for renderer in RENDERERS
    }
    text = section(
        "Shipped detectors on both renderers",
        "The detectors were trained on images of VTK. The images of sg_star_25 have the lamps of "
        "the camera; those with random lamps and colors are training images of another seed, whose "
        "lamps, shadows, exposures and camera poses are those of each renderer. Errors of position "
        "there include that of the camera's pose with the raster renderer, which the detectors do "
        "not know. Columns as in [perception](perception.md); intervals are 95 %.",
        command="python training/evaluate_detector.py"
        " --detector training/checkpoints/detector_depth.safetensors"
        " --scenes training/scenes/sg_star_25.json --count 60 --renderer raster --out FILE",
        seed=0,
        results=[f"training/results/{name}" for name in files.values()],
    )
    rows = []
    for kind in INPUTS:
        for images in IMAGES:
            for renderer in RENDERERS:
                results = read_training_results(files[kind, renderer])["rows"]
                rows.append(_detector_row(kind, renderer, images, results[images]))
    head = ["input", "images", "renderer", "count", "recall", "precision", "class accuracy"]
    return text + table([*head, "translation [mm]"], rows)


def page() -> str:
    """Return the page."""
    intro = (
        "# Rendering\n\nThe raster renderer compared with Drake's VTK engine "
        "([rendering](../explanation/rendering.md)).\n\n"
    )
    picture = figure(
        "renderers.png",
        "VTK; the raster renderer; the raster renderer with a lamp that casts shadows.",
    )
    return intro + "\n".join([_agreement(), _detectors(), picture])
