"""``import scilab_rl``: instant, complete, and known to Gymnasium."""

from __future__ import annotations

import subprocess
import sys

import pytest

import scilab_rl

from ..e2e.commands import quiet_environment


def python(code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False,
        env=quiet_environment(),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_nothing_heavy_is_imported() -> None:
    code = (
        "import sys; before = set(sys.modules); import scilab_rl; dir(scilab_rl)\n"
        "print(*sorted(set(sys.modules) - before))"
    )
    ours = {"scilab_rl", "scilab_rl.envs", "scilab_rl.envs.on_import"}
    assert set(python(code).split()) <= ours | {"__future__"}


def test_dir_lists_what_there_is() -> None:
    assert dir(scilab_rl) == sorted(scilab_rl.__all__)
    assert all(getattr(scilab_rl, name) is not None for name in scilab_rl.__all__)
    assert set(scilab_rl._API) | {"__version__"} == set(scilab_rl.__all__)
    with pytest.raises(AttributeError, match="'scilab_rl' has no attribute 'trian'"):
        scilab_rl.trian  # noqa: B018


@pytest.mark.parametrize("imports", ["scilab_rl, gymnasium", "gymnasium, scilab_rl"])
def test_gymnasium_knows_the_environments(imports: str) -> None:
    code = (
        f"import {imports}\n"
        "gymnasium.register_envs(scilab_rl)\n"
        "print(gymnasium.make('Blocks-o2-gripper_above-v1').spec.id,\n"
        "      len(gymnasium.make_vec('Hook-o1-v1', num_envs=2).reset()[0]['achieved_goal']),\n"
        "      gymnasium.make('scilab_rl:Reach1DOF-v0').spec.max_episode_steps)"
    )
    assert python(code) == "Blocks-o2-gripper_above-v1 2 50"
