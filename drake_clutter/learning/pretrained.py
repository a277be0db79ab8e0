"""Where the checkpoints of trained agents are, without PyTorch."""

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

from drake_clutter.files import InputError, file_sha256
from drake_clutter.resources import resource_path


def checkpoint_path(name: str, pretrained: Mapping[str, str]) -> Path:
    """The file of a trained agent.

    Args:
        name: of a shipped one, or a user's own .safetensors file.
        pretrained: where those are, by name.

    Raises:
        InputError: it is not shipped yet, or PyTorch is not installed.
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
    """The hash of a trained agent's weights; "" for an agent that has none. Arguments as for `checkpoint_path`.

    Raises:
        InputError: they cannot be read.
    """
    if name not in pretrained and not name.endswith(".safetensors"):
        return ""
    path = checkpoint_path(name, pretrained)
    try:
        return file_sha256(path)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); allowed is a checkpoint"
        ) from error
