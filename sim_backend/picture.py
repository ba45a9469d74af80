"""Pictures of a scene without a screen, by the small renderer that comes with PyBullet."""

from __future__ import annotations

from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from drivers.samples import Vec3
from sim_backend.bullet_scene import Scene

Image = NDArray[np.uint8]


class View(Struct, frozen=True):
    """Where a picture is taken from."""

    target: Vec3
    """What is in the middle, m, W."""
    distance: float
    """From it, m."""
    yaw: float
    """Degrees; 0 looks along y, 90 against x."""
    pitch: float
    """Degrees; negative looks down."""


class Camera:
    """Takes pictures of so many pixels of a scene."""

    def __init__(self, scene: Scene, width: int, height: int) -> None:
        self._scene, self._width, self._height = scene, width, height
        bullet = scene.bullet
        self._lens = bullet.computeProjectionMatrixFOV(40.0, width / height, 0.05, 30.0)

    def take(self, view: View) -> Image:
        """The picture, (height, width, 3)."""
        bullet = self._scene.bullet
        eye = bullet.computeViewMatrixFromYawPitchRoll(view.target, view.distance, view.yaw, view.pitch, 0.0, 2)
        _, _, pixels, _, _ = bullet.getCameraImage(
            self._width,
            self._height,
            eye,
            self._lens,
            lightDirection=(-1.5, -2.5, 4.0),
            shadow=1,
            renderer=bullet.ER_TINY_RENDERER,
            flags=bullet.ER_NO_SEGMENTATION_MASK,
            physicsClientId=self._scene.client,
        )
        rgba: Any = np.asarray(pixels, dtype=np.uint8).reshape(self._height, self._width, 4)
        return np.ascontiguousarray(rgba[:, :, :3])
