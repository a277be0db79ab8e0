"""Randomization of recorded episodes: poses, masses, friction, lights, colors, cameras, noise.

What an episode's random generator has drawn is a `Variation`, which is stored with the episode.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Self
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from drake_clutter.catalog import ObjectClass
from drake_clutter.files import InputError, temporary_folder
from drake_clutter.scenes.geometry import group_touching_objects, transport_pose
from drake_clutter.scenes.scene import Pose, Scene, SceneObject, sample_offsets
from drake_clutter.validation import (
    Flag,
    Fraction,
    InRange,
    NonNegative,
    Positive,
    StrictModel,
    allowed_error,
    load_config_as,
    validate,
)

Floats = NDArray[np.float64]
Vector = tuple[float, float, float]
Angle = Annotated[float, InRange(0.0, 180.0)]
"""Largest angle of a random rotation [deg]."""

POSE_ATTEMPTS = 20
"""Number of random poses of a stack after which it stays where it is."""
MIN_STACK_GAP = 0.010
"""Smallest distance between the bounding boxes of two stacks after their motion [m]."""
_FRICTION_TAGS = ("mu_static", "mu_dynamic")
_DRAKE_NAMESPACE = "drake.mit.edu"


class Factor(StrictModel):
    """Range of a factor.

    Attributes:
        low: Smallest value.
        high: Largest value.
    """

    low: Positive = 1.0
    high: Positive = 1.0

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if self.low > self.high:
            raise allowed_error("`low` not above `high`")
        return self

    @property
    def varies(self) -> bool:
        """Whether the range is more than the factor 1."""
        return (self.low, self.high) != (1.0, 1.0)

    def sample(self, rng: np.random.Generator) -> float:
        """Return a factor, drawn uniformly."""
        return float(rng.uniform(self.low, self.high))


class RandomizationConfig(StrictModel):
    """What is varied from episode to episode. Values are drawn uniformly from their ranges.

    The defaults vary nothing.

    Attributes:
        stack_offset: Radius of the disc from which the offset of each stack is drawn [m].
        stack_turn_deg: Largest turn of a stack about its vertical axis, in both directions [deg].
        mass: Range of a factor of each object's mass.
        friction: Range of a factor of each object's coefficients of friction.
        light_intensity: Range of a factor of the intensity of each light.
        light_turn_deg: Largest angle between a light's direction and the default one [deg].
        color: Part of a random color in the colors of support, fixtures, background and labels of
            objects.
        camera_offset: Largest offset of each recorded camera along each axis [m].
        camera_turn_deg: Largest rotation of each recorded camera about each of its axes [deg].
        depth_noise: Whether depth images have the noise of a stereo camera.
        color_noise: Standard deviation of the noise of color images [8-bit levels].
    """

    stack_offset: NonNegative = 0.0
    stack_turn_deg: Angle = 0.0
    mass: Factor = Factor()
    friction: Factor = Factor()
    light_intensity: Factor = Factor()
    light_turn_deg: Angle = 0.0
    color: Fraction = 0.0
    camera_offset: NonNegative = 0.0
    camera_turn_deg: Angle = 0.0
    depth_noise: Flag = False
    color_noise: Annotated[float, InRange(0.0, 128.0)] = 0.0


RANDOMIZATION_GROUPS: Mapping[str, Mapping[str, Any]] = {
    "poses": {"stack_offset": 0.05, "stack_turn_deg": 180.0},
    "mass": {"mass": Factor(low=0.8, high=1.2)},
    "friction": {"friction": Factor(low=0.8, high=1.2)},
    "lights": {"light_intensity": Factor(low=0.6, high=1.4), "light_turn_deg": 30.0},
    "textures": {"color": 0.5},
    "camera": {"camera_offset": 0.02, "camera_turn_deg": 2.0},
    "noise": {"depth_noise": True, "color_noise": 4.0},
}
"""Fields of `RandomizationConfig` by the names of groups. The ranges are assumptions."""


def load_randomization(text: str) -> RandomizationConfig:
    """Return the randomization of an option.

    Args:
        text: Names of groups, separated by commas; or a YAML file with the fields of
            `RandomizationConfig`; or "" for none.

    Raises:
        InputError: A group is unknown, or the file cannot be used.
    """
    if text.endswith((".yaml", ".yml")):
        return load_config_as(RandomizationConfig(), Path(text))
    fields = dict[str, Any]()
    for name in filter(None, text.split(",")):
        if name not in RANDOMIZATION_GROUPS:
            allowed = ", ".join(RANDOMIZATION_GROUPS)
            raise InputError(f"--randomize {name}: expected some of {allowed}, or a .yaml file")
        fields |= RANDOMIZATION_GROUPS[name]
    return RandomizationConfig(**fields)


@dataclass(frozen=True)
class LightVariation:
    """A light of an episode.

    Attributes:
        intensity: Factor of its intensity.
        rotation_vector: Rotation of its direction in the camera's frame [rad]. Shape (3,).
    """

    intensity: float
    rotation_vector: Vector


@dataclass(frozen=True)
class CameraVariation:
    """Mounting error of a camera: X_CC' of its actual frame C' in its nominal frame C.

    Attributes:
        translation: p_CC' [m]. Shape (3,).
        rotation_vector: Rotation [rad]. Shape (3,).
    """

    translation: Vector
    rotation_vector: Vector


@dataclass(frozen=True)
class Variation:
    """What is varied in an episode; the poses of the objects are those of its initial scene.

    Attributes:
        mass: Mass of each object [kg], by name; empty if it is not varied.
        friction: Factor of the coefficients of friction of each object, by name; empty if it is not
            varied.
        lights: The lights; empty if they are not varied.
        colors: Random sRGB colors, 0 to 1, of parts of the cell and of labels, by name.
        color_fraction: Part of these colors in the colors of the images.
        cameras: Mounting errors, by name of the camera.
        depth_noise: Whether depth images have the noise of a stereo camera.
        color_noise: Standard deviation of the noise of color images [8-bit levels].
    """

    mass: Mapping[str, Positive] = field(default_factory=dict)
    friction: Mapping[str, Positive] = field(default_factory=dict)
    lights: tuple[LightVariation, ...] = ()
    colors: Mapping[str, Vector] = field(default_factory=dict)
    color_fraction: float = 0.0
    cameras: Mapping[str, CameraVariation] = field(default_factory=dict)
    depth_noise: bool = False
    color_noise: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return asdict(self)

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> "Variation":
        """Return the variation of a recorded episode; without fields, that of none.

        Raises:
            InputError: A field has a value that is not allowed.
        """
        return validate(Variation, dict(values), "variation")

    def camera_error(self, name: str) -> RigidTransform:
        """Return X_CC' of a camera; see `CameraVariation`."""
        error = self.cameras.get(name)
        if error is None:
            return RigidTransform()
        R = Rotation.from_rotvec(error.rotation_vector).as_matrix()
        return RigidTransform(RotationMatrix(R), error.translation)


