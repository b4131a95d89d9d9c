"""The server of a report: what it answers, and to whom."""

import http.client
import json
import threading

import pytest

from rejeu.reporting.report import page
from rejeu.reporting.report.live import make_server
from tests.reporting.report.folders import write


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


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1", "127.0.0.1:1"])
def test_other_host_names_are_refused(server, host):
    assert get(server, "/", host)[0] == 403
