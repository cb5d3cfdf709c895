"""What the OctoPrint and Moonraker adapters share: addresses, requests, the push socket.

Every failure of HTTP or of the socket becomes one of our errors here, once. A request that
changes something is never sent twice: when its answer is lost, the caller asks what happened.
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect
from websockets.sync.connection import Connection

from gcode.errors import InputError, LinkError
from gcode.hosts.port import Temperatures
from gcode.hosts.secret import VARIABLES, ApiKey
from gcode.hosts.wirelog import WireLog

MAX_SERVER_MESSAGE_BYTES = 16_000_000  # OctoPrint's history holds half an hour of temperatures
LIFT_COMMANDS = ("G91", "G1 Z5 F600", "G90")
_SERVER_NAMES = {"octoprint": "OctoPrint", "moonraker": "Moonraker"}
# websockets logs frames and headers when somebody asks for DEBUG, and with them keys and sessions.
_MUTE = logging.Logger("gcode.hosts.web.frames", logging.CRITICAL + 1)


@dataclass(frozen=True, slots=True)
class WebTiming:
    """How long to wait, s.

    Attributes
    ----------
    request_s
        For the answer to a request.
    upload_s
        For the server to take a file.
    answer_s
        For a printer's answer to a question.
    lost_s
        For a server that went away in mid-print to come back; it prints on by itself.
    poll_s
        Between looks at the job's state where the server pushes nothing.
    """

    request_s: float = 10.0
    upload_s: float = 300.0
    answer_s: float = 30.0
    lost_s: float = 120.0
    poll_s: float = 1.0


@dataclass(frozen=True, slots=True)
class Address:
    """A server: `kind+base`."""

    kind: str
    base: str

    @property
    def spec(self) -> str:
        """The port as the command line has it."""
        return f"{self.kind}+{self.base}"

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"{_SERVER_NAMES[self.kind]} at {self.base}"

    def socket_url(self, path: str) -> str:
        """Return the address of a websocket."""
        return "ws" + self.base.removeprefix("http") + path

    @classmethod
    def parse(cls, spec: str) -> Address:
        """Read `octoprint+http://host:port` or `moonraker+http://host:port`.

        Raises
        ------
        InputError
            If it is not one, or carries a secret.
        """
        kind, _, url = spec.partition("+")
        parts = urlsplit(url)
        if "@" in parts.netloc or parts.query or parts.fragment:
            raise InputError(  # the text may hold a key, so it is not repeated
                f"A port's address has neither user, password nor query; give the API key by the "
                f"environment variable {VARIABLES.get(kind, 'of the server')}."
            )
        try:
            known = kind in VARIABLES and parts.scheme in {"http", "https"} and parts.hostname
            _ = parts.port
        except ValueError:
            known = None
        if not known:
            raise InputError(
                f"{spec!r} is no address of a print server; write octoprint+http://HOST:PORT or "
                f"moonraker+http://HOST:PORT."
            )
        return cls(kind, url.rstrip("/"))


class WebLog:
    """The wire log of a server's adapter: one line for every request and piece of news."""

    def __init__(self, path: Path) -> None:
        self._log = WireLog(path)
        self._mutex = threading.Lock()  # news come in a thread of their own

    def add(self, direction: bytes, text: str) -> None:
        """Note a line; `>` to the server, `<` from it."""
        with self._mutex:
            self._log.add(time.time(), direction, text.encode("utf-8", "replace"))

    def close(self) -> None:
        """Write what is left and close."""
        with self._mutex:
            self._log.close()


class WebClient:
    """Requests to one server, with errors of one sentence."""

    def __init__(
        self, address: Address, key: ApiKey, timing: WebTiming, log: WebLog | None
    ) -> None:
        self.address = address
        self.key = key
        self._timing = timing
        self._log = log
        # No proxy from the environment: printers are near, and a key is not shown to a proxy.
        self._http = httpx.Client(
            base_url=address.base, headers=key.headers, timeout=timing.request_s, trust_env=False
        )

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def request(
        self, method: str, path: str, *, timeout_s: float | None = None, **kwargs: Any
    ) -> httpx.Response:
        """Send a request once and return the answer, whatever its status below 500.

        Raises
        ------
        LinkError
            If the server cannot be reached, refuses the key or fails.
        """
        where, timeout = self.address.name, timeout_s or self._timing.request_s
        self._note(b">", f"{method} {path} {_shown(kwargs)}")
        try:
            answer = self._http.request(method, path, timeout=timeout, **kwargs)
        except httpx.TimeoutException as error:
            raise LinkError(
                f"{where} has not answered for {timeout:g} s ({method} {path}); is it running?"
            ) from error
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            raise LinkError(
                f"{where} cannot be reached ({str(error) or type(error).__name__}); check the "
                f"address and that it runs."
            ) from error
        self._note(b"<", f"{answer.status_code} {method} {path}")
        if answer.status_code in {401, 403}:
            raise refused_key(self.address, self.key)
        if answer.status_code >= 500:
            raise LinkError(
                f"{where} failed with status {answer.status_code} ({sentence(answer)}); "
                f"see its log."
            )
        return answer

    def expect(
        self, status: int, otherwise: str, method: str, path: str, **kwargs: Any
    ) -> httpx.Response:
        """Send a request that is answered with a status, or was refused.

        Parameters
        ----------
        otherwise
            What the server does not do then, such as 'pause'; a hint may follow after a `;`.

        Raises
        ------
        LinkError
            With the server's own words.
        """
        answer = self.request(method, path, **kwargs)
        if answer.status_code != status:
            what, _, hint = otherwise.partition("; ")
            raise LinkError(
                f"{self.address.name} does not {what} ({sentence(answer)})"
                f"{f'; {hint}' if hint else '.'}"
            )
        return answer

    def get(self, path: str) -> dict[str, Any]:
        """Return an answer's JSON object.

        Raises
        ------
        LinkError
            If the answer is none.
        """
        answer = self.request("GET", path)
        body = json_object(answer)
        if answer.status_code != 200 or body is None:
            raise LinkError(
                f"{self.address.name} answers {path} with status {answer.status_code} "
                f"({sentence(answer)}); is it {_SERVER_NAMES[self.address.kind]}?"
            )
        return body

    def _note(self, direction: bytes, text: str) -> None:
        if self._log is not None:
            self._log.add(direction, text)


