"""Models × protocols × seeds on movements held out, with intervals over groups and paired tests."""

from __future__ import annotations

from zoo.studies.leaderboard.board import run_leaderboard
from zoo.studies.leaderboard.own import own_protocol
from zoo.studies.leaderboard.protocol import Protocol
from zoo.studies.leaderboard.protocols import PROTOCOLS

__all__ = ["PROTOCOLS", "Protocol", "own_protocol", "run_leaderboard"]
