"""Registers the environments with Gymnasium, run by `import pharos`. Entry points are strings: nothing heavy is loaded.

`gymnasium.make("pharos/Breakout-v0", height=12)` makes an instance of a class, "pharos/Breakout-12x8x1-v0" a named
instance, and `gymnasium.make("pharos/Environment-v0", environment="breakout/12x10x1")` any environment that
`pharos.make` knows. Without `import pharos`: "pharos:pharos/Breakout-v0". Classes of one's own are registered as
`pharos.environments.register` meets them.

The version of an id rises with the rules: it is `version - first_version` of the class.
"""

from collections.abc import Iterable
from typing import TYPE_CHECKING

from gymnasium.envs import registration

from pharos.environments import BUILT_IN, on_registration

if TYPE_CHECKING:
    from pharos.environments import Environment


def ids_of(cls: type["Environment"]) -> dict[str, str]:
    """Gymnasium id -> name that `pharos.make` knows, of a class and its named instances."""
    return _ids(cls.name, cls.__name__, cls.instances, max(0, cls.version - cls.first_version))


def _ids(name: str, class_name: str, instances: Iterable[str], version: int) -> dict[str, str]:
    named = {f"pharos/{class_name}-{instance}-v{version}": f"{name}/{instance}" for instance in instances}
    return {f"pharos/{class_name}-v{version}": name, **named}


def register_class(cls: type["Environment"]) -> None:
    """Register a class and its named instances. An id stays with the class that had it first."""
    for gymnasium_id, name in ids_of(cls).items():
        owner = registration.registry.get(gymnasium_id)
        if owner is None or owner.kwargs.get("environment", "").partition("/")[0] == cls.name:
            _register(gymnasium_id, environment=name)


def _register(gymnasium_id: str, **arguments: str) -> None:
    registration.registry.pop(gymnasium_id, None)
    registration.register(
        id=gymnasium_id,
        entry_point="pharos.interaction.gym_env:GymEnv",
        vector_entry_point="pharos.interaction.vector_env:VectorEnv",
        kwargs=arguments,
        order_enforce=False,  # the environment says itself when reset() is missing, and checks its actions:
        disable_env_checker=True,  # wrappers that do it again cost more than the step
    )


_register("pharos/Environment-v0")
for _entry in BUILT_IN:
    for _id, _name in _ids(_entry.name, _entry.class_name, _entry.instance_names, _entry.version).items():
        _register(_id, environment=_name)
on_registration(register_class)
