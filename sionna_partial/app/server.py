"""The server of the app: one page for each window, under a secret path, and the files that windows send and fetch."""

import functools
import secrets
import socket
from collections.abc import Callable
from typing import Any

from sionna_partial.app.page import TEMPLATE, Page
from sionna_partial.app.session import FILES, MAP_SUFFIXES, MOST_BYTES, Session
from sionna_partial.errors import SettingsError, SionnaPartialError
from sionna_partial.maps.partial_map import PartialMap

LOOPBACK = "127.0.0.1"
"""Address that programs of this machine alone reach."""

_FIRST_EXAMPLE = "apartment"


class AppServer:
    """Serves the app until `stop`; without a map, windows begin with an example.

    Parameters
    ----------
    partial : PartialMap, optional
        With `title`, the name of its file.
    title : str
    address : str
        Of the interface that is listened at.
    port : int
        0 is any free one.

    Attributes
    ----------
    url : str
        Of the page; nobody can guess it.

    Raises
    ------
    SettingsError
        If address or port cannot be used.
    """

    def __init__(
        self, partial: PartialMap | None = None, title: str = "", address: str = LOOPBACK, port: int = 0
    ) -> None:
        from bokeh.application import Application
        from bokeh.application.handlers.function import FunctionHandler
        from bokeh.server.server import Server

        self._map, self._sessions, self._token = (partial, title), dict[str, Session](), secrets.token_urlsafe(24)
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
                http_server_kwargs={"max_buffer_size": MOST_BYTES + 10**6, "max_body_size": MOST_BYTES + 10**6},
            )
        except OSError as error:
            remedy = "choose another --port, or an --address of this machine."
            raise SettingsError(
                f"{address}:{port} cannot be listened at ({error.strerror or error}): {remedy}"
            ) from error
        self.url = f"http://{address}:{self._server.port}{path}"

    def run(self) -> None:
        """Serve in this thread."""
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
                "map_suffixes": ",".join((*MAP_SUFFIXES, ".pgm", ".png", ".bmp", ".zip")),
            }
        )

        def close(_: Any) -> None:
            self._sessions.pop(key, None)
            session.close()

        document.on_session_destroyed(close)
        partial, title = self._map
        if partial is None:
            session.open_example(_FIRST_EXAMPLE)
        else:
            session.open_map(partial, title)


def _files_handler() -> Any:
    from tornado.ioloop import IOLoop
    from tornado.web import RequestHandler

    class Files(RequestHandler):
        """Files that a window sends and fetches; `key` is known to that window alone."""

        def initialize(self, sessions: dict[str, Session]) -> None:
            self._sessions = sessions

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
                content = await IOLoop.current().run_in_executor(None, session.file, kind)
            except (SionnaPartialError, OSError) as error:
                self._refuse(409, str(error))
                return
            self.set_header("Content-Type", "application/octet-stream")
            self.set_header("Content-Disposition", f'attachment; filename="{FILES[kind]}"')
            self.set_header("X-Content-Type-Options", "nosniff")
            self.set_header("Cache-Control", "no-store")
            await self.finish(content)

        async def post(self, key: str, kind: str) -> None:
            session = self._sessions.get(key)
            files = [(each.filename, each.body) for each in self.request.files.get("file", [])]
            if session is None or kind not in ("map", "measurements") or not files:
                self._refuse(404, "There is nothing to send, or the window was closed.")
                return
            take = session.upload_map if kind == "map" else session.learn
            given: Any = files if kind == "map" else files[0][1]
            session.do(functools.partial(_guarded, session, take, given))
            await self.finish()

    return Files


def _guarded(session: Session, take: Callable[[Any], None], given: Any) -> None:
    try:
        take(given)
    except SionnaPartialError as error:
        session.refuse(error)
