"""Access to a page: a token in the link, then a cookie, and only from pages of the same origin."""

import contextlib
import ipaddress
import secrets
import socket
from dataclasses import dataclass, field
from html import escape
from urllib.parse import urlsplit

from aiohttp import web
from aiohttp.typedefs import Handler

_COOKIE = "pisigma"
MAX_UPLOAD = 200 * 2**20
"""Largest body of a request [bytes]."""
_SAFE_METHODS = ("GET", "HEAD")
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; frame-src 'self'; form-action 'self'; frame-ancestors 'self'; base-uri 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
"""Headers of every response, which forbid loading from other servers, storing, and display inside foreign pages."""
_FORBIDDEN = "Open this page with the link that pisigma printed."


def _random_name() -> str:
    return secrets.token_urlsafe(32)


@dataclass(frozen=True)
class Access:
    """Secrets of one server: the link with the token sets a cookie, which every other request needs.

    A browser sends the cookies of a host to the servers at all ports of it, including those of other users. The cookie
    is therefore restricted to a folder with a random name, in which all pages are.

    Attributes:
        token: secret in the link.
        cookie: secret in the cookie.
        folder: random name of the folder of all pages.
    """

    token: str = field(default_factory=_random_name)
    cookie: str = field(default_factory=_random_name)
    folder: str = field(default_factory=_random_name)

    @property
    def root(self) -> str:
        """Path of the folder, without a slash at its end."""
        return f"/{self.folder}"

    async def open_link(self, request: web.Request) -> web.Response:
        """Answer the link: set the cookie, and forward the browser to the first page.

        A redirect would belong to the navigation from the foreign page with the link, for which browsers send no strict
        cookie; therefore the answer is a page that forwards the browser immediately.
        """
        if not secrets.compare_digest(
            request.match_info["token"].encode(errors="replace"), self.token.encode()
        ):
            raise web.HTTPForbidden(text=_FORBIDDEN)
        page = (
            '<!doctype html><title>pisigma</title><link rel="icon" href="data:,">'
            f'<meta http-equiv="refresh" content="0;url={self.root}/">'
        )
        response = web.Response(text=page, content_type="text/html")
        response.set_cookie(_COOKIE, self.cookie, path=self.root, httponly=True, samesite="Strict")
        return response

    def check(self, request: web.Request) -> None:
        """Check host, origin and cookie of a request.

        Raises:
            HTTPForbidden: the request comes from another page, or from a browser without the cookie.
        """
        if not is_local_host(request.host):
            raise web.HTTPForbidden(text=f"The host {escape(request.host)[:100]} is not this machine.")
        if request.match_info.get("token") is not None:
            return
        cookie = request.cookies.get(_COOKIE, "")
        if not secrets.compare_digest(cookie.encode(errors="replace"), self.cookie.encode()):
            raise web.HTTPForbidden(text=_FORBIDDEN)
        if not is_same_origin(request):
            raise web.HTTPForbidden(text="The request comes from another page.")

    @web.middleware
    async def guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Check a request, have it answered, and add the headers to the response."""
        try:
            self.check(request)
            if (request.content_length or 0) > MAX_UPLOAD:
                raise web.HTTPRequestEntityTooLarge(MAX_UPLOAD, request.content_length or 0)
            response = await handler(request)
        except web.HTTPException as refusal:
            for name, value in _HEADERS.items():
                refusal.headers.setdefault(name, value)
            raise
        if not response.prepared:
            for name, value in _HEADERS.items():
                response.headers.setdefault(name, value)
        return response


def is_local_host(host: str) -> bool:
    """Return whether a Host header names this machine by an address or by a name that only this machine has.

    A foreign page whose name was made to point to this machine (DNS rebinding) is recognised by its name.
    """
    name = ""
    with contextlib.suppress(ValueError):
        name = urlsplit(f"//{host}").hostname or ""
        ipaddress.ip_address(name)
        return True
    return name in ("localhost", socket.gethostname().lower())


def is_same_origin(request: web.Request) -> bool:
    """Return whether a request was made by a page of this server, or by a person who typed the address."""
    origin = request.headers.get("Origin")
    is_socket = request.headers.get("Upgrade", "").lower() == "websocket"
    if origin is None and (is_socket or request.method not in _SAFE_METHODS):
        return False
    if origin is not None and origin.partition("://")[2].lower() != request.host.lower():
        return False
    return request.headers.get("Sec-Fetch-Site", "none") in ("none", "same-origin")
