"""The agent's live page, handed on under OctoPrint's own address and to those who may print.

So a browser needs to reach OctoPrint alone, and its login guards the page's buttons, too.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import tornado.httpclient
import tornado.web
import tornado.websocket

MAX_SCAN_MESSAGE_BYTES = 256 * 1024 * 1024  # a scan's points come in one
PAGE_PATIENCE_S = 10.0
PASSED_ON = ("Content-Type", "Content-Encoding")


class LivePage(tornado.websocket.WebSocketHandler):
    """One request for the page, or its socket."""

    def initialize(
        self, address: Callable[[], tuple[str, str]], allowed: Callable[[Any], None]
    ) -> None:
        """`address` gives the page's host:port and its token; `allowed` raises for strangers."""
        self._address, self._allowed = address, allowed
        self._behind: Any = None

    def prepare(self) -> None:
        """Refuse strangers."""
        self._allowed(self.request)

    async def get(self, *args: Any, **kwargs: Any) -> None:
        """The page itself, or the beginning of its socket."""
        host, token = self._address()
        if not host:
            raise tornado.web.HTTPError(404)
        cookie = {"Cookie": f"amrepair_token={token}"} if token else {}
        if self.request.headers.get("Upgrade", "").lower() == "websocket":
            wanted = self.request.headers.get("Sec-WebSocket-Protocol", "")
            self._behind = await tornado.websocket.websocket_connect(
                tornado.httpclient.HTTPRequest(
                    f"ws://{host}/", headers=cookie, connect_timeout=PAGE_PATIENCE_S
                ),
                subprotocols=[word.strip() for word in wanted.split(",") if word.strip()],
                max_message_size=MAX_SCAN_MESSAGE_BYTES,
            )
            await super().get(*args, **kwargs)
            return
        accepted = {"Accept-Encoding": self.request.headers.get("Accept-Encoding", "")}
        try:
            answer = await tornado.httpclient.AsyncHTTPClient().fetch(
                f"http://{host}/", headers={**cookie, **accepted}, decompress_response=False,
                request_timeout=PAGE_PATIENCE_S,
            )  # fmt: skip
        except (tornado.httpclient.HTTPError, OSError) as error:
            raise tornado.web.HTTPError(502, reason="the live page does not answer") from error
        for name in PASSED_ON:
            if name in answer.headers:
                self.set_header(name, answer.headers[name])
        self.finish(answer.body)

    def select_subprotocol(self, subprotocols: list[str]) -> str | None:
        """What the page speaks."""
        chosen: str | None = self._behind.selected_subprotocol
        return chosen

    async def on_message(self, message: str | bytes) -> None:
        """To the page."""
        await self._behind.write_message(message, binary=isinstance(message, bytes))

    async def open(self, *args: Any, **kwargs: Any) -> None:
        """The browser is there: hand on what comes from the page, until it ends."""
        while (message := await self._behind.read_message()) is not None:
            try:
                await self.write_message(message, binary=isinstance(message, bytes))
            except tornado.websocket.WebSocketClosedError:
                return
        self.close()

    def on_close(self) -> None:
        """The browser is gone."""
        if self._behind is not None:
            self._behind.close()
