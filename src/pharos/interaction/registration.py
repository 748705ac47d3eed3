"""Registers the environments with Gymnasium; run by `import pharos`. Entry points are strings: nothing heavy is loaded.

`gymnasium.make("pharos/Breakout-v0", height=12)` makes an instance of a class, "pharos/Breakout-12x8x1-v0" a named
instance, and `gymnasium.make("pharos/Environment-v0", environment="breakout/12x10x1")` any environment that
`pharos.make` knows. Without `import pharos`: "pharos:pharos/Breakout-v0". Classes of one's own are registered as
`pharos.environments.register` meets them.

The version of an id rises with the rules: it is `version - first_version` of the class.
"""

from gymnasium.envs import registration

from pharos.environments import Environment, on_registration


def ids_of(cls: type[Environment]) -> dict[str, str]:
    """Gymnasium id -> name that `pharos.make` knows, of a class and its named instances."""
    version = f"v{max(0, cls.version - cls.first_version)}"
    name = cls.__name__
    instances = {f"pharos/{name}-{instance}-{version}": f"{cls.name}/{instance}" for instance in cls.instances}
    return {f"pharos/{name}-{version}": cls.name, **instances}


def register_class(cls: type[Environment]) -> None:
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
on_registration(register_class)
