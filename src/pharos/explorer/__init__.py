"""The explorer: a page that shows an MDP state by state, from a small local server or in one file.

A file is loaded when something in it is first used.
"""

from typing import TYPE_CHECKING

from pharos.system import lazy

if TYPE_CHECKING:
    from pharos.explorer.exploration import Exploration
    from pharos.explorer.keys import ARROWS, keys_of
    from pharos.explorer.launch import Explorer, exploration_of, explore, open_browser
    from pharos.explorer.pages import contents, explorer_page, write
    from pharos.explorer.states import Learnt

__all__ = [
    "explore",
]

__getattr__ = lazy.attributes(__name__)
