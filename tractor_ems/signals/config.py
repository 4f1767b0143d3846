"""Signal maps in YAML: config/signals.yaml is the shipped one and documents the format.

The schema refuses unknown keys; what it builds are the frozen dataclasses of
``tractor_msgs_py.signals``, which node and bag reader share.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.signals import SIGNALS, MappedSignal, SignalMap, Source
from tractor_sim.config import describe
from tractor_sim.resources import resource_path
from tractor_sim.yaml_file import read_yaml

DEFAULT = "signals"
"""Name of the shipped map: the project's own topics."""

MAX_SOURCES = 16
"""Terms of a sum, and factors of a product."""

NAME = r"^/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*$"
TYPE = r"^[a-z][a-z0-9_]*/msg/[A-Za-z][A-Za-z0-9_]*$"


def _no_flag(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError("a truth value, expected a number")
    return value


Number = Annotated[float, BeforeValidator(_no_flag), Field(allow_inf_nan=False)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Term(_Strict):
    """A source (topic, type, field), a product or a sum; each with a factor of its own."""

    topic: Annotated[str, Field(max_length=256, pattern=NAME)] | None = None
    type: Annotated[str, Field(max_length=256, pattern=TYPE)] | None = None
    field: Annotated[str, Field(max_length=256)] | None = None
    offset: Number | None = None
    stamp: Literal["header", "publish"] | None = None
    per_step: bool | None = None
    product: Annotated[list["_Term"], Field(min_length=1, max_length=MAX_SOURCES)] | None = None
    sum: Annotated[list["_Term"], Field(min_length=1, max_length=MAX_SOURCES)] | None = None
    scale: Number = 1.0
    sign: Annotated[Literal[1, -1], BeforeValidator(_no_flag)] = 1


class _Signal(_Term):
    how: Literal["last", "mean"] | None = None
    max_age_s: Annotated[Number, Field(gt=0, le=86_400)] | None = None


class _Map(_Strict):
    vehicle: Annotated[str, Field(min_length=1, max_length=100)]
    soc_target: Annotated[Number, Field(ge=0, le=1)] | None = None
    p_aux_w: Annotated[Number, Field(ge=0, le=1e9)] = 0.0
    signals: Annotated[dict[str, _Signal], Field(min_length=1, max_length=len(SIGNALS))]


def load_signal_map(name_or_path: str | Path = DEFAULT) -> SignalMap:
    """A signal map by name (``config/NAME.yaml`` or ``config/signals_NAME.yaml``) or YAML file.

    Raises:
        ConfigError: the file is missing, is not YAML, has an unknown key or signal, or a value
            out of range; the message names the file, the field, the value and what is allowed.
    """
    path = _find(str(name_or_path))
    document = read_yaml(path)
    try:
        checked = _Map.model_validate(document)
    except ValidationError as error:
        raise ConfigError(f"{path}: {describe(error)}") from None
    try:
        return SignalMap(
            vehicle=checked.vehicle,
            signals=tuple(_signal(name, item) for name, item in checked.signals.items()),
            soc_target=checked.soc_target,
            p_aux_w=checked.p_aux_w,
            origin=str(path),
        )
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def optional_map(name_or_path: str | None, namespace: str | None = None) -> SignalMap | None:
    """The map of an option that may be left out.

    Raises:
        ConfigError: as :func:`load_signal_map`, or a namespace without a map.
    """
    if name_or_path:
        return load_signal_map(name_or_path)
    if namespace:
        raise ConfigError(f"namespace: {namespace}, allowed beside signals")
    return None


def _signal(name: str, item: _Signal) -> MappedSignal:
    where = f"signals.{name}"
    if name not in SIGNALS:
        raise ConfigError(f"{where}: unknown signal, allowed {', '.join(SIGNALS)}")
    terms = tuple(_terms(where, item))
    if len(terms) > MAX_SOURCES or any(len(term) > MAX_SOURCES for term in terms):
        raise ConfigError(f"{where}: more than {MAX_SOURCES} terms or factors, once multiplied")
    return MappedSignal(name, terms, item.how, item.max_age_s)


def _terms(where: str, item: _Term) -> Iterator[tuple[Source, ...]]:
    """A term as a sum of products of sources; a factor goes to each product's first source."""
    kinds = [k for k in ("topic", "product", "sum") if getattr(item, k) is not None]
    if len(kinds) != 1:
        raise ConfigError(
            f"{where}: {' and '.join(kinds) or 'no source'} given, allowed exactly one of topic, "
            "product, sum"
        )
    factor = item.scale * item.sign
    if factor == 0.0:
        raise ConfigError(f"{where}.scale: {item.scale:g}, allowed any but 0")
    if item.topic is not None:
        yield (_source(where, item),)
        return
    for key in ("type", "field", "offset", "stamp", "per_step"):
        if getattr(item, key) is not None:
            raise ConfigError(f"{where}.{key}: allowed beside topic, not beside {kinds[0]}")
    for term in _sum(where, item) if item.sum is not None else _product(where, item):
        first = term[0]
        scaled = replace(first, scale=factor * first.scale, offset=factor * first.offset)
        yield (scaled, *term[1:])


def _sum(where: str, item: _Term) -> Iterator[tuple[Source, ...]]:
    for number, part in enumerate(item.sum or ()):
        yield from _terms(f"{where}.sum.{number}", part)


def _product(where: str, item: _Term) -> Iterator[tuple[Source, ...]]:
    product: tuple[Source, ...] = ()
    for number, part in enumerate(item.product or ()):
        if part.sum is not None:
            raise ConfigError(
                f"{where}.product.{number}: a sum, allowed topics and products; write a sum of "
                "products instead"
            )
        ((*factors,),) = _terms(f"{where}.product.{number}", part)
        product = (*product, *factors)
    yield product


def _source(where: str, item: _Term) -> Source:
    for key in ("type", "field"):
        if getattr(item, key) is None:
            raise ConfigError(f"{where}.{key}: is missing, a value is required")
    assert item.topic is not None and item.type is not None and item.field is not None
    factor = item.scale * item.sign
    stamp = item.stamp or _own_stamp(where, item.type)
    try:
        offset, per_step = item.offset or 0.0, item.per_step or False
        return Source(item.topic, item.type, item.field, factor, offset, stamp, per_step)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


def _own_stamp(where: str, type_name: str) -> Literal["header", "publish"]:
    """``header`` for a message that begins with one. Standard types are known, others say so."""
    from tractor_ems.bags.rosbags_messages import has_header

    stamped = has_header(type_name)
    if stamped is None:
        raise ConfigError(
            f"{where}.stamp: is missing, {type_name} is no standard type; allowed header, publish"
        )
    return "header" if stamped else "publish"


def _find(text: str) -> Path:
    if text.endswith((".yaml", ".yml")) or "/" in text:
        path = Path(text)
        if not path.is_file():
            raise ConfigError(f"{path}: no such signal map")
        return path
    folder = resource_path("config")
    for name in (text, f"{DEFAULT}_{text}"):
        path = folder / f"{name}.yaml"
        if name.startswith(DEFAULT) and path.is_file():
            return path
    known = ", ".join(sorted(item.stem for item in folder.glob(f"{DEFAULT}*.yaml")))
    raise ConfigError(f"signal map {text!r}: unknown, shipped are: {known}")
