"""OpenGL, which only pictures need: its backend is chosen and loaded for the first picture.

At import, MuJoCo loads the OpenGL backend that MUJOCO_GL names, and fails if its libraries are
missing. This module imports MuJoCo even then.
"""

from __future__ import annotations

import importlib
import os
import sys

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


def open_renderer(model: mujoco.MjModel, width: int, height: int) -> mujoco.Renderer:
    """Open an OpenGL context that draws pictures of one size [pixels].

    The backend is the one that MUJOCO_GL names. If the variable is not set and there is no screen,
    it is EGL. The model's offscreen buffer is set to the size.

    Raises:
        OpenGLError: If OpenGL is missing or cannot be started.
    """
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    try:
        load_backend()
        return mujoco.Renderer(model, height, width)
    except Exception as error:  # every backend fails in its own way
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
