"""Where the time of a run goes: each second is given to exactly one part."""

from __future__ import annotations

import functools
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field

from scilab_rl.training.callbacks import KeepBest, RunCallback
from scilab_rl.training.loop import Trainer

# Part to the methods that do it, wherever they are found: our algorithms, Stable-Baselines3's, the
# replay buffers, the trainer and its callbacks.
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
    """The time that one part of a run took.

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

    def measure(self, name: str, owner: object, method: str) -> None:
        """Count the time of a method of one object as a part; nothing if it has no such method."""
        if callable(function := getattr(owner, method, None)):
            setattr(owner, method, self._timed(name, function))

    def _timed(self, name: str, function: Callable[..., object]) -> Callable[..., object]:
        @functools.wraps(function)
        def timed(*args: object, **kwargs: object) -> object:
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


class Profiling(RunCallback):
    """Measures the parts of a run from its beginning on.

    Args:
        profile: Where the seconds go.
    """

    def __init__(self, profile: Profile) -> None:
        super().__init__()
        self.profile = profile

    def begin(self, trainer: Trainer) -> None:
        """Measure what the run calls."""
        measure, model = self.profile.measure, trainer.state.model
        measure(ENVIRONMENT, model.get_env(), "step_wait")
        for env in getattr(model.get_env().unwrapped, "envs", []):
            measure(RENDERING, env, "render")
        for method in ("explore", "_sample_action"):  # ours and Stable-Baselines3's
            measure(ACTING, model, method)
        buffer = getattr(model, "replay_buffer", None)
        measure(STORING, buffer, "add")
        for method in ("sample", "sample_vectors"):
            measure(SAMPLING, buffer, method)
        measure(UPDATE, model, "train")
        measure(UPDATE, getattr(model, "rounds", None), "start")
        measure(WAITING, model, "finish_round")
        measure(LOGGING, trainer, "on_step")
        measure(EVALUATION, trainer, "evaluate")
        measure(SAVING, trainer.checkpoints, "save")
        for callback in trainer.callbacks:
            if isinstance(callback, KeepBest):
                measure(SAVING, callback, "on_epoch")
        self.profile.start()
