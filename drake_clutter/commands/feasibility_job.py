"""Kinematic feasibility studies, as CSV tables and a web page; parallel and resumable."""

import csv
import io
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Strict, create_model, field_validator, model_validator

from drake_clutter.catalog import load_catalog
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.cell.work_cell import WorkCell, load_cell
from drake_clutter.commands.job_file import open_job_folder
from drake_clutter.config import ClutterConfig, upgrade_cell
from drake_clutter.files import InputError, read_json, write_json, write_text
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
    CountOrZero,
    Finite,
    Flag,
    Fraction,
    Integer,
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

PARTS_FOLDER = "parts"
REPORT_FILE = "report.html"
MAP_HEIGHTS = (0.05, 0.20, 0.35, 0.50)
"""Heights of the reachability map above the floor of the support [m]."""
MAP_SPACING = 0.05
"""Grid spacing of the reachability map [m]."""
PLANNING_TIME_LIMIT = 5.0
"""Time limit for planning one move [s]."""
BASE_GRID_X = np.round(np.arange(-1.0, -0.40, 0.1), 3).tolist()
"""x of the compared base positions in the tray frame [m].

They lie on one side of the tray; the other sides of a square tray are equivalent.
"""
BASE_GRID_Y = np.round(np.arange(-0.6, 0.61, 0.2), 3).tolist()
"""y of the compared base positions in the tray frame [m]."""
_RENAMED_PART_FIELDS = {
    "noise": "pose_errors",
    "share": "reachable_fraction",
    "branches": "num_solutions",
    "in_the_way": "blocking_bodies",
    "rest": "resting_side",
    "below": "num_below",
    "about": "detail",
    "number": "failure_value",
    "attempts": "num_attempts",
    "between": "nearest_pair",
}
"""Current names of fields in part files by those that version 0.1 wrote."""


@dataclass(frozen=True)
class TargetPose:
    """Pose of the suction cup whose reachability is checked.

    Attributes:
        name: Name in the results.
        X_TG: Pose of the cup in the tray frame; z points out of the tool.
    """

    name: str
    X_TG: Pose


@dataclass(frozen=True)
class FeasibilityJob:
    """Everything that determines the results of a study.

    Attributes:
        scenes: Scene files.
        setups: Work cells by name.
        targets: Poses of the suction cup to check in addition to the moves.
        seed: Seed of placements and pose errors.
        config: Configuration; its cell is replaced by that of each setup.
        catalog_folder: Asset folder with the user's object classes, or None.
    """

    scenes: tuple[Path, ...]
    setups: dict[str, WorkCell]
    targets: tuple[TargetPose, ...]
    seed: int
    config: ClutterConfig
    catalog_folder: Path | None

    def to_dict(self) -> dict[str, Any]:
        """Return the job as a JSON document."""
        return {
            "scenes": [str(path.resolve()) for path in self.scenes],
            "setups": {name: to_plain(cell) for name, cell in self.setups.items()},
            "targets": [asdict(target) for target in self.targets],
            "seed": self.seed,
            "config": to_plain(self.config),
            "catalog_folder": str(self.catalog_folder.resolve()) if self.catalog_folder else None,
        }


def collect_scene_files(paths: Sequence[Path]) -> tuple[Path, ...]:
    """Return scene files and those of folders, in order.

    Raises:
        InputError: A folder has no scene files, or two files have the same name.
    """
    scene_paths = list[Path]()
    for path in paths:
        files = sorted(path.glob("*.yaml")) if path.is_dir() else [path]
        if not files:
            raise InputError(
                f"{path}: holds no scene files (*.yaml); give the `scenes` folder that `generate` "
                "wrote"
            )
        scene_paths += files
    check_unique_names("scenes", scene_paths)
    return tuple(scene_paths)


def check_unique_names(source: str, files: Sequence[Path]) -> None:
    """Check that file names without suffix are unique, because results are named after them.

    Args:
        source: Option that the files come from, for the message.
        files: The files.

    Raises:
        InputError: Two files have the same name.
    """
    counts = Counter(path.stem for path in files)
    if duplicates := [name for name, count in counts.items() if count > 1]:
        raise InputError(f"{source}: {duplicates[0]} occurs twice; expected unique file names")


