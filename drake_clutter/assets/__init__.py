"""Builds what Drake loads, one folder per object class, from a catalog: SDF model, collision pieces, textured visual."""

from drake_clutter.assets.asset_builder import build_assets, build_class
from drake_clutter.assets.textures import MOTIFS

__all__ = ["MOTIFS", "build_assets", "build_class"]
