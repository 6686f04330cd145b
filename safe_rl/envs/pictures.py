"""Pictures of one compiled model of any family: cameras, markers, and renderers by size."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable
from functools import cached_property
from typing import NamedTuple, TypeAlias

import mujoco
import numpy as np

from safe_rl.envs.opengl import open_renderer
from safe_rl.naming import did_you_mean

FREE = "free"

Camera: TypeAlias = str | mujoco.MjvCamera


class Marker(NamedTuple):
    """A shape that is not in the model: MuJoCo type, size as in MJCF, centre [m], colour."""

    type: mujoco.mjtGeom
    size: tuple[float, float, float]
    pos: np.ndarray
    rgba: tuple[float, float, float, float]


class Pictures(ABC):
    """Draws one model. The model is compiled and OpenGL is opened for the first picture."""

    options: mujoco.MjvOption | None = None

    def __init__(self) -> None:
        self._renderers: dict[tuple[int, int], mujoco.Renderer] = {}

    @abstractmethod
    def _load(self) -> mujoco.MjModel:
        """Compile the model."""

    @abstractmethod
    def free_camera(self) -> mujoco.MjvCamera:
        """Return the camera named "free"."""

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The model that is drawn."""
        return self._load()

    @cached_property
    def data(self) -> mujoco.MjData:
        """State that is drawn; call `place` after a change of positions."""
        return mujoco.MjData(self.model)

    @property
    def cameras(self) -> list[str]:
        """Names of cameras that `frame` takes."""
        named = [name for i in range(self.model.ncam) if (name := self.model.camera(i).name)]
        return [*named, FREE]

    def place(self) -> None:
        """Compute the poses of bodies, cameras and lights from the positions in `data`."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def frame(
        self,
        camera: Camera,
        width: int,
        height: int,
        markers: Iterable[Marker] = (),
        labels: Collection[str] = (),
    ) -> np.ndarray:
        """Draw `data` with markers and labels of bodies: RGB, uint8 [height, width, 3].

        Raises:
            ValueError: For an unknown camera.
            OpenGLError: If OpenGL is missing or cannot be started.
        """
        if isinstance(camera, str) and camera not in self.cameras:
            raise ValueError(
                f"There is no camera '{camera}'.{did_you_mean(camera, self.cameras)} "
                f"Choose one of {self.cameras}, or give a mujoco.MjvCamera."
            )
        size = (width, height)
        if size not in self._renderers:
            self._renderers[size] = open_renderer(self.model, width, height)
        renderer = self._renderers[size]
        chosen = self.free_camera() if isinstance(camera, str) and camera == FREE else camera
        renderer.update_scene(self.data, chosen, self.options)
        self._label(renderer.scene, set(labels))
        add_markers(renderer.scene, markers)
        return renderer.render()

    def close(self) -> None:
        """Free the resources of OpenGL; a later picture opens it again."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()

    def _label(self, drawn: mujoco.MjvScene, left: set[str]) -> None:
        """Write the names of some bodies, `left`, each at the first of its shapes."""
        for geom in drawn.geoms[: drawn.ngeom] if left else ():
            if geom.objtype != mujoco.mjtObj.mjOBJ_GEOM:
                continue
            name = self.model.body(self.model.geom_bodyid[geom.objid]).name
            if name in left:
                geom.label = name
                left.remove(name)


def add_markers(drawn: mujoco.MjvScene, markers: Iterable[Marker]) -> None:
    """Append markers to MuJoCo's scene; those beyond its capacity are left out."""
    upright = np.eye(3).reshape(-1)
    for marker in markers:
        if drawn.ngeom == drawn.maxgeom:
            return
        geom = drawn.geoms[drawn.ngeom]
        rgba = np.array(marker.rgba, dtype=np.float32)
        mujoco.mjv_initGeom(geom, marker.type, np.array(marker.size), marker.pos, upright, rgba)
        drawn.ngeom += 1


def resize(picture: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resize a picture by the nearest pixels."""
    lines = np.arange(height) * picture.shape[0] // height
    columns = np.arange(width) * picture.shape[1] // width
    return picture[lines[:, None], columns]
