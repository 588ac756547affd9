"""Server of the app: a page for each window under a secret path, and its uploads and downloads."""

import asyncio
import functools
import logging
import secrets
import socket
from collections.abc import Mapping, Sequence
from typing import Any

from sionna_partial.apps.app.drawing import Source
from sionna_partial.apps.app.files import FILES, MOST_BYTES, UPLOADED_SUFFIXES
from sionna_partial.apps.app.page import TEMPLATE, Page
from sionna_partial.apps.app.session import Session
from sionna_partial.errors import SettingsError, SionnaPartialError
from sionna_partial.maps.partial_map import PartialMap

LOOPBACK = "127.0.0.1"

_FIRST_EXAMPLE = "apartment"

_OTHER_BYTES = 100_000
"""Largest body of a request other than an upload to an open window [bytes]."""

_FORM_BYTES = 1_000_000
"""Allowance for the form around uploaded files [bytes]."""

_DOWNLOAD_HEADERS = {
    "Content-Type": "application/octet-stream",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}

_NOTHING_TO_SEND = 404, "There is nothing to send, or the window was closed."


class AppServer:
    """Server of the app; without a map, windows open an example.

    Parameters
    ----------
    partial : PartialMap, optional
    title : str
        Name of the map's file.
    address : str
        Address of the network interface.
    port : int
        0 is any free one.
    warnings : sequence of str
        Warnings of the map's reader.
    source : Drawing or Plan, optional
        File that can be read again with other settings; a picture without scale needs no map.

    Attributes
    ----------
    url : str
        Address of the page, with a secret part.

    Raises
    ------
    SettingsError
        If address or port cannot be used.
    """

    def __init__(
        self,
        partial: PartialMap | None = None,
        title: str = "",
        address: str = LOOPBACK,
        port: int = 0,
        warnings: Sequence[str] = (),
        source: Source | None = None,
    ) -> None:
        from bokeh.application import Application
        from bokeh.application.handlers.function import FunctionHandler
        from bokeh.server.server import Server

        logging.getLogger("bokeh.server.views.ws").setLevel(logging.ERROR)  # a window was closed during its job
        self._sessions, self._token = dict[str, Session](), secrets.token_urlsafe(24)
        given: dict[str, Any] = {"partial": partial, "title": title, "warnings": warnings, "source": source}
        self._given = given if partial is not None or source is not None else None
        path = f"/{self._token}"
        hosts = {address, socket.gethostname()} | ({"localhost"} if address == LOOPBACK else set())
        try:
            with socket.create_server((address, port)) as free:
                port = free.getsockname()[1]
            self._server = Server(
                {path: Application(FunctionHandler(self._open_window))},
                address=address,
                port=port,
                allow_websocket_origin=sorted(f"{host}:{port}" for host in hosts),
                extra_patterns=[(rf"{path}/files/([\w-]+)/(\w+)", _files_handler(), {"sessions": self._sessions})],
                use_index=False,
                redirect_root=False,
                http_server_kwargs={"max_body_size": _OTHER_BYTES},
            )
        except OSError as error:
            remedy = "choose another --port, or an --address of this machine."
            raise SettingsError(
                f"{address}:{port} cannot be listened at ({error.strerror or error}): {remedy}"
            ) from error
        self.url = f"http://{address}:{self._server.port}{path}"

    def run(self) -> None:
        """Serve in this thread until `stop`."""
        self._server.start()
        self._server.io_loop.start()

    def stop(self) -> None:
        """End `run`, from any thread."""
        self._server.io_loop.add_callback(self._server.io_loop.stop)

    def _open_window(self, document: Any) -> None:
        key = secrets.token_urlsafe(24)
        files_url = f"/{self._token}/files/{key}"
        page = Page(document, files_url)
        session = self._sessions[key] = page.session
        document.title = "Radio coverage"
        document.template = TEMPLATE
        document.template_variables.update(
            {
                "files_url": files_url,
                "most_bytes": MOST_BYTES,
                "map_suffixes": ",".join(UPLOADED_SUFFIXES),
            }
        )

        def close(_: Any) -> None:
            self._sessions.pop(key, None)
            session.jobs.close()

        document.on_session_destroyed(close)
        if self._given is None:
            session.maps.open_example(_FIRST_EXAMPLE)
        else:
            session.maps.open_map(**self._given)


