"""Shipped files are found in a source tree, beside an installed module and by the ament index."""

import os
from pathlib import Path

import pytest

from tractor_msgs_py.errors import ConfigError
from tractor_sim import resources

ROOT = Path(__file__).resolve().parents[2]


def installed_share(prefix: Path) -> Path:
    share = prefix / "share" / "tractor_ems"
    (share / "data").mkdir(parents=True)
    (share / "package.xml").touch()
    return share


@pytest.fixture
def installed_module(tmp_path, monkeypatch) -> Path:
    """Pretend that resources.py runs from an installation that has no share folder yet."""
    prefix = tmp_path / "prefix"
    module = prefix / "lib" / "python3" / "site-packages" / "tractor_sim" / "resources.py"
    monkeypatch.setattr(resources, "_HERE", module)
    monkeypatch.setattr("sys.prefix", str(tmp_path / "elsewhere"))
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    return prefix


def test_source_tree_comes_first():
    assert resources.share_dir() == ROOT
    assert resources.resource_path("data") == ROOT / "tractor_sim" / "data"
    assert resources.resource_path("config", "powertrain") == ROOT / "config" / "powertrain"


def test_share_beside_the_installed_module_wins(installed_module, tmp_path, monkeypatch):
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "other"))
    installed_share(tmp_path / "other")
    share = installed_share(installed_module)
    assert resources.share_dir() == share
    assert resources.resource_path("data") == share / "data"


def test_interpreter_prefix_then_ament_index(installed_module, tmp_path, monkeypatch):
    monkeypatch.setenv("AMENT_PREFIX_PATH", os.pathsep.join(["", str(tmp_path / "ament")]))
    ament = installed_share(tmp_path / "ament")
    assert resources.share_dir() == ament
    prefix = installed_share(tmp_path / "elsewhere")
    assert resources.share_dir() == prefix


def test_nowhere_is_one_line_that_names_the_places(installed_module):
    with pytest.raises(ConfigError) as error:
        resources.share_dir()
    message = str(error.value)
    assert "\n" not in message
    assert str(installed_module / "share" / "tractor_ems") in message


def test_missing_file_and_unknown_kind_are_one_line():
    with pytest.raises(ConfigError, match=r"config/powertrain/none\.yaml not found, looked in"):
        resources.resource_path("config", "powertrain", "none.yaml")
    with pytest.raises(
        ConfigError, match="unknown resource kind 'launch', one of config, data, bags"
    ):
        resources.resource_path("launch")