def draw_variation(
    config: RandomizationConfig,
    objects: Sequence[SceneObject],
    parts: Sequence[str],
    cameras: Sequence[str],
    num_lights: int,
    rng: np.random.Generator,
) -> Variation:
    """Draw the variation of an episode.

    Args:
        config: Ranges.
        objects: Objects of the scene.
        parts: Names of the parts of the cell whose colors are varied.
        cameras: Names of the recorded cameras.
        num_lights: Number of lights.
        rng: Random generator of the episode's variation.
    """
    # Every group has a generator of its own, so that switching one on leaves the others as they
    # are.
    masses, frictions, lights, colors, mountings = rng.spawn(5)
    names = [o.name for o in objects]

    def vector(generator: np.random.Generator, bound: float) -> Vector:
        x, y, z = generator.uniform(-bound, bound, 3).tolist()
        return (x, y, z)

    def color() -> Vector:
        red, green, blue = colors.random(3).tolist()
        return (red, green, blue)

    light_bound = math.radians(config.light_turn_deg) / math.sqrt(3)
    camera_bound = math.radians(config.camera_turn_deg)
    vary_lights = config.light_intensity.varies or config.light_turn_deg > 0
    vary_cameras = config.camera_offset > 0 or config.camera_turn_deg > 0
    return Variation(
        mass={o.name: o.object_class.mass * config.mass.sample(masses) for o in objects}
        if config.mass.varies
        else {},
        friction={name: config.friction.sample(frictions) for name in names}
        if config.friction.varies
        else {},
        lights=tuple(
            LightVariation(config.light_intensity.sample(lights), vector(lights, light_bound))
            for _ in range(num_lights)
        )
        if vary_lights
        else (),
        colors={name: color() for name in (*parts, *names)} if config.color else {},
        color_fraction=config.color,
        cameras={
            name: CameraVariation(
                vector(mountings, config.camera_offset), vector(mountings, camera_bound)
            )
            for name in cameras
        }
        if vary_cameras
        else {},
        depth_noise=config.depth_noise,
        color_noise=config.color_noise,
    )


