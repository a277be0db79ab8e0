"""Checkpoints of networks: weights as safetensors, beside a JSON file with metadata."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict
from safetensors import safe_open
from safetensors.torch import load_file, save
from torch import Tensor, nn
from torch.optim import Optimizer

from drake_clutter.files import (
    atomic_write,
    input_error,
    parse_json,
    read_json,
    reading_file,
    write_json,
)
from drake_clutter.validation import CountOrZero, validate

_CONTENT = "a checkpoint, .safetensors with a .json beside it"
"""What a checkpoint may be, for messages."""


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
        path: File of the weights, for messages.
    """

    weights: dict[str, Tensor]
    metadata: dict[str, Any]
    path: Path

    @property
    def kind(self) -> str:
        """Kind of the network, as text of at most 40 characters."""
        return str(self.metadata.get("kind"))[:40]


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
    with reading_file(path, _CONTENT):
        weights = load_file(path)
    for name, value in weights.items():
        if not value.isfinite().all():
            raise input_error(str(path), f"{name}: has weights that are NaN; expected numbers")
    metadata_path = path.with_suffix(".json")
    metadata = read_json(metadata_path, _CONTENT)
    return Checkpoint(weights, validate(dict[str, Any], metadata, str(metadata_path)), path)


def load_weights(network: nn.Module, weights: Mapping[str, Tensor], path: Path) -> None:
    """Load the weights of a checkpoint into a network of its metadata.

    Args:
        network: The network.
        weights: Weights by name of the parameter.
        path: The checkpoint, for the message.

    Raises:
        InputError: Names or shapes differ.
    """
    try:
        network.load_state_dict(weights)
    except RuntimeError as error:
        raise input_error(
            str(path),
            f"its weights do not fit {path.with_suffix('.json').name}; "
            "expected the files of one training",
        ) from error


class LearnerState(BaseModel):
    """What the saved state of every learner has besides its tensors."""

    model_config = ConfigDict(extra="allow")

    step: CountOrZero
    round: CountOrZero | None = None


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
    """Return the tensors and the state that `save_tensors` wrote.

    Raises:
        InputError: The file cannot be read, or its state is not a JSON object.
    """
    content = "the saved state of a training, unmodified"
    with reading_file(path, content), safe_open(path, "pt") as file:
        names = file.keys()
        tensors = {name: file.get_tensor(name) for name in names}
        state = parse_json(file.metadata()["state"], f"{path}: state", content, allow_nan=True)
        return tensors, validate(LearnerState, state, f"{path}: state").model_dump(
            exclude_unset=True
        )


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


def save_learner(
    path: Path,
    network: nn.Module,
    optimizer: Optimizer,
    state: Any,
    tensors: Mapping[str, Tensor] | None = None,
) -> None:
    """Write the state of a training.

    Weights are written as `network.NAME`, the state of the optimizer as
    `optimizer.PARAMETER_INDEX.NAME`.

    Args:
        path: The .safetensors file.
        network: The network.
        optimizer: Its optimizer.
        state: `LearnerState` and anything else that JSON can represent.
        tensors: Other tensors, by name.
    """
    weights = {f"network.{name}": value for name, value in network.state_dict().items()}
    optimizer_state = {
        f"optimizer.{index}.{name}": value
        for index, parameter_state in optimizer.state_dict()["state"].items()
        for name, value in parameter_state.items()
    }
    save_tensors(path, {**weights, **optimizer_state, **(tensors or {})}, state)


def load_learner(
    path: Path, network: nn.Module, optimizer: Optimizer
) -> tuple[dict[str, Tensor], Any]:
    """Restore a network and its optimizer, and return all tensors and the state of `save_learner`.

    Raises:
        InputError: The file cannot be read, or its state is not a JSON object.
        RuntimeError: The weights do not fit the network.
        ValueError: The state of the optimizer does not fit the network.
    """
    tensors, state = load_tensors(path)
    network.load_state_dict(tensors_with_prefix(tensors, "network"))
    optimizer_state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors_with_prefix(tensors, "optimizer").items():
        index, _, name = key.partition(".")
        optimizer_state.setdefault(int(index), {})[name] = value
    _check_optimizer_state(optimizer, optimizer_state)
    optimizer.load_state_dict(optimizer.state_dict() | {"state": optimizer_state})
    return tensors, state


def _check_optimizer_state(optimizer: Optimizer, state: Mapping[int, Mapping[str, Tensor]]) -> None:
    """Raise a ValueError unless each parameter has the same entries, of its own shape.

    An optimizer without a step has no state.
    """
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    names = {frozenset(entries) for entries in state.values()}
    if state and (len(names) != 1 or not state.keys() <= set(range(len(parameters)))):
        raise ValueError("the entries of the optimizer differ between parameters")
    for index, entries in state.items():
        for name, value in entries.items():
            if value.shape not in ((), parameters[index].shape) or not value.isfinite().all():
                raise ValueError(f"optimizer.{index}.{name} does not fit its parameter")
