"""`drake-clutter feasibility`: what an arm could do in scenes, as tables, pictures and a report; resumable, in parallel."""

import csv
import io
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import field_validator

from drake_clutter.catalog import load_catalog
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.cell.work_cell import WorkCell, load_cell
from drake_clutter.config import ClutterConfig, upgrade_cell
from drake_clutter.files import InputError, prepare_output_directory, write_json, write_text
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.reachability import ReachabilityAnalysis, score_base_positions
from drake_clutter.reports.feasibility_report import write_feasibility_report
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.scenes.scene_file import load_scene
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.statistics import wilson_interval
from drake_clutter.tasks.feasibility_study import (
    PLANNED,
    FeasibilityStudy,
    MoveRecord,
    PoseErrorRecord,
)
from drake_clutter.validation import (
    Finite,
    NonEmptyText,
    StrictModel,
    Vector3,
    allowed_error,
    load_config_as,
    to_plain,
    validate,
)
from drake_clutter.workers.parallel_map import map_ordered
from drake_clutter.yaml_io import read_yaml

JOB_FILE, PARTS_FOLDER, REPORT_FILE = "job.json", "parts", "report.html"
MAP_HEIGHTS, MAP_SPACING = (0.05, 0.20, 0.35, 0.50), 0.05
"""m, of the reachability map."""
PLANNING_TIME_LIMIT = 5.0
"""s, for each move."""
BASE_GRID_X, BASE_GRID_Y = (
    np.round(np.arange(-1.0, -0.40, 0.1), 3).tolist(),
    np.round(np.arange(-0.6, 0.61, 0.2), 3).tolist(),
)
"""m, of the bases that are compared, on one side of the tray: the other sides of a square one are like it."""


@dataclass(frozen=True)
class TargetPose:
    """A pose of the cup that a user asks about."""

    name: str
    X_TG: Pose


@dataclass(frozen=True)
class FeasibilityJob:
    """Everything that decides what a study finds.

    Attributes:
        scenes: files. setups: arms by name.
        targets: poses of the cup that are asked about beside the moves.
        seed: of places and errors. world: the config.
        catalog_folder: a user's asset folder, or None.
    """

    scenes: tuple[Path, ...]
    setups: dict[str, WorkCell]
    targets: tuple[TargetPose, ...]
    seed: int
    config: ClutterConfig
    catalog_folder: Path | None

    def to_dict(self) -> dict[str, Any]:
        """As a document."""
        return {
            "scenes": [str(path.resolve()) for path in self.scenes],
            "setups": {name: to_plain(cell) for name, cell in self.setups.items()},
            "targets": [asdict(target) for target in self.targets],
            "seed": self.seed,
            "world": to_plain(self.config),
            "catalog_folder": str(self.catalog_folder.resolve()) if self.catalog_folder else None,
        }


def collect_scene_files(paths: Sequence[Path]) -> tuple[Path, ...]:
    """Scene files, and those of folders, in order.

    Raises:
        InputError: a folder without any, or names that are there twice.
    """
    scene_paths = list[Path]()
    for path in paths:
        files = sorted(path.glob("*.yaml")) if path.is_dir() else [path]
        if not files:
            raise InputError(
                f"{path}: holds no scene files (*.yaml); give the `scenes` folder that `generate` wrote"
            )
        scene_paths += files
    check_unique_names("scenes", scene_paths)
    return tuple(scene_paths)


def check_unique_names(source: str, files: Sequence[Path]) -> None:
    """Refuse files of which two have the same name but for its end, as results are named after them.

    Raises:
        InputError: The name.
    """
    if duplicates := [
        name for name, count in Counter(path.stem for path in files).items() if count > 1
    ]:
        raise InputError(
            f"{source}: {duplicates[0]} is there twice; allowed are files with names of their own"
        )


def make_setups(
    base_poses: Sequence[list[float]],
    tray_poses: Sequence[list[float]],
    cell_files: Sequence[Path],
    default: WorkCell,
) -> dict[str, WorkCell]:
    """Return cells by name: the files', and the default one with other bases; the default one if nothing is given.

    Args:
        base_poses: X_TB as x, y, z (m) and yaw (deg), roll and pitch as they are.
        tray_poses: X_BT as x, y, z (m) and yaw (deg), without roll and pitch.
        cell_files: YAML with fields of `WorkCell` over those of the default; whole cells if they name
            a robot's model.
        default: A cell; all have its support, which is the scenes'.

    Raises:
        InputError: A file that is none, or a robot that cannot be loaded.
    """
    cells = {
        path.stem: _load_setup_cell(path, default).with_support(default.support)
        for path in cell_files
    }
    roll, pitch, _ = default.robot.base.rpy_deg
    for x, y, z, yaw in base_poses:
        base = PoseSpec(translation=(x, y, z), rpy_deg=(roll, pitch, yaw))
        cells[f"base {x:g}, {y:g}, {z:g}, {yaw:g}"] = _with_base(default, base)
    for x, y, z, yaw in tray_poses:
        c, s = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
        translation = (-(c * x + s * y), -(c * y - s * x), -z)
        base = PoseSpec(translation=translation, rpy_deg=(0.0, 0.0, -yaw))
        cells[f"tray {x:g}, {y:g}, {z:g}, {yaw:g}"] = _with_base(default, base)
    return cells or {"default": default}


