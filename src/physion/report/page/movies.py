"""Movies inside a page, within its limit of bytes, each with a still picture."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path

from PIL import Image

from physion.core.errors import BadInputError
from physion.core.names import canonical_name
from physion.report.page.document import data_uri
from physion.scenes.scene import OBSERVED_FRAMES

_MIME = {
    ".mp4": "video/mp4",
    ".webm": "video/webm",
    ".gif": "image/gif",
    ".png": "image/png",
    ".jpg": "image/jpeg",
}
_POSTER_SIDE = 256
"""Largest side of a still picture in pixels."""


def movies_of(folder: Path) -> dict[str, Path]:
    """Return the movies of a dataset's testing trials, by canonical stimulus, for `ReportInputs`.

    Raises `BadInputError` if ``folder`` is no dataset or has no testing trial, or if a movie does
    not have its SHA-256 in the index.
    """
    from physion.trials.dataset import Dataset

    dataset = Dataset(folder)
    trials = dict.fromkeys(dataset.trials("testing"))
    if not trials:
        raise BadInputError(f"{folder} has no testing trial, so no movie that people saw")
    for trial, file in dataset.files("movie").items():
        if trial in trials and file.path.is_file():
            file.check()
    return {canonical_name(trial): dataset.paths(trial).movie for trial in trials}


def check_movies(movies: Mapping[str, Path], stimuli: Iterable[str]) -> None:
    """Raise `BadInputError` for a movie to be shown that is absent or of a wrong kind."""
    for stimulus in stimuli:
        path = movies.get(stimulus)
        if path is not None and _mime(path) and not path.is_file():
            raise BadInputError(f"the movie of {stimulus!r} is not there: {path}")


@dataclass
class PageMovies:
    """Movies of one page as HTML.

    - ``files``: file by stimulus.
    - ``left``: bytes of HTML that the page may still take; each movie that is shown takes some.
    """

    files: Mapping[str, Path]
    left: int

    def show(self, stimulus: str, description: str) -> str:
        """Return the movie of a stimulus; a picture or a sentence if it cannot be shown.

        ``description``: for readers who do not see it. It plays without sound while it is in
        view; for people who ask for reduced motion it plays when they mark a box. Returns "" if no
        movie of any stimulus was given. Raises `BadInputError` if its file cannot be read or is no
        movie.
        """
        if not self.files:
            return ""
        path = self.files.get(stimulus)
        if path is None:
            return '<p class="none">no movie given</p>'
        poster = make_poster(path)
        for html in (_element(path, stimulus, description, poster), _still(poster, description)):
            if html and len(html) <= self.left:
                self.left -= len(html)
                return html
        return f'<p class="none">{_TOO_LARGE}</p>'


_TOO_LARGE = "movie left out: the page would grow too large"


def _element(path: Path, stimulus: str, description: str, poster: bytes) -> str:
    mime = _mime(path)
    try:
        data = data_uri(mime, path.read_bytes())
    except OSError as error:
        raise BadInputError(f"the movie of {stimulus!r} cannot be read: {error}") from error
    label = escape(description)
    if mime.startswith("image/"):
        return f'<img src="{data}" alt="{label}" loading="lazy">'
    still = data_uri("image/jpeg", poster) if poster else ""
    shown = f'poster="{still}" ' if still else ""
    # Browsers start a movie without sound when it comes into view. For people who ask for less
    # motion the style sheet hides it behind the picture until they mark the box.
    picture = f'<img src="{still}" alt="{label}" loading="lazy">' if still else ""
    return (
        f'<div class="movie"><label><input type="checkbox"> play the movie</label>{picture}'
        f'<video src="{data}" {shown}autoplay preload="none" controls loop muted playsinline '
        f'aria-label="{label}"></video></div>'
    )


def _still(poster: bytes, description: str) -> str:
    if not poster:
        return ""
    picture = data_uri("image/jpeg", poster)
    return (
        f'<div class="still"><img src="{picture}" alt="{escape(description)}">'
        f"<small>{_TOO_LARGE}</small></div>"
    )


def make_poster(path: Path) -> bytes:
    """Return the last observed picture of a movie as JPEG: what people saw when they answered.

    A shorter movie gives its last picture; a file that is no movie, or one that cannot be decoded
    here (a browser may still play it), gives b"".
    """
    from physion.trials.video import count_frames, read_chosen

    if not _mime(path).startswith("video/"):
        return b""
    try:
        last = max(0, min(OBSERVED_FRAMES, count_frames(path)) - 1)
        picture = Image.fromarray(read_chosen(path, [last])[0])
    except BadInputError:
        return b""
    picture.thumbnail((_POSTER_SIDE, _POSTER_SIDE))
    buffer = io.BytesIO()
    picture.save(buffer, format="JPEG", quality=80)
    return buffer.getvalue()


def _mime(path: Path) -> str:
    mime = _MIME.get(path.suffix.lower())
    if mime is None:
        raise BadInputError(f"{path} is no movie for a page; use one of {', '.join(_MIME)}")
    return mime
