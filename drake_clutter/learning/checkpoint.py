"""Trained networks in files: the weights as safetensors, and beside them a JSON with what made them."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.optim import Optimizer

from drake_clutter.files import InputError, atomic_write, write_json


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
    with atomic_write(path) as temporary:
        save_file(
            {
                name: value.detach().cpu().contiguous()
                for name, value in network.state_dict().items()
            },
            temporary,
        )
    write_json(path.with_suffix(".json"), about)


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


def part_of(tensors: Mapping[str, Tensor], part: str) -> dict[str, Tensor]:
    """Those that are called `PART.NAME`, by NAME."""
    return {
        name.removeprefix(f"{part}."): value
        for name, value in tensors.items()
        if name.startswith(f"{part}.")
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
    network.load_state_dict(part_of(tensors, "network"))
    moments: dict[int, dict[str, Tensor]] = {}
    for name, value in part_of(tensors, "optimizer").items():
        number, _, moment = name.partition(".")
        moments.setdefault(int(number), {})[moment] = value
    optimizer.load_state_dict(optimizer.state_dict() | {"state": moments})
