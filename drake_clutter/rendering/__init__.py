"""Compiled rendering of textured meshes: color, depth and labels, with lamps and shadows."""
