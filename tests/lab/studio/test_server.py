"""Who the server answers, where it listens, and how it ends. No browser."""

import asyncio
import http.client
import os
import socket
import stat
import subprocess
import sys
import tempfile
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

import pytest

from rejeu.core import interrupt
from rejeu.lab.cli import studio as cli

pytest.importorskip("nicegui", reason="needs nicegui, which is in the extra studio")

from starlette.responses import PlainTextResponse

from rejeu.lab.studio import server
from rejeu.lab.studio.guard import Guard
from rejeu.lab.studio.layout import address
from tests.lab.studio.conftest import Served, opened, serving
from tests.tiers import exhaustive


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    with serving(tmp_path_factory.mktemp("runs")) as one:
        yield one


def asked(served, path="/", **headers):
    """Returns status and headers of an answer."""
    connection = http.client.HTTPConnection(*served.host.split(":"), timeout=10)
    connection.request("GET", path, headers={name.replace("_", "-"): value for name, value in headers.items()})
    answer = connection.getresponse()
    answer.read()
    connection.close()
    return answer.status, {name.lower(): value for name, value in answer.getheaders()}


def test_only_the_address_with_its_token_is_answered_and_then_its_cookie(served):
    assert [asked(served, path)[0] for path in ("/", "/?token=", "/?token=wrong", "/_nicegui/x")] == [403] * 4
    status, headers = asked(served, f"/?run=a+b&token={served.token}")
    assert (status, headers["location"]) == (303, "/?run=a+b")
    name, _, value = headers["set-cookie"].partition(";")[0].partition("=")
    assert "httponly" in headers["set-cookie"].lower()
    status, headers = asked(served, Cookie=f"{name}={value}")
    assert status == 200
    assert "default-src 'self'" in headers["content-security-policy"]
    assert asked(served, Cookie=f"{name}=wrong")[0] == 403
    assert asked(served, Cookie=f"{name}={value}", Host="evil.example")[0] == 403
    assert asked(served, Cookie=f"{name}={value}", Origin="http://evil.example")[0] == 403


def requested(guard, host, receives=()):
    """Returns status and text with which a guard answers."""
    messages, received = [], iter([*receives, {"type": "http.request"}])

    async def receive():
        return next(received)

    async def send(message):
        messages.append(message)

    headers = [(b"host", host.encode()), (b"cookie", f"{guard.cookie}=secret".encode())]
    scope = {"type": "http", "headers": headers, "path": "/", "query_string": b"", "method": "GET"}
    asyncio.run(guard(scope, receive, send))
    return messages[0]["status"], messages[-1].get("body", b"").decode()


async def page(scope, receive, send):
    await PlainTextResponse("page")(scope, receive, send)


def test_another_name_is_told_how_to_forward_the_port_and_answered_if_the_command_line_allows_it():
    status, text = requested(Guard(page, "secret", 8080), "localhost:9000")
    assert status == 403
    assert "ssh -L 8080:localhost:8080 HOST" in text
    assert "--allow-host" in text
    guard = Guard(page, "secret", 8080, ["localhost:9000"])
    assert [requested(guard, host) for host in ("localhost:9000", "127.0.0.1:8080")] == [(200, "page")] * 2
    assert requested(guard, "evil.example:9000")[0] == 403