def make_setups(
    base_poses: Sequence[list[float]],
    tray_poses: Sequence[list[float]],
    cell_files: Sequence[Path],
    default: WorkCell,
) -> dict[str, WorkCell]:
    """Return the work cells to study by name; the default cell if nothing else is given.

    Args:
        base_poses: X_TB as x, y, z [m] and yaw [deg]; roll and pitch are the default cell's.
        tray_poses: X_BT as x, y, z [m] and yaw [deg]; roll and pitch are zero.
        cell_files: YAML files whose fields replace those of the default cell. A file that names a
            robot model is a complete cell.
        default: Default cell. All cells get its support, on which the objects stand.

    Raises:
        InputError: A file cannot be used, or a robot cannot be loaded.
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
        c = math.cos(math.radians(yaw))
        s = math.sin(math.radians(yaw))
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
    """Return the cup poses of a YAML list of `{name, translation, quaternion}`.

    Raises:
        InputError: The file or one of its entries cannot be used.
    """
    content = "a list of {name: TEXT, translation: [x, y, z], quaternion: [w, x, y, z]}"
    entries = validate(tuple[_TargetEntry, ...], read_yaml(path, content), str(path))
    return tuple(
        TargetPose(entry.name, Pose(entry.translation, entry.quaternion)) for entry in entries
    )


@dataclass(frozen=True)
class StudyPart:
    """Part of a study whose result is one file.

    A part with a scene plans the moves in it; a part with a base position scores base positions;
    any other part computes the reachability map and checks the target poses.

    Attributes:
        setup: Name of the work cell.
        scene_index: Index of the scene, or None.
        base_x: x of the base positions in the tray frame, or None [m].
    """

    setup: str
    scene_index: int | None = None
    base_x: float | None = None

    @property
    def file_name(self) -> str:
        """Name of the file with the result."""
        content = "reach" if self.scene_index is None else f"scene_{self.scene_index:04d}"
        return f"{self.setup}__{content if self.base_x is None else f'bases_{self.base_x:g}'}.json"


class FeasibilityWorker:
    """Computes parts of a study, in a worker process."""

    def __init__(self, job: FeasibilityJob) -> None:
        """Create a worker of a job."""
        self._job = job
        self._studies: dict[str, FeasibilityStudy] = {}

    def __call__(self, part: StudyPart) -> dict[str, Any]:
        """Return the result of a part as a JSON document."""
        cell = self._job.setups[part.setup]
        if part.base_x is not None:
            positions = [(part.base_x, y) for y in BASE_GRID_Y]
            scores = zip(positions, score_base_positions(cell, positions), strict=True)
            return {
                "bases": [
                    {"x": x, "y": y, "reachable_fraction": fraction, "manipulability": best}
                    for (x, y), (fraction, best) in scores
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
            X_TG = np.eye(4)
            X_TG[:3, :3] = target.X_TG.rotation
            X_TG[:3, 3] = target.X_TG.p
            result = reachability.analyze_poses(X_TG[None])
            targets.append(
                {
                    "target": target.name,
                    "num_solutions": int(result.num_solutions[0]),
                    "manipulability": float(result.manipulability[0]),
                    "q": result.q[0].tolist() if result.num_solutions[0] else None,
                    "blocking_bodies": result.blocking_bodies[0],
                }
            )
        return {
            "x": reachability_map.x.tolist(),
            "y": reachability_map.y.tolist(),
            "heights": list(reachability_map.heights),
            "reachable_fraction": reachability_map.reachable_fraction.tolist(),
            "manipulability": reachability_map.manipulability.tolist(),
            "targets": targets,
        }

    def _plan_moves(self, setup: str, scene_index: int) -> dict[str, Any]:
        path = self._job.scenes[scene_index]
        scene = load_settled_scene(path, self._job)
        if scene is None:
            return {"scene": path.stem, "unstable": True, "moves": [], "pose_errors": []}
        if setup not in self._studies:
            config = replace(self._job.config, cell=self._job.setups[setup])
            planner = PlannerConfig(optimize=False, time_limit=PLANNING_TIME_LIMIT)
            self._studies[setup] = FeasibilityStudy(setup, config, planner, self._job.seed)
        study = self._studies[setup]
        move_rows = study.plan_all_moves(path.stem, scene_index, scene)
        pose_error_rows = study.evaluate_pose_errors(path.stem, scene_index, scene, move_rows)
        return {
            "scene": path.stem,
            "unstable": False,
            "moves": [asdict(row) for row in move_rows],
            "pose_errors": [asdict(row) for row in pose_error_rows],
        }


def load_settled_scene(path: Path, job: FeasibilityJob) -> Scene | None:
    """Return a scene at its settled poses; None if it is unstable."""
    file = load_scene(path, load_catalog(job.catalog_folder))
    verdict = file.verdict or DrakeJudge(job.config).judge(file.scene, item_rng(job.seed))
    return file.scene.with_poses(verdict.settled) if verdict.stable else None


def run_feasibility_study(
    job: FeasibilityJob,
    out: Path,
    workers: int,
    progress: Callable[[Iterable[Any], int, int], Iterable[Any]],
) -> dict[str, Any]:
    """Compute the missing parts of a study; write CSV tables, `summary.json` and `report.html`.

    Args:
        job: The study.
        out: Output folder: new, empty, or of the same job.
        workers: Number of worker processes.
        progress: Wraps the results of the missing parts, given the number of existing parts and
            the number of all parts.

    Returns:
        The summary.

    Raises:
        InputError: A scene file cannot be used, or the folder holds other results.
    """
    for path in job.scenes:
        load_scene(path, load_catalog(job.catalog_folder))
    parts = [StudyPart(setup, index) for setup in job.setups for index in range(len(job.scenes))]
    parts += [StudyPart(setup) for setup in job.setups]
    parts += [StudyPart(next(iter(job.setups)), None, x) for x in BASE_GRID_X]
    with open_job_folder(out, job.to_dict()):
        folder = out / PARTS_FOLDER
        folder.mkdir(exist_ok=True)
        missing = [part for part in parts if not (folder / part.file_name).exists()]
        results = map_ordered(partial(FeasibilityWorker, job), missing, workers=workers)
        shown = progress(results, len(parts) - len(missing), len(parts))
        for part, result in zip(missing, shown, strict=True):
            write_json(folder / part.file_name, _nan_to_none(result))
        return _write_results(job, out, {part: load_part(folder, part) for part in parts})


@cache
def _rows_schema(record: type[MoveRecord] | type[PoseErrorRecord]) -> Any:
    """Return the schema of rows in a part file, where null stands for NaN."""
    types: dict[Any, Any] = {
        str: Annotated[str, Strict()],
        int: Integer,
        float: Finite | None,
    }
    columns: dict[str, Any] = {
        # Parts written by earlier versions have no tool.
        field.name: (types[field.type], "" if field.name == "tool" else ...)
        for field in fields(record)
    }
    row = create_model(record.__name__, __base__=StrictModel, **columns)
    return tuple[row, ...]  # type: ignore[valid-type]


class _ScenePart(StrictModel):
    """Moves that were planned in one scene."""

    scene: NonEmptyText
    unstable: Flag
    moves: tuple[Any, ...]
    pose_errors: tuple[Any, ...]


class _BaseRow(StrictModel):
    """Score of one base position."""

    x: Finite
    y: Finite
    reachable_fraction: Fraction
    manipulability: Finite | None


class _BasePart(StrictModel):
    """Scores of base positions."""

    bases: tuple[_BaseRow, ...]


class _TargetRow(StrictModel):
    """Result of one target pose."""

    target: NonEmptyText
    num_solutions: CountOrZero
    manipulability: Finite | None
    q: tuple[Finite, ...] | None
    blocking_bodies: Annotated[str, Strict()]


class _ReachPart(StrictModel):
    """Reachability map, by height, x and y, and results of the target poses."""

    x: tuple[Finite, ...]
    y: tuple[Finite, ...]
    heights: tuple[Finite, ...]
    reachable_fraction: tuple[tuple[tuple[Finite | None, ...], ...], ...]
    manipulability: tuple[tuple[tuple[Finite | None, ...], ...], ...]
    targets: tuple[_TargetRow, ...]

    @model_validator(mode="after")
    def _check_shape(self) -> Self:
        shape = (len(self.heights), len(self.x), len(self.y))
        for grid in (self.reachable_fraction, self.manipulability):
            lengths = {(len(grid), len(plane), len(row)) for plane in grid for row in plane}
            if lengths != {shape}:
                raise allowed_error("grids of one value for each height, x and y")
        return self


def load_part(folder: Path, part: StudyPart) -> Any:
    """Return the result of a part.

    Args:
        folder: Folder of the part files.
        part: The part.

    Raises:
        InputError: The file cannot be read, or a field has a value that is not allowed.
    """
    path = folder / part.file_name
    result = _read_part(path)
    if part.scene_index is not None:
        rows = validate(_ScenePart, result, str(path))
        validate(_rows_schema(MoveRecord), rows.moves, f"{path}: moves")
        validate(_rows_schema(PoseErrorRecord), rows.pose_errors, f"{path}: pose_errors")
    elif part.base_x is not None:
        validate(_BasePart, result, str(path))
    else:
        validate(_ReachPart, result, str(path))
    return result


def _read_part(path: Path) -> Any:
    """Return the result of a part with the field names of this version."""
    return _with_current_names(read_json(path, "a part of a feasibility study"))


def _with_current_names(value: Any) -> Any:
    """Return a document with the field names of this version."""
    if isinstance(value, dict):
        return {
            _RENAMED_PART_FIELDS.get(key, key): _with_current_names(item)
            for key, item in value.items()
        }
    return [_with_current_names(item) for item in value] if isinstance(value, list) else value


def _nan_to_none(value: Any) -> Any:
    """Return a document with null in place of NaN and infinity, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _nan_to_none(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_nan_to_none(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _write_results(
    job: FeasibilityJob, out: Path, results: Mapping[StudyPart, Any]
) -> dict[str, Any]:
    """Write the tables, the summary and the report from the results of all parts."""
    scene_results = [r for part, r in results.items() if part.scene_index is not None]
    moves = [row for result in scene_results for row in result["moves"]]
    pose_errors = [row for result in scene_results for row in result["pose_errors"]]
    maps = {
        part.setup: result
        for part, result in results.items()
        if part.scene_index is None and part.base_x is None
    }
    bases = [
        row
        for part, result in results.items()
        if part.base_x is not None
        for row in result["bases"]
    ]
    targets = [
        {"setup": setup, **target} for setup, result in maps.items() for target in result["targets"]
    ]
    map_rows = [
        {
            "setup": setup,
            "height": z,
            "x": x,
            "y": y,
            **{name: result[name][k][i][j] for name in ("reachable_fraction", "manipulability")},
        }
        for setup, result in maps.items()
        for k, z in enumerate(result["heights"])
        for i, x in enumerate(result["x"])
        for j, y in enumerate(result["y"])
    ]
    _write_csv(out / "moves.csv", moves, [field.name for field in fields(MoveRecord)])
    _write_csv(
        out / "pose_errors.csv", pose_errors, [field.name for field in fields(PoseErrorRecord)]
    )
    _write_csv(out / "reach.csv", map_rows)
    _write_csv(out / "bases.csv", bases)
    _write_csv(out / "targets.csv", targets)
    summary = summarize_study(job, moves, pose_errors)
    summary["unstable_scenes"] = sorted({r["scene"] for r in scene_results if r["unstable"]})
    summary["best_base"] = max(
        bases, key=lambda row: (row["reachable_fraction"], row["manipulability"])
    )
    write_json(out / "summary.json", summary)
    paths = {path.stem: path for path in job.scenes}

    def load_scene_by_name(name: str) -> Scene:
        scene = load_settled_scene(paths[name], job)
        assert scene is not None, "moves exist only for stable scenes"
        return scene

    write_feasibility_report(
        out / REPORT_FILE,
        job.setups,
        moves,
        pose_errors,
        maps,
        bases,
        targets,
        summary,
        load_scene_by_name,
    )
    return summary


def _write_csv(
    path: Path, rows: Sequence[Mapping[str, Any]], columns: Sequence[str] | None = None
) -> None:
    """Write a table with given columns or those of the first row; nothing without columns."""
    columns = columns or (list(rows[0]) if rows else [])
    if not columns:
        return
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: row[key] for key in columns} for row in rows)
    write_text(path, text.getvalue())


