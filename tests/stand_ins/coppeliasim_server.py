"""A stand-in for CoppeliaSim: the real wire protocol (ZeroMQ, CBOR), simple kinematics.

It answers the official client as CoppeliaSim does: a request is a CBOR map with `func` and `args`,
the answer one with `ret` or `err`; `zmqRemoteApi.info` lists functions and constants; a stepped
`sim.step` first answers `_*wait*_` and is then asked again. Objects form a tree of poses; kinematic
joints turn what they carry; joints with a target velocity turn while the simulation steps.

    python -m tests.stand_ins.coppeliasim_server 23000
"""

from __future__ import annotations

import argparse
import threading
from dataclasses import dataclass, field

import numpy as np
import zmq
from coppeliasim_zmqremoteapi_client import cbor

CONSTANTS = {
    "handle_world": -1,
    "simulation_stopped": 0,
    "simulation_advancing_running": 17,
    "floatparam_simulation_time_step": 1,
    "primitiveshape_cuboid": 3,
    "primitiveshape_spheroid": 4,
    "primitiveshape_cylinder": 5,
    "joint_revolute_subtype": 10,
    "jointmode_kinematic": 0,
    "colorcomponent_ambient_diffuse": 0,
}


@dataclass
class Thing:
    """An object of the scene; its pose is relative to its parent."""

    kind: str
    parent: int = -1
    pose: np.ndarray = field(default_factory=lambda: np.eye(4))
    size: tuple[float, ...] = (0.0, 0.0, 0.0)
    angle: float = 0.0
    speed: float = 0.0


class Scene:
    """The functions of `sim` that the environments use; public names are remote functions."""

    def __init__(self) -> None:
        self._things: dict[int, Thing] = {}
        self._state = CONSTANTS["simulation_stopped"]
        self._step_seconds = 0.05
        self._seconds = 0.0
        self._stepping = False

    def closeScene(self) -> int:
        self._things.clear()
        return 1

    def loadScene(self, path: str) -> int:
        self.closeScene()
        return 1

    def setStepping(self, on: bool) -> int:
        self._stepping = on
        return 0

    def setFloatParam(self, parameter: int, value: float) -> None:
        assert parameter == CONSTANTS["floatparam_simulation_time_step"]
        self._step_seconds = value

    def startSimulation(self) -> int:
        self._state, self._seconds = CONSTANTS["simulation_advancing_running"], 0.0
        return 1

    def stopSimulation(self) -> int:
        self._state = CONSTANTS["simulation_stopped"]
        return 1

    def getSimulationState(self) -> int:
        return self._state

    def getSimulationTime(self) -> float:
        return self._seconds

    def step(self, wait: bool = True) -> None:
        if not self._stepping or self._state == CONSTANTS["simulation_stopped"]:
            raise RuntimeError("sim.step needs a running simulation in stepping mode")
        self._seconds += self._step_seconds
        for thing in self._things.values():
            thing.angle += self._step_seconds * thing.speed

    def createPrimitiveShape(self, kind: int, size: list[float], options: int) -> int:
        return self._add(Thing(f"shape{kind}", size=tuple(size)))

    def createJoint(self, kind: int, mode: int, options: int) -> int:
        return self._add(Thing("joint"))

    def createDummy(self, size: float) -> int:
        return self._add(Thing("dummy"))

    def createVisionSensor(self, options: int, whole: list[int], real: list[float]) -> int:
        return self._add(Thing("camera", size=(whole[0], whole[1])))

    def setShapeColor(self, handle: int, name: str, part: int, color: list[float]) -> int:
        return 1

    def setObjectParent(self, handle: int, parent: int, keep: bool) -> None:
        world = self._world(handle)
        self._things[handle].parent = parent
        if keep:
            self._place(handle, world, -1)

    def getObjectPosition(self, handle: int, relative: int) -> list[float]:
        return self._relative(handle, relative)[:3, 3].tolist()

    def setObjectPosition(self, handle: int, place: list[float], relative: int) -> None:
        pose = self._relative(handle, relative)
        pose[:3, 3] = place
        self._place(handle, pose, relative)

    def setObjectPose(self, handle: int, pose: list[float], relative: int) -> None:
        self._place(handle, matrix(pose), relative)

    def getJointPosition(self, handle: int) -> float:
        return self._things[handle].angle

    def setJointPosition(self, handle: int, angle: float) -> None:
        self._things[handle].angle = angle

    def setJointTargetVelocity(self, handle: int, speed: float) -> None:
        self._things[handle].speed = speed

    def setJointTargetForce(self, handle: int, force: float) -> None:
        self._things[handle].speed = force  # a joint without inertia and with friction 1

    def checkCollision(self, first: int, second: int) -> list:
        distance = np.abs(self._world(first)[:3, 3] - self._world(second)[:3, 3])
        reach = (np.array(self._things[first].size) + self._things[second].size) / 2
        return [int(np.all(distance < reach)), [first, second]]

    def handleVisionSensor(self, handle: int) -> int:
        return 1

    def getVisionSensorImg(self, handle: int) -> list:
        """A dark floor seen from above, with a bright dot for each shape; the lowest row first."""
        width, height = map(int, self._things[handle].size)
        image = np.full((height, width, 3), 30, np.uint8)
        for number, thing in self._things.items():
            if thing.kind.startswith("shape"):
                x, y = self._world(number)[:2, 3]
                column, row = int((x + 1.2) / 2.4 * width), int((y + 1.2) / 2.4 * height)
                image[max(row - 4, 0) : row + 4, max(column - 4, 0) : column + 4] = 220
        return [image.tobytes(), [width, height]]

    def _add(self, thing: Thing) -> int:
        handle = len(self._things) + 15
        self._things[handle] = thing
        return handle

    def _world(self, handle: int) -> np.ndarray:
        """Return the pose in the world; what a joint carries is turned about its z axis."""
        thing = self._things[handle]
        if thing.parent == -1:
            return thing.pose.copy()
        return self._carried(thing.parent) @ thing.pose

    def _carried(self, handle: int) -> np.ndarray:
        if handle == -1:
            return np.eye(4)
        angle = self._things[handle].angle
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        return self._world(handle) @ turn

    def _relative(self, handle: int, relative: int) -> np.ndarray:
        return np.linalg.inv(self._carried(relative)) @ self._world(handle)

    def _place(self, handle: int, pose: np.ndarray, relative: int) -> None:
        world = self._carried(relative) @ pose
        self._things[handle].pose = (
            np.linalg.inv(self._carried(self._things[handle].parent)) @ world
        )


