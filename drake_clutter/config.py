"""Configuration of the simulated world.

`docs/explanation` states the reasons for the default values.
"""

from collections.abc import Sequence
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any

from drake_clutter.cell.work_cell import WorkCell, default_cell
from drake_clutter.validation import (
    Count,
    InRange,
    NonNegative,
    config_class,
    load_config_as,
    override_config,
    renamed_fields,
    to_plain,
    with_current_names,
)


@config_class
@renamed_fields(placement_tries="placement_attempts")
class LayoutConfig:
    """Layout of a terminal graph: the poses of its objects on the support.

    Attributes:
        stack_gap: Smallest distance between the footprints of two stacks, and between a stack and
            the edge of the support [m].
        max_stack_height: A graph with a higher stack is rejected [m].
        lying_gap: Distance between the two objects of a lying pair [m].
        standing_gap: Distance between the two objects of a standing pair [m].
        placement_attempts: Positions sampled for each stack before the layout restarts, and number
            of restarts.
    """

    stack_gap: NonNegative = 0.010
    max_stack_height: NonNegative = 0.50
    lying_gap: NonNegative = 0.002
    standing_gap: NonNegative = 0.050
    placement_attempts: Count = 100


@config_class
@renamed_fields(
    rest_drift="max_rest_displacement",
    calm_speed="early_stop_speed",
    calm_displacement="early_stop_displacement",
    calm_tilt_deg="early_stop_tilt_deg",
    calm_samples="early_stop_samples",
    still_displacement="chatter_displacement",
)
class SettleConfig:
    """How Drake settles a scene, and the limits within which it counts as stable.

    Contact properties belong to the assets: see `drake_clutter.assets.contact_properties`.

    Attributes:
        time_step: Time step of the simulation [s].
        jitter: Radius of the disc from which each object's random xy offset is drawn [m].
        max_displacement: An object whose origin moves this far has fallen [m].
        max_tilt_deg: An object that turns this far has fallen; of a body of revolution, only the
            tilt of the axis counts [deg].
        max_time: Longest simulated time [s].
        max_rest_displacement: An object that moved farther than this in the last 0.5 s of
            `max_time` is not at rest [m]. Contact chatter and the rocking of a cylinder on the
            facets of its contact mesh stay below the default.
        early_stop_speed: A sample counts as calm when every object is slower than this [m/s] and
            within `early_stop_displacement` and `early_stop_tilt_deg`.
        early_stop_displacement: Largest displacement since the start in a calm sample [m].
        early_stop_tilt_deg: Largest rotation since the start in a calm sample [deg].
        early_stop_samples: Consecutive calm samples, 0.05 s apart, that end the simulation.
        chatter_displacement: The simulation also ends when no object was farther than this from
            its present position for 0.5 s [m], or rotated by more than `early_stop_tilt_deg`.
            Light objects under heavy ones chatter without moving and exceed `early_stop_speed`.
    """

    time_step: Annotated[float, InRange(1e-4, 0.02)] = 0.002
    jitter: NonNegative = 0.001
    max_displacement: NonNegative = 0.010
    max_tilt_deg: NonNegative = 8.0
    max_time: Annotated[float, InRange(0.1, 60.0)] = 2.0
    max_rest_displacement: NonNegative = 0.0025
    early_stop_speed: NonNegative = 0.0003
    early_stop_displacement: NonNegative = 0.001
    early_stop_tilt_deg: NonNegative = 0.3
    early_stop_samples: Count = 4
    chatter_displacement: NonNegative = 0.0005


@config_class
class PlacementConfig:
    """What is not known of the objects that are to carry another one.

    Attributes:
        position_doubt: Bound on the error of an object's horizontal position [m].
        size_doubt: Bound on the error of an object's horizontal extents [m].
        max_offset_fraction: Largest offset of the placed object's center of mass from that of its
            carrier, as a fraction of the distance from there to the edge of the carrier's top.
        hidden_support_fraction: Part of an object's bottom, about its center of mass, on which it
            is known to rest if what carries it is hidden.
    """

    position_doubt: NonNegative = 0.002
    size_doubt: NonNegative = 0.001
    max_offset_fraction: Annotated[float, InRange(0.0, 1.0)] = 0.5
    hidden_support_fraction: Annotated[float, InRange(0.0, 1.0)] = 0.1

    @property
    def contact_margin(self) -> float:
        """Width by which the contact of two objects may be smaller than it seems [m]."""
        return 2 * self.position_doubt + self.size_doubt


