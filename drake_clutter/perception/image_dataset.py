"""Datasets of labeled images on disk in the layout of BOP (https://bop.felk.cvut.cz).

The folder of a dataset holds what all images share, see `drake_clutter.perception.bop_models`:

    camera.json            Camera: fx, fy, cx, cy, width, height, depth_scale.
    models/                Mesh of each class in mm, and models_info.json.

Each folder in `train/`, such as `000000/`, holds the images of one scene:

    rgb/000000.png         Color image; a JPEG file in compact datasets.
    depth/000000.png       Rendered depth without noise, uint16 [0.1 mm]; 0 where there is none.
    label/000000.png       Instance number of each pixel, uint8; 255: none. For the detector.
    mask/000000_000000.png Silhouette of each instance alone: 255 in it, 0 elsewhere. Not in
                           compact datasets.
    mask_visib/...         Visible part of each silhouette. Not in compact datasets.
    scene_camera.json      Per image: cam_K, depth_scale, cam_R_w2c, cam_t_w2c [mm] (X_CT).
    scene_gt.json          Per instance: obj_id, cam_R_m2c, cam_t_m2c [mm] (X_CO).
    scene_gt_info.json     Per instance: px_count_all, px_count_valid, px_count_visib, visib_fract,
                           bbox_obj, bbox_visib.
    scene_gt_coco.json     The visible masks as annotations with COCO run lengths.

Version 0.1 wrote the folders of the scenes without `train/`, the masks and the shared files.

The obj_id of a class is its index in the catalog plus 1. Frames: T tray, O object, C camera.
"""

import json
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydantic import AfterValidator, BaseModel, Field

import drake_clutter
from drake_clutter.cell.camera import Camera
from drake_clutter.files import InputError, read_json, reading_file
from drake_clutter.limits import MAX_IMAGE_SIDE
from drake_clutter.scenes.scene import Pose
from drake_clutter.validation import (
    Count,
    CountOrZero,
    Finite,
    NonEmptyText,
    Positive,
    Vector3,
    allowed_error,
    validate,
)

Entry = TypeVar("Entry")

COLOR_FOLDER = "rgb"
DEPTH_FOLDER = "depth"
LABEL_FOLDER = "label"
MASK_FOLDER = "mask"
VISIBLE_MASK_FOLDER = "mask_visib"
TRAIN_FOLDER = "train"
"""Folder of the scenes in a dataset."""
CAMERA_FILE = "scene_camera.json"
POSES_FILE = "scene_gt.json"
INFO_FILE = "scene_gt_info.json"
COCO_FILE = "scene_gt_coco.json"
MAX_INSTANCES = 255
"""Largest number of instances in an image, whose numbers are 0 to 254."""
JPEG_QUALITY = 92
"""Quality of color images of compact datasets.

At 640 x 480 pixels they take 45 kB, a fifth of a PNG file, and differ from it by 1 of 255 at the
median.
"""
_CONTENT = "annotations in the format of BOP"
"""What the JSON files may contain, for messages."""
_NO_INSTANCE = 255
DEPTH_UNIT = 1e-4
"""Depth of the value 1 in a depth image [m]."""


@dataclass(frozen=True)
class LabeledImage:
    """A rendered image with its ground truth.

    Attributes:
        color: Color image, sRGB, uint8. Shape (H, W, 3).
        depth: Depth without noise [m]; inf where there is no surface. Shape (H, W), float32.
        label: Instance number of each pixel; -1 for tray and background. Shape (H, W).
        classes: Class name of each of the N instances.
        X_TO: Pose of each instance in the tray frame.
        unoccluded_pixels: Number of pixels that each instance covers alone on the tray. Shape (N,).
    """

    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    label: NDArray[np.int64]
    classes: tuple[str, ...]
    X_TO: tuple[Pose, ...]
    unoccluded_pixels: NDArray[np.int64]

    @property
    def visible_pixels(self) -> NDArray[np.int64]:
        """Number of visible pixels of each instance. Shape (N,)."""
        return np.bincount(self.label.ravel() + 1, minlength=len(self.classes) + 1)[1:]

    @property
    def visible_fractions(self) -> NDArray[np.float64]:
        """Visible fraction of each instance's unoccluded pixels. Shape (N,)."""
        return np.asarray(self.visible_pixels / np.maximum(self.unoccluded_pixels, 1))


