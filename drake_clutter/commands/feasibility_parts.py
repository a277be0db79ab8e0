"""Parts of a feasibility study: each is computed by a worker, and is one file."""

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Strict, create_model, model_validator

from drake_clutter.catalog import load_catalog
from drake_clutter.cell.camera import Camera
from drake_clutter.commands.feasibility_job import FeasibilityJob
from drake_clutter.feasibility.base_search import BaseGrid, find_reachable_moves, make_base_grids
from drake_clutter.feasibility.home_search import Home
from drake_clutter.feasibility.inverse_reachability import (
    InverseReachabilityMap,
    build_inverse_reachability,
    load_inverse_reachability,
    save_inverse_reachability,
)
from drake_clutter.feasibility.move_study import (
    MAX_OPTIMIZED_MOVES,
    FeasibilityStudy,
    LegalMove,
    MoveRecord,
    find_legal_moves,
)
from drake_clutter.feasibility.pose_noise import NoiseRecord, NoiseStudy
from drake_clutter.feasibility.reach_map import TILTS_DEG, ReachabilityAnalysis
from drake_clutter.feasibility.sequences import SequenceRecord, search_scene
from drake_clutter.feasibility.setups import Setup, SetupRequest, UnusableSetup, prepare_setup
from drake_clutter.files import read_json
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.scenes.scene import Scene
from drake_clutter.scenes.scene_file import load_scene
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.validation import (
    CountOrZero,
    Finite,
    Flag,
    Integer,
    NonEmptyText,
    StrictModel,
    allowed_error,
    validate,
)

NUM_OPTIMIZED_MOVES = 100
"""Number of moves of a setup whose motions are optimized, at most `MAX_OPTIMIZED_MOVES` of a scene
and at least one: the cycle time of a move takes three times as long as its plan."""
MAP_HEIGHTS = (0.05, 0.20, 0.35, 0.50)
"""Heights of the reachability maps above the floor of the support [m]."""
MAP_SPACING = 0.1
"""Grid spacing of the reachability maps [m]."""
_Text = Annotated[str, Strict()]


class PartKind(Enum):
    """Kinds of parts.

    Attributes:
        MAP: Inverse reachability of the robot with a tool, of one grid of bases.
        BASES: How many moves of one scene each base of a grid reaches.
        SETUP: The home of one setup.
        REACH: Reachability maps and target poses of one setup.
        MOVES: Moves of one scene with one setup, and their simulations with errors.
        SEQUENCE: Search of one scene with one setup.
    """

    MAP = "map"
    BASES = "bases"
    SETUP = "setup"
    REACH = "reach"
    MOVES = "moves"
    SEQUENCE = "sequence"


@dataclass(frozen=True)
class StudyPart:
    """Part of a study whose result is one file.

    Attributes:
        kind: What is computed.
        index: Index of the setup, or of the grid of bases.
        scene_index: Index of the scene; None for parts without one.
        setup: The setup, for parts of one.
    """

    kind: PartKind
    index: int
    scene_index: int | None = None
    setup: Setup | SetupRequest | None = field(default=None, compare=False)

    @property
    def file_name(self) -> str:
        """Name of the file with the result."""
        scene = "" if self.scene_index is None else f"_scene_{self.scene_index:04d}"
        return f"{self.kind.value}_{self.index:04d}{scene}.json"