GROUP_KEYS: dict[str, Callable[[Mapping[str, Any]], str]] = {
    "object_class": lambda row: row["object_class"],
    "resting_side": lambda row: row["resting_side"],
    "objects_below": lambda row: str(row["num_below"]),
    "top_height_cm": lambda row: (
        f"{10 * int(10 * row['pick_top'])} to {10 * int(10 * row['pick_top']) + 10}"
    ),
    "pick_from_cm": lambda row: (
        f"x {_bin_of_20_cm(row['pick_x'])}, y {_bin_of_20_cm(row['pick_y'])}"
    ),
}
"""Groups of moves in a summary: by name, the function that returns a move's group.

Positions are in the tray frame, heights above its floor.
"""


def _bin_of_20_cm(coordinate: float) -> str:
    """Return the interval of 20 cm that contains a coordinate in m, as text in cm."""
    low = 20 * math.floor((coordinate + 0.1) / 0.2) - 10
    return f"{low} to {low + 20}"


def summarize_study(
    job: FeasibilityJob,
    moves: Sequence[Mapping[str, Any]],
    pose_errors: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """Return statistics of each setup, and how many moves only one of two setups can plan.

    Args:
        job: The study.
        moves: Rows of `moves.csv`.
        pose_errors: Rows of `pose_errors.csv`.
    """
    planned_keys = {
        (row["setup"], row["scene"], row["pick"], row["place"])
        for row in moves
        if row["result"] == PLANNED
    }
    keys = {(row["scene"], row["pick"], row["place"]) for row in moves}
    planned_by = {
        f"{first} and not {second}": sum(
            (first, *key) in planned_keys and (second, *key) not in planned_keys for key in keys
        )
        for first in job.setups
        for second in job.setups
        if first != second
    }
    setups = {
        setup: _summarize_setup(
            [row for row in moves if row["setup"] == setup],
            [row for row in pose_errors if row["setup"] == setup],
        )
        for setup in job.setups
    }
    return {"scenes": len(job.scenes), "setups": setups, "planned_by": planned_by}


def _summarize_setup(
    moves: Sequence[Mapping[str, Any]], pose_errors: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Return the statistics of one setup from its rows."""
    planned = [row for row in moves if row["result"] == PLANNED]
    planning_times = [row["planning_s"] for row in moves if row["planning_s"] > 0] or [0.0]
    quantiles = np.quantile(planning_times, [0.5, 0.95, 0.99]).tolist()
    motion_durations = [row["motion_s"] for row in planned]
    return {
        "moves": len(moves),
        "planned": len(planned),
        "planned_fraction": len(planned) / len(moves) if moves else None,
        "planned_ci95": wilson_interval(len(planned), len(moves)),
        "results": dict(Counter(row["result"] for row in moves).most_common()),
        "groups": {
            group: {
                value: {"moves": count, "planned": sum(key(row) == value for row in planned)}
                for value, count in sorted(Counter(map(key, moves)).items())
            }
            for group, key in GROUP_KEYS.items()
        },
        "median_motion_duration_s": float(np.median(motion_durations)) if planned else None,
        "planning_time_s": dict(zip(("p50", "p95", "p99"), quantiles, strict=True)),
        "pose_errors": {
            f"{1000 * error:g} mm": {
                "plans": sum(row["error"] == error for row in pose_errors),
                "valid": sum(
                    row["error"] == error and row["result"] == "holds" for row in pose_errors
                ),
            }
            for error in sorted({row["error"] for row in pose_errors})
        },
    }