def vary_poses(scene: Scene, config: RandomizationConfig, rng: np.random.Generator) -> Scene:
    """Return a scene whose stacks are moved and turned on the support.

    A stack moves as a rigid body on the floor, so it remains stable. One that would leave the
    support or come closer to another one than `MIN_STACK_GAP` is drawn again.

    Args:
        scene: Scene at rest.
        config: Ranges.
        rng: Random generator.
    """
    if not config.stack_offset and not config.stack_turn_deg:
        return scene
    stacks = group_touching_objects(scene.objects, MIN_STACK_GAP)
    for k in rng.permutation(len(stacks)).tolist():
        for _ in range(POSE_ATTEMPTS):
            moved = _move_stack(stacks[k], config, rng)
            others = [o for other, stack in enumerate(stacks) if other != k for o in stack]
            if _is_on_support(scene, moved) and _is_apart(moved, others):
                stacks[k] = moved
                break
    return scene.with_poses({o.name: o.X_TO for stack in stacks for o in stack})


def _move_stack(
    stack: Sequence[SceneObject], config: RandomizationConfig, rng: np.random.Generator
) -> list[SceneObject]:
    """Return the objects of a stack at a random pose."""
    corners = np.vstack([o.corners_T for o in stack])
    x, y = ((corners.min(axis=0) + corners.max(axis=0)) / 2)[:2].tolist()
    turn = rng.uniform(-config.stack_turn_deg, config.stack_turn_deg)
    R = Rotation.from_euler("z", turn, degrees=True).as_matrix()
    before = Pose((x, y, 0.0))
    after = Pose.from_rotation(R, before.p + sample_offsets(1, config.stack_offset, rng)[0])
    return [replace(o, X_TO=transport_pose(before, after, o.X_TO)) for o in stack]


def _is_on_support(scene: Scene, objects: Sequence[SceneObject]) -> bool:
    """Return whether objects keep `MIN_STACK_GAP` from the edges of the support."""
    reach = max(
        float(np.abs(o.corners_T[:, axis]).max() - scene.support.half_size[axis])
        for o in objects
        for axis in (0, 1)
    )
    return reach <= -MIN_STACK_GAP


def _is_apart(objects: Sequence[SceneObject], others: Sequence[SceneObject]) -> bool:
    """Return whether the bounding boxes of objects keep `MIN_STACK_GAP` from those of others."""
    for first in objects:
        for second in others:
            (lower_a, upper_a), (lower_b, upper_b) = first.bounds_T, second.bounds_T
            if np.maximum(lower_a - upper_b, lower_b - upper_a).max() <= MIN_STACK_GAP:
                return False
    return True


@contextmanager
def varied_physics(scene: Scene, variation: Variation) -> Iterator[Scene]:
    """Yield a scene whose objects have the masses and friction of a variation.

    Their classes are variants with the same name, whose models exist until the block ends.

    Args:
        scene: The scene with the classes of the catalog.
        variation: The variation, or that of a recorded episode.
    """
    if not variation.mass and not variation.friction:
        yield scene
        return
    with TemporaryDirectory(prefix="drake_clutter_variants_", dir=temporary_folder()) as folder:
        objects = [
            replace(
                o,
                object_class=_vary_class(
                    o.object_class,
                    Path(folder) / str(index),
                    variation.mass.get(o.name, o.object_class.mass),
                    variation.friction.get(o.name, 1.0),
                ),
            )
            for index, o in enumerate(scene.objects)
        ]
        yield replace(scene, objects=tuple(objects))


def _vary_class(
    object_class: ObjectClass, folder: Path, mass: float, friction: float
) -> ObjectClass:
    """Return a variant of a class, with a model in a new folder.

    Args:
        object_class: The class.
        folder: Folder of the variant's assets.
        mass: Mass [kg]; the inertia is scaled with it.
        friction: Factor of the coefficients of friction.
    """
    folder.mkdir()
    path = object_class.verified_sdf_path
    for file in path.parent.iterdir():
        if file != path:
            (folder / file.name).symlink_to(file)
    ElementTree.register_namespace("drake", _DRAKE_NAMESPACE)
    model = ElementTree.parse(path)
    factor = mass / object_class.mass
    for inertial in model.iter("inertial"):
        for element in (*inertial.iter("mass"), *(inertial.find("inertia") or ())):
            element.text = repr(float(element.text or "nan") * factor)
    for tag in _FRICTION_TAGS:
        for element in model.iter(f"{{{_DRAKE_NAMESPACE}}}{tag}"):
            element.text = repr(float(element.text or "nan") * friction)
    model.write(folder / path.name)
    return replace(object_class, mass=mass, folder=folder)
