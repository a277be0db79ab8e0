"""Every number that the simulated world leaves open, in one place; `docs/calibration.md` argues the defaults."""

from collections.abc import Sequence
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any

from drake_clutter.cell.work_cell import WorkCell, default_cell
from drake_clutter.validation import (
    InRange,
    NonNegative,
    config_class,
    load_config_as,
    override_config,
    to_plain,
)


@config_class
class LayoutConfig:
    """How a graph becomes poses on the support.

    Attributes:
        stack_gap: Least distance between the footprints of two stacks, and of a stack and the rim [m].
        max_stack_height: A higher stack is a typed failure [m].
        lying_gap: Between the two objects of a lying pair [m].
        standing_gap: Between the two objects of a standing pair [m].
        placement_tries: Draws of a stack's place before the layout starts anew, and of new starts.
    """

    stack_gap: NonNegative = 0.010
    max_stack_height: NonNegative = 0.50
    lying_gap: NonNegative = 0.002
    standing_gap: NonNegative = 0.050
    placement_tries: Annotated[int, InRange(1)] = 100


@config_class
class SettleConfig:
    """How Drake settles a scene and what counts as stable.

    Contact properties belong to the assets: see `drake_clutter.assets.contact`.

    Attributes:
        time_step: Of the simulation [s].
        jitter: Radius of the disc from which each object's random xy offset is drawn [m].
        max_displacement: A stable object's origin moves less [m].
        max_tilt_deg: A stable object turns less (a body of revolution: its axis) [deg].
        max_time: Simulated at most [s].
        rest_drift: What went further in the last 0.5 s is not at rest [m]. Contact chatter and a marker that rocks on
            the facets of its contact mesh stay below it.
        calm_speed: A stack is calm while every object is below this speed [m/s], and the next two limits.
        calm_displacement: Since the start [m].
        calm_tilt_deg: Since the start [deg].
        calm_samples: Calm samples in a row, 0.05 s apart, that end the simulation early.
        still_displacement: Half a second in which no object was further than this from where it is [m], or turned by
            calm_tilt_deg, ends it too: light objects under heavy ones chatter, and are never calm.
    """

    time_step: Annotated[float, InRange(1e-4, 0.02)] = 0.002
    jitter: NonNegative = 0.001
    max_displacement: NonNegative = 0.010
    max_tilt_deg: NonNegative = 8.0
    max_time: Annotated[float, InRange(0.1, 60.0)] = 2.0
    rest_drift: NonNegative = 0.0025
    calm_speed: NonNegative = 0.0003
    calm_displacement: NonNegative = 0.001
    calm_tilt_deg: NonNegative = 0.3
    calm_samples: Annotated[int, InRange(1)] = 4
    still_displacement: NonNegative = 0.0005


@config_class
class ExplorationConfig:
    """The exploration task.

    Attributes:
        max_moves: Moves after which an episode ends.
        detection_reward: Per newly detected object.
        collapse_penalty: Added when a move makes the scene collapse, which ends the episode.
        clearance: Kept between a placed object's footprint and anything else that the camera sees in the way [m].
        release_height: Above its support, at which a placed object is let go [m].
    """

    max_moves: Annotated[int, InRange(1)] = 10
    detection_reward: NonNegative = 1.0
    collapse_penalty: Annotated[float, InRange(-1e300, 0.0)] = -1.0
    clearance: NonNegative = 0.010
    release_height: NonNegative = 0.001


@config_class
class ClutterConfig:
    """The whole simulated world.

    Attributes:
        layout: How a graph becomes poses.
        settle: What counts as stable.
        exploration: The exploration task.
        cell: Robot, gripper, support, cameras and fixtures.
    """

    layout: LayoutConfig = field(default_factory=LayoutConfig)
    settle: SettleConfig = field(default_factory=SettleConfig)
    exploration: ExplorationConfig = field(default_factory=ExplorationConfig)
    cell: WorkCell = field(default_factory=default_cell)


def load_config(path: Path | None = None, settings: Sequence[str] = ()) -> ClutterConfig:
    """Return the simulated world, see `load_config_as`."""
    return load_config_as(ClutterConfig(), path, settings, upgrade)


def upgrade(given: Any) -> Any:
    """Return a document with the camera, tray and arm of version 0.1 in its cell."""
    if not isinstance(given, dict):
        return given
    made = {key: value if key == "cell" else upgrade(value) for key, value in given.items()}
    cell: dict[str, Any] = {}
    if isinstance(camera := made.get("camera"), dict):
        del made["camera"]
        cell["cameras"] = {"overhead": _camera(camera)}
    if isinstance(layout := made.get("layout"), dict) and "tray_side" in layout:
        made["layout"] = {key: value for key, value in layout.items() if key != "tray_side"}
        cell["support"] = {"size": [layout["tray_side"]] * 2}
    if isinstance(arm := made.get("arm"), dict):
        del made["arm"]
        made["world"] = _over({"cell": upgrade_cell(arm)}, made.get("world", {}))
    if "camera_noise" in made:
        noise = {"overhead": {"depth_noise": made.pop("camera_noise")}}
        made["world"] = _over({"cell": {"cameras": noise}}, made.get("world", {}))
    if cell:
        made["cell"] = _over(cell, made.get("cell", {}))
    return made


def _over(moved: Any, given: Any) -> Any:
    """Return what moved from elsewhere with what is given over it."""
    if not isinstance(given, dict) or not isinstance(moved, dict):
        return given
    return {**moved, **{key: _over(moved.get(key), value) for key, value in given.items()}}


def upgrade_head(given: Any) -> Any:
    """Return a document that holds configs of version 0.1, with complete cells instead of their cameras and arms."""
    return _with_complete_cells(upgrade(given))


def _with_complete_cells(given: Any) -> Any:
    if not isinstance(given, dict):
        return given
    made = {key: _with_complete_cells(value) for key, value in given.items()}
    if isinstance(cell := given.get("cell"), dict):
        made["cell"] = to_plain(override_config(default_cell(), cell, "cell"))
    return made


def _camera(old: dict[str, Any]) -> dict[str, Any]:
    camera = {key: value for key, value in old.items() if key not in ("altitude", "hidden_below")}
    if "altitude" in old:
        camera["pose"] = {"translation": [0.0, 0.0, old["altitude"]], "rpy_deg": [180.0, 0.0, 0.0]}
    if "hidden_below" in old:
        camera["visibility_threshold"] = old["hidden_below"]
    return camera


def upgrade_cell(old: Any) -> Any:
    """Return a cell's document with the arm of version 0.1 (base, home, suction, payload) as its robot and gripper."""
    if not isinstance(old, dict):
        return old
    robot = {key: old[key] for key in ("home", "payload") if key in old}
    made = {
        key: value
        for key, value in old.items()
        if key not in ("home", "payload", "suction", "base")
    }
    base = old.get("base")
    if isinstance(base, list) and len(base) == 4:
        robot["base"] = {"translation": base[:3], "rpy_deg": [0.0, 0.0, base[3]]}
    elif "base" in old:
        made["base"] = base
    if robot:
        made["robot"] = robot
    if "suction" in old:
        made["gripper"] = old["suction"]
    return made
