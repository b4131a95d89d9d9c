"""The studio as a server of its own process, and its pages in headless Chromium."""

import os
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest

pytest.importorskip("nicegui", reason="needs nicegui, which is in the extra studio")


class Served:
    """A studio that serves a folder. ``address`` has the token, and ``at`` a page of it."""

    def __init__(self, folder, *options, env=None):
        self.folder = Path(folder)
        command = [sys.executable, "-m", "rejeu", "studio", str(folder), "--port", "0", "--no-browser", *options]
        environment = {**os.environ, "PYTHONUNBUFFERED": "1", **(env or {})}
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment, encoding="utf-8"
        )
        self.lines = [self.process.stdout.readline()]
        assert self.lines[0].startswith("http://127.0.0.1:"), self.lines[0] + self.process.stdout.read()
        self.address = self.lines[0].split()[0]
        self.host, self.token = urlsplit(self.address).netloc, self.address.partition("token=")[2]
        self._reader = threading.Thread(target=lambda: self.lines.extend(self.process.stdout), daemon=True)
        self._reader.start()

    def at(self, path="/"):
        return f"http://{self.host}{path}{'&' if '?' in path else '?'}token={self.token}"

    def end(self, kill=False):
        """Ends the server, and returns what it has printed."""
        (self.process.kill if kill else self.process.terminate)()
        self.process.wait(30)
        self._reader.join(10)
        self.process.stdout.close()
        return "".join(self.lines)


@contextmanager
def serving(folder, *options, env=None):
    """Context of a studio that may print nothing but its address."""
    served = Served(folder, *options, env=env)
    try:
        yield served
    finally:
        printed = served.end()
    assert "Traceback" not in printed, printed
    assert "ERROR" not in printed, printed


@contextmanager
def opened(browser, served, path="/", width=1280, height=900, **settings):
    """Context of a page in a browser of its own. In the end no dialog was shown, and no request has left this computer.

    ``page.messages`` has the errors of the console, ``page.requests`` the addresses.
    """
    context = browser.new_context(viewport={"width": width, "height": height}, **settings)
    page = context.new_page()
    page.messages, page.requests, dialogs = [], [], []
    page.on("console", lambda message: page.messages.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: page.messages.append(str(error)))
    page.on("request", lambda request: page.requests.append(request.url))
    page.on("websocket", lambda socket: page.requests.append(socket.url))
    page.on("dialog", lambda dialog: (dialogs.append(dialog.message), dialog.dismiss()))
    page.set_default_timeout(20_000)
    try:
        page.goto(served.at(path))
        page.wait_for_selector(".page")
        yield page
        assert page.evaluate("window.hacked") is None
        assert dialogs == []
        assert [url for url in page.requests if urlsplit(url).netloc not in ("", served.host)] == []
        assert page.messages == []
    finally:
        context.close()


def check_widths(page):
    """Waits until nothing of a page is cut off, as wide as a phone's and as a desktop's."""
    for width in (400, 1280):
        page.set_viewport_size({"width": width, "height": 900})
        page.wait_for_function(f"document.documentElement.scrollWidth <= {width}")


HOSTILE = "<img src=x onerror=window.hacked=1>"


@pytest.fixture(scope="session")
def common(tmp_path_factory):
    """A studio that several files of tests share: a trained run, models, and runs of two algorithms and three seeds."""
    import rejeu
    from rejeu.lab.cli import main
    from tests.lab.reporting.test_comparison import write_run

    folder = tmp_path_factory.mktemp("common")
    for name, seed in (("anna", 0), (f"group/{HOSTILE}", 1)):
        (folder / name).parent.mkdir(exist_ok=True)
        agent = rejeu.PPO("MlpPolicy", "CartPole-v1", policy_kwargs={"net_arch": [8]}, seed=seed)
        agent.save(folder / f"{name}.safetensors")
    (folder / "cut.safetensors").write_bytes(b"cut")
    for name, algorithm, level in (("dqn", "DQN", 10.0), ("other", HOSTILE, 20.0)):
        for seed in range(3):
            write_run(folder / name / f"seed_{seed}", algorithm, seed=seed, level=level + seed)
    argv = ["train", "CartPole-v1", "--algo", "PPO", "--steps", "128", "--out", str(folder / "trained"), "--seed", "0"]
    argv += ["--evaluate-episodes", "2", "--no-report", "--no-video", "--backend", "gymnasium"]
    assert main([*argv, "--set", "n_steps=64", "policy_kwargs.net_arch=[8]"]) == 0
    with serving(folder) as studio:
        yield studio
