"""Records as bytes that hold data only: to read them runs no code, as loading a pickle can.

A record is built of dataclasses, lists, tuples, dictionaries, enumerations, texts, numbers, bytes and arrays.
Its bytes are the size of a JSON text, the text, and the contents of the arrays that the text refers to.  The
reader is given the record's type as an annotation and refuses what does not fit.

An answer is a list of records, one for each state, whose arrays are small and alike: a list of equal arrays
is one array, and a list of records of one class has a list for each field.
"""

from __future__ import annotations

import hashlib
import json
import struct
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from functools import cache, cached_property, lru_cache
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

_SIZE = struct.Struct("<Q")
_ARRAY_KINDS = "biufcUS"  # of NumPy's data types: numbers and texts, no objects
_Decoder = Callable[[Any, memoryview], Any]  # (value of the JSON text, contents of the arrays) → value


class UnfitRecord(ValueError):
    """The bytes are no record of the wanted type, or a value has no encoding."""


@dataclass(frozen=True)
class EncodedRecord:
    """A record as bytes, decoded only where it is used."""

    data: bytes
    hint: Any  # the record's type, as an annotation

    @classmethod
    def of(cls, value: Any, hint: Any) -> EncodedRecord:
        """Encode a value; raise `UnfitRecord` where it is not of the type ``hint``."""
        record = cls(encode_record(value), hint)
        record.check()
        return record

    def __reduce__(self) -> tuple[type[EncodedRecord], tuple[bytes, Any]]:
        return type(self), (self.data, self.hint)

    @cached_property
    def digest(self) -> bytes:
        """SHA-256 of the bytes, which are the same for equal values."""
        return hashlib.sha256(self.data).digest()

    def check(self) -> None:
        """Decode the record, for the next `load`; raise `UnfitRecord` where it is not of its type."""
        vars(self)["_decoded"] = [decode_record(self.data, self.hint)]

    def load(self) -> Any:
        """Decode the record; the value is a new copy."""
        for decoded in vars(self).pop("_decoded", ()):
            return decoded
        return decode_record(self.data, self.hint)


def encode_record(value: Any) -> bytes:
    """Encode a value; raise `UnfitRecord` where a part of it has no encoding."""
    contents = bytearray()
    try:
        text = json.dumps(_plain(value, contents), separators=(",", ":")).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise UnfitRecord(str(error)) from None
    return b"".join((_SIZE.pack(len(text)), text, contents))


def decode_record(data: bytes, hint: Any) -> Any:
    """Decode a value of the type ``hint``; raise `UnfitRecord` where the bytes hold no such value."""
    try:
        (size,) = _SIZE.unpack_from(data)
        end = _SIZE.size + size
        return _decoder(hint)(json.loads(data[_SIZE.size : end]), memoryview(data)[end:])
    except UnfitRecord:
        raise
    except (
        ValueError,
        TypeError,
        LookupError,
        AttributeError,
        ArithmeticError,
        RecursionError,
        struct.error,
    ) as error:
        raise UnfitRecord(f"{type(error).__name__}: {error}") from None


def _plain(value: Any, contents: bytearray) -> Any:
    """Turn a value into what JSON holds, and append the contents of its arrays."""
    match value:
        case None | bool() | str() | int() | float():
            return value
        case np.ndarray():
            if value.dtype.kind not in _ARRAY_KINDS:
                raise UnfitRecord(f"an array of {value.dtype} has no encoding")
            return {"array": [value.dtype.str, value.shape, *_append(contents, value.tobytes())]}
        case bytes():
            return {"bytes": _append(contents, value)}
        case np.generic():
            return _plain(value.item(), contents)
        case Mapping():
            return [[_plain(key, contents), _plain(item, contents)] for key, item in value.items()]
        case list() if len(value) > 1 and _are_alike_arrays(value):
            return {"arrays": _plain(np.stack(value), contents)["array"]}
        case list() if len(value) > 1 and _are_alike_records(value):
            columns = zip(*map(_values, value), strict=True)
            return {"records": [type(value[0]).__name__, *(_plain(list(c), contents) for c in columns)]}
        case list() | tuple():
            return [_plain(item, contents) for item in value]
        case _ if is_dataclass(value) and not isinstance(value, type):
            return [type(value).__name__, *(_plain(item, contents) for item in _values(value))]
    raise UnfitRecord(f"a {type(value).__name__} has no encoding")


def _are_alike_arrays(values: list[Any]) -> bool:
    first = values[0]
    return (
        isinstance(first, np.ndarray)
        and first.ndim > 0
        and all(
            isinstance(item, np.ndarray) and item.dtype == first.dtype and item.shape == first.shape
            for item in values
        )
    )


def _are_alike_records(values: list[Any]) -> bool:
    first = values[0]
    return is_dataclass(first) and bool(fields(first)) and len(set(map(type, values))) == 1


def _values(record: Any) -> list[Any]:
    return [getattr(record, field.name) for field in fields(record)]


def _append(contents: bytearray, content: bytes) -> tuple[int, int]:
    """Append bytes; return where they begin, and their number."""
    contents += content
    return len(contents) - len(content), len(content)


