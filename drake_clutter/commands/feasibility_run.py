"""Run of a feasibility study: computes the missing parts, and writes tables and page."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from drake_clutter.catalog import load_catalog
from drake_clutter.commands.feasibility_job import FeasibilityJob
from drake_clutter.commands.feasibility_parts import (
    FeasibilityWorker,
    PartKind,
    StudyPart,
    load_part,
    load_settled_scene,
    setup_from_dict,
)
from drake_clutter.commands.job_file import open_job_folder
from drake_clutter.feasibility.base_search import BaseGrid, make_base_grids, select_finalists
from drake_clutter.feasibility.move_study import MOVE_RECORD_FIELDS
from drake_clutter.feasibility.pose_noise import NOISE_RECORD_FIELDS
from drake_clutter.feasibility.sequences import SEQUENCE_RECORD_FIELDS
from drake_clutter.feasibility.setups import Setup, SetupRequest, UnusableSetup
from drake_clutter.feasibility.summary import summarize_study
from drake_clutter.feasibility.tables import write_table
from drake_clutter.files import write_json
from drake_clutter.reports.feasibility_report import StudyResults, write_feasibility_report
from drake_clutter.scenes.scene import Scene
from drake_clutter.scenes.scene_file import load_scene
from drake_clutter.validation import load_config_as
from drake_clutter.workers.parallel_map import map_ordered

PARTS_FOLDER = "parts"
REPORT_FILE = "report.html"
MAP_COLUMNS = {
    "setup": str,
    **dict.fromkeys(("tilt_deg", "height", "x", "y"), float),
    **dict.fromkeys(("reachable_fraction", "singular_value"), float),
}
"""Columns of `reach.csv`, with their types."""
BASE_COLUMNS = {
    "settings": str,
    **dict.fromkeys(("x", "y", "z", "yaw"), float),
    **dict.fromkeys(("possible", "reachable"), int),
}
"""Columns of `bases.csv`, with their types."""
TARGET_COLUMNS = {
    **{"setup": str, "target": str, "num_solutions": int, "reachable": bool},
    **{"singular_value": float, "obstacles": str},
}
"""Columns of `targets.csv`, with their types."""

Progress = Callable[[Iterable[Any], int, int], Iterable[Any]]
"""Wraps results to show progress, given how many exist already and how many there will be."""


class StudyRun:
    """Computes the parts of a study, in one or several processes."""

    def __init__(
        self,
        job: FeasibilityJob,
        folder: Path,
        workers: int,
        ray_address: str | None,
        progress: Progress,
    ) -> None:
        """Prepare a run.

        Args:
            job: The study.
            folder: Folder of the part files.
            workers: Number of worker processes.
            ray_address: Address of the Ray cluster that runs the workers; None runs them locally.
            progress: Shows progress.
        """
        self._job = job
        self._folder = folder
        self._workers = workers
        self._ray_address = ray_address
        self._progress = progress

    def compute(
        self, parts: Sequence[StudyPart], names: Sequence[str] = ()
    ) -> dict[StudyPart, Any]:
        """Return the results of parts; those without a file are computed.

        Args:
            parts: The parts.
            names: Names of the setups.
        """
        missing = [part for part in parts if not (self._folder / part.file_name).exists()]
        if missing:
            results = map_ordered(
                partial(FeasibilityWorker, self._job, tuple(names), self._folder),
                missing,
                workers=self._workers,
                ray_address=self._ray_address,
            )
            shown = self._progress(results, len(parts) - len(missing), len(parts))
            for part, result in zip(missing, shown, strict=True):
                write_json(self._folder / part.file_name, _nan_to_none(result))
        return {part: load_part(self._folder, part) for part in parts}

    def search_bases(self) -> tuple[dict[str, SetupRequest], list[dict[str, Any]]]:
        """Return the best bases as setups by name, and a row for each base that was compared."""
        if not self._job.searches:
            return {}, []
        grids = make_base_grids(self._job.reference, self._job.searches)
        self.compute([StudyPart(PartKind.MAP, k) for k in range(len(grids))])
        scenes = range(len(self._job.scenes))
        parts = [StudyPart(PartKind.BASES, k, s) for k in range(len(grids)) for s in scenes]
        results = self.compute(parts)
        rows = list[dict[str, Any]]()
        shares = []
        for k, grid in enumerate(grids):
            found = [r for part, r in results.items() if part.index == k and not r["unstable"]]
            possible = sum(result["possible"] for result in found)
            reachable = np.sum([result["reachable"] for result in found], axis=0, dtype=int)
            shares.append(reachable / max(1, possible) + np.zeros(len(grid.bases)))
            rows += _base_rows(grid, possible, reachable.tolist())
        finalists = {}
        for k, index in select_finalists(grids, shares):
            settings = grids[k].settings_of(index)
            cell = load_config_as(self._job.reference, settings=settings)
            finalists[", ".join(_changed_settings(settings, self._job))] = SetupRequest(
                cell, keep_home=False
            )
        return finalists, rows


def _changed_settings(settings: Sequence[str], job: FeasibilityJob) -> list[str]:
    """Return the settings of the fields that were searched."""
    fields = {search.field for search in job.searches}
    return [setting for setting in settings if setting.partition("=")[0] in fields]


def _base_rows(grid: BaseGrid, possible: int, reachable: Sequence[int]) -> list[dict[str, Any]]:
    return [
        {
            "settings": " ".join(grid.settings),
            **dict(zip(("x", "y", "z", "yaw"), base, strict=True)),
            "possible": possible,
            "reachable": count,
        }
        for base, count in zip(grid.bases.tolist(), reachable, strict=True)
    ]


def _show_nothing(parts: Iterable[Any], num_done: int, total: int) -> Iterable[Any]:
    return parts


def run_feasibility_study(
    job: FeasibilityJob,
    out: Path,
    *,
    workers: int = 1,
    ray_address: str | None = None,
    progress: Progress = _show_nothing,
) -> dict[str, Any]:
    """Compute the missing parts of a study; write tables, `summary.json` and `report.html`.

    Args:
        job: The study.
        out: Output folder: new, empty, or of the same job.
        workers: Number of worker processes.
        ray_address: Address of the Ray cluster that runs the workers; None runs them locally.
        progress: Shows progress.

    Returns:
        The summary, the content of `summary.json`.

    Raises:
        InputError: A scene file cannot be used, or the folder holds other results.
    """
    for path in job.scenes:
        load_scene(path, load_catalog(job.catalog_folder))
    with open_job_folder(out, job.to_dict()):
        folder = out / PARTS_FOLDER
        folder.mkdir(exist_ok=True)
        run = StudyRun(job, folder, workers, ray_address, progress)
        finalists, bases = run.search_bases()
        requests = {**job.setups, **finalists}
        names = [*requests]
        homes = [StudyPart(PartKind.SETUP, k, None, r) for k, r in enumerate(requests.values())]
        found = run.compute(homes, names)
        setups = {
            name: setup_from_dict(name, requests[name], document)
            for name, document in zip(names, found.values(), strict=True)
        }
        results = run.compute(_parts_of_setups(job, setups), names)
        return _write_results(job, out, setups, bases, results)


def _parts_of_setups(
    job: FeasibilityJob, setups: Mapping[str, Setup | UnusableSetup]
) -> list[StudyPart]:
    """Return the parts of the setups that can be studied."""
    usable = [(k, setup) for k, setup in enumerate(setups.values()) if isinstance(setup, Setup)]
    scenes = range(len(job.scenes))
    parts = [StudyPart(PartKind.MOVES, k, s, setup) for k, setup in usable for s in scenes]
    if job.agent is not None:
        parts += [StudyPart(PartKind.SEQUENCE, k, s, setup) for k, setup in usable for s in scenes]
    if job.draws_maps or job.targets:
        parts += [StudyPart(PartKind.REACH, k, None, setup) for k, setup in usable]
    return parts


def _nan_to_none(value: Any) -> Any:
    """Return a document with null in place of NaN and infinity, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _nan_to_none(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_nan_to_none(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _write_results(
    job: FeasibilityJob,
    out: Path,
    setups: Mapping[str, Setup | UnusableSetup],
    bases: list[dict[str, Any]],
    results: Mapping[StudyPart, Any],
) -> dict[str, Any]:
    """Write the tables, the summary and the report from the results of all parts."""

    def of_kind(kind: PartKind) -> dict[StudyPart, Any]:
        return {part: result for part, result in results.items() if part.kind is kind}

    scene_results = [r for r in of_kind(PartKind.MOVES).values() if not r["unstable"]]
    moves = [row for result in scene_results for row in result["moves"]]
    noise = [row for result in scene_results for row in result["noise"]]
    sequences = [
        result["sequence"]
        for result in of_kind(PartKind.SEQUENCE).values()
        if not result["unstable"]
    ]
    maps = {
        part.setup.name: result
        for part, result in of_kind(PartKind.REACH).items()
        if isinstance(part.setup, Setup)
    }
    targets = [target for result in maps.values() for target in result["targets"]]
    write_table(out / "moves", moves, MOVE_RECORD_FIELDS)
    for name, rows, columns in (
        ("noise", noise, NOISE_RECORD_FIELDS),
        ("sequences", sequences, SEQUENCE_RECORD_FIELDS),
        ("reach", _map_rows(maps), MAP_COLUMNS),
        ("bases", bases, BASE_COLUMNS),
        ("targets", targets, TARGET_COLUMNS),
    ):
        if rows:
            write_table(out / name, rows, columns)
    scenes = sorted({result["scene"] for result in scene_results})
    summary = summarize_study(setups, moves, noise, sequences, scenes)
    summary["unstable_scenes"] = sorted(
        {r["scene"] for r in of_kind(PartKind.MOVES).values() if r["unstable"]}
    )
    write_json(out / "summary.json", summary)
    paths = {path.stem: path for path in job.scenes}

    def load_scene_by_name(name: str) -> Scene:
        scene = load_settled_scene(paths[name], job)
        assert scene is not None, "moves exist only for stable scenes"
        return scene

    studied = StudyResults(
        setups={n: s.cell for n, s in setups.items() if isinstance(s, Setup)},
        moves=moves,
        noise=noise,
        sequences=sequences,
        maps=maps if job.draws_maps else {},
        bases=bases,
        targets=targets,
        summary=summary,
    )
    write_feasibility_report(out / REPORT_FILE, studied, load_scene_by_name)
    return summary


def _map_rows(maps: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a row for each point of the reachability maps."""
    return [
        {
            "setup": setup,
            "tilt_deg": tilt,
            "height": z,
            "x": x,
            "y": y,
            **{name: result[name][t][k][i][j] for name in ("reachable_fraction", "singular_value")},
        }
        for setup, result in maps.items()
        for t, tilt in enumerate(result["tilts_deg"])
        for k, z in enumerate(result["heights"])
        for i, x in enumerate(result["x"])
        for j, y in enumerate(result["y"])
    ]
