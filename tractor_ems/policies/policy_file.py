"""The policy file format: safetensors weights and one JSON document. What they mean is the
business of the policies, whose kind is the document's ``kind``; see ``made``.
"""

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from tractor_ems.policies.mlp import Activation, Float32Array, Mlp
from tractor_msgs_py.atomic import write_bytes
from tractor_msgs_py.errors import ConfigError, PolicyError
from tractor_sim.powertrain import PowertrainParams
from tractor_sim.powertrain_json import params_from_json, powertrain_hash

Made = TypeVar("Made")

FORMAT_VERSION = 1
_KEY = "tractor_ems.policy"
"""One key holds the whole document: the order of several keys differs from run to run."""

_MAX_BYTES = 256 * 1024 * 1024

LONGEST_TEXT = 1000
"""Of what is said about a damaged file."""


def write_policy_file(
    path: Path, tensors: Mapping[str, Float32Array], metadata: Mapping[str, Any]
) -> None:
    """Write tensors and metadata, whole or not at all, the same bytes for the same content.

    Raises:
        PolicyError: a weight is not finite.
        ConfigError: the folder cannot be written to.
    """
    for name, tensor in tensors.items():
        if not np.all(np.isfinite(tensor)):
            raise PolicyError(f"{path}: {name} holds a value that is not finite; nothing written")
    document = json.dumps(
        {**metadata, "format_version": FORMAT_VERSION}, sort_keys=True, allow_nan=False
    )
    whole = {
        name: np.ascontiguousarray(tensor, dtype=np.float32) for name, tensor in tensors.items()
    }
    write_bytes(path, save(whole, metadata={_KEY: document}))


def read_policy_file(path: Path) -> tuple[dict[str, Float32Array], dict[str, Any]]:
    """Tensors and metadata of a policy file.

    Raises:
        PolicyError: the file is missing, too large, cut short, not safetensors, without a policy
            document, of an unknown format version, or holds tensors that are not finite float32.
    """
    tensors: dict[str, Float32Array] = {}
    try:
        size = path.stat().st_size
        if size > _MAX_BYTES:
            raise PolicyError(f"{path}: {size} bytes, a policy has at most {_MAX_BYTES}")
        with safe_open(path, framework="numpy") as file:
            document = (file.metadata() or {}).get(_KEY)
            names = list(file.keys())
            for name in names:
                tensors[name] = file.get_tensor(name)
    except OSError as error:
        raise PolicyError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (SafetensorError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise PolicyError(f"{path}: not a whole safetensors file ({reason})") from None
    if document is None:
        raise PolicyError(f"{path}: a safetensors file, but not a policy of this package")
    try:
        metadata = json.loads(document)
        version = metadata["format_version"]
    except (ValueError, KeyError, TypeError, RecursionError):
        raise PolicyError(f"{path}: its metadata is not a policy document") from None
    if version != FORMAT_VERSION:
        raise PolicyError(f"{path}: format version {version!r}, this package reads 1")
    for name, tensor in tensors.items():
        if tensor.dtype != np.float32 or not np.all(np.isfinite(tensor)):
            raise PolicyError(f"{path}: {name} must be finite float32, is {_describe(tensor)}")
    return tensors, metadata


def read_policy(
    path: Path, make: Callable[[dict[str, Float32Array], dict[str, Any]], Made]
) -> Made:
    """What ``make`` makes of a file's tensors and metadata.

    Raises:
        PolicyError: as :func:`read_policy_file`, or ``make`` found that they do not fit.
    """
    tensors, metadata = read_policy_file(path)
    try:
        return make(tensors, metadata)
    except (PolicyError, ConfigError) as error:
        raise PolicyError(f"{path}: {_short(str(error))}") from None
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise PolicyError(f"{path}: metadata is not a policy's ({_short(repr(error))})") from None


def network_of(
    tensors: Mapping[str, Float32Array], layers: int, activation: Activation, prefix: str = ""
) -> Mlp:
    """The network in the tensors PREFIXlayerN.weight and PREFIXlayerN.bias.

    Raises:
        PolicyError: layers do not fit each other.
    """
    weights = tuple(tensors[f"{prefix}layer{n}.weight"] for n in range(layers))
    biases = tuple(tensors[f"{prefix}layer{n}.bias"] for n in range(layers))
    width: int | None = None
    for n, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        fits = weight.ndim == 2 and bias.shape == weight.shape[:1]
        if not fits or (width is not None and weight.shape[1] != width):
            raise PolicyError(
                f"{prefix}layer {n}: weight {weight.shape} and bias {bias.shape} do not fit "
                f"{width} inputs"
            )
        width = weight.shape[0]
    return Mlp(weights, biases, activation)


def params_of(metadata: Mapping[str, Any]) -> PowertrainParams:
    """The powertrain that a policy was made for.

    Raises PolicyError or ConfigError where it is damaged, KeyError where there is none.
    """
    params = params_from_json(metadata["powertrain"])
    if powertrain_hash(params) != metadata["powertrain_hash"]:
        raise PolicyError("powertrain parameters do not match their hash")
    return params


def _short(text: str) -> str:
    """A file may hold a name or list of any length; what is said of it may not."""
    return text if len(text) <= LONGEST_TEXT else f"{text[:LONGEST_TEXT]} ..."


def _describe(tensor: np.ndarray[Any, Any]) -> str:
    if tensor.dtype != np.float32:
        return str(tensor.dtype)
    bad = tensor[~np.isfinite(tensor)].flat[0]
    return "NaN somewhere" if math.isnan(float(bad)) else f"{bad} somewhere"
