"""A viser server that only its own page, on this machine or with the token, may talk to.

viser has no notion of who is there: any page open in the same browser could reach it and press
its buttons. So every request passes a guard: the host it names, the page it comes from, and off
this machine a token. Where viser cannot be guarded, nothing is served.
"""

from __future__ import annotations

import hmac
import http
import ipaddress
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

import rich

from amrepair.errors import InputError, MissingDependencyError

LOOPBACK = "127.0.0.1"
COOKIE = "amrepair_token"
_starting = threading.Lock()


def is_loopback(host: str) -> bool:
    """Whether a host's name or address is this machine alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


class Guard:
    """Judges one request.

    Parameters
    ----------
    host
        What is bound to.
    token
        Required of every request; None only for loopback.
    """

    def __init__(self, host: str, token: str | None) -> None:
        if token is None and not is_loopback(host):
            raise InputError(
                f"--host {host} would let anybody on the network drive the printer; give --token "
                "with a secret of at least 16 characters, or leave --host out"
            )
        if token is not None and len(token) < 16:
            raise InputError(
                f"the token has {len(token)} characters; at least 16 are needed, such as from "
                "'openssl rand -hex 16'"
            )
        self._token = token

    def refusal(self, path: str, headers: Mapping[str, str]) -> str:
        """Why a request is refused; empty where it may pass."""
        host = headers.get("Host", "")
        origin = headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return f"another page ({origin}) may not talk to this one"
        if self._token is None:
            name = urlsplit(f"//{host}").hostname or ""
            return "" if is_loopback(name) else f"the name {name!r} is not this machine's own"
        if self._matches(self.token_in(path)) or self._matches(_cookie(headers)):
            return ""
        return "the token is missing or wrong; open the address that amrepair printed"

    @staticmethod
    def token_in(path: str) -> str:
        """The token that an address carries, if any."""
        return parse_qs(urlsplit(path).query).get("token", [""])[0]

    def _matches(self, given: str) -> bool:
        return self._token is not None and hmac.compare_digest(given.encode(), self._token.encode())


def _cookie(headers: Mapping[str, str]) -> str:
    try:
        morsel = SimpleCookie(headers.get("Cookie", "")).get(COOKIE)
    except CookieError:
        return ""
    return morsel.value if morsel is not None else ""


def start(*, host: str = LOOPBACK, port: int = 0, token: str | None = None, title: str) -> Any:
    """Start a guarded `viser.ViserServer`.

    Raises
    ------
    InputError
        If others could reach it without a token.
    MissingDependencyError
        If viser is not there, or serves in a way that cannot be guarded.
    """
    guard = Guard(host, token)
    try:
        import viser
    except ImportError as error:
        raise MissingDependencyError(
            f"the live view needs viser, which cannot be loaded ({error}); pip install viser"
        ) from error
    rich.reconfigure(quiet=True)  # viser prints, and standard output belongs to --json
    with _starting, _guarded(guard) as guarded:
        server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
    if not guarded:
        server.stop()
        raise MissingDependencyError(
            f"viser {viser.__version__} serves in a way that amrepair cannot guard; install the "
            "version of constraints.txt"
        )
    return server


@contextmanager
def _guarded(guard: Guard) -> Iterator[list[bool]]:
    """While a server starts, have its requests judged; the list is filled once that is done."""
    import websockets.asyncio.server as serving

    original, done = serving.serve, []

    def serve(*args: Any, process_request: Any = None, **options: Any) -> Any:
        done.append(True)
        return original(*args, process_request=_judged(guard, process_request), **options)

    serving.serve = serve  # type: ignore[misc, assignment]
    try:
        yield done
    finally:
        serving.serve = original  # type: ignore[misc]


def _judged(guard: Guard, inner: Callable[..., Any] | None) -> Callable[..., Any]:
    """The server's own answer, where the guard lets the request pass."""

    def process(connection: Any, request: Any) -> Any:
        headers = {name: request.headers.get(name) for name in ("Host", "Origin", "Cookie")}
        known = {name: value for name, value in headers.items() if value is not None}
        why = guard.refusal(request.path, known)
        if why:
            return connection.respond(http.HTTPStatus.FORBIDDEN, f"amrepair: {why}\n")
        token = guard.token_in(request.path)
        if token and request.headers.get("Upgrade") != "websocket":
            # from here on a cookie carries it, out of the address and of what pages pass on
            answer = connection.respond(http.HTTPStatus.FOUND, "")
            answer.headers["Location"] = "/"
            answer.headers["Set-Cookie"] = f"{COOKIE}={token}; HttpOnly; SameSite=Strict; Path=/"
            return answer
        return inner(connection, request) if inner is not None else None

    return process