def _load_setup_cell(path: Path, default: WorkCell) -> WorkCell:
    document = read_yaml(path, "a mapping of a cell's fields")
    robot = document.get("robot") if isinstance(document, dict) else None
    if not isinstance(robot, dict) or "model" not in robot:
        return load_config_as(default, path, upgrade=upgrade_cell)
    cell = load_cell(path)
    load_robot(cell.robot)
    return cell


def _with_base(cell: WorkCell, base: PoseSpec) -> WorkCell:
    return cell.model_copy(update={"robot": cell.robot.model_copy(update={"base": base})})


class _TargetEntry(StrictModel):
    name: NonEmptyText
    translation: Vector3
    quaternion: tuple[Finite, Finite, Finite, Finite]

    @field_validator("quaternion")
    @classmethod
    def _normalize(cls, quaternion: tuple[float, ...]) -> tuple[float, ...]:
        norm = math.hypot(*quaternion)
        if not 1e-9 < norm < math.inf:
            raise allowed_error("w, x, y, z that are not all zero")
        return tuple(value / norm for value in quaternion)


def read_targets(path: Path) -> tuple[TargetPose, ...]:
    """Poses of the cup from a YAML list of `{name, translation, quaternion}`, X_TG: z points out of the tool.

    Raises:
        InputError: the file, the entry and what is allowed.
    """
    content = "a list of {name: TEXT, translation: [x, y, z], quaternion: [w, x, y, z]}"
    entries = validate(tuple[_TargetEntry, ...], read_yaml(path, content), str(path))
    return tuple(
        TargetPose(entry.name, Pose(entry.translation, entry.quaternion)) for entry in entries
    )


@dataclass(frozen=True)
class StudyPart:
    """A piece of the work: of an arm the moves of a scene, or, without a scene, what it reaches; or scores of some bases."""

    setup: str
    scene_index: int | None = None
    base_x: float | None = None

    @property
    def file_name(self) -> str:
        """Where its result is kept."""
        content = "reach" if self.scene_index is None else f"scene_{self.scene_index:04d}"
        return f"{self.setup}__{content if self.base_x is None else f'bases_{self.base_x:g}'}.json"


class FeasibilityWorker:
    """Does parts of a job; for the runner."""

    def __init__(self, job: FeasibilityJob) -> None:
        self._job = job
        self._studies: dict[str, FeasibilityStudy] = {}

    def __call__(self, part: StudyPart) -> dict[str, Any]:
        """A part's result."""
        cell = self._job.setups[part.setup]
        if part.base_x is not None:
            places = [(part.base_x, y) for y in BASE_GRID_Y]
            scores = zip(places, score_base_positions(cell, places), strict=True)
            return {
                "bases": [
                    {"x": x, "y": y, "share": share, "manipulability": best}
                    for (x, y), (share, best) in scores
                ]
            }
        if part.scene_index is None:
            return self._analyze_reachability(cell)
        return self._plan_moves(part.setup, part.scene_index)

    def _analyze_reachability(self, cell: WorkCell) -> dict[str, Any]:
        reachability = ReachabilityAnalysis(cell)
        reachability_map = reachability.compute_map(MAP_HEIGHTS, MAP_SPACING)
        targets = []
        for target in self._job.targets:
            X = np.eye(4)
            X[:3, :3], X[:3, 3] = target.X_TG.rotation, target.X_TG.p
            result = reachability.analyze_poses(X[None])
            q = result.q[0].tolist() if result.num_solutions[0] else None
            targets.append(
                {
                    "target": target.name,
                    "branches": int(result.num_solutions[0]),
                    "manipulability": float(result.manipulability[0]),
                    "q": q,
                    "in_the_way": result.blocking_bodies[0],
                }
            )
        return {
            "x": reachability_map.x.tolist(),
            "y": reachability_map.y.tolist(),
            "heights": list(reachability_map.heights),
            "share": reachability_map.reachable_fraction.tolist(),
            "manipulability": reachability_map.manipulability.tolist(),
            "targets": targets,
        }

    def _plan_moves(self, setup: str, scene_index: int) -> dict[str, Any]:
        path = self._job.scenes[scene_index]
        scene = load_settled_scene(path, self._job)
        if scene is None:
            return {"scene": path.stem, "unstable": True, "moves": [], "noise": []}
        if setup not in self._studies:
            world = replace(self._job.config, cell=self._job.setups[setup])
            planner = PlannerConfig(optimize=False, time_limit=PLANNING_TIME_LIMIT)
            self._studies[setup] = FeasibilityStudy(setup, world, planner, self._job.seed)
        study = self._studies[setup]
        move_rows = study.plan_all_moves(path.stem, scene_index, scene)
        pose_error_rows = study.test_pose_errors(path.stem, scene_index, scene, move_rows)
        return {
            "scene": path.stem,
            "unstable": False,
            "moves": [asdict(r) for r in move_rows],
            "noise": [asdict(r) for r in pose_error_rows],
        }


