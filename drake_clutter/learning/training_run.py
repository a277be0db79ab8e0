"""Training runs in a folder with configuration, history, curves and resumable state."""

import math
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Protocol

import torch
from pydantic import BaseModel, ConfigDict
from rich.console import Console
from torch import nn
from torch.utils.tensorboard import SummaryWriter

from drake_clutter.files import (
    InputError,
    file_sha256,
    input_error,
    read_json,
    read_text,
    reading_file,
    write_json,
    write_text,
)
from drake_clutter.learning.checkpoint import save_checkpoint
from drake_clutter.outputs import check_folder_is_empty, output_folder
from drake_clutter.resources import git_commit
from drake_clutter.validation import (
    CountOrZero,
    NonEmptyText,
    NonNegative,
    config_yaml,
    override_config,
    to_plain,
    validate,
)
from drake_clutter.yaml_io import parse_yaml, read_yaml

CONFIG_FILE = "config.yaml"
"""Configuration of the run, and hashes of its input files as comments."""
STATE_FILE = "state.safetensors"
"""Complete state of the learner."""
HISTORY_FILE = "history.json"
"""One row for each evaluation."""
TENSORBOARD_FOLDER = "tensorboard"
"""Curves of all evaluations."""
PROGRESS_PERIOD = 30.0
"""Time between two printed lines of progress [s]."""


class Learner(Protocol):
    """A learning algorithm whose state can be saved and restored.

    Attributes:
        step: Progress, in the unit of the run's total number of steps.
    """

    step: int

    @property
    def network(self) -> nn.Module:
        """The network that it trains."""

    def save(self, path: Path) -> None:
        """Write the complete state, from which the training continues as if uninterrupted."""

    def load(self, path: Path) -> None:
        """Restore the state that `save` wrote."""


class TrainingRun:
    """A run in a folder.

    Attributes:
        history: One row for each evaluation.
    """

    def __init__(
        self,
        folder: Path,
        config: Any,
        learner: Learner,
        total_steps: int,
        input_files: Sequence[Path] = (),
        *,
        steps_field: str = "",
    ) -> None:
        """Start a run, or resume the one in the folder.

        A run is extended if only the number of steps is larger than that of the run in the folder.

        Args:
            folder: The run's folder.
            config: Configuration, a dataclass.
            learner: The learner in its initial state.
            total_steps: Step at which the run ends.
            input_files: Files that the run learns from; they must be unchanged when it is resumed.
            steps_field: Field of the configuration that holds `total_steps`, such as
                "learning.total_timesteps"; "" for a run that cannot be extended.

        Raises:
            InputError: The folder holds other files, or a run with another configuration or other
                input files, or another process trains in it.
        """
        self._folder = folder
        self._config = config
        self._learner = learner
        self._total_steps = total_steps
        self._steps_field = steps_field
        self._input_hashes = {str(file): file_sha256(file) for file in input_files}
        text = config_yaml(config) + "".join(
            f"# {file}: sha256 {digest}\n" for file, digest in self._input_hashes.items()
        )
        self.history: list[dict[str, Any]] = []
        with ExitStack() as lock:
            lock.enter_context(output_folder(folder))
            self._open(text)
            self._lock = lock.pop_all()
        self._console = Console(stderr=True)
        self._writer = SummaryWriter(str(folder / TENSORBOARD_FOLDER), purge_step=learner.step)
        self._seconds_before = self.history[-1]["seconds"] if self.history else 0.0
        self._start_time = time.monotonic()
        self._start_step = learner.step
        self._last_print = self._start_time
        self._has_printed = False
        self._console.print(
            f"{learner.step:>7} of {total_steps} steps: {'resumed' if learner.step else 'started'}",
            highlight=False,
        )

    def _open(self, text: str) -> None:
        """Write the configuration to a new folder, or restore the run that the folder holds.

        Args:
            text: Content of `CONFIG_FILE`.
        """
        folder = self._folder
        if not (folder / CONFIG_FILE).exists():
            check_folder_is_empty(folder)
            write_text(folder / CONFIG_FILE, text)
        elif (stored := _with_current_names(folder / CONFIG_FILE, type(self._config))) != text:
            if self._is_extended(stored):
                write_text(folder / CONFIG_FILE, text)
                return self._open(text)
            raise InputError(
                f"--out {folder}: holds a run of another config or other files, see {CONFIG_FILE}; "
                "give the same ones or another folder"
            )
        if (folder / STATE_FILE).exists():
            _load_state(self._learner, folder / STATE_FILE)
            rows = _read_history(folder / HISTORY_FILE)
            self.history = [row for row in rows if row["step"] <= self._learner.step]

    def _is_extended(self, stored: str) -> bool:
        """Return whether a run has the same configuration, but for a smaller number of steps.

        Args:
            stored: Content of its `CONFIG_FILE`, with the current names of fields.
        """
        names = self._steps_field.split(".")
        steps: Any = parse_yaml(stored, CONFIG_FILE) if self._steps_field and stored else None
        for name in names:
            steps = steps.get(name) if isinstance(steps, dict) else None
        if not isinstance(steps, int) or steps >= self._total_steps:
            return False
        override: Any = steps
        for name in reversed(names):
            override = {name: override}
        earlier = override_config(self._config, override, CONFIG_FILE)
        hashes = "".join(f"# {file}: sha256 {h}\n" for file, h in self._input_hashes.items())
        return config_yaml(earlier) + hashes == stored

    @property
    def _rate(self) -> float:
        """Steps per second since the run was started or resumed; 0 before the first."""
        steps = self._learner.step - self._start_step
        return steps / (time.monotonic() - self._start_time) if steps else 0.0

    @property
    def _speed_text(self) -> str:
        """Speed and time left."""
        # The last iteration may pass the number of steps.
        remaining_steps = max(0, self._total_steps - self._learner.step)
        rate = self._rate
        left = f"{remaining_steps / rate / 60:.0f} min left" if rate else "time left unknown"
        return f"{rate:.3g} steps/s, {left}"

    def report_progress(self) -> None:
        """Print steps, speed and time left, after the first iteration and then periodically."""
        now = time.monotonic()
        if self._has_printed and now - self._last_print < PROGRESS_PERIOD:
            return
        self._has_printed = True
        self._last_print = now
        self._console.print(
            f"{self._learner.step:>7} of {self._total_steps} steps: {self._speed_text}",
            highlight=False,
        )

    def report(self, charts: Mapping[str, float], losses: Mapping[str, float]) -> None:
        """Record an evaluation in the history, as curves and on the screen.

        Args:
            charts: Metrics by name.
            losses: Losses by name.

        Raises:
            InputError: A metric or a loss is NaN or infinite: the training has diverged.
        """
        for name, value in {**charts, **losses}.items():
            if not math.isfinite(value):
                raise self._divergence_error(name)
        step = self._learner.step
        row = {
            "step": step,
            "seconds": self._seconds_before + time.monotonic() - self._start_time,
            "commit": git_commit(),
            **losses,
            **charts,
        }
        self.history.append(row)
        write_json(self._folder / HISTORY_FILE, self.history)
        for group, values in (
            ("charts", {**charts, "steps_per_second": self._rate}),
            ("losses", losses),
        ):
            for name, value in values.items():
                self._writer.add_scalar(f"{group}/{name}", value, step)
        metrics = ", ".join(f"{name} {value:.3g}" for name, value in {**charts, **losses}.items())
        self._console.print(
            f"{step:>7} of {self._total_steps}: {metrics}; {self._speed_text}",
            highlight=False,
            soft_wrap=True,
        )

    def check_convergence(self) -> None:
        """Check that the network's weights are numbers, so that they can be trained further.

        Raises:
            InputError: The training has diverged. The state that was saved last is kept.
        """
        if has_diverged(self._learner.network):
            raise self._divergence_error("weights")

    def _divergence_error(self, name: str) -> InputError:
        """Return the error of values that are not finite, by their name."""
        saved = self._folder / STATE_FILE
        kept = f"{STATE_FILE} of an earlier step is kept" if saved.exists() else "no state is saved"
        return input_error(
            f"--out {self._folder}",
            f"step {self._learner.step}: {name} NaN or infinite, the training diverged; {kept}; "
            "expected finite numbers, try a smaller learning rate",
        )

    def save(self) -> None:
        """Write the learner's state."""
        self._learner.save(self._folder / STATE_FILE)

    def finish(self, name: str, network: nn.Module, metadata: Mapping[str, Any]) -> None:
        """Write the checkpoint and the learner's state, and let others write to the folder.

        Args:
            name: See `save_checkpoint`.
            network: See `save_checkpoint`.
            metadata: See `save_checkpoint`.
        """
        self.save_checkpoint(name, network, metadata)
        self.save()
        self._lock.close()

    def save_checkpoint(self, name: str, network: nn.Module, metadata: Mapping[str, Any]) -> None:
        """Write a checkpoint of the latest evaluation.

        Args:
            name: File name of the checkpoint.
            network: The trained network.
            metadata: Metadata of the checkpoint. Configuration, hashes of the input files, metrics
                of the latest evaluation and commits are added.
        """
        save_checkpoint(
            self._folder / name,
            network,
            {
                **metadata,
                "config": to_plain(self._config),
                "files": self._input_hashes,
                "metrics": self.history[-1],
                "commits": list(dict.fromkeys(row["commit"] for row in self.history)),
            },
        )