@config_class
class TouchConfig:
    """Errors of what the gripper feels, for the class of an object.

    Attributes:
        mass_error: Standard deviation of the measured mass [kg].
        relative_mass_error: The same, as a fraction of the mass.
        height_error: Standard deviation of the height at touch-down [m].
        outlier_fraction: Fraction of measurements that say nothing, as of an object on another.
        no_seal_probability: Probability that the gripper does not grasp an object of the believed
            class.
        no_seal_otherwise: The same for an object of another class.
    """

    mass_error: Annotated[float, InRange(1e-6, 10.0)] = 0.010
    relative_mass_error: NonNegative = 0.05
    height_error: Annotated[float, InRange(1e-6, 1.0)] = 0.003
    outlier_fraction: Annotated[float, InRange(0.0, 1.0)] = 0.05
    no_seal_probability: Annotated[float, InRange(0.0, 1.0)] = 0.05
    no_seal_otherwise: Annotated[float, InRange(0.0, 1.0)] = 0.5


@config_class
class BeliefConfig:
    """When a policy takes every object for known, and stops.

    Attributes:
        stop_probability: Probability that every object is known from which the policy stops.
        contact_doubt: Width by which the contact of two known objects may differ from that of their
            poses [m].
        uncarried_probability: Probability that something hidden carries a known object that nothing
            known carries.
        doubtful_probability: The same for an object that known objects carry only if their poses
            err by less than `contact_doubt`.
        unidentified_probability: Probability that depth points of no known object show an unknown
            one.
        covered_rate: Expected number of unseen objects below known ones that carry nothing, by area
            of their possible positions [1/m^2].
        shadow_rate: The same for unseen objects that are open above, but behind known ones [1/m^2].
        touch: Errors of what the gripper feels.
    """

    stop_probability: Annotated[float, InRange(0.0, 1.0)] = 0.95
    contact_doubt: NonNegative = 0.001
    uncarried_probability: Annotated[float, InRange(0.0, 1.0)] = 0.99
    doubtful_probability: Annotated[float, InRange(0.0, 1.0)] = 0.3
    unidentified_probability: Annotated[float, InRange(0.0, 1.0)] = 0.99
    covered_rate: NonNegative = 0.07
    shadow_rate: NonNegative = 0.6
    touch: TouchConfig = field(default_factory=TouchConfig)


@config_class
class ExplorationConfig:
    """Moves, rewards and placements of the exploration task.

    Attributes:
        max_moves: Moves after which an episode is truncated.
        detection_reward: Reward for each newly detected object.
        collapse_penalty: Reward for a move that makes the scene collapse, which ends the episode.
        clearance: Distance kept between a placed object's footprint and anything else that the
            camera sees [m].
        release_height: Height above its support at which an object is released [m].
        placement: What is not known of the objects that are to carry another one.
        belief: When a policy that stops by itself considers every object known.
    """

    max_moves: Count = 10
    detection_reward: NonNegative = 1.0
    collapse_penalty: Annotated[float, InRange(-1e300, 0.0)] = -1.0
    clearance: NonNegative = 0.010
    release_height: NonNegative = 0.001
    placement: PlacementConfig = field(default_factory=PlacementConfig)
    belief: BeliefConfig = field(default_factory=BeliefConfig)


@config_class
class ClutterConfig:
    """Configuration of the simulated world.

    Attributes:
        layout: Layout of a terminal graph.
        settle: How scenes settle and what counts as stable.
        exploration: Moves, rewards and placements of the exploration task.
        cell: Robot, gripper, support, cameras and fixtures.
    """

    layout: LayoutConfig = field(default_factory=LayoutConfig)
    settle: SettleConfig = field(default_factory=SettleConfig)
    exploration: ExplorationConfig = field(default_factory=ExplorationConfig)
    cell: WorkCell = field(default_factory=default_cell)


