"""Sets of labeled images on disk, in the layout of BOP (https://bop.felk.cvut.cz), for networks that learn to see.

A folder of the set holds the images of one scene, `000000/`:

    rgb/000000.png         colour
    depth/000000.png       uint16, in 0.1 mm, 0 where nothing is seen; as rendered, without a camera's noise
    label/000000.png       uint8, the number of the instance in the image, 255: none; in place of BOP's file per mask
    scene_camera.json      cam_K, depth_scale, cam_R_w2c, cam_t_w2c (mm): R_CT and p_CT
    scene_gt.json          of each instance obj_id, cam_R_m2c, cam_t_m2c (mm): R_CO and p_CO
    scene_gt_info.json     of each instance px_count_all, px_count_visib, visib_fract, bbox_visib
    scene_gt_coco.json     the same masks as COCO run-length counts

An obj_id is the place of the class in the catalog, from 1 on. Frames: T tray, O object, C camera.
"""

import json
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from drake_clutter.cell.camera import Camera
from drake_clutter.files import InputError
from drake_clutter.scenes.scene import Pose

COLOR, DEPTH, LABEL = "rgb", "depth", "label"
CAMERA_FILE, POSES_FILE = "scene_camera.json", "scene_gt.json"
INFO_FILE, COCO_FILE = "scene_gt_info.json", "scene_gt_coco.json"
MAX_INSTANCES = 255
_NO_INSTANCE = 255
_DEPTH_UNIT = 1e-4
"""m."""


@dataclass(frozen=True)
class LabeledImage:
    """An image and what it shows.

    Attributes:
        color: (H, W, 3) uint8, sRGB.
        depth: (H, W) float32, m along the camera's axis, inf where nothing is seen; without a camera's noise.
        label: (H, W) int, number of the instance, -1 for the tray and the background.
        classes: name of the class of each of the N instances.
        X_TO: pose of each in the tray frame.
        unoccluded_pixels: (N,) int, pixels that each would cover alone on the tray.
    """

    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    label: NDArray[np.int64]
    classes: tuple[str, ...]
    X_TO: tuple[Pose, ...]
    unoccluded_pixels: NDArray[np.int64]

    @property
    def visible_pixels(self) -> NDArray[np.int64]:
        """(N,) pixels of each instance."""
        return np.bincount(self.label.ravel() + 1, minlength=len(self.classes) + 1)[1:]

    @property
    def visible_fractions(self) -> NDArray[np.float64]:
        """(N,) of the pixels that each instance would cover alone, the share that is seen."""
        return np.asarray(self.visible_pixels / np.maximum(self.unoccluded_pixels, 1))


def write_images(
    folder: Path, images: Iterable[LabeledImage], camera: Camera, class_names: Sequence[str]
) -> None:
    """Writes the images of one scene to a folder that is there once it is complete.

    Args:
        folder: not there yet; what an interrupted run left of it is replaced.
        images: of the scene, with at most 255 instances each.
        camera: what took them.
        class_names: of the catalog, in its order.
    """
    temporary = folder.with_name(f".{folder.name}")
    shutil.rmtree(temporary, ignore_errors=True)
    for kind in (COLOR, DEPTH, LABEL):
        (temporary / kind).mkdir(parents=True)
    X_CT, (u0, v0) = camera.X_TC.inverse(), camera.principal_point
    K = [camera.focal_length, 0.0, u0, 0.0, camera.focal_length, v0, 0.0, 0.0, 1.0]
    eye = {
        "cam_K": K,
        "depth_scale": 1000 * _DEPTH_UNIT,
        "cam_R_w2c": X_CT.rotation().matrix().ravel().tolist(),
        "cam_t_w2c": (1000 * X_CT.translation() + 0.0).tolist(),  # without -0.0
    }
    eyes, poses, infos = dict[str, Any](), dict[str, Any](), dict[str, Any]()
    coco: dict[str, Any] = {"images": [], "annotations": []}
    coco["categories"] = [{"id": k, "name": name} for k, name in enumerate(class_names, start=1)]
    for number, image in enumerate(images):
        name = f"{number:06d}.png"
        _write_png(image.color, temporary / COLOR / name)
        depth = np.where(np.isfinite(image.depth), np.round(image.depth / _DEPTH_UNIT), 0).astype(
            np.uint16
        )
        _write_png(depth, temporary / DEPTH / name)
        _write_png(
            np.where(image.label < 0, _NO_INSTANCE, image.label).astype(np.uint8),
            temporary / LABEL / name,
        )
        ids = [class_names.index(class_name) + 1 for class_name in image.classes]
        eyes[str(number)] = eye
        poses[str(number)] = [
            {"obj_id": k, **_pose_in_camera(X, camera)}
            for k, X in zip(ids, image.X_TO, strict=True)
        ]
        infos[str(number)] = info = _visibility_info(image)
        coco["images"].append(
            {
                "id": number,
                "file_name": f"{COLOR}/{name}",
                "width": camera.width,
                "height": camera.height,
            }
        )
        for instance, (category, about) in enumerate(zip(ids, info, strict=True)):
            if about["px_count_visib"]:
                mask = image.label == instance
                coco["annotations"].append(
                    {
                        "id": len(coco["annotations"]) + 1,
                        "image_id": number,
                        "category_id": category,
                        "segmentation": {
                            "size": list(mask.shape),
                            "counts": encode_run_lengths(mask),
                        },
                        "bbox": about["bbox_visib"],
                        "area": about["px_count_visib"],
                        "iscrowd": 0,
                        "visible_fraction": about["visib_fract"],
                    }
                )
    for file, value in (
        (CAMERA_FILE, eyes),
        (POSES_FILE, poses),
        (INFO_FILE, infos),
        (COCO_FILE, coco),
    ):
        (temporary / file).write_text(
            json.dumps(value, separators=(",", ":"), allow_nan=False), encoding="utf-8"
        )
    temporary.rename(folder)


