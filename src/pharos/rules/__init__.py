"""The rules of an environment at two speeds: compiled and interpreted. `rules_of(env)` gives the faster one that can.

Only names that load no Numba are imported at once, the others when they are asked for.
"""

from typing import TYPE_CHECKING

from pharos.rules.compiler import fingerprint_of_rules, mentioned_names, mutable_attributes
from pharos.rules.layout import Layout, layout_of, pack_states, unpack_states
from pharos.system import lazy

if TYPE_CHECKING:
    from pharos.rules.compiled import CompiledDrawing, CompiledExpansion, CompiledMotion
    from pharos.rules.compiler import reason_of
    from pharos.rules.interpreted import refused_reward
    from pharos.rules.rules import Rules, not_compiled, rules_of
    from pharos.rules.stepping import InterpretedStepping

__getattr__ = lazy.attributes(__name__)
