"""The facts about a recorded run, for lists: what it is, how far it came, and what it reached."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterator, Mapping
from fnmatch import fnmatchcase
from typing import Any

from scilab_rl.config.schema import learning_part
from scilab_rl.errors import ConfigError
from scilab_rl.results import PRUNED, SOLVED
from scilab_rl.run.annotations import read_annotations
from scilab_rl.run.directory import RESULT_FILE, RunDirectory, read_epochs
from scilab_rl.run.provenance import PROVENANCE_FILE

DAMAGED = "damaged"
CRASHED = "crashed"  # recorded as running, but its process is gone
STATUSES = ("running", CRASHED, "finished", SOLVED, PRUNED, "interrupted", "failed", DAMAGED)
# Lists have columns of their own for these.
_SHOWN = ("env", "algorithm", "algorithm.intrinsic", "algorithm.intrinsic.name")
_STARTED = re.compile(r"(\d\d)(\d\d)\d\d-")


def read_run(run: RunDirectory, studies: Collection[str] = ()) -> dict[str, object]:
    """Return the facts about a run; damaged files make its status ``damaged``.

    Args:
        run: The directory of the run.
        studies: Names of the studies: the key ``group`` of their runs.

    Returns:
        The run's name and id, start, study, environment, algorithm, intrinsic reward, changed keys,
        seed and status, the last values of success and reward, the epochs, steps and seconds of
        training, its note, tags and path, and the problem, if any.
    """
    config, problem = {}, None
    try:
        config = run.read_config()
    except ConfigError as error:
        problem = str(error)
    algorithm = config.get("algorithm")
    if not isinstance(algorithm, dict):
        algorithm = {}
    written, result = read_annotations(run), run.read_result()
    status = DAMAGED
    if result is None:
        problem = problem or f"{RESULT_FILE} is missing or damaged"
    else:
        problem = problem or result.error
        status = result.status if config else DAMAGED
        if status == "running" and not run.is_in_use():
            status = CRASHED
    values: Mapping[str, object] = result.metrics if result is not None else {}
    if not isinstance(values, dict) or not values:
        values = _last_epoch(run)  # of a run that is still training
    group = config.get("group")
    return {
        "run": run.path.name,
        "id": run.id,
        "started": started(run),
        "study": group if group in studies else None,
        "env": config.get("env"),
        "algorithm": algorithm.get("name"),
        "intrinsic": _intrinsic_reward(algorithm),
        "changed": list(changed_keys(run)),
        "seed": config.get("seed"),
        "status": status,
        "success": values.get("eval/success_rate"),
        "reward": values.get("eval/mean_reward"),
        "epochs": (result and result.epochs) or values.get("epoch"),
        "steps": (result and result.steps) or values.get("step"),
        "seconds": (result and result.seconds) or None,
        "note": written.note,
        "tags": all_tags(config, written.tags),
        "problem": problem,
        "path": str(run),
    }


def matches_name(name: object, pattern: str | None) -> bool:
    """Return whether a name matches a pattern, an id also without its version.

    >>> matches_name("FetchReach-v4", "fetch*"), matches_name("FetchReach-v4", "FetchReach")
    (True, True)
    """
    if pattern is None:
        return True
    names = (str(name), re.sub(r"-v\d+$", "", str(name)))
    return any(fnmatchcase(known.lower(), pattern.lower()) for known in names)


def started(run: RunDirectory) -> str:
    """Return the day and minute in which a run started, from the name of its directory."""
    time = _STARTED.match(run.path.name)
    return f"{run.path.parent.name} {time[1]}:{time[2]}" if time else run.path.parent.name


def all_tags(config: Mapping[str, Any], given_later: Collection[str]) -> list[str]:
    """Return the tags of a run's configuration and those that were given later."""
    configured = config.get("tags")
    known = map(str, configured) if isinstance(configured, list) else ()
    return list(dict.fromkeys([*known, *given_later]))


def changed_keys(run: RunDirectory) -> Iterator[str]:
    """Yield what the user has typed that affects learning, without environment and algorithm.

    The algorithm's keys come first, without the prefix ``algorithm.``: ``gamma=0.9``.
    """
    try:
        source = json.loads((run / PROVENANCE_FILE).read_text(encoding="utf-8"))
        typed = {str(word).lstrip("+").partition("=")[0]: str(word) for word in source["overrides"]}
    except (OSError, ValueError, TypeError, KeyError):
        return
    ordered = sorted(learning_part(typed).items(), key=lambda one: "algorithm." not in one[0])
    for key, word in ordered:
        if key not in _SHOWN:
            yield word.lstrip("+").removeprefix("algorithm.")


def _intrinsic_reward(algorithm: Mapping[str, Any]) -> str | None:
    chosen = algorithm.get("intrinsic")
    name = chosen.get("name") if isinstance(chosen, dict) else chosen
    return str(name) if name else None


def _last_epoch(run: RunDirectory) -> dict[str, object]:
    try:
        return (read_epochs(run) or [{}])[-1]
    except (OSError, ValueError):  # not the text that a run writes
        return {}
