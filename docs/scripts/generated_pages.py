"""Pages of the documentation site that are generated while it is built.

MkDocs calls `on_files`. Generated pages are never written to the repository.
"""

from collections.abc import Callable, Mapping
from functools import partial

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

import api_page
import cli_page
import configuration_page
import environments_page
import results_arm
import results_calibration
import results_closed_loop
import results_exploration
import results_export
import results_feasibility
import results_generation
import results_index
import results_intervals
import results_judge_agreement
import results_mutation
import results_negative
import results_perception
import results_recording
import results_rendering
import results_target_search

PAGES: Mapping[str, Callable[[], str]] = {
    "reference/api.md": api_page.page,
    "reference/environments.md": environments_page.page,
    "reference/cli.md": cli_page.page,
    "reference/configuration.md": configuration_page.page,
    "results/index.md": results_index.page,
    "results/generation.md": results_generation.page,
    "results/exploration.md": results_exploration.page,
    "results/target_search.md": results_target_search.page,
    "results/closed_loop.md": results_closed_loop.page,
    "results/arm.md": results_arm.page,
    "results/perception.md": results_perception.page,
    "results/rendering.md": results_rendering.page,
    "results/judge_agreement.md": results_judge_agreement.page,
    "results/calibration.md": results_calibration.page,
    "results/intervals.md": results_intervals.page,
    "results/export.md": results_export.page,
    "results/feasibility.md": results_feasibility.page,
    "results/recording.md": results_recording.page,
    "results/mutation_testing.md": results_mutation.page,
    "results/negative_results.md": results_negative.page,
    **{
        f"reference/api/{name}.md": partial(api_page.package_page, name)
        for name in api_page.packages()
    },
}
"""Functions that return the Markdown of a page, by its path below `docs`."""


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the generated pages to the site; one of the same name in `docs` is replaced."""
    for path, page in PAGES.items():
        existing = files.get_file_from_path(path)
        if existing is not None:
            files.remove(existing)
        files.append(File.generated(config, path, content=page()))
    return files
