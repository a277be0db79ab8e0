"""Write the SDF files of `models/robots`.

Usage: python models/generators/write_models.py
"""

from pathlib import Path

from iiwa14 import iiwa14_sdf
from ur10 import ur10_sdf
from ur_e_series import E_SERIES
from ur_family import ur_sdf

ROBOTS = Path(__file__).parents[1] / "robots"
"""Folder of the models."""


def main() -> None:
    """Write an SDF file for each arm."""
    texts = {"iiwa14": iiwa14_sdf(), "ur10": ur10_sdf()} | {
        arm.name: ur_sdf(arm) for arm in E_SERIES
    }
    for name, text in texts.items():
        (ROBOTS / f"{name}.sdf").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
