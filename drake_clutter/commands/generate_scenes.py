"""`drake-clutter generate`: a batch of scenes, resumable, in parallel, the same for any number of workers."""

import json
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_clutter.agents.generators import (
    GeneratedScene,
    GenerationJob,
    SceneGenerator,
    make_generation_agent,
    summarize_scenes,
)
from drake_clutter.catalog import load_catalog
from drake_clutter.files import InputError, prepare_output_directory, write_json
from drake_clutter.grammar import NodeBudget
from drake_clutter.reports.contact_sheet import MAX_THUMBNAILS, write_contact_sheet
from drake_clutter.reports.scene_images import SceneRenderer
from drake_clutter.scenes.interfaces import Verdict
from drake_clutter.scenes.scene import Scene
from drake_clutter.scenes.scene_file import load_scene, save_scene
from drake_clutter.tasks.oracle_search import Solvability
from drake_clutter.validation import to_plain
from drake_clutter.workers.parallel_map import map_ordered

JOB_FILE, PROGRESS_FILE, SCENES_FOLDER = "job.json", "progress.json", "scenes"
SUMMARY_FILE, CONTACT_SHEET_FILE = "summary.json", "contact_sheet.png"


@dataclass(frozen=True)
class _GeneratorFactory:
    """Makes a worker; picklable."""

    job: GenerationJob

    def __call__(self) -> SceneGenerator:
        return SceneGenerator(self.job)


def generate_scenes(
    job: GenerationJob,
    count: int,
    out: Path,
    workers: int,
    progress: Callable[[Iterable[Any], int, int], Iterable[Any]],
    ray_address: str | None = None,
) -> dict[str, Any]:
    """Writes `scenes/0000.yaml`, ..., `summary.json` and `contact_sheet.png`.

    A folder of the same job is taken up where it was left, and may be extended to a larger count.

    Args:
        job: what to generate.
        count: scenes in the folder at the end.
        out: the folder.
        workers: processes.
        progress: wraps the scenes that are made, given how many are there and how many there will be.
        ray_address: of the Ray cluster that the processes run on; None: they run here.

    Returns:
        The summary.

    Raises:
        InputError: an option that is not allowed, a folder that holds something else, or no Ray cluster at the address.
    """
    if count < 1:
        raise InputError(f"--count {count}; allowed is 1 or more")
    NodeBudget(job.nodes)
    make_generation_agent(job.agent, job.config, job.temperature)
    catalog = load_catalog(job.catalog_folder)
    for object_class in catalog.object_set(job.objects):
        _ = object_class.corners  # says what is missing before anything is written
    prepare_output_directory(
        out,
        allowed_entries=frozenset(
            {JOB_FILE, PROGRESS_FILE, SUMMARY_FILE, CONTACT_SHEET_FILE, SCENES_FOLDER}
        ),
    )
    if (out / JOB_FILE).exists():
        earlier = json.loads((out / JOB_FILE).read_text())
        if json.dumps(earlier) != json.dumps(job.to_dict):  # the order of cameras counts, too
            raise InputError(
                f"--out {out}: holds scenes of other options, see {JOB_FILE}; give the same options or another folder"
            )
    else:
        prepare_output_directory(out)
        write_json(out / JOB_FILE, job.to_dict)
    (out / SCENES_FOLDER).mkdir(exist_ok=True)
    paths = [out / SCENES_FOLDER / f"{index:04d}.yaml" for index in range(count)]
    # Scenes are written in order, so what is there is a beginning.
    num_done = next((index for index, path in enumerate(paths) if not path.exists()), count)
    earlier_run = (
        json.loads((out / PROGRESS_FILE).read_text()) if (out / PROGRESS_FILE).exists() else {}
    )
    seconds, layout_failures = (
        float(earlier_run.get("seconds", 0.0)),
        Counter(earlier_run.get("layout_failures", {})),
    )
    solvable: list[str | None] = earlier_run.get("solvable", [])[:num_done]
    num_done = len(
        solvable
    )  # one less than the scenes, if the run was stopped between the two files

    start_time = time.monotonic()
    generated: Iterable[GeneratedScene] = map_ordered(
        _GeneratorFactory(job), range(num_done, count), workers=workers, ray_address=ray_address
    )
    for index, result in enumerate(progress(generated, num_done, count), start=num_done):
        layout_failures.update(result.layout_failures)
        save_scene(paths[index], result.scene, job.config.cell, result.verdict)
        solvable.append(result.solvable.value if result.solvable else None)
        total_seconds = seconds + time.monotonic() - start_time
        write_json(
            out / PROGRESS_FILE,
            {
                "seconds": total_seconds,
                "layout_failures": dict(layout_failures),
                "solvable": solvable,
            },
        )
    seconds = float(json.loads((out / PROGRESS_FILE).read_text())["seconds"])

    files = [load_scene(path, catalog) for path in paths]
    judged = [(file.scene, file.verdict) for file in files if file.verdict is not None]
    solvabilities = [None if answer is None else Solvability(answer) for answer in solvable[:count]]
    summary = summarize_scenes(job, judged, solvabilities)
    summary |= {
        "layout_failures": dict(layout_failures),
        "seconds": round(seconds, 2),
        "workers": workers,
        "config": to_plain(job.config),
    }
    write_json(out / SUMMARY_FILE, summary)
    write_contact_sheet(
        out / CONTACT_SHEET_FILE,
        [_thumbnail(i, s, v) for i, (s, v) in enumerate(judged[:MAX_THUMBNAILS])],
    )
    return summary


_renderer: SceneRenderer | None = None


def _thumbnail(index: int, scene: Scene, verdict: Verdict) -> tuple[NDArray[np.uint8], str, bool]:
    """Picture, caption, and whether it is stable. An unstable scene is shown as it was laid out."""
    global _renderer
    _renderer = _renderer or SceneRenderer()
    if verdict.instability is None:
        return (
            _renderer.render_overhead(scene.with_poses(verdict.settled)),
            f"{index:04d}  hidden {len(verdict.hidden)}",
            True,
        )
    return (
        _renderer.render_overhead(scene),
        f"{index:04d}  {verdict.instability.reason.value}: {verdict.instability.object}",
        False,
    )
