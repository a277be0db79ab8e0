"""Pages of the documentation site that are generated while it is built.

MkDocs calls `on_files`. Generated pages are never written to the repository.
"""

from collections.abc import Callable, Mapping

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

PAGES: Mapping[str, Callable[[], str]] = {}
"""Functions that return the Markdown of a page, by its path below `docs`."""


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the generated pages to the site; one of the same name in `docs` is replaced."""
    for path, page in PAGES.items():
        existing = files.get_file_from_path(path)
        if existing is not None:
            files.remove(existing)
        files.append(File.generated(config, path, content=page()))
    return files
