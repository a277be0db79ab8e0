"""Scenes: data, layout, files, placement, and the interfaces of judges and executors."""
