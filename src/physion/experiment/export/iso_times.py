"""Moments as text in ISO 8601, for millions at a time."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pyarrow as pa

_FORM = "0000-00-00T00:00:00.000Z"
_DAY_MS = 86_400_000


def iso_times(seconds: npt.NDArray[np.float64]) -> pa.Array:
    """Seconds since 1970 (UTC) as ``2026-01-31T09:30:00.123Z``, milliseconds cut off; NaN is null.

    For years 1000 to 9999. Digits are put into bytes for all moments at once: the usual ways need
    a microsecond and more for each.
    """
    known = np.isfinite(seconds)
    whole = np.floor(np.where(known, seconds, 0.0) * 1000).astype(np.int64)
    days, rest = np.divmod(whole, _DAY_MS)
    text = np.tile(np.frombuffer(_FORM.encode(), np.uint8), (len(whole), 1))
    dates, which = np.unique(days, return_inverse=True)
    spelt = np.datetime_as_string(dates.astype("datetime64[D]")).astype("S10")
    text[:, :10] = spelt.view(np.uint8).reshape(-1, 10)[which]
    for last, unit, base in ((12, 3_600_000, 24), (15, 60_000, 60), (18, 1000, 60), (22, 1, 1000)):
        value = rest // unit % base
        for place in range(3 if base == 1000 else 2):
            text[:, last - place] = ord("0") + value // 10**place % 10
    offsets = np.arange(len(whole) + 1, dtype=np.int32) * len(_FORM)
    buffers = [None, pa.py_buffer(offsets), pa.py_buffer(np.ascontiguousarray(text))]
    found = pa.Array.from_buffers(pa.string(), len(whole), buffers)
    if known.all():
        return found
    return found.take(pa.array(np.arange(len(whole)), mask=~known))
