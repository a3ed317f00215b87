"""Does the work of sbx's SAC with hindsight replay on FetchReach, as `sb3_sac` does its own.

Runs in the peers' virtual environment: sbx_sac.py STEPS|live BATCH_SIZE LAYER ...
"""

import jax
import sbx
from sb3_sac import serve

if __name__ == "__main__":
    serve(sbx.SAC, wait=lambda model: jax.block_until_ready(model.policy.qf_state.params))
