"""Generate random cluttered scenes and save them with the verdict of Drake."""

import argparse
from pathlib import Path

import numpy as np

from drake_clutter import (
    ClutterConfig,
    DrakeJudge,
    LayoutFailure,
    NodeBudget,
    SceneGrammar,
    lay_out,
    load_catalog,
    make_generation_agent,
    save_scene,
)


def main(count: int, nodes: int, agent_name: str, out: Path) -> None:
    config = ClutterConfig()
    grammar = SceneGrammar(load_catalog().object_set("ycb7"))
    agent = make_generation_agent(agent_name, config)
    judge = DrakeJudge(config)
    out.mkdir(parents=True, exist_ok=True)
    for index in range(count):
        rng = np.random.default_rng([0, index])
        derivation = agent.derive(grammar, NodeBudget(nodes), rng)
        scene = lay_out(derivation, grammar.classes, config, rng)
        if isinstance(scene, LayoutFailure):
            print(f"{index:04d}: not laid out: {scene.reason.value}")
            continue
        verdict = judge.judge(scene, rng)
        save_scene(out / f"{index:04d}.yaml", scene, config.cell, verdict)
        if verdict.stable:
            print(f"{index:04d}: {len(scene.objects)} objects, hidden: {list(verdict.hidden)}")
        else:
            print(f"{index:04d}: {len(scene.objects)} objects, unstable: {verdict.instability}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=8, help="number of scenes")
    parser.add_argument("--nodes", type=int, default=15, help="size of the graphs")
    parser.add_argument("--agent", default="random", help="random, hill-climbing, sg-star, ...")
    parser.add_argument("--out", type=Path, default=Path("out/tutorial/scenes"))
    arguments = parser.parse_args()
    main(arguments.count, arguments.nodes, arguments.agent, arguments.out)
