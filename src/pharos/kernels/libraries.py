"""Less work for Numba on the way to the same code: functions that only compiled code calls are part of their callers.

Numba optimises every function that is compiled, with its ways in from Python and C, and translates it to machine code.
Then it links it into its callers, which are optimised and translated as a whole. Here a function waits until somebody
asks for its address, as Python does for a kernel. Nobody asks for most. Functions of Numba's library, such as `max`,
have no ways in. Settings of the compiler, which are compared at each call, are compared by what is not the default.

A function that is loaded from disk waits for no part of Numba that only compiling needs: the types and translations of
what compiled code may call, of NumPy and of Python, half of Numba's import.

All this holds for everything that the process compiles, and changes no result.
"""

import numba
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompileResult, Flags
from numba.core.cpu import CPUContext
from numba.core.environment import Environment, lookup_environment
from numba.core.registry import cpu_target
from numba.core.runtime import rtsys
from numba.core.typing.templates import _OverloadFunctionTemplate


class LazyLibrary(JITCodeLibrary):
    """A compiled function and those that it calls: optimised and translated if somebody asks for an address in it."""

    _compiled_object, _is_translated = None, False

    def _optimize_final_module(self) -> None:
        """Later, see `_translate`."""

    def _finalize_final_module(self) -> None:
        is_recursive = any(".numba.unresolved$" in each.name for each in self._final_module.global_variables)
        if is_recursive:  # two functions call each other, by addresses; Numba asks for this one midway
            rtsys.library.get_pointer_to_function("nrt_unresolved_abort")
        if is_recursive or self._compiled_object is not None:  # or it comes from disk
            self._translate()
        else:
            self._finalize_dynamic_globals()
            self._finalized = True

    def _translate(self) -> None:
        if self._is_translated:
            return
        self._is_translated = True
        if self._compiled_object is None:
            super()._optimize_final_module()
        self._dynamic_globals.clear()
        super()._finalize_final_module()
        for each in self._final_module.global_variables:
            environment = lookup_environment(each.name)
            if environment is not None:
                self.codegen.set_env(each.name, environment)

    def get_pointer_to_function(self, name: str) -> int:
        self._ensure_finalized()
        if any(each.name == name for each in self.get_defined_functions()):
            self._translate()
        return super().get_pointer_to_function(name)

    def serialize_using_object_code(self) -> tuple:
        self._ensure_finalized()
        return super().serialize_using_object_code() if self._is_translated else self.serialize_using_bitcode()


def install() -> None:
    """Let Numba do less from now on, in this process."""
    codegen = cpu_target.target_context.codegen()
    set_environment, decorator_of = codegen.set_env, _OverloadFunctionTemplate._get_jit_decorator

    def set_env(name: str, environment: object) -> None:
        if codegen._engine.is_symbol_defined(name):
            set_environment(name, environment)

    def without_ways_in(template: _OverloadFunctionTemplate) -> object:
        decorator = decorator_of(template)
        if decorator is not numba.jit:  # of another target
            return decorator
        return lambda **options: decorator(**{"no_cpython_wrapper": True, "no_cfunc_wrapper": True} | options)

    codegen._library_class, codegen.set_env = LazyLibrary, set_env
    _OverloadFunctionTemplate._get_jit_decorator = without_ways_in
    Flags.__eq__ = lambda one, other: isinstance(other, Flags) and _settings(one) == _settings(other)
    Flags.__hash__ = lambda one: hash(frozenset(_settings(one)))


def get_ready(target_context: CPUContext, data: bytes) -> None:
    """Load what a compiled function from disk needs. One that hashes texts needs the process's own secret as well."""
    if b"_numba_hashsecret" in data:
        target_context.refresh()
    else:
        rtsys.initialize(target_context)


def reduced(result: CompileResult) -> tuple:
    """Parts of a compiled function that go to disk. The names of Numba's modules, whose functions are part of it, do
    not: nobody asks for them, and they would be imported."""
    *parts, environments = result._reduce()
    return *parts, tuple(map(_without_module, environments))


def _without_module(environment: Environment) -> Environment:
    if not environment.globals["__name__"].startswith("numba."):
        return environment
    copy = Environment(vars(numba))
    copy.consts[:], copy.env_name = environment.consts, environment.env_name
    return copy


def _settings(flags: Flags) -> dict[str, object]:
    """The flags that are not the default."""
    options = flags.options
    return {name: value for name, value in flags._values.items() if value != options[name].default}
