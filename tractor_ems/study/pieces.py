"""Finished pieces of a long study on disk: each a JSON file that names, by a hash, everything it
depends on. A piece is there whole or not at all, so a study can be ended at any moment."""

import ast
import hashlib
import json
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any

from tractor_msgs_py.atomic import write_bytes

ROOT = Path(__file__).resolve().parents[2]


def digest_of(document: Any) -> str:
    """SHA-256 of plain data; the order of keys does not count."""
    text = json.dumps(document, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def digest_of_file(path: Path) -> str:
    """SHA-256 of a file's bytes. Raises OSError."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


@lru_cache(maxsize=32)
def code_digest(*places: str) -> str:
    """SHA-256 of modules, by file or folder below the repository, e.g. ``tractor_ems/learning``.

    Comments, docstrings and layout do not count: only what is executed makes a result stale.
    """
    files = sorted(
        file
        for place in places
        for file in ([ROOT / place] if place.endswith(".py") else (ROOT / place).rglob("*.py"))
    )
    trees = [(str(file.relative_to(ROOT)), _executed(file.read_text("utf-8"))) for file in files]
    return digest_of(trees)


def _executed(source: str) -> str:
    tree = ast.parse(source)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            kept = [item for item in body if not _is_text(item)]
            node.body = kept  # type: ignore[attr-defined]
    return ast.dump(tree)


def _is_text(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def load_piece(path: Path, key: str) -> dict[str, Any] | None:
    """The finished piece, or None where there is none, a damaged one, or one of another key."""
    try:
        document = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    if not isinstance(document, dict) or document.get("key") != key:
        return None
    return document


def save_piece(path: Path, key: str, document: dict[str, Any]) -> None:
    """Write a finished piece.

    Raises:
        ConfigError: the folder cannot be written to.
        ValueError: a number is not finite.
    """
    text = json.dumps({"key": key, **document}, allow_nan=False)
    write_bytes(path, (text + "\n").encode())


def missing(pieces: Iterable[tuple[Path, str]]) -> list[int]:
    """Numbers of the pieces that are not there yet."""
    return [n for n, (path, key) in enumerate(pieces) if load_piece(path, key) is None]
