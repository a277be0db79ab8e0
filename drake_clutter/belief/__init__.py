"""Belief about a partly seen scene: classes of known objects, and what unseen space may hide."""
