"""What every training script does around its learning: a folder with config, history, curves and state, taken up after a kill."""

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import torch
from rich.console import Console
from torch import nn
from torch.utils.tensorboard import SummaryWriter

from drake_clutter.files import (
    InputError,
    file_sha256,
    prepare_output_directory,
    write_json,
    write_text,
)
from drake_clutter.learning.checkpoint import save_checkpoint
from drake_clutter.resources import git_commit
from drake_clutter.validation import config_yaml, to_plain, validate
from drake_clutter.yaml_io import read_yaml

CONFIG_FILE, STATE_FILE, HISTORY_FILE, TENSORBOARD_FOLDER = (
    "config.yaml",
    "state.safetensors",
    "history.json",
    "tensorboard",
)


class Learner(Protocol):
    """What learns; `step` counts what the config's number of steps is reached in."""

    step: int

    def save(self, path: Path) -> None:
        """Writes all that is needed to go on as if it had never been interrupted."""

    def load(self, path: Path) -> None:
        """Goes on where `save` was called."""


class TrainingRun:
    """A run in a folder.

    Attributes:
        history: a row for each evaluation.
    """

    def __init__(
        self,
        folder: Path,
        config: Any,
        learner: Learner,
        total_steps: int,
        input_files: Sequence[Path] = (),
    ) -> None:
        """Begins a run, or takes up the one that is in the folder.

        Args:
            folder: the folder; config: a dataclass; learner: as it begins; total_steps: at which it ends.
            input_files: that the config names and the run learns from; must be the same when it is taken up.

        Raises:
            InputError: the folder holds something else, or a run of another config or of other files.
        """
        self._out, self._config, self._learner, self._steps = folder, config, learner, total_steps
        self._files = {str(file): file_sha256(file) for file in input_files}
        text = config_yaml(config)
        hashes = "".join(f"# {file}: sha256 {digest}\n" for file, digest in self._files.items())
        if not (folder / CONFIG_FILE).exists():
            prepare_output_directory(folder)
            write_text(folder / CONFIG_FILE, text + hashes)
        elif _with_current_names(folder / CONFIG_FILE, type(config)) != text + hashes:
            raise InputError(
                f"--out {folder}: holds a run of another config or other files, see {CONFIG_FILE}; "
                "give the same ones or another folder"
            )
        self.history: list[dict[str, Any]] = []
        if (folder / STATE_FILE).exists():
            learner.load(folder / STATE_FILE)
            rows = (
                json.loads((folder / HISTORY_FILE).read_text())
                if (folder / HISTORY_FILE).exists()
                else []
            )
            self.history = [row for row in rows if row["step"] <= learner.step]
        self._console = Console(stderr=True)
        self._writer = SummaryWriter(str(folder / TENSORBOARD_FOLDER), purge_step=learner.step)
        self._seconds = self.history[-1]["seconds"] if self.history else 0.0
        self._begun, self._begun_at = time.monotonic(), learner.step

    def report(self, charts: Mapping[str, float], losses: Mapping[str, float]) -> None:
        """Notes an evaluation: in the history, as curves, and on the screen."""
        step, spent = self._learner.step, time.monotonic() - self._begun
        rate = (step - self._begun_at) / spent if step > self._begun_at else 0.0
        row = {
            "step": step,
            "seconds": self._seconds + spent,
            "commit": git_commit(),
            **losses,
            **charts,
        }
        self.history.append(row)
        write_json(self._out / HISTORY_FILE, self.history)
        for folder, values in (
            ("charts", {**charts, "steps_per_second": rate}),
            ("losses", losses),
        ):
            for name, value in values.items():
                self._writer.add_scalar(f"{folder}/{name}", value, step)
        left = (self._steps - step) / rate / 60 if rate else float("nan")
        told = ", ".join(f"{name} {value:.3g}" for name, value in {**charts, **losses}.items())
        self._console.print(
            f"{step:>7} of {self._steps}: {told}; {rate:.0f} steps/s, {left:.0f} min left",
            highlight=False,
            soft_wrap=True,
        )

    def save(self) -> None:
        """Writes the state."""
        self._learner.save(self._out / STATE_FILE)

    def finish(self, name: str, network: nn.Module, metadata: Mapping[str, Any]) -> None:
        """Writes the checkpoint, with config, hashes of files, last figures and commits, and the state."""
        metrics, commits = (
            self.history[-1],
            list(dict.fromkeys(row["commit"] for row in self.history)),
        )
        save_checkpoint(
            self._out / name,
            network,
            {
                **metadata,
                "config": to_plain(self._config),
                "files": self._files,
                "metrics": metrics,
                "commits": commits,
            },
        )
        self.save()


def _with_current_names(path: Path, schema: type) -> str:
    """Return the text of a run's config file, with the current names of the config's fields."""
    hashes = [line for line in path.read_text().splitlines(keepends=True) if line[0] == "#"]
    try:
        config: Any = validate(schema, read_yaml(path, "a mapping of config fields"), str(path))
    except InputError:  # of another training
        return ""
    return config_yaml(config) + "".join(hashes)


def resolve_device(name: str) -> torch.device:
    """The device of an option: auto, cpu or cuda.

    Raises:
        InputError: another name, or a device that is not there.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise InputError(f"--device {name}; allowed are auto, cpu, cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: PyTorch finds none; allowed here are auto, cpu")
    return torch.device(
        ("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name
    )
