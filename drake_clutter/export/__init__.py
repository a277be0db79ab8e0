"""A scene as a folder that other programs open: Drake, SDFormat simulators, MuJoCo, glTF viewers."""

from drake_clutter.export.export_folder import ExportFormat, export_scene

__all__ = ["ExportFormat", "export_scene"]