def load_settled_scene(path: Path, job: FeasibilityJob) -> Scene | None:
    """The scene as it settles; None if it does not stay."""
    file = load_scene(path, load_catalog(job.catalog_folder))
    verdict = file.verdict or DrakeJudge(job.config).judge(file.scene, item_rng(job.seed))
    return file.scene.with_poses(verdict.settled) if verdict.stable else None


def run_feasibility_study(
    job: FeasibilityJob,
    out: Path,
    workers: int,
    progress: Callable[[Iterable[Any], int, int], Iterable[Any]],
) -> dict[str, Any]:
    """Does what of the study is not done yet; writes its tables (CSV), summary.json and report.html; returns the summary.

    Args:
        job: what to find out.
        out: a folder, new, or of the same job: that is taken up where it was left.
        workers: processes.
        progress: wraps the parts that are done, given how many were and how many there will be.

    Raises:
        InputError: a scene file that is none, or a folder that holds something else.
    """
    for path in job.scenes:
        load_scene(path, load_catalog(job.catalog_folder))
    if (out / JOB_FILE).exists():
        earlier = json.loads((out / JOB_FILE).read_text())
        if json.dumps(earlier) != json.dumps(job.to_dict()):  # the order of cameras counts, too
            raise InputError(
                f"--out {out}: holds another study, see {JOB_FILE}; give the same options or another folder"
            )
    else:
        prepare_output_directory(out)
        write_json(out / JOB_FILE, job.to_dict())
    (out / PARTS_FOLDER).mkdir(exist_ok=True)
    parts = [StudyPart(setup, number) for setup in job.setups for number in range(len(job.scenes))]
    parts += [StudyPart(setup) for setup in job.setups] + [
        StudyPart(next(iter(job.setups)), None, x) for x in BASE_GRID_X
    ]
    remaining = [part for part in parts if not (out / PARTS_FOLDER / part.file_name).exists()]
    new_results = map_ordered(partial(FeasibilityWorker, job), remaining, workers=workers)
    for part, result in zip(
        remaining, progress(new_results, len(parts) - len(remaining), len(parts)), strict=True
    ):
        write_json(out / PARTS_FOLDER / part.file_name, _nan_to_none(result))
    results = {
        part: json.loads((out / PARTS_FOLDER / part.file_name).read_text()) for part in parts
    }
    return _write_results(job, out, results)


