"""Add the object class of examples/custom_class and generate scenes with it."""

import argparse
from pathlib import Path

import numpy as np

from drake_clutter import (
    ClutterConfig,
    DrakeJudge,
    LayoutFailure,
    NodeBudget,
    SceneGrammar,
    build_assets,
    lay_out,
    load_catalog,
    make_generation_agent,
    save_scene,
)


def main(folder: Path, object_set: str, nodes: int, out: Path) -> None:
    for built in build_assets(folder):
        print(f"built {built.name}: {len(list(built.iterdir()))} files")
    classes = load_catalog(folder).object_set(object_set)
    grammar = SceneGrammar(classes)
    print(f"{len(grammar.rules)} rules for {len(grammar.classes)} classes")

    config, rng = ClutterConfig(), np.random.default_rng(0)
    agent = make_generation_agent("random", config)
    scene = None
    while scene is None or isinstance(scene, LayoutFailure):
        derivation = agent.derive(grammar, NodeBudget(nodes), rng)
        scene = lay_out(derivation, grammar.classes, config, rng)
    verdict = DrakeJudge(config).judge(scene, rng)
    out.parent.mkdir(parents=True, exist_ok=True)
    save_scene(out, scene, config.cell, verdict)
    print(f"{out}: {', '.join(scene.names)}; stable: {verdict.stable}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path("examples/custom_class"))
    parser.add_argument("--objects", default="kitchen", help="object set of the catalog")
    parser.add_argument("--nodes", type=int, default=12)
    parser.add_argument("--out", type=Path, default=Path("out/kitchen/0000.yaml"))
    arguments = parser.parse_args()
    main(arguments.folder, arguments.objects, arguments.nodes, arguments.out)
