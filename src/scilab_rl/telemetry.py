"""Switch off the usage reports of libraries, unless the user enables them."""

from __future__ import annotations

import os

# Read by the libraries when they are imported, and by the processes that they start.
SWITCHES = {
    "DO_NOT_TRACK": "true",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "WANDB_ERROR_REPORTING": "false",
    "RAY_USAGE_STATS_ENABLED": "0",
}


def switch_off() -> None:
    """Set the variables that are not set in the environment of this process."""
    for name, value in SWITCHES.items():
        os.environ.setdefault(name, value)
