"""Movements as moving bodies: skeletons drawn in figures and played in a page."""

from __future__ import annotations

from zoo.player.bodies import Arm, Body, Human, body_for
from zoo.player.page import Player, Track, play
from zoo.player.postures import posture_map, posture_strip, posture_strips

__all__ = [
    "Arm",
    "Body",
    "Human",
    "Player",
    "Track",
    "body_for",
    "play",
    "posture_map",
    "posture_strip",
    "posture_strips",
]