class FeasibilityWorker:
    """Computes parts of a study, in a worker process."""

    def __init__(self, job: FeasibilityJob, names: tuple[str, ...], folder: Path) -> None:
        """Create a worker.

        Args:
            job: The study.
            names: Names of the setups.
            folder: Folder of the parts, for the maps.
        """
        self._job = job
        self._names = names
        self._folder = folder
        self._studies: dict[int, FeasibilityStudy] = {}
        self._load_scene = cache(lambda index: load_settled_scene(job.scenes[index], job))
        self._legal_moves = cache(self._find_legal_moves)  # the same for all arms
        self._grids = cache(lambda: make_base_grids(job.reference, job.searches))
        self._maps = cache(self._load_maps)

    def __call__(self, part: StudyPart) -> dict[str, Any]:
        """Return the result of a part as a JSON document."""
        match part.kind:
            case PartKind.MAP:
                return self._build_maps(part.index)
            case PartKind.SETUP:
                assert isinstance(part.setup, SetupRequest)
                return _setup_to_dict(prepare_setup(self._names[part.index], part.setup))
            case PartKind.REACH:
                assert isinstance(part.setup, Setup)
                return self._analyze_reachability(part.setup)
        assert part.scene_index is not None
        path = self._job.scenes[part.scene_index]
        scene: Scene | None = self._load_scene(part.scene_index)
        if scene is None:
            return {"scene": path.stem, "unstable": True}
        found: dict[str, Any] = {"scene": path.stem, "unstable": False}
        if part.kind is PartKind.BASES:
            return found | self._count_reachable(part, scene)
        assert isinstance(part.setup, Setup)
        config = replace(self._job.config, cell=part.setup.cell)
        if part.kind is PartKind.MOVES:
            return found | self._plan_moves(part, scene, part.setup)
        assert self._job.agent is not None
        record = search_scene(
            part.setup.name,
            path.stem,
            scene,
            config,
            self._job.agent,
            simulate=self._job.simulate,
            seed=self._job.seed,
        )
        return found | {"sequence": asdict(record)}

    def _find_legal_moves(self, scene_index: int, camera: Camera) -> tuple[LegalMove, ...]:
        scene: Scene | None = self._load_scene(scene_index)
        assert scene is not None, "moves exist only for stable scenes"
        detector = LabelDetector(camera)
        return find_legal_moves(scene, detector, self._job.config, self._job.seed, scene_index)

    def _build_maps(self, index: int) -> dict[str, Any]:
        grid: BaseGrid = self._grids()[index]
        for tool in grid.cell.gripper.tools:
            reachability = build_inverse_reachability(grid.cell, tool)
            save_inverse_reachability(self._map_path(index, tool), reachability)
        return {"tools": [*grid.cell.gripper.tools]}

    def _map_path(self, index: int, tool: str) -> Path:
        safe = re.sub(r"\W", "_", tool)
        return self._folder / f"{PartKind.MAP.value}_{index:04d}_{safe}.npz"

    def _load_maps(self, index: int) -> dict[str, InverseReachabilityMap]:
        tools = self._grids()[index].cell.gripper.tools
        return {tool: load_inverse_reachability(self._map_path(index, tool)) for tool in tools}

    def _count_reachable(self, part: StudyPart, scene: Scene) -> dict[str, Any]:
        assert part.scene_index is not None
        grid: BaseGrid = self._grids()[part.index]
        legal = self._legal_moves(part.scene_index, grid.cell.camera)
        found = find_reachable_moves(grid, self._maps(part.index), scene, legal)
        possible = [reaches for reaches in found if reaches is not None]
        counts = np.sum(possible, axis=0, dtype=int) + np.zeros(len(grid.bases), int)
        return {"possible": len(possible), "reachable": counts.tolist()}

    def _analyze_reachability(self, setup: Setup) -> dict[str, Any]:
        analysis = ReachabilityAnalysis(setup.cell)
        reach = analysis.compute_map(TILTS_DEG, MAP_HEIGHTS, MAP_SPACING)
        targets = []
        for target in self._job.targets:
            X_TG = np.eye(4)
            X_TG[:3, :3] = target.X_TG.rotation
            X_TG[:3, 3] = target.X_TG.p
            found = analysis.analyze_poses(X_TG[None])
            targets.append(
                {
                    "setup": setup.name,
                    "target": target.name,
                    "num_solutions": int(found.num_solutions[0]),
                    "reachable": bool(found.is_reachable[0]),
                    "singular_value": float(found.singular_value[0]),
                    "q": found.q[0].tolist() if found.is_reachable[0] else None,
                    "obstacles": found.obstacles[0],
                }
            )
        return {
            "tilts_deg": list(reach.tilts_deg),
            "heights": list(reach.heights),
            "x": reach.x.tolist(),
            "y": reach.y.tolist(),
            "reachable_fraction": reach.reachable_fraction.tolist(),
            "singular_value": reach.singular_value.tolist(),
            "targets": targets,
        }

    def _plan_moves(self, part: StudyPart, scene: Scene, setup: Setup) -> dict[str, Any]:
        assert part.scene_index is not None
        name = self._job.scenes[part.scene_index].stem
        config = replace(self._job.config, cell=setup.cell)
        if part.index not in self._studies:
            # One study at a time: its planner holds a collision model.
            self._studies = {part.index: FeasibilityStudy(setup.name, config, self._job.seed)}
        legal = self._legal_moves(part.scene_index, setup.cell.camera)
        moves = self._studies[part.index].plan_moves(
            name, part.scene_index, scene, legal, max_optimized_moves(len(self._job.scenes))
        )
        noise = NoiseStudy(setup.name, config, self._job.seed).simulate_moves(
            name, part.scene_index, scene, moves, self._job.noisy_moves
        )
        return {"moves": [asdict(row) for row in moves], "noise": [asdict(row) for row in noise]}


