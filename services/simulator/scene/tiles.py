"""Visibility of the tiles of a large scene: only tiles in view are drawn, distant tiles coarsely."""

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from services.simulator.scene.surfaces import Tile
from services.simulator.sensors.camera import FIELD_OF_VIEW_DEG
from services.simulator.world.place import Pose

# Margin of the field of view for the tilt of the camera, degrees.
_TILT_DEG: Final = 3.0
_SLOPE: Final = math.tan(math.radians(FIELD_OF_VIEW_DEG / 2 + _TILT_DEG))


class ShownTiles:
    """Tiles with their bodies in the scene, a near and a far body each."""

    def __init__(self, tiles: Sequence[Tile], bodies: Sequence[tuple[Any, Any]]) -> None:
        self._bodies = bodies
        self._near_m = np.array([tile.near_m for tile in tiles])
        plans = [tile.near.mesh.vertices[:, :2] for tile in tiles]
        # Bounds and corners in the plan: (n, 2) and (n, 4, 2), metres.
        self._low = np.array([xy.min(axis=0) for xy in plans]).reshape(-1, 2)
        self._high = np.array([xy.max(axis=0) for xy in plans]).reshape(-1, 2)
        x = np.stack([self._low[:, 0], self._high[:, 0]], axis=1)
        y = np.stack([self._low[:, 1], self._high[:, 1]], axis=1)
        self._corners = np.stack([x[:, [0, 0, 1, 1]], y[:, [0, 1, 0, 1]]], axis=2)
        # Whether each body is shown, (n, 2); new bodies are.
        self._shown = np.ones((len(tiles), 2), dtype=np.bool_)

    def show_all(self) -> None:
        """Show the near bodies of all tiles."""
        self._show(np.tile([True, False], (len(self._shown), 1)))

    def show_from(self, camera: Pose) -> None:
        """Show the tiles before a camera and within its field of view."""
        here = np.array([camera.x, camera.y])
        cos = math.cos(camera.heading)
        sin = math.sin(camera.heading)
        corners = self._corners - here
        ahead = corners @ (cos, sin)
        left = corners @ (-sin, cos)
        beside = (left > _SLOPE * ahead).all(axis=1) | (-left > _SLOPE * ahead).all(axis=1)
        in_view = ~(beside | (ahead < 0).all(axis=1))
        outside = np.maximum(np.maximum(self._low - here, here - self._high), 0.0)
        near = np.hypot(*outside.T) < self._near_m
        self._show(np.stack([in_view & near, in_view & ~near], axis=1))

    def _show(self, shown: NDArray[np.bool_]) -> None:
        for tile, which in np.argwhere(shown != self._shown).tolist():
            self._bodies[tile][which].visibility = float(shown[tile, which])
        self._shown = shown
