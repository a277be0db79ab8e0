"""Every number that the simulated world leaves open, in one place; `docs/calibration.md` argues the defaults."""

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml
from numpy.typing import NDArray
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
        calm_speed: m/s; calm_displacement: m, calm_tilt_deg: deg, both since the start. A stack is calm while every object is
            below all three.
        calm_samples: calm samples in a row, 0.05 s apart, that end the simulation early.
        still_displacement: m; so does half a second in which nothing was further than this, or turned by calm_tilt_deg, from
            where it is: light objects under heavy ones chatter, and are never calm.
    """

    time_step: float = 0.002
    jitter: float = 0.001
    max_displacement: float = 0.010
    max_tilt_deg: float = 8.0
    max_time: float = 2.0
    rest_drift: float = 0.0025
    calm_speed: float = 0.0003
    calm_displacement: float = 0.001
    calm_tilt_deg: float = 0.3
    calm_samples: int = 4
    still_displacement: float = 0.0005


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

    def project(self, p_T: NDArray[np.float64]) -> NDArray[np.float64]:
        """Column and row (N, 2) of the pixels on which points (N, 3) m in the tray frame fall; whole numbers are their middles.

        Drake's VTK engine draws half a pixel left of and above the principal point that it is given, (width - 1) / 2,
        (height - 1) / 2: measured in tests/test_camera.py.
        """
        distance = self.altitude - p_T[:, 2:]
        offset = self.focal_length * np.column_stack([p_T[:, 0], -p_T[:, 1]]) / distance
        return np.asarray(offset + np.array([self.width / 2 - 1, self.height / 2 - 1]))


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


_ANY = (0.0, math.inf)
_ALLOWED = {
    "layout.tray_side": (0.1, 2.0),
    "layout.placement_tries": (1, math.inf),
    "settle.time_step": (1e-4, 0.02),
    "settle.max_time": (0.1, 60.0),
    "settle.calm_samples": (1, math.inf),
    "camera.width": (16, 4096),
    "camera.height": (16, 4096),
    "camera.fov_y_deg": (1.0, 170.0),
    "camera.altitude": (0.1, 10.0),
    "camera.hidden_below": (0.0, 1.0),
    "exploration.max_moves": (1, math.inf),
    "exploration.collapse_penalty": (-math.inf, 0.0),
    "task.nodes": (3, 1000),
    "task.balance_reward": (0.0, math.inf),
    "task.instability_reward": (-math.inf, 0.0),
    "learning.steps": (1, math.inf),
    "learning.environments": (1, math.inf),
    "learning.batch": (1, math.inf),
    "learning.steps_per_update": (1, math.inf),
    "learning.segment": (1, math.inf),
    "learning.trace": (0.0, 1.0),
    "learning.replay": (1, math.inf),
    "learning.halve_every": (1, math.inf),
    "learning.temperature": (1e-6, math.inf),
    "learning.target_rate": (0.0, 1.0),
    "learning.width": (1, math.inf),
    "learning.episodes": (1, math.inf),
    "learning.passes": (1, math.inf),
    "learning.discount": (0.0, 1.0),
    "learning.clip": (1e-6, math.inf),
    "learning.rounds": (1, math.inf),
    "learning.updates": (1, math.inf),
    "max_moves": (1, math.inf),
    "most_objects": (1, 64),
    "evaluation_episodes": (1, math.inf),
    "base": (-360.0, 360.0),
    "home": (-2 * math.pi, 2 * math.pi),
    "suction.cup_diameter": (0.005, 0.1),
    "suction.cup_length": (0.005, 0.1),
    "suction.extension": (0.01, 0.5),
    "suction.stroke": (0.001, 0.05),
    "suction.stiffness": (100.0, 1e5),
    "suction.vacuum": (0.01, 1.0),
    "suction.friction": (0.01, 10.0),
    "nodes": (3, 1000),
    "suction.safety": (1.0, 100.0),
    "evaluate_every": (1, math.inf),
    "evaluation_scenes": (1, math.inf),
    "save_every": (1, math.inf),
}
"""Least and greatest value of a field, by its last two names or else by its last; of every other number, `_ANY`."""


def _check(given: Any, defaults: Any, source: str, where: str = "") -> None:
    """Refuses fields that the defaults lack, values of another kind, and numbers out of range."""
    names = [item.name for item in dataclasses.fields(defaults)]
    if not isinstance(given, dict):
        raise InputError(f"{source}: {where or 'the file'}: {given!r}; allowed is a mapping with some of {', '.join(names)}")
    for name, value in given.items():
        field = f"{where}.{name}" if where else str(name)
        if name not in names:
            raise InputError(f"{source}: {field}: is unknown; allowed are {', '.join(names)}")
        default = getattr(defaults, name)
        if dataclasses.is_dataclass(default):
            _check(value, default, source, field)
        elif isinstance(default, bool | str):
            if type(value) is not type(default):
                raise InputError(
                    f"{source}: {field}: {value!r}; allowed is {'a text' if isinstance(default, str) else 'a truth value'}"
                )
        elif isinstance(default, list):
            if not isinstance(value, list) or len(value) != len(default):
                raise InputError(f"{source}: {field}: {value!r}; allowed is a list of {len(default)} numbers")
            for number in value:
                _check_number(number, default[0], source, field)
        else:
            _check_number(value, default, source, field)


def _check_number(value: Any, default: float, source: str, field: str) -> None:
    names = field.split(".")
    low, high = _ALLOWED.get(".".join(names[-2:]), _ALLOWED.get(names[-1], _ANY))
    kind = int if isinstance(default, int) else (int, float)
    if isinstance(value, bool) or not isinstance(value, kind) or not low <= value <= high or not abs(value) < 1e300:
        whole = "a whole number" if isinstance(default, int) else "a finite number"
        raise InputError(f"{source}: {field}: {value!r}; allowed is {whole} from {low:g} to {high:g}")


Config = TypeVar("Config")


def load_typed(defaults: Config, path: Path | None = None, settings: Sequence[str] = ()) -> Config:
    """A config: the defaults, with the fields that a YAML file names put over them, and single fields over those.

    Args:
        defaults: a dataclass, all fields set.
        path: the file.
        settings: such as "camera.altitude=2".

    Raises:
        InputError: the file cannot be read, an unknown field, or a value that is not allowed.
    """
    config = defaults
    if path is not None:
        try:
            given = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror})") from error
        except Exception as error:  # as in scenes/scene_file.py
            raise InputError(f"{path}: is not YAML ({error}); allowed is a mapping of config fields") from error
        config = _over(config, given, str(path))
    for setting in settings:
        name, equals, text = setting.partition("=")
        try:
            given = yaml.safe_load(text)
        except yaml.YAMLError:
            equals = ""
        if not equals:
            raise InputError(f"--set {setting}: allowed is FIELD=VALUE, such as camera.altitude=2")
        for part in reversed(name.split(".")):
            given = {part: given}
        config = _over(config, given, f"--set {setting}")
    return config


def _over(defaults: Config, given: Any, source: str) -> Config:
    _check(given, defaults, source)
    over: Config = yaml_load_typed(schema=type(defaults), data=json.dumps(given), defaults=defaults)
    return over


def load_config(path: Path | None = None) -> ClutterConfig:
    """The simulated world, see `load_typed`."""
    return load_typed(ClutterConfig(), path)


def config_yaml(config: Any) -> str:
    """A config as YAML, every field written out."""
    return str(yaml_dump_typed(config, schema=type(config)))