def _write_png(pixels: NDArray[np.uint8] | NDArray[np.uint16], path: Path) -> None:
    Image.fromarray(pixels).save(
        path, compress_level=1
    )  # a fifth larger than by default, written in a fraction of the time


def encode_run_lengths(mask: NDArray[np.bool_]) -> list[int]:
    """COCO's uncompressed counts of a mask (H, W): down the columns, pixels outside and inside in turn, outside first."""
    flat = np.concatenate([[False], mask.ravel(order="F")])
    ends = np.concatenate([[0], np.flatnonzero(flat[1:] != flat[:-1]), [mask.size]])
    return [int(count) for count in np.diff(ends)]


def _pose_in_camera(X_TO: Pose, camera: Camera) -> dict[str, list[float]]:
    R_CT = camera.X_TC.rotation().matrix().T
    R_CO, p_CO = R_CT @ X_TO.rotation, R_CT @ (X_TO.p - camera.X_TC.translation())
    return {
        "cam_R_m2c": R_CO.round(9).ravel().tolist(),
        "cam_t_m2c": (1000 * p_CO).round(6).tolist(),
    }


def _visibility_info(image: LabeledImage) -> list[dict[str, Any]]:
    infos = []
    for instance, (seen, alone, share) in enumerate(
        zip(image.visible_pixels, image.unoccluded_pixels, image.visible_fractions, strict=True)
    ):
        box = [-1, -1, -1, -1]
        if seen:
            rows, columns = np.nonzero(image.label == instance)
            box = [
                int(columns.min()),
                int(rows.min()),
                int(np.ptp(columns)) + 1,
                int(np.ptp(rows)) + 1,
            ]
        info = {
            "px_count_all": int(alone),
            "px_count_visib": int(seen),
            "visib_fract": float(share),
            "bbox_visib": box,
        }
        infos.append(info)
    return infos


class ImageDataset:
    """The images of a set, read as they are asked for."""

    def __init__(self, folder: Path) -> None:
        """Opens a set.

        Raises:
            InputError: there are no images in the folder.
        """
        scenes = sorted(path for path in folder.glob("[0-9]*") if (path / COCO_FILE).is_file())
        self._files = [
            (scene, path.stem) for scene in scenes for path in sorted((scene / COLOR).glob("*.png"))
        ]
        if not self._files:
            raise InputError(
                f"{folder}: holds no images; allowed is a folder that training/render_image_dataset.py wrote"
            )
        categories = json.loads((scenes[0] / COCO_FILE).read_text(encoding="utf-8"))["categories"]
        self._class_names = {category["id"]: category["name"] for category in categories}

    def __len__(self) -> int:
        return len(self._files)

    def __getitem__(self, index: int) -> LabeledImage:
        """The image of a number; those of one scene follow each other."""
        scene, name = self._files[index]
        eye, instances, infos = (
            _read_scene_json(scene / file)[str(int(name))]
            for file in (CAMERA_FILE, POSES_FILE, INFO_FILE)
        )
        depth = np.asarray(Image.open(scene / DEPTH / f"{name}.png")).astype(
            np.float32
        ) * np.float32(eye["depth_scale"] / 1000)
        depth[depth == 0] = np.inf
        label = np.asarray(Image.open(scene / LABEL / f"{name}.png")).astype(np.int64)
        label[label == _NO_INSTANCE] = -1
        return LabeledImage(
            np.asarray(Image.open(scene / COLOR / f"{name}.png")),
            depth,
            label,
            tuple(self._class_names[instance["obj_id"]] for instance in instances),
            tuple(_pose_in_tray(instance, eye) for instance in instances),
            np.array([info["px_count_all"] for info in infos], np.int64),
        )


@lru_cache(maxsize=64)
def _read_scene_json(path: Path) -> dict[str, Any]:
    read: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return read


def _pose_in_tray(instance: dict[str, Any], eye: dict[str, Any]) -> Pose:
    R_TC, p_CT = np.reshape(eye["cam_R_w2c"], (3, 3)).T, np.array(eye["cam_t_w2c"])
    R_CO, p_CO = np.reshape(instance["cam_R_m2c"], (3, 3)), np.array(instance["cam_t_m2c"])
    return Pose.from_rotation(R_TC @ R_CO, R_TC @ (p_CO - p_CT) / 1000)