class _HistoryRow(BaseModel):
    """What every row of `HISTORY_FILE` has; metrics and losses differ between trainings."""

    model_config = ConfigDict(extra="allow")

    step: CountOrZero
    seconds: NonNegative
    commit: NonEmptyText


def _read_history(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a history; an empty list if there is no file."""
    if not path.exists():
        return []
    rows: list[dict[str, Any]] = read_json(path, "the history of a training")
    validate(list[_HistoryRow], rows, str(path))
    return rows


def _load_state(learner: Learner, path: Path) -> None:
    """Restore a learner's state."""
    with reading_file(path, "the saved state of this training, unmodified"):
        learner.load(path)
        if has_diverged(learner.network):
            raise ValueError("has weights that are NaN")


def has_diverged(network: nn.Module) -> bool:
    """Return whether a network has weights that are NaN or infinite."""
    return not all(bool(weights.isfinite().all()) for weights in network.parameters())


def _with_current_names(path: Path, schema: type) -> str:
    """Return the text of a run's `CONFIG_FILE` with the current names of the fields.

    Args:
        path: The file, which an earlier version may have written.
        schema: Class of the configuration.

    Returns:
        The text, or "" if the file holds a configuration of another class.
    """
    text = read_text(path, "the configuration of a training")
    hashes = [line for line in text.splitlines(keepends=True) if line[0] == "#"]
    try:
        config: Any = validate(schema, read_yaml(path, "a mapping of config fields"), str(path))
    except InputError:
        return ""
    return config_yaml(config) + "".join(hashes)


def resolve_device(name: str) -> torch.device:
    """Return a PyTorch device.

    Args:
        name: `auto`, `cpu` or `cuda`; `auto` selects CUDA where it is available.

    Raises:
        InputError: The name is unknown, or the device is not available.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise InputError(f"--device {name}; expected auto, cpu or cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: PyTorch finds none; expected auto or cpu")
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return torch.device(name)
