"""What the explorer's server lets in and what its pages may load."""

import ipaddress
import re
import socket
from typing import Any
from urllib.parse import urlsplit

MAX_BODY = 20 << 20  # bytes of one request, such as an uploaded image
POLICY = "; ".join(
    (
        "default-src 'self'",
        "script-src 'self' 'unsafe-inline' 'unsafe-eval'",  # gradio builds components from text
        "style-src 'self' 'unsafe-inline'",
        "img-src 'self' data: blob:",
        "font-src 'self' data:",
        "worker-src 'self' blob:",
        "object-src 'none'",
        "base-uri 'self'",
        "frame-ancestors 'none'",
    )
)
"""Content security policy: a page loads nothing from other hosts, whatever a label says."""
HEADERS = [
    (b"content-security-policy", POLICY.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
]


class Guard:
    """ASGI middleware: refuses other names than this machine's, other origins, and large requests.

    A site that lets its name point to 127.0.0.1 (DNS rebinding) sends its own name as Host, so names are checked.
    """

    def __init__(self, app: Any, host: str) -> None:
        self.app, self.host = app, host.strip("[]")
        self.open = self.host in ("0.0.0.0", "::")

    def allows(self, host: str) -> bool:
        """Whether ``host``, the request's Host header, is a name of this server."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        if name in ("localhost", "127.0.0.1", "::1", self.host, *([socket.gethostname()] if self.open else [])):
            return True
        try:
            return bool(ipaddress.ip_address(name)) and self.open  # rebinding needs a name
        except ValueError:
            return False

    def refuses(self, headers: dict[bytes, bytes]) -> tuple[int, str] | None:
        """Status and reason if a request with these headers is refused."""
        host = headers.get(b"host", b"").decode("latin-1")
        if not self.allows(host):
            return 403, "unknown host: open the address that `mvitac explore` prints"
        origin = headers.get(b"origin")
        if origin is not None and origin.decode("latin-1") not in (f"http://{host}", f"https://{host}"):
            return 403, "requests of other sites are refused"
        other = headers.get(b"sec-fetch-site") in (b"cross-site", b"same-site")
        if other and headers.get(b"sec-fetch-mode") != b"navigate":
            return 403, "requests of other sites are refused"
        if b"transfer-encoding" in headers:  # a body of unknown length; browsers always give it
            return 411, "give the length of the request (Content-Length)"
        length = headers.get(b"content-length", b"0")
        if not length.isdigit() or int(length) > MAX_BODY:
            return 413, f"at most {MAX_BODY >> 20} MB are accepted"
        return None

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] not in ("http", "websocket"):
            return await self.app(scope, receive, send)
        if found := self.refuses(dict(scope["headers"])):
            if scope["type"] == "websocket":
                return await send({"type": "websocket.close", "code": 1008})
            status, reason = found
            await send({"type": "http.response.start", "status": status, "headers": [*HEADERS]})
            return await send({"type": "http.response.body", "body": reason.encode()})

        async def guarded(message: Any) -> None:
            if message["type"] == "http.response.start":
                message = {**message, "headers": [*message.get("headers", []), *HEADERS]}
            await send(message)

        await self.app(scope, receive, guarded)


def as_text(text: str) -> str:
    """``text`` for a Markdown field, where it is shown as it is: no link, image, emphasis or HTML."""
    escaped = re.sub(r"([\\`*_{}\[\]()#+\-.!|~^$>])", r"\\\1", " ".join(text.split()))
    return escaped.replace("&", "&amp;").replace("<", "&lt;").replace(":", "&#58;").replace("@", "&#64;")
