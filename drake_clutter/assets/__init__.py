"""Builder of SDF models, collision pieces and textured visuals of object classes.

The names are imported when they are first used: cells and plants need the contact properties alone.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
