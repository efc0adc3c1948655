"""Who may open a page: real requests of the browser with the link, and of everybody else."""

import contextlib
import os
import socket
from pathlib import Path

import pytest
from testing.pages import Visitor, ask, visitor
from testing.refusals import refused

from pisigma.files.errors import OutputError

pytest.importorskip("aiohttp", reason="the extra view is not installed")

from aiohttp import web

from pisigma.workbench.server.front_server import MAX_UPLOAD, FrontServer


async def length(request):
    return web.Response(text=str(len(await request.read())))


async def page(request):
    return web.Response(text="<p>page</p>", content_type="text/html")


PAGES = {("GET", "/"): page, ("POST", "/rows"): length}


@pytest.fixture(scope="module")
def server():
    with contextlib.closing(FrontServer(PAGES, "127.0.0.1", 0)) as started:
        yield started


@pytest.fixture(scope="module")
def browser_with_link(server) -> Visitor:
    return visitor(server.url)


def test_the_link_opens_the_page(browser_with_link):
    answer = browser_with_link.ask()
    assert (answer.status, answer.body) == (200, b"<p>page</p>")
    assert answer.headers["Cache-Control"] == "no-store"
    assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
    assert browser_with_link.ask("/rows", "POST", b"12345").body == b"5"


@pytest.mark.parametrize("token", ["", "x", "%00", "../", "ä".encode().hex(), "%ff%fe"])
def test_a_wrong_token_is_refused(server, token):
    address = server.origin.removeprefix("http://")
    answer = ask(address, f"/open/{token}")
    assert answer.status in (403, 404)
    assert answer.headers["Set-Cookie"] is None


@pytest.mark.parametrize("cookie", ["", "pisigma=", "pisigma=x", "pisigma=\xff", "other=1"])
def test_without_the_cookie_nothing_is_shown(browser_with_link, cookie):
    for path, method in (("/", "GET"), ("/rows", "POST"), ("/absent", "GET")):
        assert browser_with_link.ask(path, method, b"", Cookie=cookie).status == 403


FOREIGN = (
    {"Origin": "http://evil.example"},
    {"Origin": "null"},
    {"Origin": "http://["},
    {"Origin": "http://127.0.0.1:1"},
    {"Sec_Fetch_Site": "cross-site"},
    {"Sec_Fetch_Site": "same-site"},
)


@pytest.mark.parametrize("headers", FOREIGN, ids=str)
def test_a_foreign_page_is_refused(browser_with_link, headers):
    assert browser_with_link.ask(**headers).status == 403
    assert browser_with_link.ask("/rows", "POST", b"1", **headers).status == 403


def test_what_changes_something_needs_an_origin(browser_with_link):
    assert browser_with_link.ask(Origin="").status == 200
    assert browser_with_link.ask("/rows", "POST", b"1", Origin="").status == 403
    assert browser_with_link.ask(Origin="", Upgrade="websocket", Connection="Upgrade").status == 403


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example", "[", "a b"])
def test_a_host_that_is_not_this_machine_is_refused(server, browser_with_link, host):
    origin = f"http://{host}"
    assert browser_with_link.ask(Host=host, Origin=origin).status in (400, 403)
    token = server.url.removeprefix(server.origin)
    assert ask(browser_with_link.address, token, Host=host).status in (400, 403)


@pytest.mark.parametrize(
    "path", ["/../../etc/passwd", "/..%2f..%2fetc/passwd", "//etc/passwd", "/%00", "/rows"]
)
def test_other_paths_are_not_found(browser_with_link, path):
    assert browser_with_link.ask(path).status in (400, 403, 404, 405)


def test_a_large_upload_is_refused_before_it_is_read(browser_with_link):
    with socket.create_connection(browser_with_link.address.split(":"), timeout=20) as connection:
        head = (
            f"POST {browser_with_link.folder}/rows HTTP/1.1\r\nHost: {browser_with_link.address}\r\n"
            f"Origin: http://{browser_with_link.address}\r\nCookie: {browser_with_link.cookie}\r\n"
            f"Content-Length: {MAX_UPLOAD + 1}\r\n\r\n"
        )
        connection.sendall(head.encode())
        assert b" 413 " in connection.recv(1000).partition(b"\r\n")[0]


@pytest.mark.parametrize("host", ["192.0.2.1", "no such host"])
def test_an_address_of_another_machine_is_refused(host):
    with refused(OutputError, option="--host", value=host):
        FrontServer(PAGES, host, 8080)


def test_a_second_server_takes_the_next_port_and_has_its_own_secrets(server, browser_with_link):
    port = int(server.origin.rpartition(":")[2])
    with contextlib.closing(FrontServer(PAGES, "127.0.0.1", port)) as second:
        assert int(second.origin.rpartition(":")[2]) > port
        assert second.url.rpartition("/")[2] != server.url.rpartition("/")[2]
        other = visitor(second.url)
        assert other.folder != browser_with_link.folder
        assert other.ask(Cookie=browser_with_link.cookie).status == 403


def test_viser_can_be_reached_only_by_this_user(server):
    pytest.importorskip("viser", reason="the extra view is not installed")
    from pisigma.workbench.server.viser_server import ViserBackend

    before = listening()
    with contextlib.closing(ViserBackend("test")) as behind:
        assert listening() == before
        assert os.stat(behind.path.parent).st_mode & 0o077 == 0
        assert behind.server.request_share_url() is None
    assert not behind.path.parent.exists()


def listening() -> set[str]:
    """Return the addresses at which this machine listens."""
    tables = [Path(f"/proc/net/{name}").read_text() for name in ("tcp", "tcp6")]
    lines = [line.split() for table in tables for line in table.splitlines()[1:]]
    return {line[1] for line in lines if line[3] == "0A"}
