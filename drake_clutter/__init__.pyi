"""The public API: `drake_clutter/__init__.py` imports these names when they are first used."""

# ruff: noqa: I001 - in the order of the documentation

from .files import InputError as InputError
from .resources import resource_path as resource_path

# Objects and scenes.
from .assets.asset_builder import build_assets as build_assets
from .catalog import (
    Catalog as Catalog,
    ObjectClass as ObjectClass,
    load_catalog as load_catalog,
)
from .scenes.scene import Pose as Pose, Scene as Scene, SceneObject as SceneObject
from .scenes.scene_file import load_scene as load_scene, save_scene as save_scene
from .scenes.scene_dataset import (
    SceneDataset as SceneDataset,
    load_scene_dataset as load_scene_dataset,
)
from .export.export_folder import ExportFormat as ExportFormat, export_scene as export_scene

# The scene grammar.
from .grammar.clutter_graph import ClutterGraph as ClutterGraph
from .grammar.scene_grammar import NodeBudget as NodeBudget, SceneGrammar as SceneGrammar
from .grammar.production_rules import ProductionRule as ProductionRule
from .scenes.layout import LayoutFailure as LayoutFailure, lay_out as lay_out

# The simulated world and the work cell.
from .config import ClutterConfig as ClutterConfig, load_config as load_config
from .cell.work_cell import (
    WorkCell as WorkCell,
    default_cell as default_cell,
    load_cell as load_cell,
)
from .robots.robot_model import RobotModel as RobotModel, load_robot as load_robot

# Scene judges.
from .scenes.interfaces import SceneJudge as SceneJudge, Verdict as Verdict
from .simulation.hybrid import HybridJudge as HybridJudge
from .simulation.drake_judge import DrakeJudge as DrakeJudge
from .stability.static_judge import StaticStabilityJudge as StaticStabilityJudge

# Scene generation.
from .agents.generators import (
    GenerationAgent as GenerationAgent,
    SceneGenerator as SceneGenerator,
    make_generation_agent as make_generation_agent,
)
from .tasks.generation_task import (
    ClutterGeneration as ClutterGeneration,
    GenerationTaskConfig as GenerationTaskConfig,
)

# Exploration.
from .scenes.interfaces import (
    Detection as Detection,
    Move as Move,
    MoveResult as MoveResult,
    Observation as Observation,
    Outcome as Outcome,
    PickPlaceCommand as PickPlaceCommand,
)
from .scenes.placement import resolve_placement as resolve_placement
from .tasks.belief import Belief as Belief, Decision as Decision, Policy as Policy
from .tasks.episode import Backend as Backend, run_episode as run_episode
from .tasks.exploration_task import ExplorationTask as ExplorationTask
from .tasks.clutter_exploration import ClutterExploration as ClutterExploration
from .tasks.oracle_search import OracleSearch as OracleSearch
from .tasks.search_target import SearchTarget as SearchTarget, require_target as require_target
from .agents.backend_factory import make_backend_factory as make_backend_factory
from .agents.explorers import make_policy_factory as make_policy_factory

# Motion planning and arm simulation.
from .planning.motion_plan import (
    CellState as CellState,
    HeldObject as HeldObject,
    MotionPlan as MotionPlan,
    PlanStep as PlanStep,
    concatenate_plans as concatenate_plans,
    plan_from_steps as plan_from_steps,
    stay_at as stay_at,
)
from .planning.pick_place_plan import (
    PickPlacePlan as PickPlacePlan,
    PlanningFailure as PlanningFailure,
)
from .planning.pick_place_planner import PickPlacePlanner as PickPlacePlanner
from .planning.planner_config import PlannerConfig as PlannerConfig
from .station.arm_executor import ArmExecutor as ArmExecutor
from .station.clutter_station import ClutterStation as ClutterStation
from .station.station_simulation import StationSimulation as StationSimulation
from .feasibility.move_study import FeasibilityStudy as FeasibilityStudy
from .feasibility.setups import (
    SetupRequest as SetupRequest,
    Sweep as Sweep,
    sweep_setups as sweep_setups,
)
from .commands.feasibility_job import FeasibilityJob as FeasibilityJob
from .commands.feasibility_run import run_feasibility_study as run_feasibility_study

# Recorded episodes.
from .recording.episode_recorder import record_episode as record_episode
from .recording.exact_replay import (
    compare_samples as compare_samples,
    recorded_physics as recorded_physics,
    replay_action as replay_action,
)
from .recording.hdf5_file import load_episode as load_episode, save_episode as save_episode
from .recording.recorded_episode import (
    EpisodeHeader as EpisodeHeader,
    RecordedAction as RecordedAction,
    RecordedEpisode as RecordedEpisode,
)
from .scenes.action_samples import ActionSamples as ActionSamples
from .recording.camera_recorder import CameraChannel as CameraChannel
from .recording.formats.dataset_format import (
    DatasetFormat as DatasetFormat,
    convert_episodes as convert_episodes,
)
from .recording.randomization import RandomizationConfig as RandomizationConfig
from .commands.episode_scenes import find_scenes as find_scenes
from .commands.record_dataset import record_dataset as record_dataset
from .commands.recording_job import (
    CameraOptions as CameraOptions,
    RecordingJob as RecordingJob,
)

# The closed loop.
from .systems.closed_loop import ClosedLoop as ClosedLoop
from .systems.scenario import Scenario as Scenario

__all__: list[str]
__version__: str
