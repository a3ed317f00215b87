"""New questions to old episodes: probes of stored scenes, also with other networks than acted."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from scilab_rl.algorithms.inspection import Inspection
from scilab_rl.metrics.probes import EpisodeProbes, resolve_metrics
from scilab_rl.visualization.records import Clip, Record, label_of, panel_of

_log = logging.getLogger(__name__)


def reprobe(clip: Clip, minds: Mapping[str, Inspection], names: Sequence[str], who: str) -> Clip:
    """Return a clip with further curves.

    Args:
        clip: A recorded episode; not changed.
        minds: Algorithms by the label of their curves. One alone needs none.
        names: The probes.
        who: The algorithm's name, for messages.

    Raises:
        ConfigError: If a probe is unknown or cannot be answered.
    """
    records = [replace(record, values=dict(record.values)) for record in clip.records]
    for label, mind in minds.items():
        shown = resolve_metrics(names, mind, (), key="--metrics", who=who)
        with mind.undisturbed():
            for record, values in zip(
                records, _values(clip.records, mind, shown.probes), strict=True
            ):
                record.values |= _labelled(values, label if len(minds) > 1 else "")
    panels = tuple(dict.fromkeys((*clip.info.panels, *names)))
    return Clip(replace(clip.info, name=f"{clip.info.name}_probe", panels=panels), records)


def _values(records: Sequence[Record], mind: Inspection, probes: Any) -> list[dict[str, float]]:
    values: list[dict[str, float]] = []
    for index, record in enumerate(records):
        if record.step == 0 or index == 0:
            episode = EpisodeProbes(mind, probes, _log.warning)
        if record.is_last_scene or index + 1 == len(records):
            values.append(episode.of_scene(record.observation))
            continue
        info = {"TimeLimit.truncated": record.truncated}
        if record.success is not None:
            info["is_success"] = record.success
        values.append(
            episode.of_step(
                record.observation,
                record.action,
                record.reward,
                records[index + 1].observation,
                info,
                record.terminated or record.truncated,
            )
        )
    return values


def _labelled(values: Mapping[str, float], label: str) -> dict[str, float]:
    """Return the curves with the label of the network that they come from."""
    if not label:
        return dict(values)
    return {
        f"{panel_of(curve)}[{' '.join(filter(None, (label, label_of(curve))))}]": number
        for curve, number in values.items()
    }
