"""Find an OpenGL back end that works here, without risking this process."""

from __future__ import annotations

import functools
import os
import subprocess
import sys

from scilab_rl.errors import RenderingError

BACKENDS = ("egl", "osmesa", "glfw")
APT_LINE = "apt-get install -y libegl1 libgl1-mesa-dri libosmesa6"
_PROBE = """
import mujoco
context = mujoco.GLContext(64, 64)
context.make_current()
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>")
renderer = mujoco.Renderer(model, 64, 64)
renderer.update_scene(mujoco.MjData(model))
assert renderer.render().shape == (64, 64, 3)
"""


@functools.cache
def probe(backend: str) -> str | None:
    """Render one picture in a process of its own; a broken driver may crash it.

    Args:
        backend: A value of ``MUJOCO_GL``.

    Returns:
        None when it works, otherwise the last line of what it said.
    """
    environment = os.environ | {"MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE],
            env=environment,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return "no picture after 60 s"
    if done.returncode == 0:
        return None
    # What half-made renderers say in their destructors is not the cause.
    lines = done.stderr.partition("Exception ignored")[0].strip().splitlines()
    return lines[-1] if lines else f"exit code {done.returncode}"


def choose_backend() -> str:
    """Set ``MUJOCO_GL`` to a back end that works, unless the user has chosen one that does.

    Raises:
        RenderingError: With the line that installs one.
    """
    wished = os.environ.get("MUJOCO_GL", "")
    for backend in dict.fromkeys([wished, *BACKENDS] if wished else BACKENDS):
        if probe(backend) is None:
            os.environ["MUJOCO_GL"] = backend
            if backend != "glfw":
                os.environ["PYOPENGL_PLATFORM"] = backend
            return backend
    raise RenderingError(
        f"No picture can be drawn on this machine: {', '.join(BACKENDS)} all fail. "
        f"On Debian or Ubuntu: sudo {APT_LINE}"
    )
