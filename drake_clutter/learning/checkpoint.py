"""Trained networks in files: the weights as safetensors, and beside them a JSON with what made them."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
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
        weights: by name.
        metadata: config, metrics, git commit, and what the network's inputs and outputs stand for.
    """

    weights: dict[str, Tensor]
    metadata: dict[str, Any]


def save_checkpoint(path: Path, network: nn.Module, metadata: dict[str, Any]) -> None:
    """Writes `path` (.safetensors) and a .json beside it."""
    with atomic_write(path) as temporary:
        save_file(
            {
                name: value.detach().cpu().contiguous()
                for name, value in network.state_dict().items()
            },
            temporary,
        )
    write_json(path.with_suffix(".json"), metadata)


def load_checkpoint(path: Path) -> Checkpoint:
    """Reads what `save_checkpoint` wrote.

    Raises:
        InputError: a file is missing or broken.
    """
    try:
        return Checkpoint(
            load_file(path), json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
        )
    except (OSError, SafetensorError) as error:
        raise InputError(
            f"{path}: cannot be read ({error}); allowed is a checkpoint, .safetensors with a .json beside it"
        ) from error
    except ValueError as error:
        raise InputError(f"{path.with_suffix('.json')}: is not JSON ({error})") from error


def save_tensors(path: Path, tensors: Mapping[str, Tensor], state: Any) -> None:
    """Writes tensors by name, and beside them what JSON can hold, in one file and in one step."""
    with atomic_write(path) as temporary:
        held = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
        save_file(held, temporary, metadata={"state": json.dumps(state)})


def load_tensors(path: Path) -> tuple[dict[str, Tensor], Any]:
    """Reads what `save_tensors` wrote."""
    with safe_open(path, "pt") as file:
        names = file.keys()
        return {name: file.get_tensor(name) for name in names}, json.loads(file.metadata()["state"])


def with_current_keys(mapping: Mapping[str, Any], renamed: Mapping[str, str]) -> dict[str, Any]:
    """Return a mapping with the current names of its keys.

    Args:
        mapping: What was read from a file.
        renamed: Current name of a key by its earlier name.
    """
    return {renamed.get(key, key): value for key, value in mapping.items()}


def tensors_with_prefix(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Those that are called `PART.NAME`, by NAME."""
    return {
        name.removeprefix(f"{prefix}."): value
        for name, value in tensors.items()
        if name.startswith(f"{prefix}.")
    }


def learner_tensors(network: nn.Module, optimizer: Optimizer) -> dict[str, Tensor]:
    """A network's weights, as `network.NAME`, and what its optimiser remembers, as `optimizer.NUMBER.NAME`."""
    weights = {f"network.{name}": value for name, value in network.state_dict().items()}
    moments = optimizer.state_dict()["state"].items()
    return weights | {
        f"optimizer.{number}.{name}": value
        for number, of_one in moments
        for name, value in of_one.items()
    }


def restore_learner(
    network: nn.Module, optimizer: Optimizer, tensors: Mapping[str, Tensor]
) -> None:
    """Gives back what `learner_tensors` took; other names are left alone."""
    network.load_state_dict(tensors_with_prefix(tensors, "network"))
    moments: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors_with_prefix(tensors, "optimizer").items():
        number, _, moment = name.partition(".")
        moments.setdefault(int(number), {})[moment] = value
    optimizer.load_state_dict(optimizer.state_dict() | {"state": moments})