@dataclass(frozen=True)
class AnnotatedImage:
    """A labeled image with the masks that are written for other programs.

    Attributes:
        image: The labeled image.
        silhouettes: Pixels that each instance covers alone on the tray. Shape (N, H, W).
    """

    image: LabeledImage
    silhouettes: NDArray[np.bool_]


def encode_depth(depth: NDArray[np.floating[Any]]) -> NDArray[np.uint16]:
    """Return depths in steps of `DEPTH_UNIT`; 0 where there is none or it exceeds 16 bits.

    Args:
        depth: Depth [m]; inf or NaN where there is none.
    """
    steps = np.rint(depth / DEPTH_UNIT)
    return np.where(steps <= np.iinfo(np.uint16).max, steps, 0).astype(np.uint16)


def write_images(
    folder: Path,
    images: Iterable[AnnotatedImage],
    camera: Camera,
    class_names: Sequence[str],
    *,
    compact: bool = False,
) -> None:
    """Write the images of one scene to a folder that appears once it is complete.

    Args:
        folder: New folder of the scene. What an interrupted run left of it is replaced.
        images: Images of the scene, with at most `MAX_INSTANCES` instances each.
        camera: Camera of the images.
        class_names: Names of the classes of the catalog, in its order.
        compact: Whether color images are compressed with losses and mask images are left out, which
            are two files for each instance. The visible masks are in `COCO_FILE` as well.

    Raises:
        InputError: An image has more than `MAX_INSTANCES` instances.
    """
    temporary = folder.with_name(f".{folder.name}")
    shutil.rmtree(temporary, ignore_errors=True)
    mask_folders = () if compact else (MASK_FOLDER, VISIBLE_MASK_FOLDER)
    for kind in (COLOR_FOLDER, DEPTH_FOLDER, LABEL_FOLDER, *mask_folders):
        (temporary / kind).mkdir(parents=True)
    camera_entry = _camera_entry(camera)
    camera_entries = dict[str, Any]()
    pose_entries = dict[str, Any]()
    info_entries = dict[str, Any]()
    coco_images = list[dict[str, Any]]()
    annotations = list[dict[str, Any]]()
    for number, annotated in enumerate(images):
        image = annotated.image
        name = f"{number:06d}.png"
        if len(image.classes) > MAX_INSTANCES:
            raise InputError(
                f"{folder}: an image of {len(image.classes)} instances; "
                f"allowed are at most {MAX_INSTANCES}"
            )
        color_file = f"{COLOR_FOLDER}/{number:06d}{'.jpg' if compact else '.png'}"
        if compact:
            Image.fromarray(image.color).save(temporary / color_file, quality=JPEG_QUALITY)
        else:
            _write_png(image.color, temporary / color_file)
        depth = encode_depth(image.depth)
        _write_png(depth, temporary / DEPTH_FOLDER / name)
        label = np.where(image.label < 0, _NO_INSTANCE, image.label)
        _write_png(label.astype(np.uint8), temporary / LABEL_FOLDER / name)
        ids = [class_names.index(class_name) + 1 for class_name in image.classes]
        poses = [
            {"obj_id": k, **_pose_in_camera(X, camera)}
            for k, X in zip(ids, image.X_TO, strict=True)
        ]
        info = _visibility_info(annotated, depth)
        for instance, silhouette in enumerate(() if compact else annotated.silhouettes):
            mask_name = f"{number:06d}_{instance:06d}.png"
            _write_mask(silhouette, temporary / MASK_FOLDER / mask_name)
            _write_mask(image.label == instance, temporary / VISIBLE_MASK_FOLDER / mask_name)
        camera_entries[str(number)] = camera_entry
        pose_entries[str(number)] = poses
        info_entries[str(number)] = info
        coco_images.append(
            {
                "id": number,
                "file_name": color_file,
                "width": camera.width,
                "height": camera.height,
            }
        )
        for instance, (category, entry) in enumerate(zip(ids, info, strict=True)):
            if entry["px_count_visib"]:
                mask = image.label == instance
                annotations.append(
                    {
                        "id": len(annotations) + 1,
                        "image_id": number,
                        "category_id": category,
                        "segmentation": {
                            "size": list(mask.shape),
                            "counts": encode_run_lengths(mask),
                        },
                        "bbox": entry["bbox_visib"],
                        "area": entry["px_count_visib"],
                        "iscrowd": 0,
                        "visible_fraction": entry["visib_fract"],
                    }
                )
    categories = [{"id": k, "name": name} for k, name in enumerate(class_names, start=1)]
    coco = {
        "info": {
            "description": "Rendered images of drake_clutter",
            "version": drake_clutter.__version__,
        },
        "licenses": [],
        "images": coco_images,
        "annotations": annotations,
        "categories": categories,
    }
    for file, document in (
        (CAMERA_FILE, camera_entries),
        (POSES_FILE, pose_entries),
        (INFO_FILE, info_entries),
        (COCO_FILE, coco),
    ):
        text = json.dumps(document, separators=(",", ":"), allow_nan=False)
        (temporary / file).write_text(text, encoding="utf-8")
    temporary.rename(folder)


