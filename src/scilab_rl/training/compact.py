"""From a saved policy to the small one of a trained agent: what acts, and what probes ask.

Moments of optimizers are left out, target networks are the networks that they follow, and weights
are stored once. It loads as any policy; a run that starts from it starts with new moments.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace

import torch

from scilab_rl.training.snapshot import Node, Snapshot

_SKIP = {"@kind": "skip"}
_LEFT_OUT = ("optimizer", "scheduler")
# Inside one PyTorch module, such as `critic_target.qf0.0.weight`.
_TARGET_PART = re.compile(r"_target(?=\.)")


def compact(snapshot: Snapshot) -> Snapshot:
    """Return a snapshot of a policy without what only training needs.

    Args:
        snapshot: As `scilab_rl.training.checkpoint.load` returns it; it is not changed.
    """
    slim = replace(snapshot, tensors=dict(snapshot.tensors), arrays=dict(snapshot.arrays))
    slim.tree = {name: _compact(node, slim) for name, node in snapshot.tree.items()}
    named = {name for node in slim.tree.values() for name in _names(node)}
    slim.tensors = {name: slim.tensors[name] for name in slim.tensors if name in named}
    slim.arrays = {name: slim.arrays[name] for name in slim.arrays if name in named}
    return slim


def _compact(node: Node, slim: Snapshot) -> Node:
    if not isinstance(node, dict) or "@kind" not in node:
        return node
    if node["@kind"] in _LEFT_OUT:
        return _SKIP
    if node["@kind"] == "module":
        return _without_target_parts(node)
    for part in ("attributes", "entries"):
        if isinstance(children := node.get(part), dict):
            kept = {k: v for k, v in children.items() if not k.endswith(_LEFT_OUT)}
            _share_weights(kept, slim)
            return {**node, part: {k: _compact(v, slim) for k, v in _with_targets(kept).items()}}
        if isinstance(children, list):
            return {**node, part: [_compact(child, slim) for child in children]}
    return node


def _with_targets(children: dict[str, Node]) -> dict[str, Node]:
    """Let target networks be described as the networks that they follow.

    ``critic_target`` follows ``critic``, and ``target_network`` follows ``q_network``.
    """
    online = {name: re.sub("^target_", "q_", name).removesuffix("_target") for name in children}
    followed = {name: children.get(online[name], node) for name, node in children.items()}
    # Numbers may have such names, too.
    return {n: new if isinstance(new, dict) else children[n] for n, new in followed.items()}


def _without_target_parts(node: Node) -> Node:
    """Let a module's target networks be restored from the names of those that they follow."""
    names = set(node["names"])
    same = {
        name: online
        for name in names
        if (online := _TARGET_PART.sub("", name)) != name and online in names
    }
    attributes = {k: _SKIP if _is_left_out(v) else v for k, v in node["attributes"].items()}
    return {**node, "same": same, "attributes": attributes}


def _is_left_out(node: Node) -> bool:
    return isinstance(node, dict) and node.get("@kind") in _LEFT_OUT


def _share_weights(children: dict[str, Node], slim: Snapshot) -> None:
    """Let the state of compiled updates be the networks that act, which are stored as tensors."""
    if not {"networks", "state"} <= set(children):
        return
    for name in list(_names(children["networks"])):
        slim.tensors[name] = torch.from_numpy(slim.arrays.pop(name).copy())
    shared = children["networks"]["entries"]
    state = children["state"]
    entries = state["entries"] | {name: _as_kind(node, "jax") for name, node in shared.items()}
    children["state"] = {**state, "entries": entries}


def _as_kind(node: Node, kind: str) -> Node:
    """Return a description whose arrays are of another kind."""
    if isinstance(node, list):
        return [_as_kind(entry, kind) for entry in node]
    if not isinstance(node, dict):
        return node
    if node.get("@kind") == "array":
        return {**node, "@kind": kind}
    return {key: _as_kind(entry, kind) for key, entry in node.items()}


def _names(node: Node) -> Iterator[str]:
    """Yield the names of the tensors and arrays that a description refers to."""
    if isinstance(node, list):
        for entry in node:
            yield from _names(entry)
    if not isinstance(node, dict):
        return
    if node.get("@kind") == "module":
        same = node.get("same", {})
        yield from (f"{node['path']}.{name}" for name in node["names"] if name not in same)
        yield from _names(node["attributes"])
    elif "@kind" in node and "name" in node:
        yield node["name"]
    else:
        for entry in node.values():
            yield from _names(entry)
