"""Checks of arguments: each one passes, or raises an error that states name, contract, finding and remedy.

All conditions are phrased positively (``not (value >= low)``), so that NaN fails them.
"""

from __future__ import annotations

import os
import re
from importlib import import_module
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.errors import InvalidArrayError, InvalidOptionError

_SURROGATE = re.compile(r"[\ud800-\udfff]")

UNIT_TOLERANCE = 1e-3
"""Largest | |v| - 1 | accepted as unit length; half-precision quaternions, the coarsest input, are within it."""


NAME_BYTES = 255
"""Longest name of a file or folder on usual file systems [byte]."""


def rows_at(bad: NDArray[np.bool_]) -> str:
    """Return which rows of a mask are set, in words: ``row 12 (3 rows in all)``."""
    rows = np.flatnonzero(bad.reshape(len(bad), -1).any(axis=1))
    return f"row {rows[0]}" + (f" ({len(rows)} rows in all)" if len(rows) > 1 else "")


def require_array(name: str, value: ArrayLike, shape: tuple[int | None, ...], dtype: Any = np.float32) -> NDArray[Any]:
    """Return ``value`` as a contiguous array of ``dtype`` whose shape matches (``None`` matches any length).

    Raises:
        InvalidArrayError: The value cannot be converted, or its shape differs.
    """
    try:
        if isinstance(value, np.ma.MaskedArray) or np.iscomplexobj(value):
            raise TypeError("masked and complex arrays lose values")
        with np.errstate(over="ignore"):  # beyond the type's range is infinity, which `require_finite` names
            array = np.ascontiguousarray(value, dtype=dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidArrayError(
            f"{name} must be an array of {np.dtype(dtype).name}, got {type(value).__name__} ({error}). "
            "Pass a rectangular numeric array."
        ) from error
    wanted = "(" + ", ".join("N" if n is None else str(n) for n in shape) + ("," if len(shape) == 1 else "") + ")"
    if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
        raise InvalidArrayError(f"{name} must have shape {wanted}, got {array.shape}. Reshape or transpose it.")
    return array


def require_finite(name: str, array: NDArray[Any]) -> None:
    """Refuse NaN and infinity."""
    finite = np.isfinite(array)
    if not finite.all():
        where = rows_at(~finite)
        raise InvalidArrayError(f"{name} must be finite, got NaN or infinity at {where}. Drop or repair those rows.")


def require_range(name: str, array: NDArray[Any], low: float, high: float, remedy: str = "Clip or rescale it.") -> None:
    """Refuse values outside ``[low, high]``; NaN is outside."""
    inside = (array >= low) & (array <= high)
    if not inside.all():
        worst, where = array[~inside].flat[0], rows_at(~inside)
        raise InvalidArrayError(f"{name} must lie in [{low:g}, {high:g}], got {worst:g} at {where}. {remedy}")


def require_unit(name: str, array: NDArray[Any]) -> None:
    """Refuse rows whose length is not 1 within ``UNIT_TOLERANCE``."""
    length = np.sqrt(np.einsum("ij,ij->i", array, array))
    unit = np.abs(length - 1.0) <= UNIT_TOLERANCE
    if not unit.all():
        row = int(np.flatnonzero(~unit)[0])
        where = rows_at(~unit)
        raise InvalidArrayError(f"{name} must have unit length, got |v| = {length[row]:.4g} at {where}. Normalise it.")


def require_same_length(name: str, array: NDArray[Any], other_name: str, count: int) -> None:
    """Refuse an array with another number of rows than the array it belongs to."""
    if len(array) != count:
        raise InvalidArrayError(
            f"{name} must have as many rows as {other_name} ({count}), got {len(array)}. Pass one row each."
        )


def require_count(name: str, value: int, low: int = 1, high: int = 2**31 - 1) -> int:
    """Return an integer after checking its range."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not (low <= value <= high):
        raise InvalidOptionError(f"{name} must be an integer in [{low}, {high}], got {value!r}. Choose one in range.")
    return int(value)


def require_number(name: str, value: float, low: float = -np.inf, high: float = np.inf) -> float:
    """Return a number as a float after checking its range; NaN is outside every range."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = float("nan")
    if not (low <= number <= high):
        raise InvalidOptionError(f"{name} must be a number in [{low:g}, {high:g}], got {value!r}. Choose one in range.")
    return number


def is_text(value: object) -> TypeGuard[str]:
    """Return True for a text that is not empty and can be a file's name: no null, no half of a surrogate pair."""
    return isinstance(value, str) and bool(value) and "\0" not in value and not _SURROGATE.search(value)


def require_path(name: str, value: object, *, room: int = 0) -> Path:
    """Return a path after checking that a file can have such a name.

    Args:
        name: The argument, for the message.
        value: A text or an `os.PathLike` of text.
        room: Bytes that must be left for what is added to the name.

    Raises:
        InvalidOptionError: Anything else, also bytes; an empty text; a null character; what is not UTF-8; or a part
            that is longer than `NAME_BYTES`.
    """
    text = os.fspath(value) if isinstance(value, os.PathLike) else value
    if not isinstance(text, str) or not text:
        raise InvalidOptionError(f"{name} must be a path as a text or pathlib.Path, got {value!r}. Pass one.")
    try:
        longest = max(map(len, text.encode().split(b"/")))
    except UnicodeEncodeError:
        raise InvalidOptionError(f"{name} must be a name in UTF-8, got {text!r}. Rename the file.") from None
    if "\0" in text:
        raise InvalidOptionError(f"{name} must be a name without null characters, got {text!r}. Rename it.")
    if longest > NAME_BYTES - room:
        raise InvalidOptionError(
            f"{name} must have names of at most {NAME_BYTES - room} bytes, got {longest} in {shortened(text)}. "
            "Shorten it."
        )
    return Path(text)


def shortened(text: str) -> str:
    """Return the ends of a text that is too long for a message."""
    return text if len(text) <= 80 else f"{text[:40]}…{text[-36:]}"


def require_choice(name: str, value: str, choices: tuple[str, ...]) -> str:
    """Return a text after checking that it is one of ``choices``."""
    if value not in choices:
        raise InvalidOptionError(f"{name} must be one of {', '.join(choices)}, got {value!r}. Choose one of them.")
    return value


def require_package(name: str) -> Any:
    """Import a package of the extra ``charts``.

    Raises:
        InvalidOptionError: The package is not installed; the message names the extra.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise InvalidOptionError(
            f"{name} must be installed to draw charts, got no such package. Run pip install 'beam-warp[charts]'."
        ) from error
