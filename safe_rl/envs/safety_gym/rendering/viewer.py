"""MuJoCo's interactive viewer, showing a world that is stepped elsewhere."""

from __future__ import annotations

from collections.abc import Iterable

from safe_rl.envs.opengl import PACKAGES, OpenGLError, has_screen
from safe_rl.envs.safety_gym.rendering.display import Display, add_markers
from safe_rl.envs.safety_gym.rendering.markers import Marker


class Viewer:
    """A window onto a display; the mouse moves its camera.

    Args:
        display: what is shown, as it was posed last.

    Raises:
        OpenGLError: if there is no screen, or no OpenGL.
    """

    def __init__(self, display: Display) -> None:
        if not has_screen():
            raise OpenGLError(
                "MuJoCo's viewer needs a screen, and there is none here (neither DISPLAY nor "
                "WAYLAND_DISPLAY is set). Use render_mode='rgb_array', which needs none."
            )
        # Its import opens a connection to the screen.
        import mujoco.viewer

        try:
            self._window = mujoco.viewer.launch_passive(
                display.scene.model, display.data, show_left_ui=False, show_right_ui=False
            )
        except Exception as error:  # GLFW raises what it likes
            raise OpenGLError(
                f"MuJoCo's viewer cannot be opened ({error}). It needs OpenGL: on Debian or "
                f"Ubuntu 'apt-get install {PACKAGES['glfw']}'."
            ) from error
        camera = display.free_camera()
        with self._window.lock():
            self._window.cam.lookat[:] = camera.lookat
            self._window.cam.distance = camera.distance
            self._window.cam.azimuth, self._window.cam.elevation = camera.azimuth, camera.elevation
            self._window.opt.geomgroup[:] = 1

    @property
    def is_open(self) -> bool:
        """Whether nobody closed the window."""
        return self._window.is_running()

    def show(self, markers: Iterable[Marker]) -> None:
        """Bring the window up to date with the display, and draw markers in it."""
        if not self.is_open:
            return
        with self._window.lock():
            drawn = self._window.user_scn
            drawn.ngeom = 0
            add_markers(drawn, markers)
        self._window.sync()

    def close(self) -> None:
        """Close the window."""
        self._window.close()