def _write_png(pixels: NDArray[np.uint8] | NDArray[np.uint16], path: Path) -> None:
    # Level 1 makes files that are a fifth larger than by default in a fraction of the time.
    Image.fromarray(pixels).save(path, compress_level=1)


def _write_mask(mask: NDArray[np.bool_], path: Path) -> None:
    _write_png(np.where(mask, np.uint8(255), np.uint8(0)), path)


def encode_run_lengths(mask: NDArray[np.bool_]) -> list[int]:
    """Return COCO's uncompressed run-length counts of a mask.

    These are lists of numbers, as in BOP's files; pycocotools reads them with `frPyObjects` but
    writes compressed ones only.

    Args:
        mask: Mask of an image. Shape (H, W).

    Returns:
        Lengths of alternate runs outside and inside of the mask, down the columns. The first run
        is outside.
    """
    flat = np.concatenate([[False], mask.ravel(order="F")])
    ends = np.concatenate([[0], np.flatnonzero(flat[1:] != flat[:-1]), [mask.size]])
    return [int(count) for count in np.diff(ends)]


def _camera_entry(camera: Camera) -> dict[str, Any]:
    X_CT = camera.X_TC.inverse()
    u0, v0 = camera.principal_point
    return {
        "cam_K": [camera.focal_length, 0.0, u0, 0.0, camera.focal_length, v0, 0.0, 0.0, 1.0],
        "depth_scale": 1000 * DEPTH_UNIT,
        "cam_R_w2c": X_CT.rotation().matrix().ravel().tolist(),
        "cam_t_w2c": (1000 * X_CT.translation() + 0.0).tolist(),  # The sum turns -0.0 into 0.0.
    }


def _pose_in_camera(X_TO: Pose, camera: Camera) -> dict[str, list[float]]:
    R_CT = camera.X_TC.rotation().matrix().T
    R_CO = R_CT @ X_TO.rotation
    p_CO = R_CT @ (X_TO.p - camera.X_TC.translation())
    return {
        "cam_R_m2c": R_CO.round(9).ravel().tolist(),
        "cam_t_m2c": (1000 * p_CO).round(6).tolist(),
    }


