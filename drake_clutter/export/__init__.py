"""Export of a scene for Drake, SDFormat simulators, MuJoCo, USD or glTF viewers."""

from drake_clutter.export.export_folder import ExportFormat, export_scene

__all__ = ["ExportFormat", "export_scene"]
