"""An episode as one HTML file that needs no server, no network and no program but a browser.

``index.html`` next to the pages of a run steps through all of them, or shows two side by side.
"""

from __future__ import annotations

from pathlib import Path

from scilab_rl import files
from scilab_rl.errors import ConfigError
from scilab_rl.metrics.probes import meaning_of
from scilab_rl.pages import data_address, media_type, render
from scilab_rl.recording.movie import grid
from scilab_rl.recording.records import (
    SUFFIX,
    Clip,
    ClipInfo,
    EpisodeOutcome,
    read_outcomes,
    title_of,
)

INDEX = "index.html"


def write_replay(clip: Clip, path: Path) -> None:
    """Write a clip as a page with scene, curves, scrubber and keyboard."""
    files.write_text(path, render("replay.html", clip=_content(clip), index=INDEX))


def write_index(folder: Path) -> Path:
    """Write the page that steps through all recorded episodes of a folder, and return its path."""
    pages = sorted(folder.glob(f"*{SUFFIX}"), key=lambda path: (path.stat().st_mtime, path.name))
    episodes = [_entry(path) for path in pages if path.with_suffix(".html").is_file()]
    known = [episode for episode in episodes if episode is not None]
    title = next((str(episode["title"]) for episode in known), folder.parent.name)
    index = folder / INDEX
    files.write_text(index, render("episodes.html", title=title, episodes=known))
    return index


def _entry(path: Path) -> dict[str, object] | None:
    """Return what the list says of a clip; None for one that cannot be read."""
    try:
        info, outcomes = read_outcomes(path)
    except ConfigError:
        return None
    number, outcome = next(iter(outcomes.items()))
    return {
        "name": path.stem,
        "title": f"{info.env_id} · {info.algorithm}",
        "group": {"train": "Training", "eval": "Evaluation"}.get(info.phase, info.phase),
        "text": f"{_where(info, path.stem, number)}: {outcome.text()}",
    }


def _where(info: ClipInfo, name: str, episode: int) -> str:
    if info.epoch and name == info.name and name.startswith(info.phase):
        return f"epoch {info.epoch}, episode {episode}"
    return name.replace("_", " ")


def _content(clip: Clip) -> dict[str, object]:
    info, records = clip.info, clip.records
    rows, columns = grid(max(len(info.panels), 1))
    return {
        "name": info.name,
        "title": f"{info.env_id} · {info.algorithm}",
        "about": info.place(records[0].episode),
        "facts": _facts(clip),
        "outcomes": {number: _outcome(one) for number, one in clip.outcomes().items()},
        "fps": info.fps,
        "rate": clip.shown_rate,
        "rows": rows,
        "columns": columns,
        "small": any(media_type(record.picture) == "image/png" for record in records),
        "steps": [record.step for record in records],
        "episodes": [record.episode for record in records],
        "last": [record.is_last_scene for record in records],
        "success": [record.success for record in records],
        "events": [
            [event for event in record.events if event != "episode start"] for record in records
        ],
        "panels": [_panel(clip, name) for name in info.panels],
        "pictures": [data_address(record.picture) for record in records],
    }


def _facts(clip: Clip) -> list[tuple[str, str]]:
    info = clip.info
    seed = "" if info.seed is None else str(info.seed)
    where = info.place(clip.records[0].episode)
    facts = [("recorded in", where), ("policy", info.policy), ("seed", seed), ("run", info.run)]
    return [(name, value) for name, value in facts if value]


def _outcome(outcome: EpisodeOutcome) -> dict[str, object]:
    return {
        "success": outcome.success,
        "return": outcome.total_reward,
        "steps": outcome.n_steps,
        "complete": outcome.is_complete,
    }


def _panel(clip: Clip, name: str) -> dict[str, object]:
    return {
        "name": title_of(name),
        "meaning": meaning_of(name),
        "range": clip.range(name),
        "curves": [
            {"label": label, "values": values} for label, values in clip.curves(name).items()
        ],
    }
