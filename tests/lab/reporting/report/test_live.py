"""The server of a report: what it answers, and to whom."""

import http.client
import json
import socket
import struct
import threading
import time

import pytest

from rejeu.lab.cli import report
from rejeu.lab.cli.commands import Report
from rejeu.lab.reporting.report import page
from rejeu.lab.reporting.report.live import make_server
from tests.lab.reporting.report.folders import write


@pytest.fixture
def server(tmp_path, monkeypatch):
    monkeypatch.setattr(page, "plotly_script", lambda: "plotly")
    server, _ = make_server([write(tmp_path / "run")])
    thread = threading.Thread(target=server.serve_forever, args=(0.05,))
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


def get(server, path, host=None):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=20)
    connection.request("GET", path, headers={} if host is None else {"Host": host})
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer.status, content


def test_server_is_bound_to_this_computer(server):
    assert server.server_address[0] == "127.0.0.1"


def test_page_and_data_and_nothing_else(server):
    status, content = get(server, "/")
    assert status == 200
    assert b"connect-src &#39;self&#39;" in content
    assert get(server, "/config.json")[0] == 404
    assert get(server, "/../run/config.json")[0] == 404


def test_data_is_sent_when_the_run_has_changed(server, tmp_path):
    status, content = get(server, "/data.json?version=none")
    first = json.loads(content)
    assert status == 200
    assert "Best evaluation" in first["parts"]["run0-headline"]
    assert get(server, f"/data.json?version={first['version']}") == (204, b"")
    with (tmp_path / "run" / "evaluations.csv").open("a", encoding="utf-8") as file:
        file.write("3500,35.0,1.0,222.0,1.0,222.0,20,1\n")
    second = json.loads(get(server, f"/data.json?version={first['version']}")[1])
    assert second["version"] != first["version"]
    assert "222.00" in second["parts"]["run0-evaluations"]


def test_folder_that_is_renamed_is_one_line_for_the_page(server, tmp_path, capsys):
    version = json.loads(get(server, "/data.json?version=none")[1])["version"]
    (tmp_path / "run").rename(tmp_path / "gone")
    status, content = get(server, f"/data.json?version={version}")
    assert (status, content.count(b"\n")) == (503, 0)
    assert b"there is no run folder" in content
    (tmp_path / "gone").rename(tmp_path / "run")
    assert get(server, f"/data.json?version={version}")[0] == 204
    assert capsys.readouterr().err == ""


def test_page_that_is_closed_while_it_is_sent_prints_nothing(server, capsys, monkeypatch):
    monkeypatch.setattr(page, "render", lambda *_, **__: "x" * 50_000_000)
    for _ in range(3):
        with socket.create_connection(("127.0.0.1", server.server_port)) as client:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # reset when closed
            client.sendall(f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{server.server_port}\r\n\r\n".encode())
            client.recv(10)
    assert get(server, "/nothing")[0] == 404
    time.sleep(0.2)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1", "127.0.0.1:1"])
def test_other_host_names_are_refused(server, host):
    assert get(server, "/", host)[0] == 403


def test_a_run_that_is_about_to_begin_is_waited_for(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(report.time, "sleep", lambda seconds: write(tmp_path / "run"))

    def stop(self):
        raise KeyboardInterrupt

    monkeypatch.setattr("socketserver.BaseServer.serve_forever", stop)
    with pytest.raises(KeyboardInterrupt):
        report.follow(Report(runs=(tmp_path / "run",), live=True))
    waiting, address = capsys.readouterr().out.splitlines()
    assert "run yet; waiting for it" in waiting
    assert address.startswith("http://127.0.0.1")
