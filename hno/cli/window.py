"""A page that shows an episode while it is played, and through which a person takes part; this process serves it."""

from __future__ import annotations

import json
import secrets
import sys
import threading
import time
from collections.abc import Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Annotated, Any, final
from urllib.parse import parse_qs, urlsplit

from pydantic import Field, NonNegativeInt

from hno.cli.schema import Settings, validated

HOST = "127.0.0.1"
LARGEST = 4096
"""Bytes that a page may send."""
POLICY = (
    "default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; connect-src 'self'; img-src data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
Speed = Annotated[float, Field(ge=0.05, le=10)]
"""The game's seconds in one of the clock."""
Event = Mapping[str, Any]


class Over(Exception):  # noqa: N818  # nothing is wrong
    """The next episode is asked for before the end of this one."""


class Asked(Settings):
    """What a person asks for."""

    player: NonNegativeInt = 0
    """Who is driven, 0 for nobody."""
    drive: list[Annotated[float, Field(ge=-1, le=1)]] = Field([], max_length=99)
    """Share of each control of that player, (m,), or none."""
    speed: Speed = 0.5
    paused: bool = False
    again: bool = False
    """Whether the next episode is to begin."""


@final
class Window:
    """The page, at a port of this machine alone, behind an address that others cannot guess.

    Args:
        port: 0 for any.
        about: what the page knows of all episodes, JSON content: "players", "controls" (2, P, m) and others.
        player: who is driven at first.
        speed: at first.

    Raises:
        OSError: the port is not free.
    """

    def __init__(self, port: int, about: Mapping[str, Any], player: int = 0, speed: float = 0.5) -> None:
        self.about, self.token = about, secrets.token_urlsafe(16)
        self.asked = Asked(player=player, drive=[], speed=speed)
        self.events: list[Event] = []
        self._changed, self._pages, self._due = threading.Condition(), 0, 0.0
        try:
            self.server = _Server((HOST, port), type("Handler", (_Handler,), {"window": self}))
        except OSError as error:
            raise OSError(f"Port {port} of {HOST} cannot be used: {error.strerror}. Choose another port=.") from error
        self.address = f"http://{HOST}:{self.server.server_port}/?token={self.token}"

    def __enter__(self) -> Window:
        """Serve, in threads of its own."""
        threading.Thread(target=self.server.serve_forever, args=(0.1,), daemon=True).start()
        return self

    def __exit__(self, *error: object) -> None:
        """Let go of the port."""
        self.server.shutdown()
        self.server.server_close()

    def ask(self, content: Mapping[str, Any]) -> None:
        """Ask for something; what is not named stays.

        Raises:
            ValueError: it makes no sense.
        """
        controls = len(self.about["controls"][0][0])
        with self._changed:
            asked = validated(Asked, {**self.asked.model_dump(), **content})
            if asked.player > self.about["players"] or len(asked.drive) not in (0, controls):
                raise ValueError(f"Expected a player up to {self.about['players']} and {controls} controls.")
            self.asked = asked
            self._changed.notify_all()

    def begin(self, title: str) -> None:
        """Another episode; it waits for somebody to see it."""
        with self._changed:
            self.asked = self.asked.model_copy(update={"again": False})
            self.events = [{"title": title, "about": self.about, "asked": self.asked.model_dump()}]
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._pages > 0)
        self._due = time.monotonic()

    def tell(self, event: Event) -> None:
        """What happens next."""
        with self._changed:
            self.events.append(event)
            self._changed.notify_all()

    def pace(self, seconds: float) -> None:
        """Wait for a time of the game, and while it is paused.

        Raises:
            Over: the next episode is asked for.
        """
        with self._changed:
            self._changed.wait_for(lambda: self.asked.again or not self.asked.paused)
            self._due = max(self._due + seconds / self.asked.speed, time.monotonic())
            if self._changed.wait_for(lambda: self.asked.again, self._due - time.monotonic()):
                raise Over

    def wait(self) -> None:
        """Until the next episode is asked for."""
        with self._changed:
            self._changed.wait_for(lambda: self.asked.again)

    def news(self, known: list[Event], count: int) -> tuple[list[Event], list[Event]]:
        """The events of the episode, and those among them that a page does not know; none after a second of silence."""
        with self._changed:
            self._changed.wait_for(lambda: known is not self.events or count < len(self.events), 1.0)
            return self.events, self.events[count if known is self.events else 0 :]

    def count(self, pages: int) -> None:
        """Pages were opened, or closed: nobody's keys are held down then."""
        with self._changed:
            self._pages += pages
            self.asked = self.asked.model_copy(update={"drive": []})
            self._changed.notify_all()


class _Server(ThreadingHTTPServer):
    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a page that was closed meanwhile."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    window: Window
    timeout = 30

    def do_GET(self) -> None:
        """The page, or what happens, as server-sent events."""
        if self._refused():
            return
        place = urlsplit(self.path).path
        if place == "/":
            nonce = secrets.token_urlsafe(16)
            page = (resources.files("hno.report") / "assets" / "simulate.html").read_text(encoding="utf-8")
            self._begin("text/html; charset=utf-8", POLICY.format(nonce=nonce))
            self.wfile.write(page.replace("@NONCE@", nonce).encode())
        elif place == "/events":
            self._begin("text/event-stream", POLICY.format(nonce=""))
            self._stream()
        else:
            self.send_error(404)

    def do_POST(self) -> None:
        """What a person asks for, as JSON."""
        if self._refused():
            return
        try:
            size = int(self.headers.get("Content-Length", ""))
            if not 0 < size <= LARGEST or urlsplit(self.path).path != "/ask":
                raise ValueError(f"expected 1 to {LARGEST} bytes of JSON for /ask")
            self.window.ask(dict(json.loads(self.rfile.read(size))))
        except (ValueError, TypeError, RecursionError) as error:
            self.send_error(400, explain=str(error))
            return
        self.send_response(204)
        self.end_headers()

    def _stream(self) -> None:
        known, count = list[Event](), 0
        self.window.count(1)
        try:
            while True:
                events, fresh = self.window.news(known, count)
                known, count = events, len(fresh) + (count if events is known else 0)
                lines = [f"data: {json.dumps(event, allow_nan=False)}\n\n" for event in fresh]
                self.wfile.write("".join(lines or [":\n\n"]).encode())
        finally:
            self.window.count(-1)

    def _begin(self, kind: str, policy: str) -> None:
        self.send_response(200)
        for name, value in {
            "Content-Type": kind, "Content-Security-Policy": policy, "Cache-Control": "no-store",
            "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff",
        }.items():  # fmt: skip
            self.send_header(name, value)
        self.end_headers()

    def _refused(self) -> bool:
        """Whether a request is not of this page: without the token, of another site, or of another host."""
        port = self.window.server.server_port
        hosts = [f"{name}:{port}" for name in (HOST, "localhost")]
        token = parse_qs(urlsplit(self.path).query).get("token", [""])[0]
        sound = self.headers.get("Host") in hosts and secrets.compare_digest(token.encode(), self.window.token.encode())
        if not (sound and self.headers.get("Origin", f"http://{hosts[0]}") in [f"http://{host}" for host in hosts]):
            self.send_error(403)
            return True
        return False

    def log_message(self, *words: Any) -> None:
        """Nothing: a request is nothing to talk about."""
