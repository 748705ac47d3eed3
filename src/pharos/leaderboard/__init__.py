"""Entries of a leaderboard: what a run has learnt and what it claims, in one file that anybody can verify.

A file is loaded when something in it is first used: the command line needs `Limits` alone to show its help.
"""

from typing import TYPE_CHECKING

from pharos.system import lazy

if TYPE_CHECKING:
    from pharos.leaderboard.entry import (
        Claim,
        Entry,
        check_ending,
        check_values,
        in_file,
        read,
        read_sealed,
        stored_table,
        submit,
        write_checked,
        write_sealed,
    )
    from pharos.leaderboard.limits import Limits
    from pharos.leaderboard.page import Board, Cell, Ranking, board, reason, write_page
    from pharos.leaderboard.verification import Check, Verdict, verify

__all__ = [
    "board",
    "read",
    "submit",
    "verify",
]

__getattr__ = lazy.attributes(__name__)
