"""A run is resumed only with its own configuration and input files."""

from dataclasses import dataclass
from pathlib import Path

import pytest
from torch import nn

from drake_clutter.files import InputError
from drake_clutter.learning.training_run import CONFIG_FILE, TrainingRun


@dataclass
class Config:
    """A configuration."""

    rate: float = 0.1


class NoLearner:
    """A learner that does nothing."""

    step = 0
    network = nn.Module()

    def save(self, path: Path) -> None:
        """See `Learner`."""
        path.touch()

    def load(self, path: Path) -> None:
        """See `Learner`."""


def test_another_config_or_input_file_is_rejected(tmp_path: Path) -> None:
    teacher, out = tmp_path / "teacher", tmp_path / "out"
    teacher.write_text("first")
    TrainingRun(out, Config(), NoLearner(), 1, [teacher]).save()
    assert str(teacher) in (out / CONFIG_FILE).read_text()
    TrainingRun(out, Config(), NoLearner(), 1, [teacher])
    with pytest.raises(InputError, match="another config or other files"):
        TrainingRun(out, Config(0.2), NoLearner(), 1, [teacher])
    teacher.write_text("second")
    with pytest.raises(InputError, match="another config or other files"):
        TrainingRun(out, Config(), NoLearner(), 1, [teacher])
