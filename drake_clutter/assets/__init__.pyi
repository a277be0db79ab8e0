"""Names that `drake_clutter/assets/__init__.py` imports when they are first used."""

from .asset_builder import build_assets as build_assets
from .asset_builder import build_class as build_class
from .asset_builder import describe_built_mesh as describe_built_mesh
from .textures import MOTIFS as MOTIFS
