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
    to_plain,
    validate,
)
from drake_clutter.yaml_io import read_yaml

CONFIG_FILE = "config.yaml"
"""Configuration of the run, and hashes of its input files as comments."""
STATE_FILE = "state.safetensors"
"""Complete state of the learner."""
HISTORY_FILE = "history.json"
"""One row for each evaluation."""
TENSORBOARD_FOLDER = "tensorboard"
"""Curves of all evaluations."""


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
    ) -> None:
        """Start a run, or resume the one in the folder.

        Args:
            folder: The run's folder.
            config: Configuration, a dataclass.
            learner: The learner in its initial state.
            total_steps: Step at which the run ends.
            input_files: Files that the run learns from; they must be unchanged when it is resumed.

        Raises:
            InputError: The folder holds other files, or a run with another configuration or other
                input files, or another process trains in it.
        """
        self._folder = folder
        self._config = config
        self._learner = learner
        self._total_steps = total_steps
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

    def _open(self, text: str) -> None:
        """Write the configuration to a new folder, or restore the run that the folder holds.

        Args:
            text: Content of `CONFIG_FILE`.
        """
        folder = self._folder
        if not (folder / CONFIG_FILE).exists():
            check_folder_is_empty(folder)
            write_text(folder / CONFIG_FILE, text)
        elif _with_current_names(folder / CONFIG_FILE, type(self._config)) != text:
            raise InputError(
                f"--out {folder}: holds a run of another config or other files, see {CONFIG_FILE}; "
                "give the same ones or another folder"
            )
        if (folder / STATE_FILE).exists():
            _load_state(self._learner, folder / STATE_FILE)
            rows = _read_history(folder / HISTORY_FILE)
            self.history = [row for row in rows if row["step"] <= self._learner.step]

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
        elapsed = time.monotonic() - self._start_time
        rate = (step - self._start_step) / elapsed if step > self._start_step else 0.0
        row = {
            "step": step,
            "seconds": self._seconds_before + elapsed,
            "commit": git_commit(),
            **losses,
            **charts,
        }
        self.history.append(row)
        write_json(self._folder / HISTORY_FILE, self.history)
        for group, values in (
            ("charts", {**charts, "steps_per_second": rate}),
            ("losses", losses),
        ):
            for name, value in values.items():
                self._writer.add_scalar(f"{group}/{name}", value, step)
        # The last iteration may pass the number of steps.
        remaining_steps = max(0, self._total_steps - step)
        minutes_left = remaining_steps / rate / 60 if rate else float("nan")
        metrics = ", ".join(f"{name} {value:.3g}" for name, value in {**charts, **losses}.items())
        self._console.print(
            f"{step:>7} of {self._total_steps}: {metrics}; {rate:.0f} steps/s, "
            f"{minutes_left:.0f} min left",
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
        self.save()
        self._lock.close()


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
