"""Generation of scenes, parallel and resumable.

The result does not depend on the number of workers.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drake_clutter.agents.generators import (
    GeneratedScene,
    GenerationJob,
    SceneGenerator,
    make_generation_agent,
    summarize_scenes,
)
from drake_clutter.catalog import load_catalog
from drake_clutter.commands.job_file import open_job_folder
from drake_clutter.files import InputError, read_json, write_json
from drake_clutter.grammar import NodeBudget
from drake_clutter.reports.contact_sheet import MAX_THUMBNAILS, write_contact_sheet
from drake_clutter.reports.scene_images import SceneRenderer
from drake_clutter.scenes.interfaces import Verdict
from drake_clutter.scenes.scene import Scene
from drake_clutter.scenes.scene_file import load_scene, save_scene
from drake_clutter.tasks.oracle_search import Solvability
from drake_clutter.validation import CountOrZero, NonNegative, StrictModel, to_plain, validate
from drake_clutter.workers.parallel_map import map_ordered

PROGRESS_FILE = "progress.json"
SCENES_FOLDER = "scenes"
SUMMARY_FILE = "summary.json"
CONTACT_SHEET_FILE = "contact_sheet.png"


class GenerationProgress(StrictModel):
    """Content of `PROGRESS_FILE`.

    Attributes:
        seconds: Duration of the run so far [s].
        layout_failures: Number of discarded layouts by reason.
        solvable: Result of the oracle search of each scene; None if it was not run.
    """

    seconds: NonNegative = 0.0
    layout_failures: dict[str, CountOrZero] = Field(default_factory=dict)
    solvable: tuple[Solvability | None, ...] = ()


def read_generation_progress(path: Path) -> GenerationProgress:
    """Return the progress of a run of `generate`.

    Raises:
        InputError: The file cannot be read, or a field has a value that is not allowed.
    """
    document = read_json(path, "the progress of a run of generate")
    return validate(GenerationProgress, document, str(path))


@dataclass(frozen=True)
class _GeneratorFactory:
    """Picklable factory of the generator of a worker process."""

    job: GenerationJob

    def __call__(self) -> SceneGenerator:
        return SceneGenerator(self.job)


def generate_scenes(
    job: GenerationJob,
    count: int,
    out: Path,
    workers: int,
    progress: Callable[[Iterable[GeneratedScene], int, int], Iterable[GeneratedScene]],
    ray_address: str | None = None,
) -> dict[str, Any]:
    """Write `scenes/0000.yaml`, ..., `summary.json` and `contact_sheet.png`.

    A folder of the same job is resumed, and may be extended to a larger number of scenes.

    Args:
        job: What to generate.
        count: Number of scenes in the folder at the end.
        out: Output folder.
        workers: Number of worker processes.
        progress: Wraps the new scenes, given the number of existing scenes and of all scenes.
        ray_address: Address of the Ray cluster that runs the workers; None runs them locally.

    Returns:
        The summary.

    Raises:
        InputError: An option is not allowed, the folder holds other results, or there is no Ray
            cluster at the address.
    """
    if count < 1:
        raise InputError(f"--count {count}; expected 1 or more")
    NodeBudget(job.nodes)
    catalog = load_catalog(job.catalog_folder)
    classes = catalog.object_set(job.objects)
    names = [object_class.name for object_class in classes]
    make_generation_agent(job.agent, job.config, job.temperature, names)
    for object_class in classes:
        # These raise if a model is missing or disagrees, before anything is written.
        _ = object_class.verified_sdf_path
        _ = object_class.corners
    with open_job_folder(out, job.to_dict()):
        return _generate_missing_scenes(job, count, out, workers, progress, ray_address)


def _generate_missing_scenes(
    job: GenerationJob,
    count: int,
    out: Path,
    workers: int,
    progress: Callable[[Iterable[GeneratedScene], int, int], Iterable[GeneratedScene]],
    ray_address: str | None,
) -> dict[str, Any]:
    """Generate the scenes that a job's folder lacks; see `generate_scenes`."""
    catalog = load_catalog(job.catalog_folder)
    folder = out / SCENES_FOLDER
    folder.mkdir(exist_ok=True)
    paths = [folder / f"{index:04d}.yaml" for index in range(count)]
    # Scenes are written in order, so the existing ones have the lowest indices.
    num_files = next((index for index, path in enumerate(paths) if not path.exists()), count)
    earlier_run = GenerationProgress()
    if (out / PROGRESS_FILE).exists():
        earlier_run = read_generation_progress(out / PROGRESS_FILE)
    layout_failures = Counter(earlier_run.layout_failures)
    solvable = [value and value.value for value in earlier_run.solvable[:num_files]]
    # One less than the files if the run was interrupted between the two writes of a scene.
    num_done = len(solvable)

    start_time = time.monotonic()
    generated: Iterable[GeneratedScene] = map_ordered(
        _GeneratorFactory(job), range(num_done, count), workers=workers, ray_address=ray_address
    )
    for index, result in enumerate(progress(generated, num_done, count), start=num_done):
        layout_failures.update(result.layout_failures)
        save_scene(paths[index], result.scene, job.config.cell, result.verdict)
        solvable.append(result.solvability.value if result.solvability else None)
        write_json(
            out / PROGRESS_FILE,
            {
                "seconds": earlier_run.seconds + time.monotonic() - start_time,
                "layout_failures": dict(layout_failures),
                "solvable": solvable,
            },
        )
    seconds = read_generation_progress(out / PROGRESS_FILE).seconds

    files = [load_scene(path, catalog) for path in paths]
    judged = [(file.scene, file.verdict) for file in files if file.verdict is not None]
    solvabilities = [None if value is None else Solvability(value) for value in solvable[:count]]
    summary = summarize_scenes(job, judged, solvabilities)
    summary |= {
        "layout_failures": dict(layout_failures),
        "seconds": round(seconds, 2),
        "workers": workers,
        "config": to_plain(job.config),
    }
    write_json(out / SUMMARY_FILE, summary)
    renderer = SceneRenderer()
    thumbnails = [
        _thumbnail(renderer, index, scene, verdict)
        for index, (scene, verdict) in enumerate(judged[:MAX_THUMBNAILS])
    ]
    write_contact_sheet(out / CONTACT_SHEET_FILE, thumbnails)
    return summary


def _thumbnail(
    renderer: SceneRenderer, index: int, scene: Scene, verdict: Verdict
) -> tuple[NDArray[np.uint8], str, bool]:
    """Return the image of a scene, its caption, and whether it is stable.

    A stable scene is shown at its settled poses, an unstable one at its initial poses.
    """
    if verdict.instability is None:
        image = renderer.render_overhead(scene.with_poses(verdict.settled))
        return image, f"{index:04d}  {len(verdict.hidden)} hidden", True
    reason = f"{verdict.instability.reason.value}: {verdict.instability.object}"
    return renderer.render_overhead(scene), f"{index:04d}  {reason}", False
