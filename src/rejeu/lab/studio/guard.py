"""Who is answered: the browser that was given the address with its token, on this computer."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from typing import Any
from urllib.parse import parse_qsl, urlencode, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse, RedirectResponse

HOST = "127.0.0.1"
POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; media-src 'self' data:; font-src 'self' data:; connect-src 'self'; object-src 'none'; "
    "base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
)
"""Nothing is requested from elsewhere, whatever a page holds. Vue compiles its templates in the browser."""
HEADERS = {
    "Content-Security-Policy": POLICY,
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class Guard:
    """Middleware that answers requests and websockets with the token, as parameter ``token`` or as cookie, and refuses others.

    The cookie is bound to the port, since browsers send those of one server to all ports. ``Host`` and ``Origin`` must be this
    server's, so that no page of another site reaches it.
    """

    def __init__(self, app: Any, token: str, port: int, hosts: Sequence[str] = ()) -> None:
        self.app, self.token, self.cookie = app, token, f"rejeu_studio_{port}"
        self.hosts = {*hosts, *(f"{name}:{port}" for name in (HOST, "localhost"))}
        self.advice = (
            f"open the studio as localhost:{port}; by ssh forward the same port, ssh -L {port}:localhost:{port} HOST, "
        )
        self.advice += "or start it with --allow-host NAME:PORT, as it is in the address of the browser"

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Answers one request."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        asked = HTTPConnection(scope)
        if not self.is_own(asked.headers):
            await refuse(scope, receive, send, self.advice)
        elif secrets.compare_digest(asked.cookies.get(self.cookie, "").encode(), self.token.encode()):
            await while_there(self.app, scope, receive, with_headers(send))
        elif scope["type"] == "http" and self.token in asked.query_params.getlist("token"):
            await self.welcome(asked)(scope, receive, send)
        else:
            await refuse(scope, receive, send, "open the address that rejeu studio printed, with its token")

    def is_own(self, headers: Headers) -> bool:
        """Returns whether a request is for this server's name, and not from another site's page."""
        origin = headers.get("origin")
        return headers.get("host") in self.hosts and (origin is None or urlsplit(origin).netloc in self.hosts)

    def welcome(self, asked: HTTPConnection) -> RedirectResponse:
        """Returns the answer that sets the cookie and leads to the same page without the token in its address."""
        query = urlencode([pair for pair in parse_qsl(asked.url.query) if pair[0] != "token"])
        path = "/" + asked.url.path.lstrip("/\\")  # two at the beginning would lead to another host
        response = RedirectResponse(path + (f"?{query}" if query else ""), 303)
        response.set_cookie(self.cookie, self.token, httponly=True, samesite="lax")
        return response


async def refuse(scope: Any, receive: Any, send: Any, text: str) -> None:
    """Answers with status 403; a websocket is closed before it is accepted, which is the same."""
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008})
    else:
        await PlainTextResponse(f"403: {text}", 403)(scope, receive, send)


async def while_there(app: Any, scope: Any, receive: Any, send: Any) -> None:
    """Answers a request. When the browser has gone, as with a tab that is closed while it connects, an error is of no use."""
    is_gone = False

    async def receiving() -> Any:
        nonlocal is_gone
        message = await receive()
        is_gone = is_gone or message["type"].endswith(".disconnect")
        return message

    try:
        await app(scope, receiving, send)
    except Exception:  # middleware raises RuntimeError, and what it waits for anything
        if not is_gone:
            raise


def with_headers(send: Any) -> Any:
    """Returns ``send`` with :data:`HEADERS` on every answer."""

    async def sending(message: Any) -> None:
        if message["type"] == "http.response.start":
            MutableHeaders(scope=message).update(HEADERS)
        await send(message)

    return sending
