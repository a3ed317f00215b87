from functools import partial

import numpy as np

from scilab_rl.envs.workers import WorkersVecEnv
from tests.unit.envs.test_shares import limited


def test_closing_ends_the_processes_also_in_the_middle_of_a_step():
    env = WorkersVecEnv([partial(limited, i) for i in range(3)], 2, "fork")
    env.reset()
    env.step_async(np.zeros((3, 1)))
    env.close()
    env.close()
    assert [process.exitcode for process in env.processes] == [0, 0]
