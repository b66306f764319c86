"""Arrays and a few texts in one safetensors file: the same content is the same bytes, and a changed bit is found.

Layout: https://huggingface.co/docs/safetensors (8 bytes of length, a JSON header, the data). Header keys are sorted, which
the library's own writer leaves to chance. The text ``checksum`` is SHA-256 over the whole file with its digits as zeros.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError
from testbed.base.files import from_json

CHECKSUM = "checksum"
_BLANK = "0" * 64
_KINDS = {"float64": "F64", "float32": "F32", "float16": "F16", "int64": "I64", "uint8": "U8"}


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]], texts: Mapping[str, str]) -> None:
    """Write the file beside ``path`` and rename it, so that a kill leaves the old one or the new one."""
    header: dict[str, Any] = {"__metadata__": dict(texts) | {CHECKSUM: _BLANK}}
    parts, end = [], 0
    for name in sorted(arrays, key=lambda key: (-arrays[key].dtype.itemsize, key)):
        part = np.ascontiguousarray(arrays[name]).tobytes()
        span = [end, end := end + len(part)]
        header[name] = {
            "dtype": _KINDS[arrays[name].dtype.name],
            "shape": list(arrays[name].shape),
            "data_offsets": span,
        }
        parts.append(part)
    head = json.dumps(header, sort_keys=True, separators=(",", ":")).encode()
    head += b" " * (-len(head) % 8)
    content = len(head).to_bytes(8, "little") + head + b"".join(parts)
    field = f'"{CHECKSUM}":"%s"'
    digest = hashlib.sha256(content).hexdigest()
    scratch = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        scratch.write_bytes(content.replace((field % _BLANK).encode(), (field % digest).encode(), 1))
        os.replace(scratch, path)
    except BaseException:
        scratch.unlink(missing_ok=True)
        raise


def read_arrays(path: Path, what: str) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """Arrays and texts of a file; numbers stored in half precision come as singles, which all of them are.

    A file of version 0.1 carries no checksum and is taken as it is.

    Raises InputError, which names the file and says that it is not ``what``, where it is missing, something else, cut or
    damaged, or holds a number that is not finite.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    try:
        arrays = load(content)
        texts = from_json(content[8 : 8 + int.from_bytes(content[:8], "little")]).get("__metadata__", {})
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not {what} ({str(error) or 'no safetensors file'})") from None
    if (digest := texts.pop(CHECKSUM, None)) is not None:
        unsigned = content.replace(f'"{CHECKSUM}":"{digest}"'.encode(), f'"{CHECKSUM}":"{_BLANK}"'.encode(), 1)
        if hashlib.sha256(unsigned).hexdigest() != digest:
            raise InputError(f"{path}: damaged: its content does not match its checksum; make it again")
    for name, values in arrays.items():
        if not np.isfinite(values).all():
            count = int((~np.isfinite(values)).sum())
            raise InputError(f"{path}: '{name}' has {count} numbers that are not finite; make the file again")
    return {name: a.astype(np.float32) if a.dtype == np.float16 else a for name, a in arrays.items()}, texts


def check_shapes(path: Path, arrays: Mapping[str, NDArray[Any]], shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raises InputError for an array that is missing or has another shape than ``shapes`` says."""
    for name, shape in shapes.items():
        if name not in arrays:
            raise InputError(f"{path}: has no array '{name}' of shape {shape}")
        if arrays[name].shape != shape:
            raise InputError(f"{path}: '{name}' has the shape {arrays[name].shape}, expected {shape}")