def max_optimized_moves(num_scenes: int) -> int:
    """Return the number of moves of a scene whose motions are optimized, for their cycle times."""
    return max(1, min(MAX_OPTIMIZED_MOVES, -(-NUM_OPTIMIZED_MOVES // num_scenes)))


def load_settled_scene(path: Path, job: FeasibilityJob) -> Scene | None:
    """Return a scene at its settled poses; None if it is unstable."""
    file = load_scene(path, load_catalog(job.catalog_folder))
    verdict = file.verdict or DrakeJudge(job.config).judge(file.scene, item_rng(job.seed))
    return file.scene.with_poses(verdict.settled) if verdict.stable else None


def _setup_to_dict(setup: Setup | UnusableSetup) -> dict[str, Any]:
    if isinstance(setup, UnusableSetup):
        return {"unusable": setup.reason, "home": None}
    return {"unusable": None, "home": asdict(setup.home)}


class _HomeDocument(StrictModel):
    """Home of a setup."""

    q: tuple[Finite, ...]
    is_given: Flag
    obstacle: _Text


class _SetupPart(StrictModel):
    """Home of a setup, or why there is none."""

    unusable: _Text | None
    home: _HomeDocument | None

    @model_validator(mode="after")
    def _check_alternative(self) -> Self:
        if (self.unusable is None) == (self.home is None):
            raise allowed_error("either a home or a reason")
        return self


class _MapPart(StrictModel):
    """Tools whose inverse reachability maps are files."""

    tools: tuple[NonEmptyText, ...]


class _BasesPart(StrictModel):
    """Numbers of moves of a scene that bases reach."""

    scene: NonEmptyText
    unstable: Flag
    possible: CountOrZero = 0
    reachable: tuple[CountOrZero, ...] = ()


class _TargetRow(StrictModel):
    """Result of one target pose."""

    setup: NonEmptyText
    target: NonEmptyText
    num_solutions: CountOrZero
    reachable: Flag
    singular_value: Finite
    q: tuple[Finite, ...] | None
    obstacles: _Text


_Grid = tuple[tuple[tuple[tuple[Finite, ...], ...], ...], ...]


class _ReachPart(StrictModel):
    """Reachability maps, by tilt, height, x and y, and results of the target poses."""

    tilts_deg: tuple[Finite, ...]
    heights: tuple[Finite, ...]
    x: tuple[Finite, ...]
    y: tuple[Finite, ...]
    reachable_fraction: _Grid
    singular_value: _Grid
    targets: tuple[_TargetRow, ...]

    @model_validator(mode="after")
    def _check_shape(self) -> Self:
        shape = tuple(map(len, (self.tilts_deg, self.heights, self.x, self.y)))
        for grid in (self.reachable_fraction, self.singular_value):
            lengths = {
                (len(grid), len(tilt), len(plane), len(row))
                for tilt in grid
                for plane in tilt
                for row in plane
            }
            if lengths != {shape}:
                raise allowed_error("grids of one value for each tilt, height, x and y")
        return self


class _ScenePart(StrictModel):
    """Moves of a scene."""

    scene: NonEmptyText
    unstable: Flag
    moves: tuple[Any, ...] = ()
    noise: tuple[Any, ...] = ()


class _SequencePart(StrictModel):
    """Search of a scene."""

    scene: NonEmptyText
    unstable: Flag
    sequence: Any = None


_SCHEMAS: Mapping[PartKind, type[StrictModel]] = {
    PartKind.MAP: _MapPart,
    PartKind.BASES: _BasesPart,
    PartKind.SETUP: _SetupPart,
    PartKind.REACH: _ReachPart,
    PartKind.MOVES: _ScenePart,
    PartKind.SEQUENCE: _SequencePart,
}


@cache
def _row_schema(record: type[MoveRecord] | type[NoiseRecord] | type[SequenceRecord]) -> Any:
    """Return the schema of rows in a part file, where null stands for NaN."""
    types: dict[Any, Any] = {
        str: _Text,
        bool: Flag,
        int: Integer,
        float: Finite | None,
    }
    columns: dict[str, Any] = {column.name: (types[column.type], ...) for column in fields(record)}
    return create_model(record.__name__, __base__=StrictModel, **columns)


def load_part(folder: Path, part: StudyPart) -> Any:
    """Return the result of a part.

    Args:
        folder: Folder of the part files.
        part: The part.

    Raises:
        InputError: The file cannot be read, or a field has a value that is not allowed.
    """
    path = folder / part.file_name
    result = read_json(path, "a part of a feasibility study")
    checked: Any = validate(_SCHEMAS[part.kind], result, str(path))
    if part.kind is PartKind.MOVES:
        for name, record in (("moves", MoveRecord), ("noise", NoiseRecord)):
            rows: Any = tuple[_row_schema(record), ...]  # type: ignore[misc]
            validate(rows, getattr(checked, name), f"{path}: {name}")
    if part.kind is PartKind.SEQUENCE and not checked.unstable:
        validate(_row_schema(SequenceRecord), checked.sequence, f"{path}: sequence")
    return result


def setup_from_dict(
    name: str, request: SetupRequest, document: Mapping[str, Any]
) -> Setup | UnusableSetup:
    """Return a setup from the result of its part.

    Args:
        name: Name of the setup.
        request: Its work cell.
        document: Result of the part.
    """
    if document["home"] is None:
        return UnusableSetup(name, document["unusable"])
    home = Home(**{**document["home"], "q": tuple(document["home"]["q"])})
    robot = request.cell.robot.model_copy(update={"home": home.q})
    return Setup(name, request.cell.model_copy(update={"robot": robot}), home)
