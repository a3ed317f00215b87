"""From what the user typed to an environment that this machine can make."""

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.util
import logging
import re
from collections.abc import Iterable
from importlib import metadata

import gymnasium as gym
from gymnasium.envs import registration
from gymnasium.envs.registration import EnvSpec

from scilab_rl.envs.ids import is_variant, register_shipped, register_variant
from scilab_rl.envs.suites import SUITES, Suite, suite_of_module, suite_of_name
from scilab_rl.errors import ConfigError, MissingDependencyError, did_you_mean

_log = logging.getLogger(__name__)
PLUG_INS = "gymnasium.envs"  # the group of entry points
_NO_NAMESPACE = ("__root__", "__internal__")
_VERSIONED = re.compile(r"(?P<name>.*?)(?:-v(?P<version>\d+))?", re.DOTALL)
# Entry points of ids that stay registered and can no longer be made.
_ABANDONED = re.compile(r"MujocoPy|mujoco_py|_raise_shimmy_error")


def resolve_env_id(given: str) -> tuple[str, str | None]:
    """Return the id to make, and a one-line notice when it differs from the given one.

    A name without version means the newest version. A version that is gone or can no longer be
    made (``FetchPush-v1``) becomes the newest one. A long id (``Blocks-o2-gripper_above-v1``) names
    a variant, which is registered here.

    Args:
        given: For example ``FetchPush-v4``, ``FetchPush-v1``, ``FetchPush`` or ``module:Id-v0``.

    Raises:
        ConfigError: If there is no such environment.
        MissingDependencyError: If the id belongs to a suite that is not installed.
    """
    if not isinstance(given, str) or not given.strip():
        raise ConfigError(f"env must be the id of an environment, but it is {given!r}.")
    module, _, name = given.rpartition(":")
    if module:
        _import_user_module(module, given)
    variant = None if module else register_variant(name)
    if variant is not None:
        return variant
    _register_suite_of(name)
    parsed = _VERSIONED.fullmatch(name)
    assert parsed is not None  # the pattern fits every text
    family, version = parsed["name"], parsed["version"]
    specs = _usable_specs(family)
    if not specs and name not in gym.registry:
        register_plug_ins()
        specs = _usable_specs(family)
    usable = [spec.version for spec in specs]
    if not usable and name not in gym.registry:
        raise ConfigError(
            f"No environment '{given}'.{_suggestion(name)} `scilab-rl envs` lists all."
        )
    for spec in specs[:1]:
        _require(suite_of(spec), given)
    if version is not None and (int(version) in usable or not usable):
        return given, None
    newest = family if usable == [None] else f"{family}-v{max(v for v in usable if v is not None)}"
    if module:  # kept, so that other processes can import it too
        newest = f"{module}:{newest}"
    if version is None:
        return newest, None
    return newest, f"{name} is not available any more; using {newest}."


def known_env_ids() -> list[str]:
    """Return the usable ids of all installed suites, without the variants that long ids name."""
    for suite in SUITES:
        if suite.begins and suite.installed:
            _register(suite.package)
    register_plug_ins()
    return [s.id for s in gym.registry.values() if _is_usable(s) and not is_variant(s.id)]


@functools.cache
def register_plug_ins() -> None:
    """Let installed packages register their environments, once.

    These are the entry points of the group ``gymnasium.envs``: the name of one is the namespace of
    its ids, and ``__root__`` means none. Gymnasium has read them until its version 0.29.
    """
    for plug_in in metadata.entry_points(group=PLUG_INS):
        is_root = plug_in.name in _NO_NAMESPACE
        try:
            with contextlib.nullcontext() if is_root else registration.namespace(plug_in.name):
                loaded = plug_in.load()
                if ":" in plug_in.value:
                    loaded()
        except Exception as error:  # noqa: BLE001 - a broken package must not stop the others
            _log.warning(
                "The plug-in %s cannot register its environments: %s: %s",
                plug_in.value, type(error).__name__, error,
            )  # fmt: skip


def _usable_specs(family: str) -> list[EnvSpec]:
    return [
        spec
        for spec in gym.registry.values()
        if (f"{spec.namespace}/{spec.name}" if spec.namespace else spec.name) == family
        and _is_usable(spec)
    ]


def _is_usable(spec: EnvSpec) -> bool:
    return spec.entry_point is not None and not _ABANDONED.search(str(spec.entry_point))


def suite_of(spec: EnvSpec) -> Suite | None:
    """Return the suite of a registered environment; None for other environments."""
    return suite_of_module(module_of(spec))


def module_of(spec: EnvSpec) -> str:
    """Return the module that a registered environment is made from."""
    target = spec.entry_point
    return (target if isinstance(target, str) else getattr(target, "__module__", "")).split(":")[0]


def _register_suite_of(name: str) -> None:
    """Import the suite that a name is from.

    Raises:
        MissingDependencyError: If it is not installed.
    """
    suite = suite_of_name(name)
    if suite is None or (not suite.installed and name in gym.registry):  # one of the user's own
        return
    _require(suite, name)
    _register(suite.package)


def _require(suite: Suite | None, name: str) -> None:
    if suite is not None and not suite.installed:
        purpose = f"for the environment '{name}'"
        raise MissingDependencyError(suite.package, suite.extra, purpose, suite.pip_options)


def _register(package: str) -> None:
    _drop_import_notice(package)
    module = importlib.import_module(package)
    gym.register_envs(module)
    own_part = f"scilab_rl.envs.suites.{package}"
    if importlib.util.find_spec(own_part):
        importlib.import_module(own_part).register()


def _drop_import_notice(package: str) -> None:
    """Drop the notice about old Adroit rewards that Gymnasium-Robotics prints at each import.

    It concerns ids that are not used here, and no logging level or warning filter reaches a print.
    Its text comes from a table that can be imported before.
    """
    with contextlib.suppress(ImportError):
        from farama_notifications import notifications

        notices = notifications.get(package, {})
        for version in [v for v, text in notices.items() if "Adroit" in text]:
            del notices[version]


def _import_user_module(module: str, given: str) -> None:
    try:
        importlib.import_module(module)
    except Exception as error:
        kind = "" if isinstance(error, ImportError) else f"{type(error).__name__}: "
        raise ConfigError(
            f"The environment '{given}' names the module '{module}', which cannot be imported: "
            f"{kind}{error}."
        ) from error


def _suggestion(name: str) -> str:
    """Suggest by the name first: a wrong version must not hide the right name."""
    ids = known_env_ids()
    newest: dict[str, str] = {}
    for env_id in sorted(ids, key=_version_of):
        newest[_family_of(env_id)] = env_id
    suggestion = did_you_mean(_family_of(name), newest)
    for family, env_id in newest.items():
        suggestion = suggestion.replace(f"'{family}'", f"'{env_id}'")
    return suggestion


def _family_of(env_id: str) -> str:
    return re.sub(r"-v\d+$", "", env_id)


def _version_of(env_id: str) -> int:
    match = re.search(r"-v(\d+)$", env_id)
    return int(match[1]) if match else -1


def versions_by_family(ids: Iterable[str]) -> dict[str, list[str]]:
    """Group ids by their name without version."""
    families: dict[str, list[str]] = {}
    for env_id in sorted(ids, key=lambda i: (_family_of(i), _version_of(i))):
        families.setdefault(_family_of(env_id), []).append(env_id)
    return families


register_shipped()
