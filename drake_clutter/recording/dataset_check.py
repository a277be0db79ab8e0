"""Checks of recorded episodes: time stamps, numbers, limits, rest, and images against poses.

Frames: T is the support, C is a camera, z along its optical axis, y down, O is an object.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drake_clutter.files import InputError
from drake_clutter.recording.recorded_episode import CameraImages, RecordedAction, RecordedEpisode
from drake_clutter.robots.robot_model import RobotModel, load_robot
from drake_clutter.scenes.action_samples import CHANNELS, ActionSamples
from drake_clutter.scenes.scene import Scene

Floats = NDArray[np.float64]

LIMIT_TOLERANCE = 1.02
"""Factor by which measured speeds and torques may exceed their limits: the arm follows its command
with a small error."""
POSITION_TOLERANCE = 0.01
"""Angle by which measured joints may leave their range, for the same reason [rad]."""
MAX_REST_SPEED = 0.02
"""Largest joint speed at rest [rad/s], which moves the tool at 20 mm/s at a reach of 1 m."""
MAX_DRIFT = 0.01
"""Largest distance that an object may move between two actions, when nothing moves it [m]."""
TIME_TOLERANCE = 1e-6
"""Difference below which times are equal [s]."""
PIXEL_TOLERANCE = 3
"""Distance of a pixel of an object from the outline of its box [px]: rounding and half a pixel."""
MAX_STRAY_FRACTION = 0.02
"""Largest fraction of an object's pixels beyond the outline of its box."""
MIN_PIXELS = 30
"""Number of pixels of an object below which its image is not compared with its pose."""
MAX_COMPARED_IMAGES = 5
"""Number of images of an action that are compared with the poses, evenly chosen."""


@dataclass(frozen=True)
class Problem:
    """Something that is wrong with a data set.

    Attributes:
        source: File, and action where it concerns one.
        text: What is wrong, with numbers.
    """

    source: str
    text: str

    def __str__(self) -> str:
        return f"{self.source}: {self.text}"


def find_episode_files(path: Path) -> list[Path]:
    """Return the files of recorded episodes of a data set, in order.

    Args:
        path: Folder of a data set, folder of its episodes, or a single file.

    Raises:
        InputError: There are none.
    """
    if path.is_file():
        return [path]
    for folder in (path / "episodes", path):
        files = sorted(folder.glob("*.h5")) if folder.is_dir() else []
        files = [file for file in files if not file.name.startswith(".")]
        if files:
            return files
    raise InputError(
        f"{path}: holds no recorded episode; expected a file, or a folder with episodes/*.h5"
    )


def check_episode(episode: RecordedEpisode, source: str) -> Iterator[Problem]:
    """Yield what is wrong with an episode.

    Args:
        episode: The episode.
        source: Its file.
    """
    robot = load_robot(episode.cell.robot)
    scene = episode.initial_scene
    poses = np.array([[*o.X_TO.quaternion, *o.X_TO.translation] for o in scene.objects])
    for number, action in enumerate(episode.actions, start=1):
        place = f"{source}, action {number}"
        if action.result.was_executed != (action.samples is not None):
            found = "no samples" if action.samples is None else "samples"
            yield Problem(place, f"{found} of a move that is {action.result.value!r}")
        if action.samples is None:
            continue
        texts = [
            *_check_times(action.samples, episode.rate),
            *_check_numbers(action.samples),
        ]
        if not texts:
            texts = [
                *_check_limits(action.samples, robot),
                *_check_rest(action.samples),
                *_check_continuity(action.samples, poses, scene),
                *_check_images(action, action.samples, scene),
            ]
            poses = action.samples.X_TO[-1]
        for text in texts:
            yield Problem(place, text)


def _check_times(samples: ActionSamples, rate: float) -> Iterator[str]:
    """Yield gaps and steps back of the time stamps."""
    time = samples.time
    if len(time) < 2:
        yield f"{len(time)} samples; expected at least 2"
        return
    if not np.isfinite(time).all():
        yield "a time stamp is not finite"
        return
    if abs(time[0]) > TIME_TOLERANCE:
        yield f"starts at {time[0]:.3f} s; expected 0 s"
    steps = np.diff(time)
    if (steps <= 0).any():
        index = int((steps <= 0).argmax())
        yield f"time goes from {time[index]:.4f} s to {time[index + 1]:.4f} s"
        return
    longest = int(steps.argmax())
    if steps[longest] > 1.5 / rate:
        yield (
            f"a gap of {1000 * steps[longest]:.1f} ms at {time[longest]:.3f} s; expected "
            f"{1000 / rate:.1f} ms"
        )


def _check_numbers(samples: ActionSamples) -> Iterator[str]:
    """Yield channels with numbers that are not finite or quaternions without unit norm."""
    for channel in CHANNELS:
        values = getattr(samples, channel.name)
        bad = ~np.isfinite(values) if values.dtype.kind == "f" else np.zeros(1, dtype=bool)
        if bad.any():
            row = int(np.argwhere(bad)[0][0])
            yield (
                f"{channel.name}: {int(bad.sum())} numbers that are not finite, the first at "
                f"{samples.time[row]:.3f} s"
            )
        elif channel.axes[-1:] == ("pose",) and values.size:
            error = np.abs(np.linalg.norm(values[..., :4], axis=-1) - 1).max()
            if error > 1e-3:
                yield f"{channel.name}: a quaternion of norm {1 + error:.3f}; expected 1"


