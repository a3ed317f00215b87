"""The real client talks to a stand-in for the simulator; see tests/stand_ins."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("coppeliasim_zmqremoteapi_client")

from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.checker import check_environment
from scilab_rl.envs.coppeliasim_tasks import CoppeliaDrive, CoppeliaReach
from scilab_rl.envs.vectorize import make_single_env
from scilab_rl.errors import ConfigError, EnvironmentFailure
from tests.stand_ins.coppeliasim_server import StandIn

N_SIMULATORS = 3


def free_port() -> int:
    """Return the first of a few ports in a row that nobody uses."""
    for port in range(24000, 30000, 10):
        try:
            for index in range(N_SIMULATORS):
                with socket.socket() as probe:
                    probe.bind(("127.0.0.1", port + 2 * index))
        except OSError:
            continue
        return port
    raise RuntimeError("no free ports")


@pytest.fixture
def stand_ins(monkeypatch) -> Iterator[list[StandIn]]:
    monkeypatch.delenv("COPPELIASIM_ROOT", raising=False)
    port = free_port()
    running = [StandIn(port + 2 * index) for index in range(N_SIMULATORS)]
    for stand_in, number in zip(running, range(port, port + 10, 2), strict=False):
        stand_in.port = number
    yield running
    for stand_in in running:
        stand_in.stop()


def test_the_arm_is_where_its_joints_put_it(stand_ins) -> None:
    env = CoppeliaReach(port=stand_ins[0].port)
    rng = np.random.default_rng(0)
    for _ in range(10):
        angles = rng.uniform(env.low, env.high)
        env.set_joint_positions(env._joints, angles)
        assert np.allclose(env.position(env._tip), env.tip_place(angles), atol=1e-9)
    env.close()


def test_joint_speeds_move_while_the_simulation_steps(stand_ins) -> None:
    env = CoppeliaReach(port=stand_ins[0].port, step_seconds=0.1)
    env.reset(seed=0)
    env.set_joint_velocities(env._joints, np.array([1.0, -0.5, 0.0]))
    env.sim.step()
    moved = env.joint_positions(env._joints) - env.rest
    assert np.allclose(moved, [0.1, -0.05, 0.0])
    env.set_joint_forces(env._joints, np.array([0.0, 0.0, 0.0]))
    env.sim.step()
    assert np.allclose(env.joint_positions(env._joints) - env.rest, moved)
    assert np.isclose(env.sim.getSimulationTime(), 0.2)
    env.close()


def test_the_pillar_stops_the_robot(stand_ins) -> None:
    env = CoppeliaDrive(port=stand_ins[0].port)
    env.reset(seed=0)
    env._move(np.array([-0.6, 0.0, 0.0]))
    for _ in range(40):
        observation = env.step(np.array([1.0, 0.0]))[0]
    assert -0.4 < observation["achieved_goal"][0] < -0.2
    env.close()


@pytest.mark.parametrize("env_id", ["CoppeliaReach-v0", "CoppeliaDrive-v0"])
def test_the_doctor_finds_no_fault(stand_ins, env_id) -> None:
    settings = RunConfig(env_id, {"port": stand_ins[0].port})
    found = list(check_environment(lambda: make_single_env(settings), n_steps=200))
    assert [f for f in found if f.result in ("warn", "fail")] == []
    assert len(found) == 16


def test_frames_are_upright(stand_ins) -> None:
    env = CoppeliaDrive(port=stand_ins[0].port, render_mode="rgb_array")
    env.reset(seed=0)
    env._move(np.array([0.0, 0.9, 0.0]))
    env.set_position(env._marker, (0.0, 0.9, 0.0))
    frame = env.render()
    assert frame.shape == (256, 256, 3)
    upper, lower = frame[:100].max(), frame[156:].max()
    assert (upper, lower) == (220, 30)  # large y is at the top
    env.close()


def test_each_environment_has_a_simulator_of_its_own(stand_ins) -> None:
    first, second = (CoppeliaReach(port=stand_ins[0].port) for _ in range(2))
    first.reset(seed=0), second.reset(seed=0)
    first.step(np.ones(3))
    assert len(stand_ins[0].scene._things) == len(stand_ins[1].scene._things) > 0
    assert not stand_ins[2].scene._things
    assert np.array_equal(second.joint_positions(second._joints), second.rest)
    first.close()
    third = CoppeliaReach(port=stand_ins[0].port)  # the port is free again
    assert not stand_ins[2].scene._things
    second.close(), third.close()


def test_no_simulator_says_how_to_start_one(monkeypatch) -> None:
    monkeypatch.delenv("COPPELIASIM_ROOT", raising=False)
    port = free_port()
    message = rf"No CoppeliaSim at localhost:{port} answers.*rpcPort={port}.*COPPELIASIM_ROOT"
    with pytest.raises(EnvironmentFailure, match=message):
        CoppeliaReach(port=port, timeout_seconds=0.3)


def test_wrong_folders_and_scenes_are_named(stand_ins, monkeypatch, tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"there is no file 'nowhere\.ttt'"):
        CoppeliaReach(port=stand_ins[0].port, scene="nowhere.ttt")
    monkeypatch.setenv("COPPELIASIM_ROOT", str(tmp_path))
    with pytest.raises(EnvironmentFailure, match=r"has no coppeliaSim\.sh"):
        CoppeliaReach(port=free_port(), timeout_seconds=0.3)


def test_a_simulator_that_dies_is_reported_and_the_port_is_freed(stand_ins) -> None:
    env = CoppeliaReach(port=stand_ins[0].port, timeout_seconds=0.5)
    env.reset(seed=0)
    stand_ins[0].mute = True
    with pytest.raises(EnvironmentFailure, match=r"has not answered for 0\.5 s"):
        env.step(np.zeros(3))
    env.close()
    stand_ins[0].mute = False


def test_a_simulator_is_started_and_ended(monkeypatch, tmp_path) -> None:
    import sys
    from pathlib import Path

    program, root = tmp_path / "coppeliaSim.sh", Path(__file__).parents[3]
    program.write_text(
        "#!/bin/sh\n"
        f'cd "{root}" && exec "{sys.executable}" -m tests.stand_ins.coppeliasim_server '
        '"${2#-GzmqRemoteApi.rpcPort=}"\n'
    )
    program.chmod(0o755)
    monkeypatch.setenv("COPPELIASIM_ROOT", str(tmp_path))
    env = CoppeliaReach(port=free_port(), timeout_seconds=5)
    env.reset(seed=0)
    process = env._simulator._process
    assert process.poll() is None
    env.close()
    assert process.poll() is not None


@pytest.mark.coppeliasim
@pytest.mark.skipif("COPPELIASIM_ROOT" not in os.environ, reason="needs the real simulator")
@pytest.mark.parametrize("cls", [CoppeliaReach, CoppeliaDrive])
def test_the_real_simulator(cls) -> None:
    found = list(check_environment(lambda: cls(render_mode="rgb_array"), n_steps=100))
    assert [f for f in found if f.result == "fail"] == []
