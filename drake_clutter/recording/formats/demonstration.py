"""Demonstrations: the executed actions of an episode as rows at a fixed rate.

LeRobot and robomimic train on them: each row holds what a policy observes and what it commands.
Frames: T is the support, O is an object, G is the tool that the action uses.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_clutter.files import InputError
from drake_clutter.recording.recorded_episode import CameraImages, RecordedAction, RecordedEpisode
from drake_clutter.scenes.action_samples import POSE_COLUMNS, ActionSamples
from drake_clutter.scenes.interfaces import MoveResult

_TIME_TOLERANCE = 1e-6
"""Difference below which times are equal [s]."""


@dataclass(frozen=True, eq=False)
class Demonstration:
    """An executed action as m rows at a fixed rate.

    Attributes:
        episode: The episode of the action.
        number: Number of the action in the episode, from 1.
        action: The action.
        samples: Samples of the rows.
        rate: Rows per second [Hz].
        state: Measured state of robot and gripper, see `state_names`. Shape (m, s).
        command: Command that is to be reached at the next row, see `command_names`; the last row
            repeats its own command. Shape (m, a).
        object_state: X_TO of the picked object at each row and X_TO_place, see
            `OBJECT_STATE_NAMES`. Shape (m, 14).
        images: Images of each camera, one a row.
    """

    episode: RecordedEpisode
    number: int
    action: RecordedAction
    samples: ActionSamples
    rate: float
    state: NDArray[np.float64]
    command: NDArray[np.float64]
    object_state: NDArray[np.float64]
    images: dict[str, CameraImages]

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.samples)

    @property
    def is_success(self) -> bool:
        """Whether the object was placed and nothing fell."""
        return self.action.result is MoveResult.PLACED

    @property
    def task(self) -> str:
        """The move in words, such as `gelatin_box_1 onto tray`."""
        move = self.action.move
        if move.place_values is None:
            return f"{move.pick} onto {move.place}"
        x, y, z, yaw = move.place_values
        return f"{move.pick} to {x:.3f} {y:.3f} {z:.3f} m, turned {yaw:.0f} deg"


OBJECT_STATE_NAMES = (
    *(f"pick_{column}" for column in POSE_COLUMNS),
    *(f"place_{column}" for column in POSE_COLUMNS),
)
"""Columns of `Demonstration.object_state`."""


def state_names(episode: RecordedEpisode) -> tuple[str, ...]:
    """Return the columns of `Demonstration.state`.

    Joint positions [rad], positions of the gripper's actuated joints [m], pressure of each cup
    below the ambient one [Pa], and whether an object is held (0 or 1).
    """
    axes = episode.axes
    vacuum = (f"vacuum_{cup}" for cup in axes["cups"])
    return (*axes["joints"], *axes["gripper_actuators"], *vacuum, "holds_object")


def command_names(episode: RecordedEpisode) -> tuple[str, ...]:
    """Return the columns of `Demonstration.command`.

    Joint positions [rad], positions of the gripper's actuated joints [m], and whether each tool is
    to hold (0 or 1).
    """
    axes = episode.axes
    hold = (f"hold_{tool}" for tool in axes["tools"])
    return (*axes["joints"], *(f"{name}_target" for name in axes["gripper_actuators"]), *hold)


def demonstrations(episode: RecordedEpisode) -> Iterator[Demonstration]:
    """Yield the executed actions of an episode.

    An action with images has a row for each image, else one for each sample.

    Raises:
        InputError: The cameras have images at different times, or at other times than the samples;
            or the episode is of version 1, which does not hold the placement.
    """
    for number, action in enumerate(episode.actions, start=1):
        if action.samples is not None and len(action.samples) > 0:
            yield _demonstrate(episode, number, action, action.samples)


def _demonstrate(
    episode: RecordedEpisode, number: int, action: RecordedAction, samples: ActionSamples
) -> Demonstration:
    """Return the demonstration of an action with samples."""
    rate = episode.rate
    source = f"episode {episode.index}, action {number}"
    place = action.X_TO_place
    if place is None:
        raise InputError(f"{source}: has no placement; expected an episode of version 2")
    if action.images:
        time = _image_times(action.images, source)
        rows = _nearest_samples(samples.time, time, source)
        rate = _image_rate(time, float(np.diff(samples.time).max()))
        chosen: dict[str, Any] = {name: a[rows] for name, a in samples.channels().items()}
        samples = replace(samples, **chosen)
    jaws = samples.gripper[:, : samples.gripper_commanded.shape[1]]
    hold = samples.tool_commanded[:, None] == np.arange(len(episode.axes["tools"]))
    command = np.column_stack([samples.q_commanded, samples.gripper_commanded, hold])
    X_TO_pick = samples.X_TO[:, episode.initial_scene.names.index(action.move.pick)]
    X_TO_place = np.tile([*place.quaternion, *place.translation], (len(samples), 1))
    return Demonstration(
        episode,
        number,
        action,
        samples,
        rate,
        np.column_stack([samples.q, jaws, samples.vacuum, samples.held_object >= 0]),
        np.concatenate([command[1:], command[-1:]]),
        np.column_stack([X_TO_pick, X_TO_place]),
        dict(action.images),
    )


def _image_times(images: Mapping[str, CameraImages], source: str) -> NDArray[np.float64]:
    """Return the times at which all cameras have an image [s]. Shape (f,)."""
    (first, time), *others = ((name, camera.time) for name, camera in images.items())
    for name, other in others:
        if len(other) != len(time) or (np.abs(other - time) > _TIME_TOLERANCE).any():
            raise InputError(
                f"{source}: images of {first} and {name} at different times; expected equal times"
            )
    if len(time) < 3:
        raise InputError(f"{source}: {len(time)} images of {first}; expected at least 3")
    return time


def _image_rate(time: NDArray[np.float64], sample_period: float) -> float:
    """Return the number of images per second [Hz].

    It is the nearest whole number if each image is at the sample after its multiple of the period.
    The last image shows the end of the action, less than a period after the one before.

    Args:
        time: Times of the images [s]. Shape (f,).
        sample_period: Time between two samples [s].
    """
    span = float(time[-2] - time[0])
    rate = (len(time) - 2) / span
    whole = max(1, round(rate))
    is_whole = abs((len(time) - 2) / whole - span) <= sample_period + _TIME_TOLERANCE
    return float(whole) if is_whole else rate


def _nearest_samples(
    samples: NDArray[np.float64], images: NDArray[np.float64], source: str
) -> NDArray[np.int64]:
    """Return the index of the sample at the time of each image.

    Raises:
        InputError: An image is farther from its sample than from the middle between two samples.
    """
    after = np.clip(np.searchsorted(samples, images), 1, len(samples) - 1)
    nearest = np.where(images - samples[after - 1] <= samples[after] - images, after - 1, after)
    offsets = np.abs(samples[nearest] - images)
    limit = float(np.diff(samples).max()) / 2 + _TIME_TOLERANCE
    if (offsets > limit).any():
        raise InputError(
            f"{source}: an image {1000 * offsets.max():.1f} ms from the nearest sample; expected "
            f"at most {1000 * limit:.1f} ms"
        )
    return np.asarray(nearest)