def _bounding_box(mask: NDArray[np.bool_]) -> list[int]:
    """Return the left column, upper row, width and height of a mask; all -1 if it is empty."""
    rows = np.flatnonzero(mask.any(axis=1))
    columns = np.flatnonzero(mask.any(axis=0))
    if not rows.size:
        return [-1, -1, -1, -1]
    left, top = int(columns[0]), int(rows[0])
    return [left, top, int(columns[-1]) - left + 1, int(rows[-1]) - top + 1]


def _visibility_info(annotated: AnnotatedImage, depth: NDArray[np.uint16]) -> list[dict[str, Any]]:
    """Return BOP's information on the instances of an image, given its encoded depth."""
    image = annotated.image
    entries = []
    counts = zip(
        image.visible_pixels, image.unoccluded_pixels, image.visible_fractions, strict=True
    )
    for instance, (visible, unoccluded, fraction) in enumerate(counts):
        silhouette = annotated.silhouettes[instance]
        entry = {
            "px_count_all": int(unoccluded),
            "px_count_valid": int(np.count_nonzero(depth[silhouette])),
            "px_count_visib": int(visible),
            "visib_fract": float(fraction),
            "bbox_obj": _bounding_box(silhouette),
            "bbox_visib": _bounding_box(image.label == instance),
        }
        entries.append(entry)
    return entries


class ImageDataset:
    """Images of a dataset, read from disk when they are accessed by index."""

    def __init__(self, folder: Path) -> None:
        """Open a dataset.

        Raises:
            InputError: The folder holds no images.
        """
        # Datasets of version 0.1 have no such folder.
        split = folder / TRAIN_FOLDER if (folder / TRAIN_FOLDER).is_dir() else folder
        scenes = sorted(path for path in split.glob("[0-9]*") if (path / COCO_FILE).is_file())
        self._files = [
            (scene, path.name)
            for scene in scenes
            for path in sorted((scene / COLOR_FOLDER).glob("[0-9]*"))
        ]
        if not self._files:
            raise InputError(
                f"{folder}: holds no images; "
                "expected a folder that training/render_image_dataset.py wrote"
            )
        path = scenes[0] / COCO_FILE
        coco = validate(_CocoFile, read_json(path, "annotations in the format of COCO"), str(path))
        self._class_names = {category.id: category.name for category in coco.categories}

    def __len__(self) -> int:
        return len(self._files)

    def __getitem__(self, index: int) -> LabeledImage:
        """Return the image of an index; the images of one scene have consecutive indices.

        Raises:
            InputError: A file cannot be read, or does not belong to the others.
        """
        scene, color_name = self._files[index]
        name = Path(color_name).stem
        key = name.lstrip("0") or "0"
        camera_entry = _entry_of_image(_read_cameras, scene / CAMERA_FILE, key)
        instances = _entry_of_image(_read_poses, scene / POSES_FILE, key)
        infos = _entry_of_image(_read_infos, scene / INFO_FILE, key)
        color = _read_image(scene / COLOR_FOLDER / color_name)
        stored_depth = _read_image(scene / DEPTH_FOLDER / f"{name}.png")
        meters = np.float32(camera_entry.depth_scale / 1000)
        depth = stored_depth.astype(np.float32) * meters
        depth[depth == 0] = np.inf
        label = _read_image(scene / LABEL_FOLDER / f"{name}.png").astype(np.int64)
        label[label == _NO_INSTANCE] = -1
        size = label.shape
        if len(size) != 2 or depth.shape != size or color.shape != (*size, 3):
            raise InputError(
                f"{scene}: image {name}: shapes {color.shape}, {depth.shape}, {label.shape}; "
                "expected color, depth and label of one size"
            )
        if not label.max() < len(instances) == len(infos):
            raise InputError(
                f"{scene}: image {name}: {len(instances)} poses, {len(infos)} infos, labels up to "
                f"{label.max()}; expected one of each for every instance"
            )
        unknown = [entry.obj_id for entry in instances if entry.obj_id not in self._class_names]
        if unknown:
            raise InputError(
                f"{scene / POSES_FILE}: {key}: obj_id: {unknown[0]}; "
                f"expected a category of {COCO_FILE}"
            )
        return LabeledImage(
            color,
            depth,
            label,
            tuple(self._class_names[instance.obj_id] for instance in instances),
            tuple(_pose_in_tray(instance, camera_entry) for instance in instances),
            np.array([info.px_count_all for info in infos], np.int64),
        )


