"""Generate, judge and search cluttered scenes with Drake (Kumar, Essa and Ha, ICRA 2022).

The names that this package exports are its public API; they are imported when they are first
used. Everything else may change between versions.
"""

import lazy_loader

__version__ = "0.2.0.dev0"

__getattr__, __dir__, _exported = lazy_loader.attach_stub(__name__, __file__)
__all__ = ["__version__", *_exported]
