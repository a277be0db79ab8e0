"""The two tasks, as gymnasium environments: `gymnasium.make("drake_clutter.tasks:ClutterGeneration-v0")`."""

import gymnasium

gymnasium.register(
    "ClutterGeneration-v0", entry_point="drake_clutter.tasks.generation_task:ClutterGeneration"
)
gymnasium.register(
    "ClutterExploration-v0",
    entry_point="drake_clutter.tasks.clutter_exploration:ClutterExploration",
)
