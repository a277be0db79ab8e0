"""Builder of SDF models, collision pieces and textured visuals of object classes."""

from drake_clutter.assets.asset_builder import build_assets, build_class, describe_built_mesh
from drake_clutter.assets.textures import MOTIFS

__all__ = ["MOTIFS", "build_assets", "build_class", "describe_built_mesh"]
