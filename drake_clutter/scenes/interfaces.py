"""What crosses the three seams: verdicts, moves and outcomes, observations; and the protocols of the parts that are exchanged."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drake_clutter.catalog import ObjectClass
from drake_clutter.cell.camera import Camera
from drake_clutter.cell.support import Support
from drake_clutter.scenes.scene import TRAY, Pose, Scene


class InstabilityReason(Enum):
    """Why a scene is not stable."""

    TOPPLED = "toppled"
    SLID = "slid"
    LEFT_TRAY = "left the tray"
    NOT_AT_REST = "not at rest in time"
    UNBALANCED = "out of balance"
    ROLLS = "balanced on a lying cylinder"
    UNSUPPORTED = "stands beside what should carry it"


@dataclass(frozen=True)
class Instability:
    """The object that did not stay, and how.

    Attributes:
        reason: toppled (turned past the limit), slid (moved past it, sideways or down, not turned), left the tray,
            or still moving at the end; of a judge that simulates no motion: no contact forces hold it, they do only on a line
            on which it rolls, or nothing is under it.
        object: its name.
        displacement: m, of its origin; 0 if no motion was simulated.
        tilt: rad, see `tilt_between`; likewise.
    """

    reason: InstabilityReason
    object: str
    displacement: float = 0.0
    tilt: float = 0.0

    def __str__(self) -> str:
        if not self.displacement and not self.tilt:
            return f"{self.object} {self.reason.value}"
        return f"{self.object} {self.reason.value} ({1000 * self.displacement:.0f} mm, {math.degrees(self.tilt):.0f} deg)"


@dataclass(frozen=True)
class Verdict:
    """What a judge says of a scene.

    Attributes:
        instability: None for a stable scene.
        settled: X_TO of every object after settling, by name. Of an unstable scene: as far as it was followed.
        visible_fractions: of its unoccluded pixels, what the camera sees of each object, 0 to 1, by name; empty if unstable.
        hidden: the objects whose visible share is below the config's threshold, in the scene's order; empty if unstable.
    """

    instability: Instability | None
    settled: Mapping[str, Pose]
    visible_fractions: Mapping[str, float]
    hidden: tuple[str, ...]

    @property
    def stable(self) -> bool:
        """Whether nothing moved or turned past the limits, left the tray, or was still moving."""
        return self.instability is None


class InconclusiveReason(Enum):
    """What is beyond a judge's model of a scene."""

    LEANING = "leans"
    NOT_CONVEX = "is not convex"
    OUTSIDE_TRAY = "is outside the tray"
    INTERPENETRATING = "interpenetrates another object or the tray"
    FLOATING = "floats in the air"
    EDGE_CONTACT = "rests on an edge or on a curved side"
    UNSUPPORTED = "stands beside what should carry it"
    RESTS_NEVERTHELESS = "rests where the judge would let it fall"


@dataclass(frozen=True)
class InconclusiveVerdict:
    """A judge's answer to a scene that its model does not cover; `DrakeJudge` judges all.

    Attributes:
        reason: what is beyond the model.
        object: the name of the first object of which it is true.
    """

    reason: InconclusiveReason
    object: str

    def __str__(self) -> str:
        return f"{self.object} {self.reason.value}"


class SceneJudge(Protocol):
    """Says whether a scene is stable and what it hides."""

    def judge(self, scene: Scene, rng: np.random.Generator) -> Verdict | InconclusiveVerdict:
        """The verdict; `rng` draws the random offsets that no exact balance survives."""


@dataclass(frozen=True)
class Move:
    """Pick one object, put it on another or on the tray.

    Attributes:
        pick: the object's name.
        place: the name of the object to put it on, or `TRAY`.
    """

    pick: str
    place: str = TRAY

    def __str__(self) -> str:
        return f"{self.pick} -> {self.place}"


