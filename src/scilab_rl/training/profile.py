"""Where the time of a run goes: each second is given to exactly one part."""

from __future__ import annotations

import functools
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

# Part to the methods that do it, wherever they are found: our algorithms, Stable-Baselines3's, the
# replay buffers, the trainer and the trackers.
ENVIRONMENT, SAMPLING, UPDATE = "environment", "sampling", "update"
WAITING, ACTING, STORING = "waiting for updates", "acting", "storing"
EVALUATION, LOGGING, SAVING, RENDERING = "evaluation", "logging", "saving", "rendering"
OTHER = "everything else"
REMEDIES = {
    ENVIRONMENT: "n_envs=4 vector=workers steps several environments on several cores",
    SAMPLING: "a smaller algorithm.batch_size draws less",
    UPDATE: "algorithm=jaxsac, smaller networks or fewer algorithm.gradient_steps compute less",
    WAITING: "smaller networks or batches, fewer algorithm.gradient_steps, or "
    "algorithm.precision=bfloat16 compute less",
    EVALUATION: "a larger eval_after_n_steps or a smaller n_test_rollouts evaluates less",
    LOGGING: "mlflow=0, wandb=0 or fewer log_*_step options record less",
    SAVING: "a larger save_model_freq saves less often",
    RENDERING: "a larger render_freq shows fewer episodes",
}


@dataclass
class Part:
    """What one part of a run has cost.

    Attributes:
        seconds: Without the seconds of the parts inside of it.
        n_calls: How often it was entered.
    """

    seconds: float = 0.0
    n_calls: int = 0


@dataclass
class Profile:
    """Divides the time of a run among its parts.

    Attributes:
        parts: Name to cost.
        seconds: The whole, from `start` to `stop`.
    """

    parts: dict[str, Part] = field(default_factory=lambda: defaultdict(Part))
    seconds: float = 0.0
    _inside: list[float] = field(default_factory=list)
    _started: float = 0.0

    def start(self) -> None:
        """Begin with the whole."""
        self._started = time.perf_counter()

    def stop(self) -> None:
        """End the whole; what belongs to no part is `OTHER`."""
        self.seconds = time.perf_counter() - self._started
        measured = sum(part.seconds for part in self.parts.values())
        self.parts[OTHER] = Part(max(self.seconds - measured, 0.0), 1)

    def measure(self, name: str, owner: Any, method: str) -> None:
        """Count the time of a method of one object as a part; nothing if it has no such method."""
        if callable(function := getattr(owner, method, None)):
            setattr(owner, method, self._timed(name, function))

    def _timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def timed(*args: Any, **kwargs: Any) -> Any:
            self._inside.append(0.0)
            started = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                seconds = time.perf_counter() - started
                part = self.parts[name]
                part.seconds += seconds - self._inside.pop()
                part.n_calls += 1
                if self._inside:
                    self._inside[-1] += seconds

        return timed


def attach(session: Any) -> Profile:
    """Measure the parts of a run that is about to start.

    Args:
        session: Of `scilab_rl.experiment.run`, which calls this as ``watch``.
    """
    profile = Profile()
    algorithm, trainer = session.algorithm, session.trainer
    profile.measure(ENVIRONMENT, algorithm.get_env(), "step")
    for env in getattr(session.train_env.unwrapped, "envs", []):
        profile.measure(RENDERING, env, "render")
    for method in ("explore", "_sample_action"):
        profile.measure(ACTING, algorithm, method)
    buffer = getattr(algorithm, "replay_buffer", None)
    profile.measure(STORING, buffer, "add")
    for method in ("sample", "sample_vectors"):
        profile.measure(SAMPLING, buffer, method)
    profile.measure(UPDATE, algorithm, "train")
    profile.measure(UPDATE, getattr(algorithm, "rounds", None), "start")
    profile.measure(WAITING, algorithm, "finish_round")
    profile.measure(LOGGING, trainer, "_on_step")
    profile.measure(EVALUATION, trainer, "_evaluate")
    for method in ("_save_checkpoint", "save_policy"):
        profile.measure(SAVING, trainer, method)
    profile.start()
    return profile
