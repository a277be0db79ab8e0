"""Lookup of the checkpoints of trained agents, without importing PyTorch."""

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

from drake_clutter.files import InputError, file_sha256
from drake_clutter.resources import resource_path


def checkpoint_path(name: str, pretrained: Mapping[str, str]) -> Path:
    """Return the checkpoint file of a trained agent.

    Args:
        name: Name of a pretrained agent, or the path of a .safetensors file.
        pretrained: Resource paths of the pretrained agents by name.

    Raises:
        InputError: The checkpoint is not part of this installation, or PyTorch is not installed.
    """
    missing = [module for module in ("torch", "safetensors") if find_spec(module) is None]
    if missing:
        raise InputError(
            f"--agent {name}: needs {' and '.join(missing)}; install drake_clutter with [learned]"
        )
    try:
        return resource_path(pretrained[name]) if name in pretrained else Path(name)
    except FileNotFoundError as error:
        raise InputError(
            f"--agent {name}: {error}; train it with the scripts of training/, and give its file"
        ) from error


def checkpoint_sha256(name: str, pretrained: Mapping[str, str]) -> str:
    """Return the SHA-256 hash of a trained agent's weights; "" for an agent without weights.

    Args:
        name: Name of an agent, or the path of a .safetensors file.
        pretrained: Resource paths of the pretrained agents by name.

    Raises:
        InputError: The checkpoint cannot be read.
    """
    if name not in pretrained and not name.endswith(".safetensors"):
        return ""
    path = checkpoint_path(name, pretrained)
    try:
        return file_sha256(path)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); expected a checkpoint"
        ) from error
