"""Data types and protocols shared by judges, executors, detectors and policies."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drake_clutter.catalog import ObjectClass
from drake_clutter.cell.camera import Camera
from drake_clutter.cell.support import Support
from drake_clutter.scenes.action_samples import ActionSamples
from drake_clutter.scenes.scene import TRAY, Pose, Scene


class InstabilityReason(Enum):
    """Why a scene is not stable.

    A simulation reports the first four, the static judge the last three.

    Attributes:
        TOPPLED: The object rotated past the limit.
        SLID: The object moved past the limit without rotating past its limit.
        LEFT_TRAY: The object fell off the support.
        NOT_AT_REST: The object was still moving at the end of the simulation time.
        UNBALANCED: No contact forces hold the object.
        ROLLS: The object is balanced on the contact line of a lying cylinder.
        UNSUPPORTED: The object has nothing below it, but the top of another object beside it.
    """

    TOPPLED = "toppled"
    SLID = "slid"
    LEFT_TRAY = "left the tray"
    NOT_AT_REST = "not at rest in time"
    UNBALANCED = "out of balance"
    ROLLS = "balanced on a lying cylinder"
    UNSUPPORTED = "stands beside what should carry it"


@dataclass(frozen=True)
class Instability:
    """The object that did not stay in place, and how it failed.

    Attributes:
        reason: How the object failed.
        object: Name of the object.
        displacement: Displacement of its origin [m]; 0 if no motion was simulated.
        tilt: Rotation, see `tilt_between` [rad]; 0 if no motion was simulated.
    """

    reason: InstabilityReason
    object: str
    displacement: float = 0.0
    tilt: float = 0.0

    def __str__(self) -> str:
        if not self.displacement and not self.tilt:
            return f"{self.object} {self.reason.value}"
        amount = f"{1000 * self.displacement:.0f} mm, {math.degrees(self.tilt):.0f} deg"
        return f"{self.object} {self.reason.value} ({amount})"


@dataclass(frozen=True)
class Verdict:
    """A judge's result for a scene.

    Attributes:
        instability: The failed object, or None for a stable scene.
        settled: X_TO of every object at the end, by name. The simulation ends when a fall is
            detected.
        visible_fractions: Fraction of each object's unoccluded pixels that the camera sees, by
            name; empty for an unstable scene.
        hidden: Objects whose visible fraction is below the camera's threshold, in the order of
            the scene; empty for an unstable scene.
    """

    instability: Instability | None
    settled: Mapping[str, Pose]
    visible_fractions: Mapping[str, float]
    hidden: tuple[str, ...]

    @property
    def stable(self) -> bool:
        """Whether the scene is stable.

        No object moved or rotated past the limits, left the support or kept moving.
        """
        return self.instability is None


class InconclusiveReason(Enum):
    """What a judge's model of a scene does not cover.

    Attributes:
        LEANING: No face of the object is horizontal.
        OUTSIDE_TRAY: The object reaches beyond the support.
        INTERPENETRATING: The object overlaps another one or the support.
        FLOATING: Nothing is below or beside the object's bottom.
        EDGE_CONTACT: The object touches others only on an edge or a curved surface.
        UNSUPPORTED: The object has nothing below it, but the top of another object beside it.
        RESTS_NEVERTHELESS: The object rests in the given scene, but the model predicts a fall.
    """

    LEANING = "leans"
    OUTSIDE_TRAY = "is outside the tray"
    INTERPENETRATING = "interpenetrates another object or the tray"
    FLOATING = "floats in the air"
    EDGE_CONTACT = "rests on an edge or on a curved side"
    UNSUPPORTED = "stands beside what should carry it"
    RESTS_NEVERTHELESS = "rests where the judge would let it fall"


@dataclass(frozen=True)
class InconclusiveVerdict:
    """A judge's result for a scene that its model does not cover.

    `DrakeJudge` covers every scene.

    Attributes:
        reason: What the model does not cover.
        object: Name of the first object to which the reason applies.
    """

    reason: InconclusiveReason
    object: str

    def __str__(self) -> str:
        return f"{self.object} {self.reason.value}"


class SceneJudge(Protocol):
    """Decides whether a scene is stable and which of its objects are hidden."""

    def judge(self, scene: Scene, rng: np.random.Generator) -> Verdict | InconclusiveVerdict:
        """Return the verdict.

        Args:
            scene: The scene to judge.
            rng: Random generator of small offsets of the objects, which remove unstable equilibria.
        """


@dataclass(frozen=True)
class Move:
    """Pick one object and place it on another one or on the tray.

    Attributes:
        pick: Name of the object to pick.
        place: Name of the object to place it on, or `TRAY`; or a pose `X,Y,Z,YAW`: the position of
            the picked object's origin in T [m], and its turn about the vertical [deg].
    """

    pick: str
    place: str = TRAY

    @property
    def place_values(self) -> tuple[float, float, float, float] | None:
        """x, y, z [m] and yaw [deg] if the place is a pose, else None."""
        try:
            x, y, z, yaw = (float(part) for part in self.place.split(","))
        except ValueError:
            return None
        return (x, y, z, yaw) if all(map(math.isfinite, (x, y, z, yaw))) else None

    def place_pose(self, X_TO_pick: Pose) -> Pose | None:
        """Return X_TO at the place if it is a pose, else None.

        Args:
            X_TO_pick: Pose of the picked object, whose orientation is turned.
        """
        if self.place_values is None:
            return None
        *p_TO, yaw = self.place_values
        R = Rotation.from_euler("z", yaw, degrees=True).as_matrix()
        return Pose.from_rotation(R @ X_TO_pick.rotation, p_TO)

    def __str__(self) -> str:
        return f"{self.pick} -> {self.place}"


@dataclass(frozen=True)
class PickPlaceCommand:
    """A move with its poses, ready to be executed.

    Attributes:
        move: What to pick, and on what to place it.
        X_TO_pick: Pose at which the picked object was seen.
        X_TO_place: Pose at which it is released.
    """

    move: Move
    X_TO_pick: Pose
    X_TO_place: Pose

    def is_beside(self, support: Support) -> bool:
        """Return whether the move names a pose beside the support, such as a hand-over place."""
        is_pose = self.move.place_values is not None
        return is_pose and not support.contains(*self.X_TO_place.translation[:2])


class MovePart(Enum):
    """Part of a move for which no plan was found.

    Attributes:
        PICK: The object cannot be picked, wherever it is to be placed.
        CARRY: The object cannot be carried from where it is to the place.
        PLACE: The object cannot be released at the place.
    """

    PICK = "pick"
    CARRY = "carry"
    PLACE = "place"


class MoveResult(Enum):
    """How a move ended.

    Attributes:
        PLACED: The object is at its placement, and the scene is stable.
        CAME_OFF: The gripper lost the object, which is at its placement anyway, and the scene
            is stable.
        COLLAPSED: The scene is unstable after the move.
        LEFT_TRAY: An object fell off the support.
        NO_FREE_PLACEMENT: No placement is known to be free.
        INCONCLUSIVE: The executor's model does not cover the scene, or a simulated motion has not
            ended in time.
        NOT_PLANNED: No motion plan was found.
        DROPPED: The gripper lost the object on the way.
        NOT_GRASPED: The gripper did not grasp the object, which is where it was, and the scene is
            stable.
    """

    PLACED = "placed"
    CAME_OFF = "came off"
    COLLAPSED = "collapsed"
    LEFT_TRAY = "left the tray"
    NO_FREE_PLACEMENT = "no free spot"
    INCONCLUSIVE = "cannot be judged"
    NOT_PLANNED = "not planned"
    DROPPED = "dropped"
    NOT_GRASPED = "not grasped"

    @property
    def was_executed(self) -> bool:
        """Whether the arm moved."""
        lost = self in (MoveResult.DROPPED, MoveResult.NOT_GRASPED)
        return self.is_at_placement or lost or self.ends_episode

    @property
    def is_at_placement(self) -> bool:
        """Whether the object is where it was to be, in a stable scene."""
        return self in (MoveResult.PLACED, MoveResult.CAME_OFF)

    @property
    def ends_episode(self) -> bool:
        """Whether the move ruined the scene."""
        return self in (MoveResult.COLLAPSED, MoveResult.LEFT_TRAY)

    @staticmethod
    def of_instability(instability: Instability) -> "MoveResult":
        """Return the result of a move that made an object fall."""
        left_tray = instability.reason is InstabilityReason.LEFT_TRAY
        return MoveResult.LEFT_TRAY if left_tray else MoveResult.COLLAPSED


@dataclass(frozen=True)
class MotionSample:
    """What a picture shows of one time of a motion.

    Attributes:
        time: Time since the motion began [s].
        poses: X_TO of the objects, by name.
        q: Joint positions of the arm that moves them [rad]; empty without an arm. Shape (n,).
    """

    time: float
    poses: Mapping[str, Pose]
    q: tuple[float, ...] = ()


@dataclass(frozen=True)
class Outcome:
    """Result of an executed command.

    Attributes:
        result: How the move ended.
        scene: The scene after the move; the scene before it if nothing was moved.
        instability: The failed object of a collapsed scene, or the object that left the support.
        motion: Motion of the scene after the release, without an arm.
        inconclusive: What the executor's model does not cover, if that is the result.
        detail: Reason why no plan was found, or a remark on the execution.
        X_TO_released: Pose at which the picked object was released.
        samples: Recorded motion of arm and scene; None without an arm.
        failure_reason: Value of the `PlanningFailureReason` if no plan was found; else "".
        failed_part: Part of the move for which no plan was found; None with a plan, or if no single
            part is the cause.
    """

    result: MoveResult
    scene: Scene
    instability: Instability | None = None
    motion: tuple[MotionSample, ...] = ()
    inconclusive: InconclusiveVerdict | None = None
    detail: str = ""
    X_TO_released: Pose | None = None
    samples: ActionSamples | None = field(repr=False, default=None)
    failure_reason: str = ""
    failed_part: MovePart | None = None

    @property
    def instability_text(self) -> str:
        """The failed object, how it failed, and where it is if it left the support; else ""."""
        if self.instability is None:
            return ""
        if self.result is not MoveResult.LEFT_TRAY:
            return str(self.instability)
        return (
            f"{self.instability}, and is at {self.scene[self.instability.object].X_TO.place_text}"
        )


@dataclass(frozen=True)
class Detection:
    """An object reported by a detector.

    Attributes:
        name: Name of the object, which stays the same from image to image.
        object_class: Class of the object.
        X_TO: Pose in the support's frame.
        mask: Pixels of the object. Shape (height, width), bool.
        is_confident: Whether all evidence supports the detection. Without confidence, an earlier
            estimate of the object may be better.
        class_probabilities: Probability of each class by its name, and of no object by ""; empty if
            the class is certain.
    """

    name: str
    object_class: ObjectClass
    X_TO: Pose
    mask: NDArray[np.bool_]
    is_confident: bool = False
    class_probabilities: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Observation:
    """One image of the camera with its detections, without any ground truth.

    Observations compare by identity, so that results derived from one can be cached.

    Attributes:
        depth: Depth along the camera's axis, inf where nothing is seen [m]. Shape (height, width).
        detections: Objects detected in the image (V_t).
        camera: The camera that took the image.
        support: The support that the objects stand on.
    """

    depth: NDArray[np.float32]
    detections: tuple[Detection, ...]
    camera: Camera
    support: Support

    def __getitem__(self, name: str) -> Detection:
        """Return the detection of a name.

        Raises:
            KeyError: No detection has this name.
        """
        for detection in self.detections:
            if detection.name == name:
                return detection
        visible = ", ".join(detection.name for detection in self.detections)
        raise KeyError(f"object {name!r} is not in view; in view are {visible}")


class MoveExecutor(Protocol):
    """Executes commands in a scene at rest."""

    def execute(self, scene: Scene, command: PickPlaceCommand, rng: np.random.Generator) -> Outcome:
        """Return the outcome of a command.

        Args:
            scene: The objects before the move, at rest.
            command: Command to execute.
            rng: Random generator of release offsets.

        Raises:
            KeyError: The command names an object that is not in the scene.
        """
