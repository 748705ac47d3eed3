"""Registers the environments with Gymnasium; run by `import pharos`. The entry points are strings: nothing else is loaded.

`gymnasium.make("pharos/Breakout-v0", height=12)` makes an instance of a class, and
`gymnasium.make("pharos/Environment-v0", environment="breakout/12x10x1")` any environment that `pharos.make` knows. Without
`import pharos`: "pharos:pharos/Breakout-v0".
"""

from typing import Any

from gymnasium.envs.registration import register

CLASSES = {
    "SimpleGrid": "simple_grid",
    "FrozenLake": "frozen_lake",
    "Freeway": "freeway",
    "Breakout": "breakout",
}
VERSION = "v0"  # goes up with the rules or rewards of a class

for _name, _environment in {**CLASSES, "Environment": None}.items():
    _kwargs: dict[str, Any] = {} if _environment is None else {"environment": _environment}
    register(
        id=f"pharos/{_name}-{VERSION}",
        entry_point="pharos.interaction.gym_env:GymEnv",
        vector_entry_point="pharos.interaction.vector_env:VectorEnv",
        kwargs=_kwargs,
        order_enforce=False,  # the environment says itself when reset() is missing, and checks its actions:
        disable_env_checker=True,  # wrappers that do it again cost more than the step
    )
