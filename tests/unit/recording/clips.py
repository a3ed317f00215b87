"""Clips made by hand, for the tests of what is made of them."""

from __future__ import annotations

import numpy as np

from scilab_rl.metrics.probes import Curve
from scilab_rl.recording.records import Clip, ClipInfo, Record, encode_picture
from scilab_rl.testing.environments import encode_frame


def make_clip(
    panels: tuple[str, ...] = ("reward", "q_values"), n_steps: int = 4, *, large: bool = False
) -> Clip:
    """Return an episode with two critics, whose reward is missing in step 1."""
    info = ClipInfo("eval_epoch_0001_episode_00003", "eval", 1, "Tiny-v0", "sac", 25.0, panels)
    records = []
    for step in range(n_steps + 1):
        is_last = step == n_steps
        frame = encode_frame(3, step)
        if large:
            frame = np.kron(frame, np.ones((5, 5, 1), np.uint8))
        values = (
            {}
            if is_last
            else {Curve("q_values", "0"): step + 0.5, Curve("q_values", "1"): -float(step)}
        )
        if not is_last and step != 1:
            values[Curve("reward")] = float(step)
        record = Record("eval", 0, 3, step, 4 * step, encode_picture(frame), np.array([3.0, step]))
        record.values, record.state = values, np.arange(3.0) + step
        if not is_last:
            record.action, record.reward, record.success = np.zeros(2), float(step), step > 2
        record.truncated = step == n_steps - 1
        record.events = ["success"] if step == 3 else []
        records.append(record)
    return Clip(info, records)
