"""YAML files from a user, read so that no content of theirs can end in a traceback or eat the
memory: one place for powertrains, training presets and cycle families. Schemas are elsewhere.
"""

from pathlib import Path
from typing import Any

import yaml

from tractor_msgs_py.errors import ConfigError

MAX_BYTES = 1_000_000
"""No settings file is larger; nested to any depth, one of this size still parses quickly."""


def read_yaml(path: Path) -> Any:
    """The document of a YAML file.

    Aliases are refused: a few of them, nested, stand for more data than fits into memory, and
    no settings file needs one.

    Raises:
        ConfigError: the file cannot be read, is too large, is not YAML, holds an alias, or a
            value that Python cannot hold (a date 2023-13-01, a number of 5000 digits).
    """
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
        text = raw.decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from None
    if len(raw) > MAX_BYTES:
        raise ConfigError(f"{path}: more than the {MAX_BYTES} bytes a settings file may have")
    try:
        for event in yaml.parse(text, Loader=yaml.SafeLoader):
            if isinstance(event, yaml.AliasEvent):
                raise ConfigError(f"{path}: alias *{event.anchor}, no aliases are allowed")
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: not YAML ({' '.join(str(error).split())})") from None
    except RecursionError:
        raise ConfigError(f"{path}: not YAML (nested too deeply)") from None
    except (ValueError, OverflowError, TypeError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"{path}: holds a value that cannot be read ({reason})") from None