def load_config(path: Path | None = None, settings: Sequence[str] = ()) -> ClutterConfig:
    """Load the configuration of the simulated world; see `load_config_as`."""
    return load_config_as(ClutterConfig(), path, settings, upgrade_config)


def upgrade_config(document: Any) -> Any:
    """Upgrade a config document of version 0.1: camera, tray and arm move into the cell.

    Args:
        document: Content of a config file; returned unchanged if it is not a mapping.
    """
    if not isinstance(document, dict):
        return document
    upgraded = {
        key: value if key == "cell" else upgrade_config(value) for key, value in document.items()
    }
    cell: dict[str, Any] = {}
    if isinstance(camera := upgraded.get("camera"), dict):
        del upgraded["camera"]
        cell["cameras"] = {"overhead": _upgrade_camera(camera)}
    if isinstance(layout := upgraded.get("layout"), dict) and "tray_side" in layout:
        upgraded["layout"] = {key: value for key, value in layout.items() if key != "tray_side"}
        cell["support"] = {"size": [layout["tray_side"]] * 2}
    if isinstance(arm := upgraded.get("arm"), dict):
        del upgraded["arm"]
        upgraded["world"] = _deep_merge({"cell": upgrade_cell(arm)}, upgraded.get("world", {}))
    if "camera_noise" in upgraded:
        noise = {"overhead": {"depth_noise": upgraded.pop("camera_noise")}}
        upgraded["world"] = _deep_merge({"cell": {"cameras": noise}}, upgraded.get("world", {}))
    if cell:
        upgraded["cell"] = _deep_merge(cell, upgraded.get("cell", {}))
    return upgraded


def _deep_merge(base: Any, overrides: Any) -> Any:
    """Return `base`, updated recursively with the entries of `overrides`."""
    if not isinstance(overrides, dict) or not isinstance(base, dict):
        return overrides
    return {**base, **{key: _deep_merge(base.get(key), value) for key, value in overrides.items()}}


def upgrade_header_configs(header: Any) -> Any:
    """Upgrade the header of a results file of version 0.1.

    Its configs get the current names of fields, and complete cells instead of cameras and arms.
    """
    return _complete_configs(upgrade_config(header))


def _complete_configs(document: Any) -> Any:
    """Return a document with current names of fields and complete cells."""
    if not isinstance(document, dict):
        return document
    completed = {key: _complete_configs(value) for key, value in document.items()}
    for key, schema in (("layout", LayoutConfig), ("settle", SettleConfig)):
        if key in completed:
            completed[key] = with_current_names(schema, completed[key])
    if isinstance(cell := document.get("cell"), dict):
        completed["cell"] = to_plain(override_config(default_cell(), cell, "cell"))
    return completed


def _upgrade_camera(old: dict[str, Any]) -> dict[str, Any]:
    """Upgrade the document of a camera of version 0.1."""
    camera = {key: value for key, value in old.items() if key not in ("altitude", "hidden_below")}
    if "altitude" in old:
        camera["pose"] = {"translation": [0.0, 0.0, old["altitude"]], "rpy_deg": [180.0, 0.0, 0.0]}
    if "hidden_below" in old:
        camera["visibility_threshold"] = old["hidden_below"]
    return camera


def upgrade_cell(old: Any) -> Any:
    """Upgrade the document of an arm of version 0.1 to robot and gripper of a cell.

    The fields of version 0.1 are `base`, `home`, `suction` and `payload`.
    """
    if not isinstance(old, dict):
        return old
    robot = {key: old[key] for key in ("home", "payload") if key in old}
    upgraded = {
        key: value
        for key, value in old.items()
        if key not in ("home", "payload", "suction", "base")
    }
    base = old.get("base")
    if isinstance(base, list) and len(base) == 4:
        robot["base"] = {"translation": base[:3], "rpy_deg": [0.0, 0.0, base[3]]}
    elif "base" in old:
        upgraded["base"] = base
    if robot:
        upgraded["robot"] = robot
    if "suction" in old:
        upgraded["gripper"] = old["suction"]
    return upgraded
