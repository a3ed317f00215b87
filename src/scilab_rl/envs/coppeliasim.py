"""The base class of goal tasks in CoppeliaSim, over its official ZeroMQ remote API.

Each environment needs a simulator of its own, and a run has at least two of them: one to train in
and one to evaluate in. They take the first free ones of the ports 23000, 23002, 23004, ...
Start simulators with

    $COPPELIASIM_ROOT/coppeliaSim.sh -h -GzmqRemoteApi.rpcPort=23000

or set ``COPPELIASIM_ROOT`` and let the environments start them.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import subprocess
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from scilab_rl import files
from scilab_rl.envs.goal import GoalEnv
from scilab_rl.errors import ConfigError, EnvironmentFailure, MissingDependencyError

_CLIENT = "coppeliasim_zmqremoteapi_client"
_PORT_STRIDE = 2  # a simulator takes two ports
_MAX_SIMULATORS = 64
_START_SECONDS = 60.0
_IMAGE_SIZE = 256


class CoppeliaSimEnv(GoalEnv):
    """A `GoalEnv` whose world is a CoppeliaSim scene, one simulation step per environment step.

    A subclass builds its scene in `build_scene` (once), and has `sample_goal`, `achieved_goal`,
    `get_observation` and `set_control`. ``self.sim`` is CoppeliaSim's API as its manual describes
    it.

    Args:
        host: Where the simulators run.
        port: Port of the first one; the next ones are at every second port after it.
        timeout_seconds: How long a simulator may take for an answer.
        step_seconds: Simulated time per step.
        scene: A ``.ttt`` file to load first; None for an empty scene.
        render_mode: None or ``rgb_array``.
        kwargs: Those of `GoalEnv`.

    Attributes:
        sim: The simulator's API.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 - Gymnasium's

    def __init__(
        self,
        *,
        host: str = "localhost",
        port: int = 23000,
        timeout_seconds: float = 10.0,
        step_seconds: float = 0.05,
        scene: str | None = None,
        **kwargs: Any,
    ) -> None:
        if importlib.util.find_spec(_CLIENT) is None:
            raise MissingDependencyError(_CLIENT, "coppeliasim", "to talk to CoppeliaSim")
        self.step_seconds = step_seconds
        self._simulator = Simulator.claim(host, port, timeout_seconds)
        self._camera: int | None = None
        try:
            with self._simulator.errors_named():
                self.sim = self._simulator.connect()
                self._prepare(scene)
            super().__init__(**kwargs)
        except BaseException:
            self._simulator.close()
            raise

    def build_scene(self) -> None:
        """Create or look up the objects of the scene; the simulation is stopped."""

    def place_objects(self) -> None:
        """Put everything to its start; the simulation is stopped."""

    def set_control(self, action: np.ndarray) -> None:
        """Turn an action into controls. Shapes: ``(action_size,)``, in [-1, 1]."""
        raise NotImplementedError

    def reset_state(self) -> None:
        """Stop the simulation, place the objects and start it again."""
        with self._simulator.errors_named():
            self._stop()
            self.place_objects()
            self.sim.startSimulation()

    def apply_action(self, action: np.ndarray) -> None:
        """Act and let one simulation step pass."""
        with self._simulator.errors_named():
            self.set_control(action)
            self.sim.step()

    def render(self) -> np.ndarray | None:
        """Return what the camera sees. Shapes: ``(256, 256, 3)``, uint8."""
        with self._simulator.errors_named():
            if self._camera is None:
                self._camera = self._create_camera()
            self.sim.handleVisionSensor(self._camera)
            pixels, (width, height) = self.sim.getVisionSensorImg(self._camera)
        # CoppeliaSim's first row is the lowest one.
        return np.frombuffer(pixels, np.uint8).reshape(height, width, 3)[::-1].copy()

    def close(self) -> None:
        """Stop the simulation, and the simulator, if this environment has started it."""
        self._simulator.close()

    def position(self, handle: int) -> np.ndarray:
        """Return the place of an object in the world. Shapes: ``(3,)`` in m."""
        with self._simulator.errors_named():
            return np.array(self.sim.getObjectPosition(handle, self.sim.handle_world))

    def set_position(self, handle: int, place: Sequence[float] | np.ndarray) -> None:
        """Put an object somewhere in the world. Shapes: ``(3,)`` in m."""
        self.sim.setObjectPosition(handle, _plain(place), self.sim.handle_world)

    def set_pose(self, handle: int, pose: Sequence[float] | np.ndarray) -> None:
        """Put and turn an object. Shapes: ``(7,)``: place in m, quaternion x y z w."""
        self.sim.setObjectPose(handle, _plain(pose), self.sim.handle_world)

    def joint_positions(self, joints: Sequence[int]) -> np.ndarray:
        """Return joint angles or offsets. Shapes: ``(n_joints,)`` in rad or m."""
        with self._simulator.errors_named():
            return np.array([self.sim.getJointPosition(joint) for joint in joints])

    def set_joint_positions(self, joints: Sequence[int], places: np.ndarray) -> None:
        """Put kinematic joints somewhere at once. Shapes: ``(n_joints,)`` in rad or m."""
        for joint, place in zip(joints, places, strict=True):
            self.sim.setJointPosition(joint, float(place))

    def set_joint_velocities(self, joints: Sequence[int], speeds: np.ndarray) -> None:
        """Set the speeds that the joints' motors aim at. Shapes: ``(n_joints,)`` per s."""
        for joint, speed in zip(joints, speeds, strict=True):
            self.sim.setJointTargetVelocity(joint, float(speed))

    def set_joint_forces(self, joints: Sequence[int], forces: np.ndarray) -> None:
        """Set forces or torques. Shapes: ``(n_joints,)`` in N or N m."""
        for joint, force in zip(joints, forces, strict=True):
            self.sim.setJointTargetForce(joint, float(force))

    def collide(self, first: int, second: int) -> bool:
        """Return whether two shapes touch."""
        return bool(self.sim.checkCollision(first, second)[0])

    def create_shape(
        self, kind: str, size: Sequence[float], color: Sequence[float], parent: int | None = None
    ) -> int:
        """Create a primitive and return its handle.

        Args:
            kind: ``cuboid``, ``spheroid`` or ``cylinder``.
            size: In m. Shapes: ``(3,)``.
            color: Red, green, blue from 0 to 1.
            parent: Handle of the object that carries it.
        """
        sim = self.sim
        shape = sim.createPrimitiveShape(getattr(sim, f"primitiveshape_{kind}"), _plain(size), 0)
        sim.setShapeColor(shape, "", sim.colorcomponent_ambient_diffuse, _plain(color))
        if parent is not None:
            sim.setObjectParent(shape, parent, False)
        return int(shape)

    def _prepare(self, scene: str | None) -> None:
        self._stop()
        if scene is None:
            self.sim.closeScene()
        elif Path(scene).is_file():
            self.sim.loadScene(str(Path(scene).resolve()))
        else:
            raise ConfigError(f"env_kwargs.scene: there is no file '{scene}'.")
        self.sim.setStepping(True)
        self.sim.setFloatParam(self.sim.floatparam_simulation_time_step, self.step_seconds)
        self.build_scene()

    def _stop(self) -> None:
        self.sim.stopSimulation()
        deadline = time.monotonic() + self._simulator.timeout_seconds
        while self.sim.getSimulationState() != self.sim.simulation_stopped:
            if time.monotonic() > deadline:
                raise EnvironmentFailure(f"{self._simulator}: the simulation does not stop.")
            time.sleep(0.01)

    def _create_camera(self) -> int:
        """Look down on the scene at an angle of 45 degrees."""
        # A perspective camera that is handled explicitly; sizes and angles as the manual has them.
        options, resolution = 1 | 2, [_IMAGE_SIZE, _IMAGE_SIZE, 0, 0]
        lens = [0.01, 10.0, np.pi / 3, 0.1, 0.0, 0.0, 0.7, 0.8, 0.9, 0.0, 0.0]
        camera = int(self.sim.createVisionSensor(options, resolution, lens))
        # A camera looks along its z axis, here turned by -135 degrees about x.
        angle = -3 * np.pi / 8
        self.set_pose(camera, [0.0, -1.4, 1.4, np.sin(angle), 0.0, 0.0, np.cos(angle)])
        return camera


