"""YAML files from a user, read so that no content of theirs can end in a traceback or eat the
memory: one place for powertrains, training presets and cycle families. Schemas are elsewhere.
"""

from pathlib import Path
from typing import Any

import yaml

from tractor_msgs_py.errors import ConfigError

MAX_BYTES = 1_000_000
MAX_DEPTH = 32
"""No settings file is larger, or nested deeper: the parser recurses, and takes quadratic time."""


class _Once(yaml.SafeLoader):
    """Refuses a mapping that says something twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in seen:
                    raise yaml.constructor.ConstructorError(
                        None, None, f"key {key.value} stands twice", key.start_mark
                    )
                seen.add(key.value)
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> Any:
    """The document of a YAML file.

    Aliases are refused: a few of them, nested, stand for more data than fits into memory, and
    no settings file needs one. So is a key that stands twice in one mapping, of which YAML's
    parser would quietly keep the last.

    Raises:
        ConfigError: the file cannot be read, is too large or nested too deeply, is not YAML,
            holds an alias, a key twice, or a value that Python cannot (a date 2023-13-01, 5000
            digits).
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
        depth = 0
        for event in yaml.parse(text, Loader=yaml.SafeLoader):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if depth > MAX_DEPTH:
                raise ConfigError(f"{path}: nested more than {MAX_DEPTH} deep")
            if isinstance(event, yaml.AliasEvent):
                raise ConfigError(f"{path}: alias *{event.anchor}, no aliases are allowed")
        return yaml.load(text, Loader=_Once)  # noqa: S506  (a SafeLoader)
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: not YAML ({' '.join(str(error).split())})") from None
    except (ValueError, OverflowError, TypeError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"{path}: holds a value that cannot be read ({reason})") from None