@dataclass(frozen=True)
class PickPlaceCommand:
    """A move with its poses, ready to be carried out.

    Attributes:
        move: What to pick, and on what to place it.
        X_TO_pick: Pose at which the picked object was seen.
        X_TO_place: Pose at which it is released.
    """

    move: Move
    X_TO_pick: Pose
    X_TO_place: Pose


class MoveResult(Enum):
    """How a move ended."""

    PLACED = "placed"
    COLLAPSED = "collapsed"
    NO_FREE_PLACEMENT = "no free spot"
    INCONCLUSIVE = "cannot be judged"
    NOT_PLANNED = "not planned"
    DROPPED = "dropped"

    @property
    def was_executed(self) -> bool:
        """Whether anything was moved."""
        return self in (MoveResult.PLACED, MoveResult.COLLAPSED, MoveResult.DROPPED)


@dataclass(frozen=True)
class ArmState:
    """An arm at a time.

    Attributes:
        q, v, torque: rad, rad/s, and N m of the motors, by joint.
        suction: whether the vacuum is switched on.
    """

    q: tuple[float, ...]
    v: tuple[float, ...]
    torque: tuple[float, ...]
    suction: bool


@dataclass(frozen=True)
class MotionSample:
    """Where the objects were at a time.

    Attributes:
        time: s since the move began.
        poses: X_TO by name.
        arm: that carries them; None if they move by themselves.
    """

    time: float
    poses: Mapping[str, Pose]
    arm: ArmState | None = None


@dataclass(frozen=True)
class Outcome:
    """What a move led to.

    Attributes:
        result: placed, collapsed, dropped on the way, or why it could not be carried out.
        scene: the scene afterwards; the scene before, if the move could not be carried out.
        instability: what did not stay, when it collapsed.
        motion: for pictures: from when the picked object was let go, or of a robot's whole move.
        X_TO_released: X_TO where the picked object was let go.
        inconclusive: what is beyond the executor's model, when that is the result.
        detail: in words, why no plan was found, or how well it was carried out.
    """

    result: MoveResult
    scene: Scene
    instability: Instability | None = None
    motion: tuple[MotionSample, ...] = ()
    inconclusive: InconclusiveVerdict | None = None
    detail: str = ""
    X_TO_released: Pose | None = None


@dataclass(frozen=True)
class Detection:
    """An object that the detector reports.

    Attributes:
        name: the same object keeps its name from image to image.
        object_class: its class.
        X_TO: its pose in the tray frame.
        mask: (height, width) bool, its pixels.
        is_confident: whether all that was looked at says so; without that, what was known before may be right.
    """

    name: str
    object_class: ObjectClass
    X_TO: Pose
    mask: NDArray[np.bool_]
    is_confident: bool = False


@dataclass(frozen=True, eq=False)
class Observation:
    """What the camera has shown at one time; it holds nothing that is hidden.

    Observations are equal only to themselves, so that what follows from one can be cached.

    Attributes:
        depth: (height, width) m along the camera's axis, inf where nothing is seen.
        detections: V_t, the objects that can be detected now.
        camera: what has seen it.
        support: what the objects stand on.
    """

    depth: NDArray[np.float32]
    detections: tuple[Detection, ...]
    camera: Camera
    support: Support

    def __getitem__(self, name: str) -> Detection:
        """The detection of a name.

        Raises:
            KeyError: the object is not in view.
        """
        for detection in self.detections:
            if detection.name == name:
                return detection
        raise KeyError(
            f"object {name!r} is not in view; in view are {', '.join(d.name for d in self.detections)}"
        )


class MoveExecutor(Protocol):
    """Carries out commands in a scene at rest."""

    def execute(self, scene: Scene, command: PickPlaceCommand, rng: np.random.Generator) -> Outcome:
        """Return the outcome of a command.

        Args:
            scene: The objects before the move, at rest.
            command: What to carry out.
            rng: Draws random release offsets.

        Raises:
            KeyError: The command names an object that is not in the scene.
        """
