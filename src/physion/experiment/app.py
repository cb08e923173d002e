"""Web application of one study: participants' pages, API, media and experimenter's pages."""

from __future__ import annotations

import logging
import math
import time
from typing import TYPE_CHECKING

from fastapi import FastAPI
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import Response

from physion.core.errors import BadInputError
from physion.experiment.experimenter.pages import build_router
from physion.experiment.protocol import Refused
from physion.experiment.study.media import read_media
from physion.experiment.study.texts import TEXTS_FOLDER, read_consent_file, read_picture
from physion.experiment.web.api import BadBodyError, build_api
from physion.experiment.web.files import PACKAGE, MediaFiles, read_page_file, read_page_files
from physion.experiment.web.guards import Guards, code_of, refuse

if TYPE_CHECKING:
    from physion.experiment.store.store import Store
    from physion.experiment.study.identity import Secrets
    from physion.experiment.study.study import Study

log = logging.getLogger(__name__)


def build_app(study: Study, secrets: Secrets, store: Store) -> FastAPI:
    """Return the ASGI application of a study, without FastAPI's own documentation pages."""
    app = FastAPI(
        docs_url=None,
        redoc_url=None,
        openapi_url=None,
        redirect_slashes=False,
        middleware=[Middleware(Guards, study=study)],
        exception_handlers={
            Refused: _refused,
            BadBodyError: _bad_body,
            HTTPException: _framework_error,
            RequestValidationError: _bad_request,
        },
    )
    app.include_router(build_api(study, secrets, store))
    _serve_pages(app, study)
    _serve_media(app, study, secrets, store)
    app.include_router(build_router(study, secrets, store), prefix="/experimenter")
    return app


def _serve_pages(app: FastAPI, study: Study) -> None:
    """Add the routes of the page, its static files, the consent forms and pictures of questions."""
    forms = {
        f"{language}.pdf": read_consent_file(study.folder / TEXTS_FOLDER, language)
        for language in study.consent_files
    }
    pictures = {
        question.picture: read_picture(study.folder / TEXTS_FOLDER, question.picture)
        for question in study.questions
        if question.picture
    }
    index = read_page_file(PACKAGE / "pages" / "index.html")
    files = read_page_files(PACKAGE / "static")

    @app.api_route("/", methods=["GET", "HEAD"])
    async def get_index(request: Request) -> Response:
        return index.response(request)

    @app.get("/static/{name:path}")
    async def get_static(request: Request) -> Response:
        file = files.get(request.path_params["name"])
        return refuse("not_found") if file is None else file.response(request)

    @app.get("/consent/{name}")
    async def get_consent(request: Request) -> Response:
        content = forms.get(request.path_params["name"])
        if content is None:
            return refuse("not_found")
        return Response(content, media_type="application/pdf")

    @app.get("/picture/{name}")
    async def get_picture(request: Request) -> Response:
        content = pictures.get(request.path_params["name"])
        if content is None:
            return refuse("not_found")
        return Response(content, media_type="image/png")


def _serve_media(app: FastAPI, study: Study, secrets: Secrets, store: Store) -> None:
    """Add the route of movies and maps."""
    files = MediaFiles()

    @app.get("/media/{name}")
    async def get_media(request: Request) -> Response:
        try:
            media = read_media(study, secrets, request.scope["path"])
        except BadInputError:
            return refuse("not_found")
        try:
            response = await files.response(media.file)
        except BadInputError as error:
            log.error("a movie or map could not be sent to a participant: %s", error)
            return refuse("not_found", "This file is missing on the server.")
        store.fetched.note(media.tag, media.phase, media.trial, media.kind, time.time())
        return response


async def _refused(request: Request, error: Exception) -> Response:
    """Handle a refusal by the store."""
    assert isinstance(error, Refused)
    headers = {"retry-after": str(math.ceil(error.wait_s))} if error.wait_s else {}
    if error.code == "too_large":  # the rest of the body is not read
        headers["connection"] = "close"
    return refuse(
        error.code, error.message, error.state, headers=headers, completion=error.completion
    )


async def _bad_body(request: Request, error: Exception) -> Response:
    """Handle an invalid request body."""
    return refuse("bad_request", str(error))


async def _bad_request(request: Request, error: Exception) -> Response:
    """Handle a request that the framework finds invalid."""
    return refuse("bad_request")


async def _framework_error(request: Request, error: Exception) -> Response:
    """Handle an HTTP error of the framework, such as an unknown path."""
    assert isinstance(error, HTTPException)
    headers = dict(error.headers or {}) if error.status_code == 405 else None
    return refuse(code_of(error.status_code), status=error.status_code, headers=headers)
