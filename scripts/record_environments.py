"""Record the spaces of all environments that this machine can make, for `scilab-rl envs`.

Run it with the pinned versions, while a CoppeliaSim or its stand-in listens, and once more in
.venv-myosuite; what is recorded and cannot be made now is kept.

    python -m tests.stand_ins.coppeliasim_server 23000 &
    python scripts/record_environments.py [PART OF AN ID]
"""

from __future__ import annotations

import json
import sys

from scilab_rl.envs.catalog import SPACES, describe
from scilab_rl.envs.registration import known_env_ids, versions_by_family

KEPT = ("observation", "action", "goal")


def main() -> None:
    """Write the file."""
    recorded = json.loads(SPACES.read_text(encoding="utf-8")) if SPACES.exists() else {}
    part = "".join(sys.argv[1:2])
    for versions in versions_by_family(known_env_ids()).values():
        if part not in versions[-1]:
            continue
        row = describe(versions[-1])
        if row["problem"]:
            sys.stderr.write(f"{row['env']}: {row['problem']}\n")
        else:
            recorded[row["env"]] = {key: row[key] for key in KEPT}
    lines = (f"  {json.dumps(key)}: {json.dumps(recorded[key])}" for key in sorted(recorded))
    SPACES.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