def _check_rotation(matrix: tuple[float, ...]) -> tuple[float, ...]:
    """Check that nine numbers are a rotation matrix, but for rounding."""
    R = np.reshape(matrix, (3, 3))
    is_orthogonal = (np.abs(R) < 2).all() and np.allclose(R @ R.T, np.eye(3), atol=1e-3)
    if not is_orthogonal or np.linalg.det(R) < 0:
        raise allowed_error("the nine numbers of a rotation matrix")
    return matrix


_RotationEntry = Annotated[
    tuple[Finite, ...], Field(min_length=9, max_length=9), AfterValidator(_check_rotation)
]
"""Rotation matrix in a file, row by row."""


class _CategoryEntry(BaseModel):
    """A category of `COCO_FILE`."""

    id: Count
    name: NonEmptyText


class _CocoFile(BaseModel):
    """What is read of `COCO_FILE`."""

    categories: tuple[_CategoryEntry, ...]


class _CameraEntry(BaseModel):
    """What is read of an image's entry in `CAMERA_FILE`."""

    depth_scale: Positive
    cam_R_w2c: _RotationEntry
    cam_t_w2c: Vector3


class _PoseEntry(BaseModel):
    """An instance in `POSES_FILE`."""

    obj_id: Count
    cam_R_m2c: _RotationEntry
    cam_t_m2c: Vector3


class _InfoEntry(BaseModel):
    """What is read of an instance in `INFO_FILE`."""

    px_count_all: CountOrZero


@lru_cache(maxsize=64)
def _read_cameras(path: Path) -> dict[str, _CameraEntry]:
    return validate(dict[str, _CameraEntry], read_json(path, _CONTENT), str(path))


@lru_cache(maxsize=64)
def _read_poses(path: Path) -> dict[str, tuple[_PoseEntry, ...]]:
    return validate(dict[str, tuple[_PoseEntry, ...]], read_json(path, _CONTENT), str(path))


@lru_cache(maxsize=64)
def _read_infos(path: Path) -> dict[str, tuple[_InfoEntry, ...]]:
    return validate(dict[str, tuple[_InfoEntry, ...]], read_json(path, _CONTENT), str(path))


def _entry_of_image(read: Callable[[Path], Mapping[str, Entry]], path: Path, key: str) -> Entry:
    """Return the entry of an image in a file of its scene."""
    entries = read(path)
    if key not in entries:
        raise InputError(f"{path}: lacks image {key}; expected one entry for each image")
    return entries[key]


def _read_image(path: Path) -> NDArray[Any]:
    with reading_file(path, "an image"), Image.open(path) as image:
        if image.width > MAX_IMAGE_SIDE or image.height > MAX_IMAGE_SIDE:
            raise ValueError(f"{image.width} x {image.height} pixels")
        return np.array(image)


def _pose_in_tray(instance: _PoseEntry, camera_entry: _CameraEntry) -> Pose:
    R_TC = np.reshape(camera_entry.cam_R_w2c, (3, 3)).T
    p_CT = np.array(camera_entry.cam_t_w2c)
    R_CO = np.reshape(instance.cam_R_m2c, (3, 3))
    p_CO = np.array(instance.cam_t_m2c)
    return Pose.from_rotation(R_TC @ R_CO, R_TC @ (p_CO - p_CT) / 1000)
