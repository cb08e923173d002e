"""Headers of every response: what a browser may do with our pages, and who may show them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from physion.experiment.study.recruitment import MTURK_HOSTS

if TYPE_CHECKING:
    from physion.experiment.study.study import Study

NOT_NEEDED = ("accelerometer", "camera", "display-capture", "geolocation", "gyroscope", "hid",
              "magnetometer", "microphone", "midi", "payment", "serial", "usb",
              "xr-spatial-tracking")  # fmt: skip


def content_policy(study: Study) -> str:
    """Content security policy: our own files, and movies as blobs, which trials are preloaded as.

    Forms go to ourselves, and to MTurk where the study may be shown in its frame, since that is how
    a task there is handed in.
    """
    frames = " ".join(study.embed_from) or "'none'"
    forms = " ".join(("'self'", *(MTURK_HOSTS if study.embed_from else ())))
    return "; ".join((
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' blob:",
        "media-src 'self' blob:",
        "connect-src 'self'",
        f"frame-ancestors {frames}",
        "base-uri 'none'",
        f"form-action {forms}",
    ))  # fmt: skip


def security_headers(study: Study) -> list[tuple[bytes, bytes]]:
    """Raw headers, names in small letters, for whatever is served.

    The addresses of the pages hold recruiters' ids: no referrer ever. Isolated from other origins
    the page also gets the browser's finer clock.
    """
    headers = {
        "content-security-policy": content_policy(study),
        "x-content-type-options": "nosniff",
        "referrer-policy": "no-referrer",
        "permissions-policy": ", ".join(f"{name}=()" for name in NOT_NEEDED),
        "cross-origin-opener-policy": "same-origin",
        "cross-origin-embedder-policy": "require-corp",
        "cross-origin-resource-policy": "same-origin",
        "x-robots-tag": "noindex, nofollow",
    }
    if not study.embed_from:
        headers["x-frame-options"] = "DENY"
    return [(name.encode(), value.encode("latin-1")) for name, value in headers.items()]


HTTPS_ONLY = (b"strict-transport-security", b"max-age=31536000")
"""Added where the request came by https."""
