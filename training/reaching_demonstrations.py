"""Demonstrations of reaching for a pick: recorded moves up to their grasps.

Frames: T is the support, G is the tool, z out of it, O is the picked object.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from drake_clutter.catalog import load_catalog
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.files import InputError, reading_file
from drake_clutter.recording.hdf5_file import action_name, load_episode
from drake_clutter.recording.recorded_episode import CameraImages
from drake_clutter.scenes.action_samples import PHASES
from drake_clutter.scenes.scene import Pose, Scene

Floats = NDArray[np.float64]

CAMERA = "overhead"
"""Camera of the recorded images."""
NEIGHBORHOOD = 0.15
"""Horizontal distance from the target within which objects are its neighbors [m]."""
CROP = 64
"""Side of the part of the depth image around the mask of the object [px]."""
BRANCH_RADIUS = np.pi / 2
"""Largest distance of a joint from its median angle in the same branch [rad]."""


@dataclass(frozen=True, eq=False)
class Demonstration:
    """Recorded move up to its grasp.

    Attributes:
        name: Episode and number of the action.
        scene_name: Name of the scene of the episode.
        cell: Work cell.
        scene: Scene at the start.
        pick: Name of the picked object.
        tool: Name of the tool.
        time: Times of the commands [s]. Shape (m,).
        q: Commanded joint angles [rad]. Shape (m, n).
        target: Top of the object and rise of its neighbors [m], see `object_target`. Shape (4,).
        image: Points of the depth image around the object, relative to `window`, their height, and
            the mask of the object. None without images. Shape (4, CROP, CROP), see `crop_image`.
    """

    name: str
    scene_name: str
    cell: WorkCell
    scene: Scene
    pick: str
    tool: str
    time: Floats
    q: Floats
    target: Floats
    image: NDArray[np.float32] | None


def object_target(scene: Scene, name: str) -> Floats:
    """Return the target of a pick: where it is, and how far its neighbors rise above it.

    Args:
        scene: Scene.
        name: Name of the picked object.

    Returns:
        Center of the object with the height of its highest point, and the height of the highest
        object within `NEIGHBORHOOD` above that, at least 0 [m]. Shape (4,).
    """
    picked = scene[name]
    center = picked.X_TO.p[:2]
    rise = 0.0
    for other in scene.objects:
        low, high = other.bounds_T
        gap = np.maximum(np.maximum(low[:2] - center, center - high[:2]), 0.0)
        if other.name != name and np.linalg.norm(gap) <= NEIGHBORHOOD:
            rise = max(rise, other.top_height - picked.top_height)
    return np.array([*center, picked.top_height, rise])


def read_first_images(path: Path, number: int) -> CameraImages | None:
    """Return the first images of an action; None without depth or segmentation images.

    The others, which are most of a file, are not read.

    Args:
        path: Recorded episode.
        number: Number of the action; the first is 1.
    """
    with reading_file(path, "a recorded episode"), h5py.File(path) as file:
        group = file.get(f"{action_name(number)}/images/{CAMERA}", {})
        if "depth" not in group or "segmentation" not in group:
            return None
        fx, fy, cx, cy = group.attrs["intrinsics"].tolist()
        return CameraImages(
            time=group["time"][:1],
            X_TC=group["X_TC"][:1],
            intrinsics=(fx, fy, cx, cy),
            depth=group["depth"][:1],
            segmentation=group["segmentation"][:1],
        )


def crop_image(images: CameraImages | None, index: int) -> NDArray[np.float32] | None:
    """Return the first image around the picked object.

    Args:
        images: Images of the overhead camera, or None.
        index: Index of the picked object in the segmentation.

    Returns:
        Positions x, y and z in T of the points that the camera sees [m], and the mask of the
        object. None if the object is not in an image. Shape (4, CROP, CROP).
    """
    if images is None or images.depth is None or images.segmentation is None:
        return None
    mask = images.segmentation[0] == index + 1
    if not mask.any():
        return None
    depth = images.depth[0].astype(float)
    depth = depth / 1000 if images.depth.dtype == np.uint16 else depth
    height, width = depth.shape
    fx, fy, cx, cy = images.intrinsics
    row, column = np.indices(depth.shape)
    p_C = np.stack([(column - cx) / fx * depth, (row - cy) / fy * depth, depth])
    X_TC = Pose(tuple(images.X_TC[0, 4:].tolist()), tuple(images.X_TC[0, :4].tolist()))
    p_T = np.einsum("ij,jhw->ihw", X_TC.rotation, p_C) + X_TC.p[:, None, None]
    p_T[:, depth == 0] = 0.0
    rows, columns = np.nonzero(mask)
    top = int(np.clip(rows.mean() - CROP / 2, 0, height - CROP))
    left = int(np.clip(columns.mean() - CROP / 2, 0, width - CROP))
    window = np.s_[:, top : top + CROP, left : left + CROP]
    return np.concatenate([p_T, mask[None]])[window].astype(np.float32)


def read_demonstrations(folder: Path, tool: str, first: int = 0) -> list[Demonstration]:
    """Return the moves of a data set that grasped their object with a tool, in order.

    Args:
        folder: Folder that `drake-clutter record` wrote.
        tool: Name of the tool.
        first: Number of the first episode that is read.

    Raises:
        InputError: The folder has no such moves, or they are of several cells.
    """
    paths = sorted((folder / "episodes").glob("*.h5"))[first:]
    catalog = load_catalog()
    demonstrations = list[Demonstration]()
    for path in paths:
        episode = load_episode(path, catalog, images=False)
        for number, action in enumerate(episode.actions, start=1):
            samples = action.samples
            if action.tool != tool or samples is None:
                continue
            names = list(episode.initial_scene.names)
            index = names.index(action.move.pick)
            if index not in samples.held_object:
                continue
            grasp = np.flatnonzero(samples.phase == PHASES.index("grasp"))
            if not len(grasp):
                continue
            poses = {
                name: Pose(tuple(row[4:].tolist()), tuple(row[:4].tolist()))
                for name, row in zip(names, samples.X_TO[0], strict=True)
            }
            scene = episode.initial_scene.with_poses(poses)
            demonstrations.append(
                Demonstration(
                    name=f"{path.stem} {number}",
                    scene_name=episode.scene_name,
                    cell=episode.cell,
                    scene=scene,
                    pick=action.move.pick,
                    tool=action.tool,
                    time=samples.time[: grasp[0] + 1],
                    q=samples.q_commanded[: grasp[0] + 1],
                    target=object_target(scene, action.move.pick),
                    image=crop_image(read_first_images(path, number), index),
                )
            )
    if not demonstrations or len({d.cell for d in demonstrations}) > 1:
        expected = f"recorded moves of one cell, with grasps of {tool}"
        raise InputError(f"data: {folder}; expected {expected}")
    return demonstrations


def split(
    demonstrations: Sequence[Demonstration], num_validation: int
) -> tuple[list[Demonstration], list[Demonstration]]:
    """Return training and validation moves; no scene is in both.

    Episodes go through the scenes of a data set again and again. Moves of earlier episodes with the
    scenes of validation moves are left out.

    Args:
        demonstrations: Moves in the order of their episodes.
        num_validation: Number of the last moves, which are not learned from.

    Raises:
        InputError: There are not enough moves.
    """
    if len(demonstrations) < 2 * num_validation:
        found = f"validation: {num_validation} of {len(demonstrations)} moves"
        raise InputError(f"{found}; expected at most half of them")
    validation = list(demonstrations[-num_validation:])
    scenes = {d.scene_name for d in validation}
    return [d for d in demonstrations if d.scene_name not in scenes], validation


def common_branch(demonstrations: Sequence[Demonstration]) -> list[Demonstration]:
    """Return the demonstrations that end in the most common branch of the inverse kinematics.

    The mean of two branches, such as a wrist that is turned to either side, leads to neither.

    Args:
        demonstrations: Demonstrations of one robot.
    """
    # The first joint turns the arm to the target, the last one the tool about its axis.
    ends = np.array([d.q[-1, 1:-1] for d in demonstrations])
    is_near = np.abs(ends - np.median(ends, axis=0)).max(axis=1) <= BRANCH_RADIUS
    return [d for d, near in zip(demonstrations, is_near, strict=True) if near]