def test_an_error_after_the_browser_has_gone_is_not_printed_and_another_is():
    async def app(scope, receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await receive()
        raise RuntimeError("No response returned.")

    guard = Guard(app, "secret", 8080)
    assert requested(guard, "localhost:8080", receives=[{"type": "http.disconnect"}])[0] == 200
    with pytest.raises(RuntimeError):
        requested(guard, "localhost:8080")


@pytest.mark.parametrize("own", [{}, {"Origin": "http://evil.example"}])
def test_a_websocket_needs_the_cookie_and_the_own_origin(served, own):
    _, headers = asked(served, f"/?token={served.token}")
    cookie = {"Cookie": headers["set-cookie"].partition(";")[0]} if own else {}
    upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
    upgrade |= {"Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==", **own, **cookie}
    assert asked(served, "/_nicegui_ws/socket.io/?EIO=4&transport=websocket", **upgrade)[0] == 403


def test_it_listens_on_this_computer_only_and_takes_the_next_port(tmp_path, served):
    port = int(served.host.partition(":")[2])
    command = [sys.executable, "-m", "rejeu", "studio", str(tmp_path), "--port", str(port), "--no-browser"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        line = process.stdout.readline()
        assert int(line.partition("127.0.0.1:")[2].partition("/")[0]) > port
    finally:
        process.kill()
        process.communicate()
    with pytest.raises(OSError, match=r"refused|unreachable|timed out|assign"):
        socket.create_connection(("127.0.0.2", port), timeout=1).close()  # this computer too, by another address


@pytest.mark.skipif(sys.platform == "win32", reason="Windows frees a port at once")
def test_the_port_is_taken_again_though_its_connections_linger():
    """A tunnel and the tabs of the browser lead to the same port, also after a studio that has just ended."""
    with server.bound(0) as listener:
        port = listener.getsockname()[1]
        with socket.create_connection((server.HOST, port)) as client:
            listener.accept()[0].close()  # the side that closes first waits
            client.recv(1)
    with server.bound(port) as listener:
        assert listener.getsockname()[1] == port
        with server.bound(port) as following:
            assert following.getsockname()[1] != port


def test_without_the_extra_there_is_one_line(tmp_path):
    (tmp_path / "nicegui.py").write_text("raise ModuleNotFoundError", encoding="utf-8")
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    ended = subprocess.run(
        [sys.executable, "-m", "rejeu", "studio", str(tmp_path)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert (ended.returncode, ended.stdout) == (2, "")
    expected = 'rejeu: error: the studio needs nicegui, which is not installed; run: pip install "rejeu[studio]"'
    assert ended.stderr.strip() == expected


def test_an_address_holds_any_name():
    assert address("/play", agent=b"bad\xff".decode("utf-8", "surrogateescape")) == "/play?agent=bad%FF"


def test_an_empty_folder_says_so_and_leads_to_a_new_run(browser, served):
    with opened(browser, served, "/run?run=mistyped") as page:
        page.wait_for_selector("text=there is no run of this name below the folder: mistyped")
    with opened(browser, served) as page:
        page.wait_for_selector("text=There is no run in this folder yet.")
        assert page.get_by_role("button", name="Watch it learn").count() == 4
        assert not page.locator("table").is_visible()
        page.locator(".page").get_by_role("link", name="Another environment").click()
        page.wait_for_url("**/new")


@exhaustive
@pytest.mark.parametrize(
    ("language", "words"), [("en", "open the address that it prints"), ("fr", "l'adresse qu'il affiche")]
)
def test_a_page_whose_studio_has_ended_says_where_to_go(browser, tmp_path, language, words):
    served = Served(tmp_path)
    try:
        with opened(browser, served, f"/?language={language}") as page:
            served.end(kill=True)
            page.wait_for_selector("#popup[aria-hidden=false]")
            assert words in page.evaluate("getComputedStyle(document.querySelector('#popup'), '::after').content")
            page.messages.clear()  # connections that were refused
    finally:
        served.process.kill()


def test_ctrl_c_ends_it(tmp_path):
    printed = Served(tmp_path).end()
    assert "Traceback" not in printed


@pytest.mark.parametrize("path", ["//evil.example/x", "/\\evil.example/x", "/%5Cevil.example/x", "///evil.example"])
def test_an_address_with_the_token_leads_to_no_other_host(served, path):
    status, headers = asked(served, f"{path}?token={served.token}")
    assert status == 303
    assert urlsplit(headers["location"]).netloc == ""
    assert headers["location"][:2] not in ("//", "/\\")


def test_the_browser_is_not_started_with_the_token(monkeypatch, tmp_path):
    """Every user of a computer can read command lines."""
    opened = []

    def look(address):
        path = Path(url2pathname(urlsplit(address).path))
        opened.append(address)
        assert path in interrupt.unfinished  # which Ctrl-C removes
        assert "http://127.0.0.1:1/?run=a&amp;b&amp;token=secret&lt;" in path.read_text(encoding="utf-8")
        assert os.name != "posix" or stat.S_IMODE(path.stat().st_mode) == 0o600

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(cli.webbrowser, "open", look)
    monkeypatch.setattr(
        server, "serve", lambda studio, port, ready, *_: ready("http://127.0.0.1:1/?run=a&b&token=secret<")
    )
    cli.open_studio(tmp_path)
    assert "secret" not in opened[0]
    assert [*tmp_path.iterdir()] == []