def _check_limits(samples: ActionSamples, robot: RobotModel) -> Iterator[str]:
    """Yield joints that leave their range, and exceed their limits of speed or torque."""
    low, high = robot.position_limits.T
    for name in ("q", "q_commanded"):
        q = getattr(samples, name)
        excess = np.maximum(low - q, q - high)
        row, joint = np.unravel_index(int(excess.argmax()), excess.shape)
        if excess[row, joint] > POSITION_TOLERANCE:
            yield (
                f"{name}: {robot.joint_names[joint]} at {q[row, joint]:.3f} rad at "
                f"{samples.time[row]:.3f} s; expected {low[joint]:.3f} to {high[joint]:.3f} rad"
            )
    limits = {
        "v": (robot.velocity_limits, "rad/s"),
        "v_commanded": (robot.velocity_limits, "rad/s"),
        "torque": (robot.torque_limits, "N m"),
    }
    for name, (limit, unit) in limits.items():
        values = np.abs(getattr(samples, name))
        row, joint = np.unravel_index(int((values / limit).argmax()), values.shape)
        if values[row, joint] > LIMIT_TOLERANCE * limit[joint]:
            yield (
                f"{name}: {robot.joint_names[joint]} at {values[row, joint]:.2f} {unit} at "
                f"{samples.time[row]:.3f} s; expected at most {limit[joint]:.2f} {unit}"
            )


def _check_rest(samples: ActionSamples) -> Iterator[str]:
    """Yield motion of the arm at the start or at the end."""
    for name, row in (("starts", 0), ("ends", -1)):
        speed = float(np.abs(samples.v[row]).max())
        if speed > MAX_REST_SPEED:
            yield f"{name} at {speed:.3f} rad/s; expected rest"


def _check_continuity(samples: ActionSamples, poses: Floats, scene: Scene) -> Iterator[str]:
    """Yield the object that is farthest from where it was at the end of the action before."""
    distances = np.linalg.norm(samples.X_TO[0, :, 4:] - poses[:, 4:], axis=1)
    index = int(distances.argmax())
    if distances[index] > MAX_DRIFT:
        yield (
            f"{scene.names[index]} starts {1000 * distances[index]:.0f} mm from where it was "
            f"before; expected at most {1000 * MAX_DRIFT:.0f} mm"
        )


def _check_images(action: RecordedAction, samples: ActionSamples, scene: Scene) -> Iterator[str]:
    """Yield times of images outside of the action, and objects that are not where they are seen."""
    for name, images in action.images.items():
        time = images.time
        is_outside = len(time) == 0 or time[0] < -TIME_TOLERANCE
        if is_outside or time[-1] > samples.time[-1] + TIME_TOLERANCE:
            yield f"{name}: images from {time[:1]} to {time[-1:]} s; expected times of the action"
            continue
        if (np.diff(time) <= 0).any() or not np.isfinite(images.X_TC).all():
            yield f"{name}: time stamps that do not increase, or poses that are not finite"
            continue
        chosen = np.linspace(0, len(time) - 1, min(len(time), MAX_COMPARED_IMAGES)).round()
        for index in dict.fromkeys(chosen.astype(int).tolist()):
            row = int(np.abs(samples.time - time[index]).argmin())
            text = _compare_with_poses(images, index, samples.X_TO[row], scene)
            if text:
                yield f"{name}: at {time[index]:.3f} s {text}"
                break


def _compare_with_poses(images: CameraImages, index: int, X_TO: Floats, scene: Scene) -> str:
    """Return which object is not seen where it is; "" if all are, or without a segmentation.

    Pixels of an object lie within the outline of its bounding box.
    """
    if images.segmentation is None:
        return ""
    labels = images.segmentation[index]
    for number, o in enumerate(scene.objects):
        v, u = np.nonzero(labels == number + 1)
        if len(u) < MIN_PIXELS:
            continue
        low, high = o.object_class.corners.min(axis=0), o.object_class.corners.max(axis=0)
        box_O = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
        p_TC = _transform(X_TO[number], low + box_O * (high - low))
        p_C = _transform_inverse(images.X_TC[index], p_TC)
        if (p_C[:, 2] <= 0).any():
            continue  # beside the camera: its outline is unbounded
        fx, fy, cx, cy = images.intrinsics
        corners = p_C[:, :2] / p_C[:, 2:] * [fx, fy] + [cx, cy]
        left, top = corners.min(axis=0) - PIXEL_TOLERANCE
        right, bottom = corners.max(axis=0) + PIXEL_TOLERANCE
        stray = ~((u >= left) & (u <= right) & (v >= top) & (v <= bottom))
        if stray.mean() > MAX_STRAY_FRACTION:
            return (
                f"{o.name} is seen about pixel ({u.mean():.0f}, {v.mean():.0f}); expected within "
                f"({left:.0f}, {top:.0f}) to ({right:.0f}, {bottom:.0f})"
            )
    return ""


def _transform(X_AB: Floats, p_B: Floats) -> Floats:
    """Return points (N, 3) given in B, expressed in A; the pose is given as `POSE_COLUMNS`."""
    return np.asarray(Rotation.from_quat(X_AB[:4], scalar_first=True).apply(p_B) + X_AB[4:])


def _transform_inverse(X_AB: Floats, p_A: Floats) -> Floats:
    """Return points (N, 3) given in A, expressed in B; the pose is given as `POSE_COLUMNS`."""
    rotation = Rotation.from_quat(X_AB[:4], scalar_first=True)
    return np.asarray(rotation.inv().apply(p_A - X_AB[4:]))
