"""Drawing of a Drake Diagram: its systems on a circle, and their connections.

Usage: python -m drake_clutter.reports.diagram_drawing docs/images/closed_loop.svg
"""

import sys
from collections import defaultdict
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import networkx as nx
import numpy as np
from matplotlib.patches import Rectangle
from pydrake.systems.framework import Diagram

from drake_clutter.cell.work_cell import default_cell
from drake_clutter.config import ClutterConfig
from drake_clutter.scenes.scene import Scene
from drake_clutter.systems.closed_loop import ClosedLoop

_BOX_WIDTH = 4.3
"""Width of the box of a system, in the units of the drawing."""
_BOX_HEIGHT = 1.0
"""Height of the box of a system, in the same units."""
_ARROW_OFFSET = 0.13
"""Distance by which arrows of opposite directions are separated, in the same units."""


def connection_graph(diagram: Diagram) -> nx.DiGraph:
    """Return the systems of a diagram by name, and their connections.

    The attribute `ports` of an edge lists the names of the connected output ports, with those of
    the input ports where they differ.
    """
    port_labels = defaultdict[tuple[str, str], list[str]](list)
    for (reader, input_index), (writer, output_index) in diagram.connection_map().items():
        output_name = writer.get_output_port(output_index).get_name()
        input_name = reader.get_input_port(input_index).get_name()
        label = output_name if output_name == input_name else f"{output_name} → {input_name}"
        port_labels[writer.get_name(), reader.get_name()].append(label)
    graph = nx.DiGraph()
    graph.add_nodes_from(system.get_name() for system in diagram.GetSystems())
    graph.add_edges_from(
        (a, b, {"ports": sorted(ports)}) for (a, b), ports in sorted(port_labels.items())
    )
    return graph


def draw_diagram(diagram: Diagram, path: Path) -> None:
    """Draw a diagram to a file of a format that Matplotlib supports.

    The systems of the longest cycle come first, in its order.
    """
    graph = connection_graph(diagram)
    cycle = max(nx.simple_cycles(graph), key=len)
    first = cycle.index(min(cycle))
    cycle = cycle[first:] + cycle[:first]
    order = [*cycle, *(name for name in graph if name not in cycle)]
    angles = np.pi / 2 - 2 * np.pi * np.arange(len(order)) / len(order)
    centers = {
        name: np.array([6.2 * np.cos(a), 3.6 * np.sin(a)])
        for name, a in zip(order, angles, strict=True)
    }
    plt.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "drake_clutter", "font.size": 15})
    figure, axes = plt.subplots(figsize=(15, 9), layout="constrained")
    type_names = {system.get_name(): type(system).__name__ for system in diagram.GetSystems()}
    for name, (x, y) in centers.items():
        corner = (x - _BOX_WIDTH / 2, y - _BOX_HEIGHT / 2)
        axes.add_patch(
            Rectangle(
                corner,
                _BOX_WIDTH,
                _BOX_HEIGHT,
                facecolor="#e8eef7",
                edgecolor="#30507a",
                linewidth=2,
                zorder=2,
            )
        )
        axes.text(x, y + 0.17, type_names[name], ha="center", va="center", weight="bold", zorder=3)
        axes.text(x, y - 0.22, name, ha="center", va="center", size=12, color="#444444", zorder=3)
    for a, b, ports in graph.edges(data="ports"):
        direction = centers[b] - centers[a]
        offset = np.zeros(2)
        if graph.has_edge(b, a):
            normal = np.array([direction[1], -direction[0]]) / np.linalg.norm(direction)
            offset = _ARROW_OFFSET * normal
        start = _box_intersection(centers[a], direction, offset)
        end = _box_intersection(centers[b], -direction, offset)
        arrow = {
            "arrowstyle": "-|>",
            "linewidth": 2,
            "color": "#30507a",
            "mutation_scale": 20,
            "shrinkA": 0,
            "shrinkB": 0,
        }
        axes.annotate("", (end[0], end[1]), (start[0], start[1]), arrowprops=arrow, zorder=1)
        label_position = (start + end) / 2 + 2.2 * offset
        label_box = {"facecolor": "white", "edgecolor": "none", "pad": 1.5, "alpha": 0.9}
        axes.text(
            label_position[0],
            label_position[1],
            "\n".join(ports),
            ha="center",
            va="center",
            size=11,
            bbox=label_box,
            zorder=2,
        )
    axes.set(xlim=(-9, 9), ylim=(-4.8, 4.8), aspect="equal")
    axes.axis("off")
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)
    plt.close(figure)


def _box_intersection(center: np.ndarray, direction: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return where a line leaves a box.

    Args:
        center: Center of the box. Shape (2,).
        direction: Direction of the line. Shape (2,).
        offset: Distance of the line from the center, perpendicular to it. Shape (2,).
    """
    with np.errstate(divide="ignore"):
        scale = np.min(
            (np.copysign(np.array([_BOX_WIDTH, _BOX_HEIGHT]) / 2, direction) - offset) / direction
        )
    return np.asarray(center + offset + scale * direction)


if __name__ == "__main__":
    empty = ClosedLoop(Scene((), default_cell().support), seed=0, config=ClutterConfig())
    draw_diagram(empty.simulation.diagram, Path(sys.argv[1]))
