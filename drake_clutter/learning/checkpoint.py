"""Checkpoints of networks: weights as safetensors, beside a JSON file with metadata."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save
from torch import Tensor, nn
from torch.optim import Optimizer

from drake_clutter.files import InputError, atomic_write, write_json


class RenamedParameters(nn.Module):
    """Base of modules that load weights saved under earlier names of their attributes.

    Attributes:
        renamed: Current name of a parameter or submodule by its earlier name.
    """

    renamed: ClassVar[Mapping[str, str]] = {}

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        for key in list(state_dict):
            name, dot, rest = key.removeprefix(prefix).partition(".")
            if key.startswith(prefix) and name in self.renamed:
                state_dict[f"{prefix}{self.renamed[name]}{dot}{rest}"] = state_dict.pop(key)
        super()._load_from_state_dict(state_dict, prefix, *args)


@dataclass(frozen=True)
class Checkpoint:
    """A trained network.

    Attributes:
        weights: Weights by name of the parameter.
        metadata: Kind of the network, meaning of its inputs and outputs, configuration, metrics and
            commits of its training.
    """

    weights: dict[str, Tensor]
    metadata: dict[str, Any]


def save_checkpoint(path: Path, network: nn.Module, metadata: dict[str, Any]) -> None:
    """Write a network's weights, and a .json file with metadata beside them.

    Args:
        path: The .safetensors file.
        network: The network.
        metadata: See `Checkpoint`.
    """
    with atomic_write(path) as temporary:
        temporary.write_bytes(save(_contiguous(network.state_dict())))
    write_json(path.with_suffix(".json"), metadata)


def load_checkpoint(path: Path) -> Checkpoint:
    """Read what `save_checkpoint` wrote.

    Args:
        path: The .safetensors file.

    Raises:
        InputError: A file is missing or broken.
    """
    try:
        return Checkpoint(
            load_file(path), json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
        )
    except (OSError, SafetensorError) as error:
        raise InputError(
            f"{path}: cannot be read ({error}); "
            "expected a checkpoint, .safetensors with a .json beside it"
        ) from error
    except ValueError as error:
        raise InputError(f"{path.with_suffix('.json')}: is not JSON ({error})") from error


def save_tensors(path: Path, tensors: Mapping[str, Tensor], state: Any) -> None:
    """Write tensors and a JSON-compatible state to one file, atomically.

    Args:
        path: The .safetensors file.
        tensors: Tensors by name.
        state: Anything that JSON can represent.
    """
    with atomic_write(path) as temporary:
        temporary.write_bytes(save(_contiguous(tensors), {"state": json.dumps(state)}))


def load_tensors(path: Path) -> tuple[dict[str, Tensor], Any]:
    """Return the tensors and the state that `save_tensors` wrote."""
    with safe_open(path, "pt") as file:
        names = file.keys()
        tensors = {name: file.get_tensor(name) for name in names}
        return tensors, json.loads(file.metadata()["state"])


def _contiguous(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return tensors as safetensors can store them."""
    return {name: value.detach().cpu().contiguous() for name, value in tensors.items()}


def with_current_keys(mapping: Mapping[str, Any], renamed: Mapping[str, str]) -> dict[str, Any]:
    """Return a mapping with the current names of its keys.

    Args:
        mapping: What was read from a file.
        renamed: Current name of a key by its earlier name.
    """
    return {renamed.get(key, key): value for key, value in mapping.items()}


def tensors_with_prefix(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Return the tensors whose names begin with `PREFIX.`, by the rest of their names."""
    return {
        name.removeprefix(f"{prefix}."): value
        for name, value in tensors.items()
        if name.startswith(f"{prefix}.")
    }


def learner_tensors(network: nn.Module, optimizer: Optimizer) -> dict[str, Tensor]:
    """Return the tensors of a network and its optimizer.

    Returns:
        Weights as `network.NAME`, state of the optimizer as `optimizer.PARAMETER_INDEX.NAME`.
    """
    weights = {f"network.{name}": value for name, value in network.state_dict().items()}
    optimizer_state = {
        f"optimizer.{index}.{name}": value
        for index, parameter_state in optimizer.state_dict()["state"].items()
        for name, value in parameter_state.items()
    }
    return weights | optimizer_state


def restore_learner(
    network: nn.Module, optimizer: Optimizer, tensors: Mapping[str, Tensor]
) -> None:
    """Restore a network and its optimizer from `learner_tensors`; ignore other tensors."""
    network.load_state_dict(tensors_with_prefix(tensors, "network"))
    optimizer_state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors_with_prefix(tensors, "optimizer").items():
        index, _, name = key.partition(".")
        optimizer_state.setdefault(int(index), {})[name] = value
    optimizer.load_state_dict(optimizer.state_dict() | {"state": optimizer_state})
