"""Models × protocols × seeds on movements held out, with intervals over groups and paired tests."""

from __future__ import annotations

from zoo.leaderboard.board import run_leaderboard
from zoo.leaderboard.own import own_protocol
from zoo.leaderboard.protocol import Protocol
from zoo.leaderboard.protocols import PROTOCOLS

__all__ = ["PROTOCOLS", "Protocol", "own_protocol", "run_leaderboard"]