def _upload_fault(session: Session | None, kind: str, headers: Mapping[str, str]) -> tuple[int, str] | None:
    """Return HTTP status and reason of an upload that is refused by its headers."""
    size = headers.get("Content-Length", "")
    if session is None or kind not in ("map", "measurements"):
        return _NOTHING_TO_SEND
    if not size.isdecimal():
        return 411, "The size of an upload has to be in its header."
    if int(size) > MOST_BYTES + _FORM_BYTES:
        return 413, f"An upload may have {MOST_BYTES:,} bytes."
    if not headers.get("Content-Type", "").startswith("multipart/form-data"):
        return 415, "An upload has to be a form with files."
    if session.is_receiving:
        return 409, "Another upload of this window is under way: wait for its end."
    return None


def _take_upload(session: Session, kind: str, files: list[tuple[str, bytes]]) -> None:
    try:
        if kind == "map":
            session.maps.upload_map(files)
        else:
            session.surveys.learn(files[0][1], files[0][0])
    except SionnaPartialError as error:
        session.jobs.refuse(error)


class _Files:
    """Handler of uploads and downloads; only the window knows its `key`.

    `_files_handler` adds tornado's base class, so that tornado is imported with the app only.
    """

    request: Any
    path_args: Any
    set_status: Any
    set_header: Any
    finish: Any

    def initialize(self, sessions: dict[str, Session]) -> None:
        self._sessions, self._chunks = sessions, list[bytes]()
        self._receiver: Session | None = None

    def prepare(self) -> None:
        """Refuse an upload before its body is read."""
        if self.request.method != "POST":
            return
        key, kind = self.path_args
        session = self._sessions.get(key)
        fault = _upload_fault(session, kind, self.request.headers)
        if fault is not None:
            self._refuse(*fault)
            return
        assert session is not None
        session.is_receiving, self._receiver = True, session
        self.request.connection.set_max_body_size(MOST_BYTES + _FORM_BYTES)

    def data_received(self, chunk: bytes) -> None:
        if self._receiver is not None:
            self._chunks.append(chunk)

    def on_finish(self) -> None:
        if self._receiver is not None:
            self._receiver.is_receiving = False

    on_connection_close = on_finish

    def _refuse(self, code: int, text: str) -> None:
        self.set_status(code)
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(text)

    async def get(self, key: str, kind: str) -> None:
        session = self._sessions.get(key)
        if session is None or kind not in FILES:
            self._refuse(404, "There is no such file, or its window was closed.")
            return
        try:
            content = await asyncio.to_thread(session.file, kind)
        except (SionnaPartialError, OSError) as error:
            self._refuse(409, str(error))
            return
        for name, value in _DOWNLOAD_HEADERS.items():
            self.set_header(name, value)
        self.set_header("Content-Disposition", f'attachment; filename="{FILES[kind]}"')
        await self.finish(content)

    async def post(self, key: str, kind: str) -> None:
        from tornado.httputil import HTTPFile, HTTPInputError, parse_body_arguments

        form: dict[str, list[HTTPFile]] = {}
        body, session = b"".join(self._chunks), self._sessions.get(key)
        self._chunks.clear()
        try:
            parse_body_arguments(self.request.headers["Content-Type"], body, {}, form)
        except HTTPInputError as error:
            self._refuse(400, f"The upload cannot be read: {error}")
            return
        files = [(file.filename, file.body) for file in form.get("file", [])]
        if session is None or not files:
            self._refuse(*_NOTHING_TO_SEND)
            return
        session.jobs.do(functools.partial(_take_upload, session, kind, files))
        await self.finish()


def _files_handler() -> Any:
    from tornado.web import RequestHandler, stream_request_body

    class Files(_Files, RequestHandler):
        pass

    return stream_request_body(Files)