@cache
def _decoder(hint: Any) -> _Decoder:
    """Make the function that decodes values of a type."""
    origin, arguments = get_origin(hint), get_args(hint)
    if hint in (None, types.NoneType):
        return lambda value, _: _require(value is None, value, hint)
    if hint is Any:
        return _decode_any
    if origin in (Union, types.UnionType):
        return _union_decoder(arguments)
    if origin is Literal:
        return lambda value, _: _require(value in arguments, value, hint)
    if origin is np.ndarray:
        (scalar,) = get_args(arguments[1])
        return lambda value, contents: _decode_array(value, contents, np.dtype(scalar))
    if origin in (list, Sequence):
        return _list_decoder(arguments[0])
    if origin is tuple:
        return _tuple_decoder(arguments)
    if origin in (dict, Mapping):
        key, item = map(_decoder, arguments)
        return lambda value, contents: {key(k, contents): item(v, contents) for k, v in _sequence(value)}
    if isinstance(hint, type) and issubclass(hint, Enum):
        return lambda value, _: hint(value)
    if is_dataclass(hint):
        return _dataclass_decoder(hint)
    if hint is bytes:
        return lambda value, contents: bytes(_content(value["bytes"], contents))
    accepted = (float, int) if hint is float else (hint,)
    if hint not in (float, int, str, bool):
        raise UnfitRecord(f"values of {hint} have no encoding")
    return lambda value, _: _require(type(value) in accepted, value, hint)


def _require(is_fit: bool, value: Any, hint: Any) -> Any:
    if not is_fit:
        raise UnfitRecord(f"a {type(value).__name__} in place of {hint}")
    return value


def _sequence(value: Any) -> list[Any]:
    """The encoded items of a list, also of one that was encoded as one array or field by field."""
    match value:
        case {"arrays": [kind, [number, *shape], begin, size]}:
            step = size // number
            return [{"array": [kind, shape, begin + i * step, step]} for i in range(number)]
        case {"records": [name, *columns]}:
            return [[name, *values] for values in zip(*map(_sequence, columns), strict=True)]
    found: list[Any] = _require(isinstance(value, list), value, "a list")
    return found


def _union_decoder(options: tuple[Any, ...]) -> _Decoder:
    decoders = [_decoder(option) for option in options if option is not types.NoneType]
    is_optional = types.NoneType in options

    def decode(value: Any, contents: memoryview) -> Any:
        if value is None and is_optional:
            return None
        for decoder in decoders:
            try:
                return decoder(value, contents)
            except (UnfitRecord, ValueError, TypeError, LookupError):
                pass
        raise UnfitRecord(f"a {type(value).__name__} in place of {options}")

    return decode


@cache
def _list_decoder(hint: Any) -> _Decoder:
    """Make the function that decodes lists of a type: of arrays and of records all at once where it can."""
    item = _decoder(hint)
    options = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    arrays = [option for option in options if get_origin(option) is np.ndarray]
    records: dict[str, Any] = {getattr(o, "__name__", ""): o for o in options if is_dataclass(o)}

    def decode(value: Any, contents: memoryview) -> Any:
        match value:
            case {"arrays": description} if len(arrays) == 1:
                return list(_decoder(arrays[0])({"array": description}, contents))
            case {"records": [name, *columns]} if name in records:
                decoders = _decoders_of_fields(records[name], _list_decoder)
                values = [decode(column, contents) for decode, column in zip(decoders, columns, strict=True)]
                return [records[name](*each) for each in zip(*values, strict=True)]
        return [item(one, contents) for one in _sequence(value)]

    return decode


@cache
def _decoders_of_fields(record: Any, decoder_of: Callable[[Any], _Decoder]) -> list[_Decoder]:
    hints = get_type_hints(record)
    return [decoder_of(hints[field.name]) for field in fields(record)]


def _tuple_decoder(arguments: tuple[Any, ...]) -> _Decoder:
    if arguments[1:] == (Ellipsis,):
        items_of = _list_decoder(arguments[0])
        return lambda value, contents: tuple(items_of(value, contents))
    items = [_decoder(argument) for argument in arguments]
    return lambda value, contents: tuple(
        [item(one, contents) for item, one in zip(items, _sequence(value), strict=True)]
    )


def _dataclass_decoder(record: Any) -> _Decoder:
    name = record.__name__

    def decode(value: Any, contents: memoryview) -> Any:
        _require(isinstance(value, list) and value[:1] == [name], value, name)
        items = _decoders_of_fields(record, _decoder)  # made here: a record may hold others of its class
        return record(*[item(one, contents) for item, one in zip(items, value[1:], strict=True)])

    return decode


def _decode_any(value: Any, contents: memoryview) -> Any:
    if isinstance(value, dict) and "array" in value:
        return _decode_array(value, contents)
    if isinstance(value, dict):
        value = _sequence(value)
    return [_decode_any(item, contents) for item in value] if isinstance(value, list) else value


def _decode_array(value: Any, contents: memoryview, wanted: np.dtype[Any] | None = None) -> Any:
    kind, shape, *place = value["array"]
    dtype = _data_type(kind)
    if wanted is not dtype and wanted not in (None, dtype):
        raise UnfitRecord(f"an array of {dtype} in place of {wanted}")
    return np.frombuffer(_content(place, contents), dtype).reshape(shape).copy()


@lru_cache(maxsize=64)  # a record has hundreds of arrays, of few types
def _data_type(kind: str) -> np.dtype[Any]:
    dtype = np.dtype(kind)
    _require(dtype.kind in _ARRAY_KINDS, dtype, "numbers or texts")
    return dtype


def _content(place: Sequence[int], contents: memoryview) -> memoryview:
    begin, size = place
    if not 0 <= begin <= begin + size <= len(contents):
        raise UnfitRecord(f"{place} in place of a part of the record")
    return contents[begin : begin + size]
