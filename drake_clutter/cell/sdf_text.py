"""SDF models as text for Drake's parser."""

from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree


@lru_cache(maxsize=256)
def read_sdf_text(path: Path, *, visuals: bool) -> str:
    """Return the text of an SDF model with absolute URIs.

    Drake parses the text in 1 to 2 ms, the file in 60 ms.

    Args:
        path: SDF file.
        visuals: Whether to keep visual geometry.
    """
    # Without registration, ElementTree would rename the prefix, which Drake would not recognize.
    ElementTree.register_namespace("drake", "drake.mit.edu")
    root = ElementTree.parse(path).getroot()
    for link in () if visuals else root.iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
    for uri in root.iter("uri"):
        uri.text = (path.parent / (uri.text or "")).as_uri()
    return ElementTree.tostring(root, encoding="unicode")
