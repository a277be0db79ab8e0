"""Search a scene for its hidden objects with an exploration policy."""

import argparse

import numpy as np

from drake_clutter import (
    ClutterConfig,
    load_catalog,
    load_scene_dataset,
    make_backend_factory,
    make_policy_factory,
    resource_path,
    run_episode,
)


def main(agent: str, fidelity: str, index: int, max_moves: int) -> None:
    config = ClutterConfig()
    scenes = load_scene_dataset(resource_path("training/scenes/sg_star_10.json"), load_catalog())
    scene = scenes.settled_scene(index, scenes.grammar, config)

    backend = make_backend_factory(fidelity, config)(scene, np.random.default_rng(0))
    policy = make_policy_factory(agent, config)(backend)
    task = run_episode(backend, policy, max_moves=max_moves)

    print(f"{len(scene.objects)} objects, hidden at the start: {list(task.initially_hidden)}")
    for transition in task.transitions:
        result = transition.outcome.result.value
        print(f"{transition.move}: {result}, found {list(transition.newly_found)}")
    print(f"ended: {task.termination.value if task.termination else 'no move left'}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--agent", default="largest-clear", help="student, largest-clear, ...")
    parser.add_argument("--fidelity", default="settle", help="static_or_drake, settle or arm")
    parser.add_argument("--scene", type=int, default=0, help="index in the scene dataset")
    parser.add_argument("--max-moves", type=int, default=10)
    arguments = parser.parse_args()
    main(arguments.agent, arguments.fidelity, arguments.scene, arguments.max_moves)
