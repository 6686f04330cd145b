"""Pictures of one compiled model of any family: OpenGL, cameras, markers, and renderers by size.

Only pictures need OpenGL: its backend is chosen and loaded for the first one. At import, MuJoCo
loads the backend that MUJOCO_GL names, and fails if its libraries are missing. This module imports
MuJoCo even then.
"""

from __future__ import annotations

import importlib
import operator
import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from safe_rl.naming import did_you_mean

try:
    import mujoco
except ImportError:
    raise
except Exception:  # PyOpenGL raises various errors instead of an ImportError
    _backend = os.environ["MUJOCO_GL"]
    os.environ["MUJOCO_GL"] = "disable"
    import mujoco

    os.environ["MUJOCO_GL"] = _backend
from mujoco.rendering.classic import gl_context

# Packages of Debian and Ubuntu with the libraries of each backend.
PACKAGES = {
    "egl": "libegl1 libgl1 libgl1-mesa-dri",
    "glfw": "libgl1 libgl1-mesa-dri",
    "osmesa": "libosmesa6",
}


class OpenGLError(RuntimeError):
    """Nothing can be drawn on this machine; the message names the package to install."""


def chosen_rows(rows: Any, num_envs: int) -> tuple[list[int], bool]:
    """Return the indices of one row, some, or all (None), and whether it is one integer."""
    is_one = isinstance(rows, int) or getattr(rows, "ndim", None) == 0
    chosen = range(num_envs) if rows is None else [rows] if is_one else rows
    return [operator.index(row) for row in chosen], is_one


def open_renderer(model: mujoco.MjModel, width: int, height: int) -> mujoco.Renderer:
    """Open an OpenGL context that draws pictures of one size [pixels].

    The backend is the one that MUJOCO_GL names. If the variable is not set and there is no screen,
    it is EGL. The model's offscreen buffer is set to the size.

    Raises:
        ValueError: If OpenGL has no buffer of this size.
        OpenGLError: If OpenGL is missing or cannot be started.
    """
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    try:
        load_backend()
        return mujoco.Renderer(model, height, width)
    except Exception as error:  # every backend fails in its own way
        if "framebuffer" in str(error):
            raise ValueError(
                f"OpenGL cannot draw {width} x {height} pixels here ({error}): choose a smaller "
                "picture."
            ) from error
        raise OpenGLError(_advice(error)) from error


def load_backend() -> None:
    """Choose and load MuJoCo's OpenGL backend, for code that opens its own contexts."""
    has_screen = sys.platform != "linux" or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))
    if not os.environ.get("MUJOCO_GL") and not has_screen:
        os.environ["MUJOCO_GL"] = "egl"
    elif hasattr(gl_context, "GLContext"):
        return
    # When this module is loaded, it chooses by MUJOCO_GL; MuJoCo's Renderer uses its choice.
    importlib.reload(gl_context)


def release_context() -> None:
    """Leave no OpenGL context of EGL current in this thread.

    No other thread can draw with a context that is current here, or free it, even when this thread
    has ended. MuJoCo would then free the textures and buffers of the same numbers in its present
    context, which may be that of another environment, whose pictures would be wrong from then on.
    """
    if (egl := sys.modules.get("mujoco.egl")) is not None:
        egl.EGL.eglReleaseThread()


def _advice(error: Exception) -> str:
    backend = os.environ.get("MUJOCO_GL", "").lower().strip()
    name = backend if backend in PACKAGES else "glfw"
    message = (
        f"Pictures need OpenGL, which cannot be started here with MUJOCO_GL={backend or 'unset'} "
        f"({type(error).__name__}: {error}). On Debian or Ubuntu install it with "
        f"'apt-get install {PACKAGES[name]}'"
    )
    if name == "glfw":
        return f"{message}; without a screen, set MUJOCO_GL=egl."
    return f"{message}, then restart Python."


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

    @property
    @abstractmethod
    def model(self) -> mujoco.MjModel:
        """The model that is drawn."""

    @abstractmethod
    def free_cameras(self) -> dict[str, mujoco.MjvCamera]:
        """Return cameras for the present positions; cameras of the model precede them."""

    @cached_property
    def data(self) -> mujoco.MjData:
        """State that is drawn; call `place` after a change of positions."""
        return mujoco.MjData(self.model)

    @property
    def cameras(self) -> dict[str, Camera]:
        """Cameras that `frame` takes, by name."""
        names = (self.model.camera(i).name for i in range(self.model.ncam))
        named = {name: name for name in names if name}
        return named | {n: each for n, each in self.free_cameras().items() if n not in named}

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

        Markers beyond the capacity of MuJoCo's scene are left out.

        Raises:
            ValueError: For an unknown camera, or too many pixels.
            OpenGLError: If OpenGL is missing or cannot be started.
        """
        cameras = self.cameras
        if isinstance(camera, str) and camera not in cameras:
            raise ValueError(
                f"There is no camera '{camera}'.{did_you_mean(camera, cameras)} "
                f"Choose one of {[*cameras]}, or give a mujoco.MjvCamera."
            )
        chosen = cameras[camera] if isinstance(camera, str) else camera
        try:
            return self._draw(chosen, (width, height), markers, labels)
        finally:
            release_context()

    def _draw(
        self,
        camera: mujoco.MjvCamera | str,
        size: tuple[int, int],
        markers: Iterable[Marker],
        labels: Collection[str],
    ) -> np.ndarray:
        if size not in self._renderers:
            self._renderers[size] = open_renderer(self.model, *size)
        renderer = self._renderers[size]
        renderer.update_scene(self.data, camera, self.options)
        self._label(renderer.scene, set(labels))
        drawn, upright = renderer.scene, np.eye(3).reshape(-1)
        for marker in list(markers)[: drawn.maxgeom - drawn.ngeom]:
            extent, rgba = np.array(marker.size), np.array(marker.rgba, dtype=np.float32)
            geom = drawn.geoms[drawn.ngeom]
            mujoco.mjv_initGeom(geom, marker.type, extent, marker.pos, upright, rgba)
            drawn.ngeom += 1
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


def resize(picture: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resize a picture by the nearest pixels."""
    lines = np.arange(height) * picture.shape[0] // height
    columns = np.arange(width) * picture.shape[1] // width
    return picture[lines[:, None], columns]
