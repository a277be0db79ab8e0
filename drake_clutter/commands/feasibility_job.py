"""Kinematic feasibility studies, as tables and a web page; parallel and resumable."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pydantic import field_validator

from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.cell.work_cell import WorkCell, load_cell
from drake_clutter.config import ClutterConfig, upgrade_cell
from drake_clutter.feasibility.setups import SetupRequest, Sweep
from drake_clutter.files import InputError, file_sha256
from drake_clutter.scenes.scene import Pose
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
from drake_clutter.yaml_io import read_yaml


@dataclass(frozen=True)
class TargetPose:
    """Pose of the first tool whose reachability is checked.

    Attributes:
        name: Name in the results.
        X_TG: Pose of the tool in the tray frame; z points out of the tool.
    """

    name: str
    X_TG: Pose


@dataclass(frozen=True)
class FeasibilityJob:
    """Everything that determines the results of a study.

    Attributes:
        scenes: Scene files.
        setups: Work cells by name.
        searches: Fields whose best values are searched, from the first work cell.
        targets: Poses of the first tool to check in addition to the moves.
        draws_maps: Whether reachability maps are computed.
        noisy_moves: Number of moves of each scene and setup that are simulated with errors.
        agent: Exploration policy that searches each scene to the end; None for no searches.
        simulate: Whether the motions of searches are simulated.
        seed: Seed of placements, errors and searches.
        config: Configuration; its cell is replaced by that of each setup.
        catalog_folder: Asset folder with the user's object classes, or None.
    """

    scenes: tuple[Path, ...]
    setups: Mapping[str, SetupRequest]
    searches: tuple[Sweep, ...] = ()
    targets: tuple[TargetPose, ...] = ()
    draws_maps: bool = True
    noisy_moves: int = 0
    agent: str | None = None
    simulate: bool = False
    seed: int = 0
    config: ClutterConfig = field(default_factory=ClutterConfig)
    catalog_folder: Path | None = None

    @property
    def reference(self) -> WorkCell:
        """Work cell whose base is searched."""
        return next(iter(self.setups.values())).cell

    def to_dict(self) -> dict[str, Any]:
        """Return the job as a JSON document."""
        return {
            "scenes": {str(path.resolve()): file_sha256(path) for path in self.scenes},
            "setups": {name: to_plain(setup.cell) for name, setup in self.setups.items()},
            "searched_homes": [n for n, setup in self.setups.items() if not setup.keep_home],
            "searches": [asdict(search) for search in self.searches],
            "targets": [asdict(target) for target in self.targets],
            "draws_maps": self.draws_maps,
            "noisy_moves": self.noisy_moves,
            "agent": self.agent,
            "simulate": self.simulate,
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
) -> dict[str, SetupRequest]:
    """Return the work cells to study by name; the default cell if nothing else is given.

    A cell file keeps its home where that is clear; for another base it is searched.

    Args:
        base_poses: X_TB as x, y, z [m] and yaw [deg]; roll and pitch are the default cell's.
        tray_poses: X_BT as x, y, z [m] and yaw [deg]; roll and pitch are zero.
        cell_files: YAML files whose fields replace those of the default cell. A file that names a
            robot model is a complete cell.
        default: Default cell. All cells get its support, on which the objects stand.

    Raises:
        InputError: A file cannot be used.
    """
    cells = {
        path.stem: SetupRequest(
            _load_setup_cell(path, default).with_support(default.support), keep_home=True
        )
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
    return cells or {"default": SetupRequest(default, keep_home=True)}


def _load_setup_cell(path: Path, default: WorkCell) -> WorkCell:
    document = read_yaml(path, "a mapping of a cell's fields")
    robot = document.get("robot") if isinstance(document, dict) else None
    if not isinstance(robot, dict) or "model" not in robot:
        return load_config_as(default, path, upgrade=upgrade_cell)
    return load_cell(path)


def _with_base(cell: WorkCell, base: PoseSpec) -> SetupRequest:
    robot = cell.robot.model_copy(update={"base": base})
    return SetupRequest(cell.model_copy(update={"robot": robot}), keep_home=False)


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
    """Return the tool poses of a YAML list of `{name, translation, quaternion}`.

    Raises:
        InputError: The file or one of its entries cannot be used.
    """
    content = "a list of {name: TEXT, translation: [x, y, z], quaternion: [w, x, y, z]}"
    entries = validate(tuple[_TargetEntry, ...], read_yaml(path, content), str(path))
    return tuple(
        TargetPose(entry.name, Pose(entry.translation, entry.quaternion)) for entry in entries
    )
