"""A print server in this process: HTTP by a handler, a websocket that the test pushes through."""

from __future__ import annotations

import json
import logging
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any

from websockets.frames import Frame, Opcode
from websockets.http11 import Request
from websockets.protocol import State
from websockets.server import ServerProtocol

QUIET = logging.Logger("quiet", logging.CRITICAL + 1)  # the test looks at what the client logs
Answer = tuple[int, object]


@dataclass
class Asked:
    """One HTTP request as it arrived."""

    method: str
    path: str
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> dict[str, Any]:
        return dict(json.loads(self.body)) if self.body else {}


@dataclass
class FakeServer:
    """Serves `handle` until closed; `on_message` hears what comes over websockets.

    `asked` keeps every request in order, for the test to look at.
    """

    handle: Callable[[Asked], Answer]
    on_open: Callable[[], None] = lambda: None
    on_message: Callable[[Any], None] = lambda message: None
    asked: list[Asked] = field(default_factory=list)
    socket_headers: list[dict[str, str]] = field(default_factory=list)

    def __enter__(self) -> FakeServer:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.base = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        self._sockets: list[tuple[socket.socket, ServerProtocol]] = []
        self._mutex = threading.RLock()
        self._threads = [threading.Thread(target=self._accept, daemon=True)]
        self._threads[0].start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.drop_sockets()
        for thread in self._threads:
            thread.join(timeout=5)

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            thread = threading.Thread(target=self._serve, args=(connection,), daemon=True)
            self._threads.append(thread)
            thread.start()

    def _serve(self, connection: socket.socket) -> None:
        with connection:
            data = b""
            while b"\r\n\r\n" not in data:
                more = connection.recv(65536)
                if not more:
                    return
                data += more
            head, _, body = data.partition(b"\r\n\r\n")
            first, *rows = head.decode("latin-1").split("\r\n")
            headers = {k.lower(): v.strip() for k, _, v in (row.partition(":") for row in rows)}
            if headers.get("upgrade") == "websocket":
                self.socket_headers.append(headers)
                self._serve_socket(connection, data)
                return
            while len(body) < int(headers.get("content-length", 0)):
                body += connection.recv(65536)
            method, path, _ = first.split()
            asked = Asked(method, path.partition("?")[0], headers, body)
            self.asked.append(asked)
            status, answer = self.handle(asked)
            raw = isinstance(answer, bytes)  # a file
            payload = answer if raw else b"" if answer is None else json.dumps(answer).encode()
            connection.sendall(
                b"HTTP/1.1 %d X\r\nContent-Type: application/json\r\nContent-Length: %d\r\n"
                b"Connection: close\r\n\r\n%b" % (status, len(payload), payload)
            )

    def _serve_socket(self, connection: socket.socket, data: bytes) -> None:
        protocol = ServerProtocol(logger=QUIET)
        protocol.receive_data(data)
        (request,) = protocol.events_received()
        assert isinstance(request, Request)
        protocol.send_response(protocol.accept(request))
        with self._mutex:
            self._sockets.append((connection, protocol))
            self._flush(connection, protocol)
        self.on_open()
        try:
            self._hear(connection, protocol)
        finally:
            with self._mutex:
                if (connection, protocol) in self._sockets:
                    self._sockets.remove((connection, protocol))

    def _hear(self, connection: socket.socket, protocol: ServerProtocol) -> None:
        while True:
            try:
                data = connection.recv(65536)
            except OSError:
                return
            if not data:
                return
            with self._mutex:
                protocol.receive_data(data)
                frames = protocol.events_received()
                self._flush(connection, protocol)
            for frame in frames:
                if isinstance(frame, Frame) and frame.opcode is Opcode.TEXT:
                    self.on_message(json.loads(frame.data))

    @staticmethod
    def _flush(connection: socket.socket, protocol: ServerProtocol) -> None:
        try:
            for data in protocol.data_to_send():
                if data:
                    connection.sendall(data)
                else:
                    connection.shutdown(socket.SHUT_WR)
        except OSError:  # the peer has hung up already
            return

    def push(self, message: object) -> None:
        """Send a JSON value over every websocket."""
        with self._mutex:
            for connection, protocol in self._sockets:
                if protocol.state is not State.OPEN:  # it has said goodbye
                    continue
                protocol.send_text(json.dumps(message).encode())
                self._flush(connection, protocol)

    def drop_sockets(self) -> None:
        """Cut every websocket, as a server that is killed does."""
        with self._mutex:
            for connection, _ in self._sockets:
                try:
                    connection.shutdown(socket.SHUT_RDWR)
                except OSError:
                    continue
            self._sockets.clear()
