"""A run is taken up only with what it was begun with."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from drake_clutter.files import InputError
from drake_clutter.learning.training_run import CONFIG_FILE, TrainingRun


@dataclass
class Asked:
    """A config."""

    rate: float = 0.1


class Nothing:
    """Learns nothing."""

    step = 0

    def save(self, path: Path) -> None:
        """See `Learner`."""
        path.touch()

    def load(self, path: Path) -> None:
        """See `Learner`."""


def test_another_config_or_teacher_is_refused(tmp_path: Path) -> None:
    teacher, out = tmp_path / "teacher", tmp_path / "out"
    teacher.write_text("knows")
    TrainingRun(out, Asked(), Nothing(), 1, [teacher]).save()
    assert str(teacher) in (out / CONFIG_FILE).read_text()
    TrainingRun(out, Asked(), Nothing(), 1, [teacher])
    with pytest.raises(InputError, match="another config or other files"):
        TrainingRun(out, Asked(0.2), Nothing(), 1, [teacher])
    teacher.write_text("knows better")
    with pytest.raises(InputError, match="another config or other files"):
        TrainingRun(out, Asked(), Nothing(), 1, [teacher])
