"""The two tasks of Kumar et al. 2022 as gymnasium environments, and what they are built on.

Importing this package registers `ClutterGeneration-v0` and `ClutterExploration-v0`, as does
`gymnasium.make("drake_clutter.tasks:ClutterGeneration-v0")`.
"""

import gymnasium

gymnasium.register(
    "ClutterGeneration-v0", entry_point="drake_clutter.tasks.generation_task:ClutterGeneration"
)
gymnasium.register(
    "ClutterExploration-v0",
    entry_point="drake_clutter.tasks.clutter_exploration:ClutterExploration",
)
