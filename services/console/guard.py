"""Access control of the page's server, applied before any other handling of a request.

Pages of other sites must not reach the server through a person's browser. Therefore the host must
be known ("DNS rebinding": a foreign name can resolve to this machine), connections must come from
the page itself, and there is no CORS.
"""

import hmac
import re
from typing import Final
from urllib.parse import parse_qs, quote

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

COOKIE: Final = "smal_console"
MAP: Final = "/map"  # Path for uploads of maps and scans.
_LOOPBACK: Final = frozenset({"localhost", "127.0.0.1", "[::1]"})
_PORT: Final = re.compile(r":\d{1,5}\Z")
#: The browser runs, displays and connects to content of this server only, and never parses text as
#: markup.
HEADERS: Final = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; "
    "require-trusted-types-for 'script'; trusted-types 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
}


class AccessGuard:
    """Passes requests of the page itself, with the token or, without one, for local host names."""

    def __init__(self, app: ASGIApp, token: str | None = None) -> None:
        self._app = app
        self._token = token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse a request, or pass it on."""
        if scope["type"] not in ("http", "websocket"):
            return
        refusal = self._refusal(scope)
        if refusal is None:
            await self._app(scope, receive, _with_headers(send))
        elif scope["type"] == "websocket":
            # Before acceptance: status 403.
            await send({"type": "websocket.close", "code": 1008})
        else:
            await refusal(scope, receive, _with_headers(send))

    def _refusal(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if self._token is None and _PORT.sub("", host).lower() not in _LOOPBACK:
            return PlainTextResponse("permission denied: this console serves localhost only\n", 421)
        origin = headers.get("origin")
        encrypted = scope["scheme"] in ("https", "wss")
        own = f"{'https' if encrypted else 'http'}://{host}"
        if origin != own and (origin is not None or scope["type"] == "websocket"):
            return PlainTextResponse(
                "permission denied: only the console's own page may connect\n", 403
            )
        if scope["type"] == "http" and scope["method"] not in ("GET", "HEAD"):
            if (scope["method"], scope["path"]) != ("POST", MAP):
                return PlainTextResponse("unsupported method\n", 405)
            if origin is None:
                return PlainTextResponse(
                    "permission denied: only the console's own page may connect\n", 403
                )
        return None if self._token is None else self._unknown(scope, headers, self._token)

    @staticmethod
    def _unknown(scope: Scope, headers: Headers, token: str) -> Response | None:
        """Request the token; a cookie, invisible to scripts, stores it."""
        # http.cookies takes quadratic time on hostile input (CVE-2024-7592).
        if any(
            _same(one.strip(), f"{COOKIE}={quote(token)}")
            for one in headers.get("cookie", "").split(";")
        ):
            return None
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        if scope["type"] == "http" and _same(given, token):
            answer = RedirectResponse("/", 303)
            answer.set_cookie(COOKIE, quote(token), httponly=True, secure=True, samesite="strict")
            return answer
        return PlainTextResponse(
            "permission denied; open this page with its token: https://HOST:PORT/?token=WORD\n", 401
        )


def _same(given: str, known: str) -> bool:
    return hmac.compare_digest(given.encode(), known.encode())


def _with_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in {**HEADERS, "Cache-Control": "no-cache"}.items():
                headers.setdefault(name, value)
        await send(message)

    return sending
