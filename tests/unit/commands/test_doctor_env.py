from __future__ import annotations

from textwrap import dedent

from scilab_rl.commands import doctor

from .conftest import read_table, write_file


def test_an_environment_is_examined_with_its_arguments(desk, capsys):
    words = ["env=PointGym-v0", "env_kwargs.threshold=0.25", "--steps", "60"]
    assert doctor.main(words) == 0
    rows = {row["check"]: row for row in read_table(capsys.readouterr().out)}
    assert rows["rewards of a batch"]["found"] == "equal on 60 steps"
    assert rows["seeds"]["result"] == "ok"


def test_a_broken_environment_makes_the_exit_code_1(desk, capsys):
    write_file(
        desk / "src/custom_envs/__init__.py",
        dedent("""
        import gymnasium
        from gymnasium.envs.classic_control import PendulumEnv

        class Stuck(PendulumEnv):
            def step(self, action):
                raise RuntimeError("motor off")

        gymnasium.register("Stuck-v0", entry_point=Stuck, max_episode_steps=9)
        """),
    )
    assert doctor.main(["env=Stuck-v0"]) == 1
    assert "RuntimeError: motor off" in capsys.readouterr().out
