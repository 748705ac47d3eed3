"""The batched engine: many independent runs of DQN or PPO as one program on torch. docs/agents.md describes it.

torch is loaded when a batch is made.
"""

from typing import TYPE_CHECKING

from pharos.system import lazy

if TYPE_CHECKING:
    from pharos.agents.batched.batch import Batch, make_batch
    from pharos.agents.batched.runs import OWN_OPTIONS, BatchRun, ObservationSource, group_key, lane_width, supports

__all__ = ["OWN_OPTIONS", "Batch", "BatchRun", "ObservationSource", "group_key", "lane_width", "make_batch", "supports"]

__getattr__ = lazy.attributes(__name__)
