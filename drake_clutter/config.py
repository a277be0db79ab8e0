"""Every number that the simulated world leaves open, in one place; `docs/calibration.md` argues the defaults."""

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed

from drake_clutter.files import InputError


@dataclass
class LayoutConfig:
    """How a graph becomes poses on the tray.

    Attributes:
        tray_side: m, inner side of the square tray.
        stack_gap: m, least distance between the footprints of two stacks, and of a stack and the rim.
        max_stack_height: m, a higher stack is a typed failure.
        lying_gap: m, between the two objects of a lying pair.
        standing_gap: m, between the two objects of a standing pair.
        placement_tries: draws of a stack's place before the layout starts anew, and of new starts.
    """

    tray_side: float = 0.70
    stack_gap: float = 0.010
    max_stack_height: float = 0.50
    lying_gap: float = 0.002
    standing_gap: float = 0.050
    placement_tries: int = 100


@dataclass
class SettleConfig:
    """How Drake settles a scene and what counts as stable (SPEC section 6; DRAKE_NOTES "Verdicts").

    Contact properties belong to the assets: see `drake_clutter.assets.contact`.

    Attributes:
        time_step: s.
        jitter: m, radius of the disc from which each object's random xy offset is drawn.
        max_displacement: m, a stable object's origin moves less.
        max_tilt_deg: deg, a stable object turns less (a body of revolution: its axis).
        max_time: s simulated.
        rest_drift: m, what went further in the last 0.5 s is "not at rest". Contact chatter and a marker that rocks on the
            facets of its contact mesh stay below it.
        calm_speed: m/s; calm_displacement: m; calm_tilt_deg: deg. A stack is calm while every object is below all three.
        calm_samples: calm samples in a row, 0.1 s apart, that end the simulation early.
    """

    time_step: float = 0.002
    jitter: float = 0.001
    max_displacement: float = 0.010
    max_tilt_deg: float = 8.0
    max_time: float = 2.0
    rest_drift: float = 0.0025
    calm_speed: float = 0.0005
    calm_displacement: float = 0.001
    calm_tilt_deg: float = 0.3
    calm_samples: int = 4


@dataclass
class CameraConfig:
    """The overhead camera: the colour stream of a RealSense D435 at 640 x 480 (vertical field of view 42.5 deg, data sheet).

    Attributes:
        width, height: pixels.
        fov_y_deg: deg, vertical field of view.
        altitude: m above the tray's floor; the camera looks straight down at the tray's centre.
        hidden_below: an object is hidden when the camera sees less than this share of its unoccluded pixels.
    """

    width: int = 640
    height: int = 480
    fov_y_deg: float = 42.5
    altitude: float = 1.60
    hidden_below: float = 0.30

    @property
    def focal_length(self) -> float:
        """Pixels."""
        return self.height / 2 / math.tan(math.radians(self.fov_y_deg) / 2)


@dataclass
class ExplorationConfig:
    """The exploration task (SPEC section 4).

    Attributes:
        max_moves: moves after which an episode ends.
        detection_reward: per newly detected object.
        collapse_penalty: added when a move makes the scene collapse, which ends the episode.
        clearance: m, kept between a placed object's footprint and anything else the camera sees standing in the way.
        release_height: m, above its support at which a placed object is let go.
    """

    max_moves: int = 10
    detection_reward: float = 1.0
    collapse_penalty: float = -1.0
    clearance: float = 0.010
    release_height: float = 0.001


@dataclass
class ClutterConfig:
    """The whole simulated world."""

    layout: LayoutConfig = field(default_factory=LayoutConfig)
    settle: SettleConfig = field(default_factory=SettleConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    exploration: ExplorationConfig = field(default_factory=ExplorationConfig)


def _numbers(config: Any, prefix: str = "") -> Iterator[tuple[str, float]]:
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if dataclasses.is_dataclass(value):
            yield from _numbers(value, f"{prefix}{item.name}.")
        else:
            yield prefix + item.name, value


def load_config(path: Path | None = None) -> ClutterConfig:
    """The defaults, with the fields that a YAML file names put over them.

    Raises:
        InputError: an unknown field or a value that is not allowed.
    """
    if path is None:
        return ClutterConfig()
    try:
        config: ClutterConfig = yaml_load_typed(schema=ClutterConfig, filename=str(path), defaults=ClutterConfig())
    except Exception as error:  # Drake's reader raises many kinds; every one means a broken file
        raise InputError(f"{path}: {error}; allowed are the fields of\n{config_yaml(ClutterConfig())}") from error
    for name, value in _numbers(config):
        may_be_negative = name == "exploration.collapse_penalty"
        if not math.isfinite(value) or (value < 0 and not may_be_negative):
            raise InputError(f"{path}: {name}: {value}; allowed is a finite number, not negative")
    for name in ("layout.tray_side", "settle.time_step", "settle.max_time", "camera.width", "camera.height", "camera.altitude"):
        if dict(_numbers(config))[name] <= 0:
            raise InputError(f"{path}: {name}: allowed is more than 0")
    return config


def config_yaml(config: ClutterConfig) -> str:
    """The config as YAML, every field written out."""
    return str(yaml_dump_typed(config, schema=ClutterConfig))
