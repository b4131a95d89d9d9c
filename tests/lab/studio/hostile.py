"""Run folders that want to run a script, to send something, to take a path out of the folder, or to be too large."""

import json
import os

from tests.lab.reporting.report.folders import CONFIG, write

HACK = "window.hacked=1"
TEXTS = (
    f"<img src=x onerror={HACK}>",
    f"</script><script>{HACK}</script>",
    f"<svg onload={HACK}>",
    f"'\"><iframe srcdoc='<script>parent.{HACK}</script>'>",
    "{{ constructor.constructor('window.hacked=1')() }}",
    "${window.hacked=1}",
    "javascript:window.hacked=1",
    "<img src=http://example.com/x.png>",
    '<link rel=stylesheet href="http://example.com/x.css">',
    "[x](javascript:window.hacked=1) ![x](http://example.com/y.png)",
    "<b>bold</b>\x1b[31m\u202etxt\u0000",
    "__proto__",
    "constructor",
    "../../../../etc/passwd",
    "a" * 5000,
    "=cmd|' /C calc'!A0",
)
"""Each is all texts of one run."""
DAMAGED = {
    "config.json": (b"", b"{", b"[]", b"\xff\xfe\x00", b'{"env": 3}', b"[" * 100_000, b'{"a":' * 50 + b"1" + b"}" * 50),
    "episodes.csv": (
        b"\x00" * 1000,
        b"step,return\n" + b"1" * 100_000,
        b"a," * 2000 + b"\n",
        b"step,return\n1,1e999\n-1,0\n",
    ),
    "evaluations.csv": (b"step,mean_return\n1,1e308\n2,-1e308\n", b"\r\r\r", b"step,step\n1,2\n"),
    "metrics.csv": (b"step,time/time_elapsed,</script><script>window.hacked=1</script>\n1,1,1\n2,2,2\n",),
}
"""Contents of one file of a run."""


def write_all(parent):
    """Writes 40 hostile run folders, and returns how many rows they are."""
    for i, text in enumerate(TEXTS):
        config = dict.fromkeys(("env", "algorithm", "backend", "policy", "env_argument", text), text)
        nested = {text: {text: [text]}, "learning_rate": {"schedule": text}}
        run = write(parent / f"text_{i:02}", {**CONFIG, **config, "hyperparameters": nested, "versions": {text: text}})
        (run / "warnings.txt").write_text(f"{text}\n" * 3, encoding="utf-8")
        if i < 4 and os.name == "posix":
            run.rename(parent / f"name_{i} {text.replace('/', '|')}")
    for name, contents in DAMAGED.items():
        for i, content in enumerate(contents):
            (write(parent / f"{name}_{i}", videos=False) / name).write_bytes(content)
    return len(TEXTS) + sum(map(len, DAMAGED.values())) + write_odd(parent)


def write_odd(parent):
    """Writes run folders with odd files, and returns how many."""
    outside = parent / ".outside"
    outside.mkdir()
    (outside / "secret.png").write_bytes(b"secret")
    odd = [write(parent / f"odd_{i}", videos=False) for i in range(9)]
    html = f"<script>{HACK}</script>".encode()
    for name in ("curve.png", "video.mp4", "report.html", "agent.safetensors", "best.safetensors", "live.safetensors"):
        (odd[0] / name).write_bytes(html)
    (odd[1] / "models").mkdir()
    for name in (f"step_<img src=x onerror={HACK}>.safetensors", "step_x.safetensors", "step_000000000001.safetensors"):
        (odd[1] / "models" / name).write_bytes(html)
    for i in range(10_000):
        (odd[2] / f"{i}.txt").touch()
    if os.name == "posix":
        (odd[3] / "curve.png").symlink_to(outside / "secret.png")
        (odd[3] / "video.mp4").symlink_to("/etc/passwd")
        (odd[3] / "episodes.csv").unlink()
        os.mkfifo(odd[3] / "episodes.csv")
    for name in ("metrics.csv", "evaluations.csv", "warnings.txt", "curve.png"):
        path = odd[4] / name
        path.unlink(missing_ok=True)
        path.mkdir()
    rows = "".join(f"{i},0,{i % 500},1,0.0,{i}\n" for i in range(1, 300_000))
    (odd[5] / "episodes.csv").write_text(f"step,env,return,length,success,seconds\n{rows}", encoding="utf-8")
    replays = (
        f"seed,return,length,success,goal_0,goal_1,{TEXTS[0]}\n1e300,1,1,1,1,1,1\nnan,2,2,0,1e308,-1,1\n3,3,3,1,0,0,1\n"
    )
    (odd[6] / "replays.csv").write_text(replays, encoding="utf-8")
    kwargs = {"env_kwargs": {"cls": "os:system", "file": "x.py"}, "wrappers": ["os:system"], "imports": ["antigravity"]}
    (odd[7] / "config.json").write_text(json.dumps({**CONFIG, **kwargs, "env": "os:system"}), encoding="utf-8")
    logs = parent / ".studio"
    logs.mkdir()
    (logs / "odd_8.log").write_text(TEXTS[1] * 10_000, encoding="utf-8")
    return len(odd)