class PushSocket:
    """A websocket whose messages a thread hands on, one JSON value each.

    Parameters
    ----------
    on_message
        Called in the thread; must not block.
    on_closed
        Called in the thread when the socket has ended, however.
    """

    def __init__(
        self,
        address: Address,
        path: str,
        *,
        headers: Mapping[str, str],
        timing: WebTiming,
        on_message: Callable[[Any], None],
        on_closed: Callable[[], None],
    ) -> None:
        self._address = address
        self._on_message = on_message
        self._on_closed = on_closed
        self.alive = True
        self._stack = contextlib.ExitStack()
        try:
            self._socket: Connection = self._stack.enter_context(
                connect(
                    address.socket_url(path),
                    additional_headers=dict(headers),
                    open_timeout=timing.request_s,
                    close_timeout=1.0,
                    max_size=MAX_SERVER_MESSAGE_BYTES,
                    proxy=None,
                    logger=_MUTE,
                )
            )
        except (OSError, WebSocketException, TimeoutError) as error:
            raise LinkError(
                f"{address.name} does not open its push socket "
                f"({str(error) or type(error).__name__}); check the address and the API key."
            ) from error
        self._thread = threading.Thread(target=self._read, daemon=True, name="push-socket")
        self._thread.start()

    def send(self, message: object) -> None:
        """Send a JSON value.

        Raises
        ------
        LinkError
            If the socket has ended.
        """
        try:
            self._socket.send(json.dumps(message))
        except (OSError, WebSocketException) as error:
            raise LinkError(f"The push socket of {self._address.name} is closed.") from error

    def close(self) -> None:
        """End it; harmless when it has ended."""
        self.alive = False
        with contextlib.suppress(OSError, WebSocketException):
            self._stack.close()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=5.0)

    def _read(self) -> None:
        try:
            for text in self._socket:
                try:
                    message = json.loads(text)
                except ValueError:
                    continue  # what is no JSON tells us nothing; the state is asked for anyway
                self._on_message(message)
        except (OSError, WebSocketException):
            pass  # told below
        finally:
            self.alive = False
            self._on_closed()


def refused_key(address: Address, key: ApiKey) -> LinkError:
    """Return the error for a key that is missing, wrong or too weak."""
    variable = VARIABLES[address.kind]
    if key.value:
        return LinkError(
            f"{address.name} refuses the API key or its owner's permissions; check {variable}."
        )
    return LinkError(
        f"{address.name} wants an API key and none is set; put it in {variable}, or in the keys "
        f"file of your configuration folder."
    )


def json_object(answer: httpx.Response) -> dict[str, Any] | None:
    """Return an answer's JSON object, None if it is none."""
    try:
        body = answer.json()
    except ValueError:
        return None
    return body if isinstance(body, dict) else None


def part_of(told: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return an object in an object, an empty one where it is none."""
    found = told.get(name)
    return found if isinstance(found, dict) else {}


def number_or_none(said: object) -> float | None:
    """Return a finite number that a server told; None where it is none."""
    if isinstance(said, bool) or not isinstance(said, int | float):
        return None
    try:
        value = float(said)
    except OverflowError:
        return None
    return value if math.isfinite(value) else None


def sentence(answer: httpx.Response) -> str:
    """Return what a server says of an error, shortened."""
    error = (json_object(answer) or {}).get("error", "")
    if isinstance(error, dict):
        error = error.get("message", "")
    text = error if isinstance(error, str) else ""
    return " ".join((text or answer.reason_phrase or "no reason given").split())[:200]


def _shown(kwargs: Mapping[str, Any]) -> str:
    """What the wire log shows of a request: its JSON; never a file's content or a header."""
    return json.dumps(kwargs["json"]) if "json" in kwargs else ""


def heaters_word(read: Callable[[], Temperatures]) -> str:
    """Return what may be said of heaters that were just told to switch off."""
    try:
        now = read()
    except LinkError:
        return "Heaters were told to switch off."
    if not now.set_c:
        return "Heaters are off."
    return "Heaters were told to switch off."
