"""Types of what environments take and return."""

from __future__ import annotations

from typing import Any, SupportsFloat, TypeAlias

import numpy as np

Observation: TypeAlias = np.ndarray | dict[str, np.ndarray]
Info: TypeAlias = dict[str, Any]
# Of one environment, as Gymnasium defines them; an observation is checked before it is used.
ResetResult: TypeAlias = tuple[Any, Info]
StepResult: TypeAlias = tuple[Any, SupportsFloat, bool, bool, Info]
