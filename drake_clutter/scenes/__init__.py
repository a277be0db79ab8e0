"""Scenes: data, layout, files, placement; interfaces of judges and executors."""
