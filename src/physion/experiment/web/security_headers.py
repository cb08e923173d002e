"""Security headers of every response, such as the content security policy."""

from __future__ import annotations

from typing import TYPE_CHECKING

from physion.experiment.study.recruitment import MTURK_HOSTS

if TYPE_CHECKING:
    from physion.experiment.study.study import Study

NOT_NEEDED = ("accelerometer", "camera", "display-capture", "geolocation", "gyroscope", "hid",
              "magnetometer", "microphone", "midi", "payment", "serial", "usb",
              "xr-spatial-tracking")  # fmt: skip


def content_policy(study: Study) -> str:
    """Return the content security policy: files of this server only, and media as blobs.

    Blobs are needed because trials are preloaded. Forms may be sent to this server, and to MTurk if
    the study may be embedded there, since tasks on MTurk are submitted by a form.
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
    """Return the raw headers of every response, with lower-case names.

    No referrer is sent, since page URLs contain recruiters' ids. Cross-origin isolation also gives
    the page the browser's high-resolution clock.
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
"""Header added to responses over HTTPS."""
