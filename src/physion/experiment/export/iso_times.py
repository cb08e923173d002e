"""Fast formatting of arrays of times in ISO 8601."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pyarrow as pa

_FORM = "0000-00-00T00:00:00.000Z"
_DAY_MS = 86_400_000


def iso_times(seconds: npt.NDArray[np.float64]) -> pa.Array:
    """Format Unix times as text such as ``2026-01-31T09:30:00.123Z``.

    Digits are computed for the whole array at once, since the usual functions take a microsecond
    or more per value.

    Parameters
    ----------
    seconds
        Seconds since 1970 (UTC), in the years 1000 to 9999; NaN for a missing time.

    Returns
    -------
    pa.Array
        Texts, truncated to milliseconds; null for NaN.
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
        for digit in range(3 if base == 1000 else 2):
            text[:, last - digit] = ord("0") + value // 10**digit % 10
    offsets = np.arange(len(whole) + 1, dtype=np.int32) * len(_FORM)
    buffers = [None, pa.py_buffer(offsets), pa.py_buffer(np.ascontiguousarray(text))]
    times = pa.Array.from_buffers(pa.string(), len(whole), buffers)
    if known.all():
        return times
    return times.take(pa.array(np.arange(len(whole)), mask=~known))