def _nan_to_none(value: Any) -> Any:
    """JSON has neither NaN nor infinity: they are null."""
    if isinstance(value, dict):
        return {key: _nan_to_none(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_nan_to_none(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _write_results(job: FeasibilityJob, out: Path, results: dict[StudyPart, Any]) -> dict[str, Any]:
    moves = [
        row
        for part, found in results.items()
        if part.scene_index is not None
        for row in found["moves"]
    ]
    pose_errors = [
        row
        for part, found in results.items()
        if part.scene_index is not None
        for row in found["noise"]
    ]
    reach = {
        part.setup: found
        for part, found in results.items()
        if part.scene_index is None and part.base_x is None
    }
    bases = [
        row for part, found in results.items() if part.base_x is not None for row in found["bases"]
    ]
    targets = [
        {"setup": setup, **target} for setup, found in reach.items() for target in found["targets"]
    ]
    map_rows = [
        {
            "setup": setup,
            "height": z,
            "x": x,
            "y": y,
            **{name: f[name][k][i][j] for name in ("share", "manipulability")},
        }
        for setup, f in reach.items()
        for k, z in enumerate(f["heights"])
        for i, x in enumerate(f["x"])
        for j, y in enumerate(f["y"])
    ]
    tables = {
        "moves": (moves, MoveRecord),
        "noise": (pose_errors, PoseErrorRecord),
        "reach": (map_rows, None),
        "bases": (bases, None),
    }
    for name, (rows, kind) in (tables | {"targets": (targets, None)}).items():
        columns = [field.name for field in fields(kind)] if kind else list(rows[0]) if rows else []
        if columns:
            _write_csv(out / f"{name}.csv", columns, rows)
    summary = summarize_study(job, moves, pose_errors)
    summary["unstable_scenes"] = sorted(
        {f["scene"] for p, f in results.items() if p.scene_index is not None and f["unstable"]}
    )
    best = max(bases, key=lambda row: (row["share"], row["manipulability"]))
    summary["best_base"] = best
    write_json(out / "summary.json", summary)
    scenes = {path.stem: path for path in job.scenes}

    def load_scene_by_name(name: str) -> Scene:
        scene = load_settled_scene(scenes[name], job)
        assert scene is not None, "only moves of stable scenes are shown"
        return scene

    write_feasibility_report(
        out / REPORT_FILE,
        job.setups,
        moves,
        pose_errors,
        reach,
        bases,
        targets,
        summary,
        load_scene_by_name,
        job.config,
    )
    return summary


def _write_csv(path: Path, columns: Sequence[str], rows: Sequence[dict[str, Any]]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: row[key] for key in columns} for row in rows)
    write_text(path, text.getvalue())


GROUP_KEYS: dict[str, Callable[[dict[str, Any]], str]] = {
    "object_class": lambda row: row["object_class"],
    "rest": lambda row: row["rest"],
    "objects_below": lambda row: str(row["below"]),
    "top_height_cm": lambda row: (
        f"{10 * int(10 * row['pick_top'])} to {10 * int(10 * row['pick_top']) + 10}"
    ),
    "pick_from_cm": lambda row: (
        f"x {_bin_of_20_cm(row['pick_x'])}, y {_bin_of_20_cm(row['pick_y'])}"
    ),
}
"""What the moves of a summary are grouped by; places in the tray's frame, heights above its floor."""


def _bin_of_20_cm(coordinate: float) -> str:
    """The 20 cm within which a place (m) lies, in cm."""
    low = 20 * math.floor((coordinate + 0.1) / 0.2) - 10
    return f"{low} to {low + 20}"


def summarize_study(
    job: FeasibilityJob, moves: Sequence[dict[str, Any]], pose_errors: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """By setup: shares, reasons, what was planned of each of `GROUPS`; and which moves only one of two can do."""
    setups = {}
    for setup in job.setups:
        rows = [row for row in moves if row["setup"] == setup]
        planned = [row for row in rows if row["result"] == PLANNED]
        quantiles = np.quantile(
            [row["planning_s"] for row in rows if row["planning_s"] > 0] or [0.0], [0.5, 0.95, 0.99]
        ).tolist()
        setups[setup] = {
            "moves": len(rows),
            "planned": len(planned),
            "planned_share": len(planned) / len(rows) if rows else None,
            "planned_ci95": wilson_interval(len(planned), len(rows)),
            "results": dict(Counter(row["result"] for row in rows).most_common()),
            "groups": {
                group: {
                    value: {"moves": count, "planned": sum(name(row) == value for row in planned)}
                    for value, count in sorted(Counter(map(name, rows)).items())
                }
                for group, name in GROUP_KEYS.items()
            },
            "motion_s_median": float(np.median([row["motion_s"] for row in planned]))
            if planned
            else None,
            "planning_s": dict(zip(("p50", "p95", "p99"), quantiles, strict=True)),
            "holds_with_error": {
                f"{1000 * error:g} mm": [
                    sum(
                        n["result"] == "holds"
                        for n in pose_errors
                        if n["setup"] == setup and n["error"] == error
                    ),
                    sum(1 for n in pose_errors if n["setup"] == setup and n["error"] == error),
                ]
                for error in sorted({n["error"] for n in pose_errors})
            },
        }
    planned_keys = {
        (r["setup"], r["scene"], r["pick"], r["place"]) for r in moves if r["result"] == PLANNED
    }
    names, keys = list(job.setups), {(r["scene"], r["pick"], r["place"]) for r in moves}
    planned_by = {
        f"{first} and not {second}": sum(
            (first, *key) in planned_keys and (second, *key) not in planned_keys for key in keys
        )
        for first in names
        for second in names
        if first != second
    }
    return {"scenes": len(job.scenes), "setups": setups, "planned_by": planned_by}
