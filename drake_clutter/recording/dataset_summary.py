"""Figures of a data set: a row for each attempted move, and outliers.

Frames: T is the support, G is the tool that the action uses.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_clutter.recording.recorded_episode import RecordedAction, RecordedEpisode
from drake_clutter.robots.robot_model import RobotModel, load_robot
from drake_clutter.scenes.interfaces import MoveResult

OUTLIER_FACTOR = 3.0
"""Distance from the quartiles beyond which a value is far out, in interquartile ranges
(Tukey 1977)."""
MIN_ROWS_FOR_OUTLIERS = 8
"""Number of values below which quartiles say little."""


@dataclass(frozen=True)
class MotionFigures:
    """Figures of an executed action.

    Attributes:
        duration: Duration [s].
        path_length: Length of the path of the tool [m].
        speed_ratios: Largest speed of each joint over its limit. Shape (n,).
        torque_ratios: Largest torque of each joint over its limit. Shape (n,).
        start: x and y of the picked object before, in T [m].
        place: x and y at which it was to be released, in T [m]; None without a placement.
        place_error: Distance from there at the end [m]; NaN without a placement.
        num_samples: Number of samples.
        num_images: Number of images of each camera by name.
    """

    duration: float
    path_length: float
    speed_ratios: tuple[float, ...]
    torque_ratios: tuple[float, ...]
    start: tuple[float, float]
    place: tuple[float, float] | None
    place_error: float
    num_samples: int
    num_images: Mapping[str, int]


@dataclass(frozen=True)
class ActionFigures:
    """Figures of an attempted move.

    Attributes:
        source: File of the episode.
        number: Number of the action in the episode, from 1.
        object_class: Class of the picked object.
        result: Result.
        reason: Why there is no plan, what fell, or ""; without names and numbers.
        motion: Figures of the motion; None if nothing was executed.
    """

    source: str
    number: int
    object_class: str
    result: MoveResult
    reason: str
    motion: MotionFigures | None


@dataclass(frozen=True)
class EpisodeFigures:
    """Figures of an episode.

    Attributes:
        source: Its file.
        scene_name: Name of the scene.
        policy: Name of the policy.
        termination: Why it ended.
        seed: Seed of the data set; -1 if unknown.
        rate: Samples per second [Hz].
        robot: Name of the robot's model.
        gripper: Kind of the gripper.
        joints: Names of the joints.
        support_size: Inner size of the support [m].
        object_classes: Class of each object of the scene.
        versions: Versions of this package and of Drake.
        actions: Figures of the attempted moves.
    """

    source: str
    scene_name: str
    policy: str
    termination: str
    seed: int
    rate: float
    robot: str
    gripper: str
    joints: tuple[str, ...]
    support_size: tuple[float, float]
    object_classes: tuple[str, ...]
    versions: tuple[str, str]
    actions: tuple[ActionFigures, ...]


def summarize_episode(episode: RecordedEpisode, source: str) -> EpisodeFigures:
    """Return the figures of an episode.

    Args:
        episode: The episode.
        source: Its file.
    """
    robot = load_robot(episode.cell.robot)
    width, depth = episode.initial_scene.support.size
    return EpisodeFigures(
        source=source,
        scene_name=episode.scene_name,
        policy=episode.policy,
        termination=episode.termination,
        seed=episode.seed,
        rate=episode.rate,
        robot=episode.cell.robot.model.rpartition("/")[2].partition(".")[0],
        gripper=episode.cell.gripper.kind,
        joints=robot.joint_names,
        support_size=(width, depth),
        object_classes=episode.object_classes,
        versions=(episode.package_version, episode.drake_version),
        actions=tuple(
            _summarize_action(episode, number, action, robot, source)
            for number, action in enumerate(episode.actions, start=1)
        ),
    )


def _summarize_action(
    episode: RecordedEpisode, number: int, action: RecordedAction, robot: RobotModel, source: str
) -> ActionFigures:
    """Return the figures of an attempted move."""
    scene = episode.initial_scene
    return ActionFigures(
        source=source,
        number=number,
        object_class=scene[action.move.pick].object_class.name,
        result=action.result,
        reason=action.failure_reason,
        motion=_summarize_motion(action, robot, scene.names.index(action.move.pick)),
    )


def _summarize_motion(action: RecordedAction, robot: RobotModel, pick: int) -> MotionFigures | None:
    """Return the figures of a motion; None without samples."""
    samples = action.samples
    if samples is None or len(samples) == 0:
        return None
    steps = np.diff(samples.X_TG[:, 4:], axis=0)
    p_TO = samples.X_TO[:, pick, 4:]
    place = action.X_TO_place
    error = np.nan if place is None else float(np.linalg.norm(p_TO[-1] - place.p))
    return MotionFigures(
        duration=float(samples.time[-1]),
        path_length=float(np.linalg.norm(steps, axis=1).sum()),
        speed_ratios=tuple((np.abs(samples.v).max(axis=0) / robot.velocity_limits).tolist()),
        torque_ratios=tuple((np.abs(samples.torque).max(axis=0) / robot.torque_limits).tolist()),
        start=(float(p_TO[0, 0]), float(p_TO[0, 1])),
        place=None if place is None else (float(place.p[0]), float(place.p[1])),
        place_error=error,
        num_samples=len(samples),
        num_images={name: len(images.time) for name, images in action.images.items()},
    )


def attempted(episodes: Iterable[EpisodeFigures]) -> list[ActionFigures]:
    """Return the attempted moves of episodes."""
    return [action for episode in episodes for action in episode.actions]


def motions(episodes: Iterable[EpisodeFigures]) -> list[MotionFigures]:
    """Return the executed motions of episodes."""
    return [action.motion for action in attempted(episodes) if action.motion is not None]


def count_results(episodes: Iterable[EpisodeFigures]) -> Counter[str]:
    """Return the number of attempted moves of each result."""
    return Counter(action.result.value for action in attempted(episodes))


def count_reasons(episodes: Iterable[EpisodeFigures]) -> Counter[str]:
    """Return the number of moves without a plan of each reason."""
    return Counter(action.reason for action in attempted(episodes) if action.reason)


def find_outliers(episodes: Sequence[EpisodeFigures]) -> list[str]:
    """Return the executed moves whose duration, path or place is an outlier, as text."""
    rows = [action for action in attempted(episodes) if action.motion is not None]
    found = [row.motion for row in rows if row.motion is not None]
    texts = list[str]()
    for name, unit, least, values in _compared_quantities(found):
        known = values[np.isfinite(values)]
        if len(known) < MIN_ROWS_FOR_OUTLIERS:
            continue
        low, median, high = np.percentile(known, [25, 50, 75])
        margin = max(least, OUTLIER_FACTOR * (high - low))
        for row, value in zip(rows, values, strict=True):
            if value < low - margin or value > high + margin:
                texts.append(
                    f"{row.source}, action {row.number}: {name} {value:.2f} {unit} "
                    f"(median {median:.2f} {unit}), {row.result.value}"
                )
    return texts


def _compared_quantities(
    figures: Sequence[MotionFigures],
) -> Iterator[tuple[str, str, float, NDArray[np.float64]]]:
    """Yield name, unit, smallest deviation that counts, and values of each compared quantity."""
    yield "duration", "s", 0.5, np.array([row.duration for row in figures])
    yield "tool path", "m", 0.1, np.array([row.path_length for row in figures])
    yield "place error", "mm", 5.0, 1000 * np.array([row.place_error for row in figures])
