"""Content hashes (SHA-256) of what the bench writes and reads back, so that a flipped bit is noticed.

A Parquet file carries its own hash in its footer, computed with the hash's 64 places as zeros; a JSON table in the key
``sha256``, over its other keys. A second mark beside the hash tells a damaged seal from a file that never had one.
"""

from __future__ import annotations

import hashlib
import io
import json
import mmap
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from testbed.base.errors import InputError
from testbed.base.files import from_json

if TYPE_CHECKING:
    import pyarrow as pa

SEAL = b"testbed-sha256"
MARK = b"testbed-sealed"
KEY = "sha256"
_ZEROS = b"0" * 64
_GAP = 2
"""Bytes between a key and its value in a Parquet footer (Thrift compact protocol: field type and length of 64)."""


class DamagedError(InputError):
    """The content of a file is not what the bench wrote."""


def digest(content: bytes) -> str:
    """Hash of bytes, hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def file_digest(path: str | Path) -> str:
    """Hash of a file's content. Raises DamagedError when it cannot be read."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise DamagedError(f"{path}: cannot be read ({error.strerror})") from None


def sealed_parquet(table: pa.Table, row_group_size: int | None = None) -> bytes:
    """A table as the bytes of a Parquet file that carries its own hash."""
    import pyarrow.parquet as pq

    buffer = io.BytesIO()
    with pq.ParquetWriter(buffer, table.schema) as writer:
        writer.write_table(table, row_group_size)
        writer.add_key_value_metadata({MARK: b"1", SEAL: _ZEROS})
    content = buffer.getvalue()
    start = _place(content)
    if start is None or content[start : start + 64] != _ZEROS:
        raise AssertionError("the Parquet library keeps the footer in another layout")
    return content[:start] + digest(content).encode() + content[start + 64 :]


def is_sealed(content: bytes | mmap.mmap) -> bool:
    """Whether a Parquet file carries, or carried before it was damaged, its own hash."""
    return content.find(SEAL) >= 0 or content.find(MARK) >= 0


def unsealed(source: str | Path | bytes, where: str = "", required: bool = True) -> bytes:
    """The bytes of a file of `sealed_parquet` (or the bytes themselves, named ``where``) once their hash agrees.

    Raises DamagedError when it does not, or is missing although ``required``.
    """
    where = where or ("stored table" if isinstance(source, bytes) else str(source))
    try:
        content = source if isinstance(source, bytes) else Path(source).read_bytes()
    except OSError as error:
        raise DamagedError(f"{where}: cannot be read ({error.strerror})") from None
    _check(content, where, required)
    return content


def check_seal(path: str | Path) -> None:
    """`unsealed` for a large file, without a copy of it in memory; one without a hash (of version 0.1) passes."""
    try:
        with open(path, "rb") as file:
            if os.fstat(file.fileno()).st_size == 0:
                raise DamagedError(f"{path}: damaged (empty)")
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
                _check(content, str(path), required=False)
    except OSError as error:
        raise DamagedError(f"{path}: cannot be read ({error.strerror})") from None


def _check(content: bytes | mmap.mmap, where: str, required: bool) -> None:
    """Raise DamagedError unless the content has the hash that it carries."""
    if not is_sealed(content):
        if required:
            raise DamagedError(f"{where}: carries no hash of its content; not written by this version of the bench")
        return
    start = _place(content)
    if start is not None:
        with memoryview(content) as view, view[:start] as before, view[start + 64 :] as after:
            body = hashlib.sha256(before)
            body.update(_ZEROS)
            body.update(after)
        if content[start : start + 64] == body.hexdigest().encode():
            return
    raise DamagedError(f"{where}: damaged (its content does not have the hash that it was written with)")


def _place(content: bytes | mmap.mmap) -> int | None:
    """Where the hash stands in a Parquet file."""
    k = content.rfind(SEAL)
    return None if k < 0 else k + len(SEAL) + _GAP


def sealed_json(data: Mapping[str, Any]) -> bytes:
    """A table as JSON that carries the hash of its content under `KEY`."""
    plain = {key: value for key, value in data.items() if key != KEY}
    return (json.dumps(plain | {KEY: _json_digest(plain)}, indent=1, ensure_ascii=False) + "\n").encode()


def read_json(path: str | Path) -> dict[str, Any]:
    """A table of JSON; where it carries a hash, that must agree. Raises DamagedError naming file and fault."""
    try:
        data = from_json(Path(path).read_bytes())
    except OSError as error:
        raise DamagedError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise DamagedError(f"{path}: damaged, no JSON ({str(error)[:200]})") from None
    if not isinstance(data, dict):
        raise DamagedError(f"{path}: damaged, holds no table")
    plain = {key: value for key, value in data.items() if key != KEY}
    if KEY in data and data[KEY] != _json_digest(plain):
        raise DamagedError(f"{path}: damaged or edited (its content does not have the hash that it was written with)")
    return plain


def _json_digest(plain: Mapping[str, Any]) -> str:
    return digest(json.dumps(json.loads(json.dumps(plain)), sort_keys=True).encode())
