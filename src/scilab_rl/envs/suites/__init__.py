"""The packages that contain environments; our changes to their tasks are in the other files here.

Each of these files is imported when its package is used, and its ``register()`` called.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass


@dataclass(frozen=True)
class Suite:
    """One source of environments.

    Attributes:
        package: The package that has to be there; also the suite's name.
        contents: Its tasks, in a few words.
        extra: The extra of Scilab-RL that installs it; empty for what is always there.
        modules: Beginnings of the modules that its environments are made from.
        begins: Beginnings of its ids, which are unknown before the package is imported; empty for
            a suite whose ids are always known.
        pip_options: Options of pip for its installation.
        conflicts: What it cannot be installed with, and what to do.
        note: What one has to know before one trains in it.
    """

    package: str
    contents: str
    extra: str = ""
    modules: tuple[str, ...] = ()
    begins: tuple[str, ...] = ()
    pip_options: str = ""
    conflicts: str = ""
    note: str = ""

    @property
    def installed(self) -> bool:
        """Whether the package can be imported."""
        return importlib.util.find_spec(self.package) is not None

    @property
    def install_line(self) -> str:
        """The command that installs it; empty if it is always installed."""
        return f'pip install {self.pip_options}"scilab-rl[{self.extra}]"' if self.extra else ""


SUITES = (
    Suite(
        "scilab_rl",
        "reaching, stacking, tools, buttons, mazes, choices",
        modules=("scilab_rl.envs.",),
    ),
    Suite(
        "gymnasium",
        "classic control, toy texts, MuJoCo's walkers",
        modules=("gymnasium.envs.",),
        note="the walkers come with [robotics], which every installation has",
    ),
    Suite(
        "Box2D",
        "LunarLander, BipedalWalker, CarRacing",
        extra="box2d",
        modules=("gymnasium.envs.box2d.",),
    ),
    Suite(
        "gymnasium_robotics",
        "Fetch, Shadow hand, Adroit, kitchen, mazes",
        extra="robotics",
        modules=("gymnasium_robotics.",),
        begins=("Fetch", "Hand", "Adroit", "FrankaKitchen", "PointMaze", "AntMaze"),
        conflicts="mujoco>=3.7 changes Fetch silently, mujoco>=3.13 breaks it",
    ),
    Suite(
        "metaworld",
        "50 tasks for a Sawyer arm",
        extra="metaworld",
        modules=("metaworld.", "scilab_rl.envs.suites.metaworld"),
        begins=("MetaW", "Meta-World"),
        conflicts="myosuite; needs mujoco==3.3.0",
    ),
    Suite(
        "highway_env",
        "parking and driving",
        extra="highway",
        modules=("highway_env.", "scilab_rl.envs.suites.highway_env"),
        begins=(
            "parking",
            "highway",
            "merge",
            "roundabout",
            "intersection",
            "exit",
            "lane-keeping",
            "racetrack",
            "two-way",
            "u-turn",
        ),
    ),
    Suite(
        "coppeliasim_zmqremoteapi_client",
        "CoppeliaSim: an arm and a robot with wheels",
        extra="coppeliasim",
        modules=("scilab_rl.envs.coppeliasim",),
        note="needs the simulator: COPPELIASIM_ROOT, or one that listens on env_kwargs.port",
    ),
    Suite(
        "panda_gym",
        "reaching, pushing, sliding, stacking for a Franka arm in PyBullet",
        extra="panda",
        modules=("panda_gym.", "scilab_rl.envs.suites.panda_gym"),
        begins=("Panda",),
        note="each reset rebuilds the world (60 ms), as PyBullet's episodes depend on earlier "
        "ones; PandaFlip cannot be made: its texture is missing in panda-gym 3.0.7",
    ),
    Suite(
        "myosuite",
        "muscles that move arms, hands and legs",
        extra="myosuite",
        modules=("myosuite.", "scilab_rl.envs.suites.myosuite"),
        begins=("myo", "motorFinger"),
        pip_options="-c constraints-myosuite.txt ",
        conflicts="metaworld, gymnasium>=1.3: a virtual environment of its own, "
        "see `make test-myosuite`",
        note="dense rewards, no goals in the observation; turning keys, twirling pens and "
        "reorienting need mujoco>=3.7, with which Fetch is not the same",
    ),
)


def suite_of_module(module: str) -> Suite | None:
    """Return the suite of an environment by the module that it is made from.

    >>> suite_of_module("gymnasium.envs.box2d.lunar_lander").package
    'Box2D'
    """
    fitting = [
        (len(beginning), suite)
        for suite in SUITES
        for beginning in suite.modules
        if f"{module}.".startswith(beginning)
    ]
    return max(fitting, key=lambda pair: pair[0])[1] if fitting else None


def suite_of_name(name: str) -> Suite | None:
    """Return the suite that a name would be from, if its package were imported."""
    return next((s for s in SUITES if s.begins and name.startswith(s.begins)), None)
