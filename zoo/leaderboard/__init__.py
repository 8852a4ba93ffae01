"""Models × protocols × seeds on movements held out, with intervals over groups and paired tests."""

from __future__ import annotations

from zoo.leaderboard.board import run_leaderboard
from zoo.leaderboard.protocols import PROTOCOLS, Protocol

__all__ = ["PROTOCOLS", "Protocol", "run_leaderboard"]
