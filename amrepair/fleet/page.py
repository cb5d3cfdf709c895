"""The fleet's page, and what it says to browsers and to Prometheus; every request is guarded."""

from __future__ import annotations

import json
import threading
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any
from urllib.parse import unquote, urlsplit

from amrepair.errors import InputError
from amrepair.fleet.history import History
from amrepair.fleet.supervisor import Fleet, RunState
from amrepair.report.guarded import COOKIE, Guard, is_loopback

PAGE_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "connect-src 'self'; form-action 'none'; base-uri 'none'; frame-ancestors 'none'"
)
MOST_BODY_BYTES = 10_000
BUTTONS = ("approve", "skip", "stop", "resume")


class Page:
    """A running server.

    Parameters
    ----------
    host, port, token
        As of the live view: off this machine a token is needed. Port 0 takes a free one.

    Raises
    ------
    InputError
        If others could reach it without a token, or the port is taken.
    """

    def __init__(
        self, fleet: Fleet, history: History, *, host: str, port: int, token: str | None
    ) -> None:
        guard = Guard(host, token)
        self._host, self._token = host, token

        class Handler(_Handler):
            pass

        Handler.fleet, Handler.history, Handler.guard = fleet, history, guard
        try:
            self._server = ThreadingHTTPServer((host, port), Handler)
        except OSError as error:
            raise InputError(
                f"the page cannot be served at {host}:{port} ({error.strerror}); choose another "
                "--view-port"
            ) from error
        self._server.daemon_threads = True
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True
        )
        self._thread.start()

    @property
    def url(self) -> str:
        """The address to open."""
        host = "localhost" if is_loopback(self._host) else self._host
        tail = f"?token={self._token}" if self._token else ""
        return f"http://{host}:{self._server.server_address[1]}/{tail}"

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Handler(BaseHTTPRequestHandler):
    """One request."""

    fleet: Fleet
    history: History
    guard: Guard

    def do_GET(self) -> None:
        """The page, its data, the metrics."""
        if not self._passes():
            return
        path = urlsplit(self.path).path
        token = self.guard.token_in(self.path)
        if token and path == "/":
            # from here on a cookie carries it, out of the address
            cookie = f"{COOKIE}={token}; HttpOnly; SameSite=Strict; Path=/"
            self._say(HTTPStatus.FOUND, b"", "text/plain", {"Location": "/", "Set-Cookie": cookie})
        elif path == "/":
            text = (resources.files("amrepair.fleet") / "page.html").read_text(encoding="utf-8")
            self._say(HTTPStatus.OK, text.encode(), "text/html; charset=utf-8")
        elif path == "/state.json":
            said = {
                "printers": self.fleet.told(),
                "history": self.history.by_printer(),
                "lessons": [one for one in (x.told() for x in self.history.lessons()) if one],
            }
            self._say(HTTPStatus.OK, json.dumps(said).encode(), "application/json")
        elif path == "/metrics":
            text = metrics(self.fleet.told(), self.history.by_printer())
            self._say(HTTPStatus.OK, text.encode(), "text/plain; version=0.0.4; charset=utf-8")
        else:
            self._say(HTTPStatus.NOT_FOUND, b"there is no such page\n", "text/plain")

    def do_POST(self) -> None:
        """A button: `/printers/NAME/WORD`, with the question's number."""
        if not self._passes():
            return
        length = int(self.headers.get("Content-Length") or 0)
        words = [unquote(word) for word in urlsplit(self.path).path.split("/")]
        if len(words) != 4 or words[1] != "printers" or words[3] not in BUTTONS:
            self._say(HTTPStatus.NOT_FOUND, b"there is no such button\n", "text/plain")
            return
        try:
            body = json.loads(self.rfile.read(min(length, MOST_BODY_BYTES)) or b"{}")
            number = int(body.get("number", 0))
        except (ValueError, AttributeError, TypeError):
            self._say(HTTPStatus.BAD_REQUEST, b"the body is to be a JSON object\n", "text/plain")
            return
        done = self.fleet.do(words[2], words[3], number)
        status = HTTPStatus.OK if done else HTTPStatus.CONFLICT
        self._say(status, json.dumps({"done": done}).encode(), "application/json")

    def _passes(self) -> bool:
        names = ("Host", "Origin", "Cookie")
        headers = {name: self.headers[name] for name in names if self.headers[name] is not None}
        why = self.guard.refusal(self.path, headers)
        if why:
            self._say(HTTPStatus.FORBIDDEN, f"amrepair: {why}\n".encode(), "text/plain")
        return not why

    def _say(
        self,
        status: HTTPStatus,
        body: bytes,
        kind: str,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        self.send_response(status)
        given = {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Content-Security-Policy": PAGE_POLICY,
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            **(headers or {}),
        }
        for name, value in given.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not logged: their addresses may hold the token."""


def metrics(printers: Sequence[Mapping[str, Any]], history: Sequence[Mapping[str, Any]]) -> str:
    """Prometheus' text format."""
    names = [(one, f'printer="{_label(one["name"])}"') for one in printers]
    of_part = [(row, f'printer="{_label(row["printer"])}",part="{_label(row["part"])}"')
               for row in history]  # fmt: skip
    told = [
        *_metric("printer_state", "gauge", "Which state a printer is in (1) and which not (0).",
                 [(f'{name},state="{state}"', int(one["state"] == state))
                  for one, name in names for state in RunState]),
        *_metric("question_waiting", "gauge", "Whether a printer waits for somebody's word.",
                 [(name, int(one["question"] is not None)) for one, name in names]),
        *_metric("restarts_total", "counter", "How often a printer's process was started again.",
                 [(name, one["restarts"]) for one, name in names]),
        *_metric("judged_total", "counter", "Scans of the process that runs, by who detected.",
                 [(f'{name},by="{by}"', one["judged"][by])
                  for one, name in names for by in ("shared", "itself")]),
    ]  # fmt: skip
    for column, what in (
        ("runs", "Runs begun"), ("looks", "Scans that were judged"),
        ("repairs", "Repairs that were printed"),
        ("missing_mm3", "Volume found missing at the first look of each stop, mm³"),
        ("excess_mm3", "Volume found too much at the first look of each stop, mm³"),
    ):  # fmt: skip
        rows = [(name, f"{row[column]:.10g}") for row, name in of_part]
        told += _metric(f"{column}_total", "counter", f"{what}.", rows)
    return "\n".join(told) + "\n"


def _metric(name: str, kind: str, what: str, rows: Sequence[tuple[str, object]]) -> list[str]:
    """A figure's lines: labels and value by row."""
    name = f"amrepair_{name}"
    head = [f"# HELP {name} {what}", f"# TYPE {name} {kind}"]
    return head + [f"{name}{{{labels}}} {value}" for labels, value in rows]


def _label(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
