"""New questions to old episodes: probes of stored scenes, also with other networks than acted."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

from scilab_rl.learning.inspector import AgentInspector
from scilab_rl.metrics.probes import Curve, EpisodeProbes, Probe, resolve_metrics
from scilab_rl.recording.records import Clip, Record

_log = logging.getLogger(__name__)


def recompute_metrics(
    clip: Clip, inspectors: Mapping[str, AgentInspector], names: Sequence[str], algorithm_name: str
) -> Clip:
    """Return a clip with further curves.

    Args:
        clip: A recorded episode; not changed.
        inspectors: Algorithms by the label of their curves. One alone needs none.
        names: The probes.
        algorithm_name: The algorithm's name, for messages.

    Raises:
        ConfigError: If a probe is unknown or cannot be answered.
    """
    records = [replace(record, values=dict(record.values)) for record in clip.records]
    for label, inspector in inspectors.items():
        shown = resolve_metrics(
            names, inspector, (), key="--metrics", algorithm_name=algorithm_name
        )
        with inspector.undisturbed():
            for record, values in zip(
                records, _values(clip.records, inspector, shown.probes), strict=True
            ):
                record.values |= _labeled(values, label) if len(inspectors) > 1 else values
    panels = tuple(dict.fromkeys((*clip.info.panels, *names)))
    return Clip(replace(clip.info, name=f"{clip.info.name}_probe", panels=panels), records)


def _values(
    records: Sequence[Record], inspector: AgentInspector, probes: Sequence[Probe]
) -> list[dict[Curve, float]]:
    values: list[dict[Curve, float]] = []
    for index, record in enumerate(records):
        if record.step == 0 or index == 0:
            episode = EpisodeProbes(inspector, probes, _log.warning)
        if record.is_last_scene or index + 1 == len(records):
            values.append(episode.of_scene(record.observation))
            continue
        info = {"TimeLimit.truncated": record.truncated}  # own probes may read it
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
                record.terminated,
            )
        )
    return values


def _labeled(values: Mapping[Curve, float], label: str) -> dict[Curve, float]:
    """Return the curves with the label of the network that they come from."""
    return {
        Curve(curve.panel, f"{label} {curve.label}".rstrip()): number
        for curve, number in values.items()
    }
