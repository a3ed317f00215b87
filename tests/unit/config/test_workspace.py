import sys

import pytest

from scilab_rl.config.workspace import config_files, open_project
from scilab_rl.errors import ConfigError


@pytest.fixture
def project(tmp_path, monkeypatch):
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


def test_a_folder_without_a_desk_is_fine(project):
    before = list(sys.path)
    open_project()
    assert sys.path == before


def test_the_desks_environments_register_themselves(project):
    write(project / "src/custom_envs/__init__.py", "REGISTERED = True\n")
    write(project / "src/custom_algorithms/mine.py", "class Mine: pass\n")
    open_project()
    open_project()
    assert sys.modules["custom_envs"].REGISTERED
    assert sys.path.count(str(project / "src")) == 1
    import custom_algorithms.mine

    assert custom_algorithms.mine.Mine


def test_a_broken_environment_file_is_named(project):
    write(project / "src/custom_envs/__init__.py", "from . import missing_thing\n")
    with pytest.raises(ConfigError, match="src/custom_envs cannot be imported: ImportError"):
        open_project()


def test_a_desk_file_that_hides_behind_a_shipped_one_is_refused(project):
    write(project / "conf/algorithm/sac.yaml")
    with pytest.raises(ConfigError, match=r"conf/algorithm/my_sac\.yaml"):
        open_project()


def test_the_options_of_a_group_are_shipped_and_own(project):
    write(project / "conf/algorithm/mine.yaml")
    write(project / "conf/performance/FetchPush/mine-opti.yaml")
    algorithms = config_files("algorithm")
    assert algorithms["mine"].read_text() == ""
    assert algorithms["sac"].is_file()
    assert "FetchPush/mine-opti" in config_files("performance")
    assert config_files("no_such_group") == {}
