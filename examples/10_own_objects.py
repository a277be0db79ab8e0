"""Make the meshes of examples/own_objects, but for the mug."""

# mypy: allow-untyped-calls
import argparse
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image, ImageDraw
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

OUTLINES = {  # radius and height [mm], from the axis around
    "glass": [(0, 0), (35, 0), (35, 115), (14, 150), (14, 180)],
    "cap": [(14, 180), (17, 180), (17, 200), (0, 200)],
    "bowl": [(0, 0), (35, 0), (75, 55), (71, 55), (33, 5), (0, 5)],
    "plate": [(0, 0), (55, 0), (90, 9), (90, 14), (54, 5), (0, 5)],
}


def turned(name: str) -> trimesh.Trimesh:
    return trimesh.creation.revolve(np.array(OUTLINES[name]) / 1000, sections=48)


def scanned_box() -> trimesh.Trimesh:
    box = trimesh.creation.box((70, 150, 110)).subdivide().subdivide()  # in mm
    points = box.triangles.reshape(-1, 3)
    side = 2 * np.abs(box.face_normals).argmax(axis=1) + (box.face_normals.max(axis=1) > 0.5)
    image = Image.new("RGB", (300, 200), "#f4e7c5")
    draw, uv = ImageDraw.Draw(image), np.empty((len(points), 2))
    for k in range(6):  # each side has a part of the texture
        left, top, axes = 100 * (k % 3), 100 * (k // 3), [(1, 2), (0, 2), (0, 1)][k // 2]
        draw.rectangle((left + 4, top + 60, left + 95, top + 92), fill="#2c6e49")
        draw.text((left + 18, top + 12), "TEA", fill="#8c2f1b", font_size=34)
        corners = np.repeat(side == k, 3)
        on_side = 0.5 + points[corners][:, axes] / np.ptp(points, axis=0)[list(axes)]
        uv[corners] = (on_side + np.array([k % 3, 1 - k // 3])) / [3, 2]
    noise = 0.3 * np.sin(points[:, [1, 2, 0]] / 9)
    visual = TextureVisuals(uv, SimpleMaterial(image, diffuse=[255] * 3, name="tea_box"))
    faces = np.arange(len(points)).reshape(-1, 3)
    return trimesh.Trimesh(points + noise, faces, visual=visual, process=False)


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--folder", type=Path, default=Path("examples/own_objects"))
folder = parser.parse_args().folder
bottle = trimesh.Scene()
y_up = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])
for name, color in (("glass", (0.15, 0.40, 0.25)), ("cap", (0.75, 0.15, 0.12))):
    part = turned(name)  # open where the other one continues
    part.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=[*color, 1.0]))
    bottle.add_geometry(part.apply_transform(y_up), node_name=name)
bottle.export(folder / "bottle.glb")
turned("bowl").export(folder / "bowl.stl")
turned("plate").export(folder / "plate.stl")
scanned_box().export(folder / "tea_box.obj", mtl_name="tea_box.mtl")