def matrix(pose: list[float]) -> np.ndarray:
    """Turn a place and a quaternion (x, y, z, w) into a matrix."""
    x, y, z, w = pose[3:]
    result = np.eye(4)
    result[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    result[:3, 3] = pose[:3]
    return result


class StandIn:
    """Serves one scene on a port, in a thread of its own."""

    def __init__(self, port: int) -> None:
        self.scene = Scene()
        self.mute = False  # a simulator that hangs: it takes requests and never answers
        self._stopped = threading.Event()
        self._waiting = False
        self._socket = zmq.Context.instance().socket(zmq.REP)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.bind(f"tcp://127.0.0.1:{port}")
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End as a program that is killed: without a word to its clients."""
        self._stopped.set()
        self._thread.join()

    def _serve(self) -> None:
        while not self._stopped.is_set():
            if self.mute or not self._socket.poll(20):
                self._stopped.wait(0.001)
                continue
            request = cbor.loads(self._socket.recv())
            self._socket.send(cbor.dumps(self._answer(request)))
        self._socket.close()

    def _answer(self, request: dict) -> dict:
        name, arguments = request["func"], list(request.get("args") or [])
        try:
            if name == "sim.step" and not self._waiting:
                self._waiting = True
                return {"func": "_*wait*_", "args": []}
            if name == "_*executed*_":
                self._waiting = False
                self.scene.step()
                return {"ret": []}
            return {"ret": self._call(name, arguments)}
        except Exception as error:  # noqa: BLE001 - as CoppeliaSim: the client gets its text
            self._waiting = False
            return {"err": f"{type(error).__name__}: {error}"}

    def _call(self, name: str, arguments: list) -> list:
        if name == "zmqRemoteApi.require":
            return []
        if name == "zmqRemoteApi.info":
            public = [key for key in dir(self.scene) if not key.startswith("_")]
            functions = {key: {"func": {}} for key in public}
            return [functions | {key: {"const": value} for key, value in CONSTANTS.items()}]
        result = getattr(self.scene, name.removeprefix("sim."))(*arguments)
        several = name in ("sim.checkCollision", "sim.getVisionSensorImg")
        return list(result) if several else [] if result is None else [result]


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("ports", type=int, nargs="+")
    stand_ins = [StandIn(port) for port in parser.parse_args().ports]
    threading.Event().wait()