class Simulator:
    """One running CoppeliaSim that belongs to one environment.

    Args:
        host: Where it runs.
        port: Its port.
        timeout_seconds: How long it may take for an answer.
        lock: The locked file that keeps other environments away from it.
    """

    def __init__(self, host: str, port: int, timeout_seconds: float, lock: IO[str]) -> None:
        self.host, self.port, self.timeout_seconds = host, port, timeout_seconds
        self._lock = lock
        self._process: subprocess.Popen[bytes] | None = None
        self._client: Any = None
        self._sim: Any = None

    def __str__(self) -> str:
        """Name it for error messages."""
        return f"CoppeliaSim at {self.host}:{self.port}"

    @classmethod
    def claim(cls, host: str, first_port: int, timeout_seconds: float) -> Simulator:
        """Return the first simulator that no other environment of this machine uses.

        Raises:
            EnvironmentFailure: If all are in use.
        """
        for port in range(first_port, first_port + _PORT_STRIDE * _MAX_SIMULATORS, _PORT_STRIDE):
            path = Path(tempfile.gettempdir()) / f"scilab_rl-coppeliasim-{host}-{port}.lock"
            lock = path.open("w", encoding="utf-8")
            with contextlib.suppress(OSError):
                if files.lock(lock, wait=False):
                    return cls(host, port, timeout_seconds, lock)
            lock.close()
        raise EnvironmentFailure(f"All {_MAX_SIMULATORS} ports from {first_port} are in use.")

    def connect(self) -> Any:
        """Connect to the simulator, start it where that is possible, and return its API.

        Raises:
            EnvironmentFailure: If none answers.
        """
        if not self._answers():
            self._start()
        self._sim = self._open_client(self.timeout_seconds).require("sim")
        return self._sim

    @contextlib.contextmanager
    def errors_named(self) -> Iterator[None]:
        """Turn silence and errors of the simulator into one line for people."""
        import zmq

        try:
            yield
        except (zmq.Again, zmq.ZMQError) as error:
            self._drop_client()
            raise EnvironmentFailure(
                f"{self} has not answered for {self.timeout_seconds:g} s. Is it still running?"
            ) from error

    def close(self) -> None:
        """Stop the simulation, the process if it is ours, and free the port."""
        if self._sim is not None and self._client is not None:
            # A simulator that is gone needs no stopping.
            with contextlib.suppress(Exception):
                self._sim.stopSimulation()
        self._drop_client()
        if self._process is not None:
            self._process.terminate()
            try:
                self._process.wait(timeout=10)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._process = None
        self._lock.close()

    def _answers(self) -> bool:
        import zmq

        try:
            self._open_client(min(2.0, self.timeout_seconds)).call("zmqRemoteApi.info", ["sim"])
        except zmq.ZMQError:
            return False
        finally:
            self._drop_client()
        return True

    def _open_client(self, timeout_seconds: float) -> Any:
        import zmq
        from coppeliasim_zmqremoteapi_client import RemoteAPIClient

        self._drop_client()
        self._client = RemoteAPIClient(self.host, self.port)
        milliseconds = int(1000 * timeout_seconds)
        self._client.socket.setsockopt(zmq.RCVTIMEO, milliseconds)
        self._client.socket.setsockopt(zmq.SNDTIMEO, milliseconds)
        # What is still to be sent when a simulator has died must not keep this process alive.
        self._client.socket.setsockopt(zmq.LINGER, 0)
        return self._client

    def _drop_client(self) -> None:
        if self._client is not None:
            self._client.socket.close()
            self._client = None

    def _start(self) -> None:
        root = os.environ.get("COPPELIASIM_ROOT")
        option = f"-GzmqRemoteApi.rpcPort={self.port}"
        if root is None or self.host not in ("localhost", "127.0.0.1"):
            raise EnvironmentFailure(
                f"No {self} answers. Start one with `coppeliaSim.sh -h {option}` (each environment "
                "needs its own, a run at least two), or set COPPELIASIM_ROOT to its folder."
            )
        program = Path(root) / "coppeliaSim.sh"
        if not program.is_file():
            raise EnvironmentFailure(f"COPPELIASIM_ROOT={root} has no coppeliaSim.sh.")
        self._process = subprocess.Popen(
            [str(program), "-h", option],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        deadline = time.monotonic() + _START_SECONDS
        while not self._answers():
            if self._process.poll() is not None:
                raise EnvironmentFailure(f"{program} ended with {self._process.returncode}.")
            if time.monotonic() > deadline:
                raise EnvironmentFailure(f"{program} does not answer after {_START_SECONDS:g} s.")


def _plain(values: Iterable[float]) -> list[float]:
    """Return a list of Python's own numbers; the client's encoder knows no others."""
    return [float(value) for value in values]
