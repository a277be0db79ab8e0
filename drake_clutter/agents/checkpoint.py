"""Trained networks in files: the weights as safetensors, and beside them a JSON with what made them."""

import json
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from drake_clutter.files import InputError, replacing, write_json


@dataclass(frozen=True)
class Checkpoint:
    """A trained network.

    Attributes:
        weights: by name.
        about: config, metrics, git commit, and what the network's inputs and outputs stand for.
    """

    weights: dict[str, Tensor]
    about: dict[str, Any]


def save_checkpoint(path: Path, network: nn.Module, about: dict[str, Any]) -> None:
    """Writes `path` (.safetensors) and a .json beside it."""
    with replacing(path) as temporary:
        save_file({name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}, temporary)
    write_json(path.with_suffix(".json"), about)


def load_checkpoint(path: Path) -> Checkpoint:
    """Reads what `save_checkpoint` wrote.

    Raises:
        InputError: a file is missing or broken.
    """
    try:
        return Checkpoint(load_file(path), json.loads(path.with_suffix(".json").read_text(encoding="utf-8")))
    except (OSError, SafetensorError) as error:
        raise InputError(
            f"{path}: cannot be read ({error}); allowed is a checkpoint, .safetensors with a .json beside it"
        ) from error
    except ValueError as error:
        raise InputError(f"{path.with_suffix('.json')}: is not JSON ({error})") from error


def git_commit() -> str:
    """The commit that is checked out around this package, marked if files differ from it; "unknown" outside of a checkout."""
    here = Path(__file__).resolve().parent
    try:
        told = subprocess.run(
            ["git", "describe", "--always", "--dirty"], capture_output=True, text=True, check=True, cwd=here, timeout=10
        )
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return told.stdout.strip()
