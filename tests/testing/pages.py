"""Requests to a served page, as a browser or a stranger makes them."""

import http.client
import re
from dataclasses import dataclass
from urllib.parse import urlsplit


@dataclass(frozen=True)
class Answer:
    """What a server answered."""

    status: int
    headers: http.client.HTTPMessage
    body: bytes


@dataclass(frozen=True)
class Visitor:
    """A browser that opened the link: it knows the folder of the pages and has the cookie."""

    address: str
    folder: str
    cookie: str

    def ask(self, path="/", method="GET", body=None, **headers: str) -> Answer:
        """Ask for a path in the folder of the pages; headers are given with _ for -."""
        sent = {"Cookie": self.cookie, "Origin": f"http://{self.address}"} | {
            name.replace("_", "-"): value for name, value in headers.items()
        }
        return ask(self.address, self.folder + path, method, body, **sent)


def visitor(link: str) -> Visitor:
    """Open a link, and return the browser that did."""
    parts = urlsplit(link)
    answer = ask(parts.netloc, parts.path)
    assert answer.status == 200, answer
    (folder,) = re.findall(rb"url=(/[^/]+)/", answer.body)
    stated = answer.headers["Set-Cookie"]
    assert "HttpOnly" in stated
    assert "SameSite=Strict" in stated
    assert f"Path={folder.decode()};" in f"{stated};"
    return Visitor(parts.netloc, folder.decode(), stated.partition(";")[0])


def ask(address: str, path: str, method="GET", body=None, **headers: str) -> Answer:
    """Send one request with an unmodified path."""
    connection = http.client.HTTPConnection(address, timeout=20)
    try:
        connection.request(method, path, body, {name: value for name, value in headers.items() if value})
        answer = connection.getresponse()
        return Answer(answer.status, answer.headers, answer.read())
    finally:
        connection.close()
