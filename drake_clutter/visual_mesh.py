"""Checks of textured mesh files, which VTK and trimesh do not make.

VTK ends the process where it reads a damaged texture or a vertex that does not exist, and trimesh
leaves a damaged texture out.
"""

# trimesh is typed in part only.
# mypy: allow-untyped-calls

import base64
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import trimesh
from PIL import Image

from drake_clutter.files import reading_file

GLTF_SUFFIXES = frozenset({".glb", ".gltf"})
"""Suffixes of glTF files, whose y axis points up."""
_EXPECTED = "a mesh with intact textures"
_PNG_END = b"IEND\xae\x42\x60\x82"
"""Last chunk of a PNG file with its checksum, which Pillow does not need."""


def _named_files(path: Path, keyword: str) -> Iterator[Path]:
    """Yield the files that a line of an OBJ or MTL file names after a keyword."""
    for line in path.read_text(errors="replace").splitlines():
        words = line.split()
        if len(words) > 1 and words[0] == keyword:
            file = path.parent / " ".join(words[1:])
            # Options may precede the name, which is the last word then.
            yield file if file.is_file() else path.parent / words[-1]


def obj_companions(path: Path) -> Iterator[Path]:
    """Yield the material files and color textures that an OBJ file names.

    Args:
        path: The OBJ file.
    """
    for materials in _named_files(path, "mtllib"):
        yield materials
        if materials.is_file():
            yield from _named_files(materials, "map_Kd")


def _split_gltf(path: Path) -> tuple[dict[str, Any], bytes]:
    """Return the JSON document of a glTF file and the binary buffer of a GLB file."""
    content = path.read_bytes()
    if not content.startswith(b"glTF"):
        return json.loads(content), b""
    chunks = list[bytes]()
    start = 12  # after magic number, version and length
    while start < len(content):
        length = int.from_bytes(content[start : start + 4], "little")
        chunks.append(content[start + 8 : start + 8 + length])
        start += 8 + length
    return json.loads(chunks[0]), b"".join(chunks[1:2])


def _read_uri(folder: Path, uri: str) -> bytes:
    """Return the content of a URI in a glTF file of a folder."""
    if uri.startswith("data:"):
        return base64.b64decode(uri.partition(",")[2])
    return (folder / unquote(uri)).read_bytes()


def _gltf_images(path: Path) -> Iterator[tuple[str, bytes]]:
    """Yield the places and contents of the images of a glTF file."""
    document, binary = _split_gltf(path)
    for index, image in enumerate(document.get("images", [])):
        uri = image.get("uri", "")
        if "ktx2" in image.get("mimeType", uri):
            continue  # only some renderers read these, by an extension
        if uri:
            content = _read_uri(path.parent, uri)
        else:
            view = document["bufferViews"][image["bufferView"]]
            buffer = document["buffers"][view["buffer"]]
            data = _read_uri(path.parent, buffer["uri"]) if "uri" in buffer else binary
            start = view.get("byteOffset", 0)
            content = data[start : start + view["byteLength"]]
        yield f"{path}: images.{index}", content


def _check_image(where: str, content: bytes) -> None:
    """Raise an error unless an image can be decoded to its end."""
    with reading_file(where, "an image, such as PNG or JPEG"):
        with Image.open(io.BytesIO(content)) as image:
            image.verify()
        with Image.open(io.BytesIO(content)) as image:
            image.load()
            if image.format == "PNG" and _PNG_END not in content:
                raise ValueError("its end is missing")


def check_textures(path: Path) -> None:
    """Check the textures of a mesh file.

    Args:
        path: The file. Other formats than OBJ and glTF are not checked.

    Raises:
        InputError: A texture is damaged.
    """
    suffix = path.suffix.lower()
    with reading_file(path, _EXPECTED):
        if suffix == ".obj":
            for file in obj_companions(path):
                if file.suffix.lower() != ".mtl" and file.is_file():
                    _check_image(str(file), file.read_bytes())
        elif suffix in GLTF_SUFFIXES:
            for where, content in _gltf_images(path):
                _check_image(where, content)


def check_visual_mesh(path: Path) -> None:
    """Check a mesh file before VTK reads it.

    Args:
        path: The file. Other formats than OBJ and glTF are not checked.

    Raises:
        InputError: A texture is damaged, or an index in a glTF file is out of range.
    """
    check_textures(path)
    if path.suffix.lower() in GLTF_SUFFIXES:
        with reading_file(path, _EXPECTED):
            _check_indices(path)


def _check_indices(path: Path) -> None:
    """Raise an error if an index of a mesh, material or vertex of a glTF file is out of range."""
    document, _ = _split_gltf(path)
    primitives = [each for mesh in document["meshes"] for each in mesh["primitives"]]
    for owners, key, values in (
        (document.get("nodes", []), "mesh", document["meshes"]),
        (primitives, "material", document.get("materials", [])),
    ):
        if (index := max((owner.get(key, -1) for owner in owners), default=-1)) >= len(values):
            raise ValueError(f"it refers to {key} {index} of {len(values)}")
    for part in trimesh.load_scene(path, process=False).geometry.values():
        faces = np.asarray(getattr(part, "faces", ()))
        if faces.size and faces.max() >= len(part.vertices):
            raise ValueError(f"a triangle has vertex {faces.max()} of {len(part.vertices)}")
