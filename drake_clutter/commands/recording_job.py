"""What determines a recorded data set: scenes, policy, configuration, rates, images, variation."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import drake_clutter
from drake_clutter.agents.explorers import PRETRAINED_EXPLORERS, make_policy_factory
from drake_clutter.commands.episode_scenes import SceneSource
from drake_clutter.commands.explore_scene import move_list_policy
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.learning.pretrained import checkpoint_sha256
from drake_clutter.recording.camera_recorder import CameraChannel, RecordedCamera, find_cameras
from drake_clutter.recording.hdf5_file import FORMAT_VERSION
from drake_clutter.recording.randomization import RandomizationConfig
from drake_clutter.scenes.interfaces import Move
from drake_clutter.station.motion_recorder import DEFAULT_RATE
from drake_clutter.tasks.belief import Policy
from drake_clutter.tasks.episode import Backend
from drake_clutter.validation import to_plain

RANDOM = "random"
"""Name of the policy of random legal moves."""


@dataclass(frozen=True)
class CameraOptions:
    """Which images are recorded.

    Attributes:
        names: Names of the cameras; see `find_cameras`. None are rendered without names.
        channels: Kinds of images.
        resolution: Width and height [px]; None for those of each camera.
        rate: Images per second [Hz].
    """

    names: tuple[str, ...] = ()
    channels: tuple[CameraChannel, ...] = (CameraChannel.RGB, CameraChannel.DEPTH)
    resolution: tuple[int, int] | None = None
    rate: float = 10.0

    def find(self, config: ClutterConfig) -> tuple[RecordedCamera, ...]:
        """Return the cameras in the cell of a configuration."""
        return find_cameras(config.cell, self.names, self.resolution)


@dataclass(frozen=True)
class RecordingJob:
    """Everything that determines a data set but the number of its episodes.

    Attributes:
        scenes: Scenes of the episodes.
        policy: Name of an exploration policy, see `make_policy_factory`; a list of moves, which are
            attempted in every scene; or a function. The episodes of explorers end when every
            object has been seen, those of `RANDOM`, lists and functions do not.
        config: Configuration of the simulated world.
        seed: Seed of policies, placements, simulation and randomization.
        rate: Samples per second [Hz].
        max_moves: Largest number of moves of an episode; None for that of the configuration.
        cameras: Which images are recorded.
        randomization: What is varied from episode to episode.
        catalog_folder: Asset folder with the user's object classes, or None.
    """

    scenes: SceneSource
    policy: str | tuple[Move, ...] | Policy
    config: ClutterConfig
    seed: int = 0
    rate: float = DEFAULT_RATE
    max_moves: int | None = None
    cameras: CameraOptions = field(default_factory=CameraOptions)
    randomization: RandomizationConfig = field(default_factory=RandomizationConfig)
    catalog_folder: Path | None = None

    @property
    def policy_name(self) -> str:
        """Name of the policy."""
        if isinstance(self.policy, str):
            return self.policy
        if isinstance(self.policy, tuple):
            return "moves"
        return getattr(self.policy, "__qualname__", type(self.policy).__qualname__)

    def make_policy_factory(self) -> Callable[[Backend], Policy]:
        """Return the factory of the policies of the episodes.

        Raises:
            InputError: There is no such policy, or it does not know the classes of the scenes.
        """
        policy = self.policy
        if isinstance(policy, str):
            try:
                return make_policy_factory(policy, self.config, self.scenes.classes)
            except InputError as error:  # Of an option that other commands call --agent.
                message = str(error).replace("--agent", "--policy", 1)
                raise InputError(message) from None
        if isinstance(policy, tuple):
            return partial(move_list_policy, policy)
        return lambda _: policy

    def check(self) -> None:
        """Raise an InputError if the policy or a camera does not exist."""
        self.make_policy_factory()
        self.cameras.find(self.config)

    def to_dict(self) -> dict[str, Any]:
        """Return everything that determines the data set, for JSON."""
        moves = [asdict(move) for move in self.policy] if isinstance(self.policy, tuple) else None
        weights = (
            checkpoint_sha256(self.policy, PRETRAINED_EXPLORERS)
            if isinstance(self.policy, str)
            else None
        )
        return {
            "command": "record",
            "version": FORMAT_VERSION,
            "package_version": drake_clutter.__version__,
            "scenes": self.scenes.to_dict(),
            "policy": self.policy_name,
            "weights": weights,
            "moves": moves,
            "seed": self.seed,
            "rate": self.rate,
            "max_moves": self.max_moves,
            "cameras": {
                "names": [*self.cameras.names],
                "channels": [channel.value for channel in self.cameras.channels],
                "resolution": self.cameras.resolution and [*self.cameras.resolution],
                "rate": self.cameras.rate,
            },
            "randomization": to_plain(self.randomization),
            "catalog_folder": str(self.catalog_folder.resolve()) if self.catalog_folder else None,
            "config": to_plain(self.config),
        }
