"""The environments' ids in Gymnasium's registry, without importing Gymnasium for it.

Gymnasium takes a third of a second to import, ``import scilab_rl`` a few milliseconds. So the ids
are registered at once where Gymnasium is imported already, and else right after it will have been.
"""

from __future__ import annotations

import sys

TYPE_CHECKING = False  # that of `typing`, whose import would take longer than all of this
if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.machinery import ModuleSpec
    from types import ModuleType

_REGISTRATION = "gymnasium.envs.registration"


def register_when_imported() -> None:
    """Register the environments now, or when Gymnasium is imported."""
    if _REGISTRATION in sys.modules:
        _register()
    elif not any(isinstance(finder, _AfterGymnasium) for finder in sys.meta_path):
        sys.meta_path.insert(0, _AfterGymnasium())


def _register() -> None:
    from scilab_rl.envs.ids import register_shipped

    register_shipped()


class _AfterGymnasium:
    """Waits for the import of Gymnasium's registry; finds nothing itself, and leaves then."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Let the others find the registry, and register after it has been executed."""
        if name != _REGISTRATION:
            return None
        import importlib.util

        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        if spec is None or spec.loader is None:
            return None
        execute = spec.loader.exec_module

        def execute_and_register(module: ModuleType) -> None:
            execute(module)
            _register()

        spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]
        return spec
