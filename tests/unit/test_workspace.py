import sys

import pytest

from scilab_rl import workspace
from scilab_rl.errors import ConfigError


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """An empty folder to work in; what is imported from it is forgotten afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if not entry.endswith("/src")])
    for name in [name for name in sys.modules if name.startswith("custom_")]:
        monkeypatch.delitem(sys.modules, name)
    yield tmp_path
    for name in [name for name in sys.modules if name.startswith("custom_")]:
        del sys.modules[name]


def write(path, text=""):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def test_a_folder_without_a_desk_is_fine(desk):
    before = list(sys.path)
    workspace.open_desk()
    assert sys.path == before


def test_the_desks_environments_register_themselves(desk):
    write(desk / "src/custom_envs/__init__.py", "REGISTERED = True\n")
    write(desk / "src/custom_algorithms/mine.py", "class Mine: pass\n")
    workspace.open_desk()
    workspace.open_desk()
    assert sys.modules["custom_envs"].REGISTERED
    assert sys.path.count(str(desk / "src")) == 1
    import custom_algorithms.mine

    assert custom_algorithms.mine.Mine


def test_a_broken_environment_file_is_named(desk):
    write(desk / "src/custom_envs/__init__.py", "from . import missing_thing\n")
    with pytest.raises(ConfigError, match="src/custom_envs cannot be imported: ImportError"):
        workspace.open_desk()


def test_a_desk_file_that_hides_behind_a_shipped_one_is_refused(desk):
    write(desk / "conf/algorithm/sac.yaml")
    with pytest.raises(ConfigError, match=r"conf/algorithm/my_sac\.yaml"):
        workspace.open_desk()


def test_the_options_of_a_group_are_shipped_and_own(desk):
    write(desk / "conf/algorithm/mine.yaml")
    write(desk / "conf/performance/FetchPush/mine-opti.yaml")
    algorithms = workspace.config_files("algorithm")
    assert algorithms["mine"].read_text() == ""
    assert algorithms["sac"].is_file()
    assert "FetchPush/mine-opti" in workspace.config_files("performance")
    assert workspace.config_files("no_such_group") == {}
