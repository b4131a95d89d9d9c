"""Run folders for the tests of reports: an ordinary one, and one whose every text tries to run a script."""

import json

import numpy as np

EVIL = "</script><script>window.hacked=1</script><img src=x onerror=window.hacked=1>"
HYPERPARAMETERS = {"gamma": 0.9, "batch_size": 32, "learning_rate": {"schedule": "linear", "start": 1e-3, "end": 0.0}}
CONFIG = {
    "env": "CartPole-v1",
    "algorithm": "DQN",
    "preset": False,
    "hyperparameters": HYPERPARAMETERS,
    "seed": 3,
    "n_envs": 2,
    "backend": "gymnasium",
    "steps": 3000,
    "versions": {"python": "3.11.7", "rejeu": "0.1.0"},
}
MP4 = b"\0\0\0\x18ftypisom" + bytes(100)
"""The beginning of an mp4 file, and nothing more."""


def write(folder, config=CONFIG, episodes=60, metrics="train/loss", videos=True):
    """Writes a run folder with random episodes and returns its path."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    (folder / "config.json").write_text(json.dumps(config), encoding="utf-8")
    steps = np.linspace(50, 3000, episodes).astype(int)
    returns = np.linspace(10, 200, episodes) + rng.normal(0, 20, episodes)
    with (folder / "episodes.csv").open("w", encoding="utf-8") as file:
        file.write("step,env,return,length,success,seconds\n")
        rows = zip(steps.tolist(), returns.tolist(), strict=True)
        file.writelines(f"{step},0,{value:.3f},{value:.0f},{int(value > 150)}.0,{step / 100}\n" for step, value in rows)
    (folder / "evaluations.csv").write_text(
        "step,seconds,success_rate,mean_return,std_return,mean_length,episodes,best\n"
        "1000,10.0,0.25,95.0,12.0,95.0,20,1\n2000,20.0,0.5,160.0,9.0,160.0,20,1\n3000,30.0,0.45,150.0,20.0,150.0,20,0\n",
        encoding="utf-8",
    )
    shares = "time/env_share,time/replay_share,time/update_share,time/rest_share"
    (folder / "metrics.csv").write_text(
        f"step,{metrics},train/entropy,time/time_elapsed,{shares}\n"
        "1000,0.5,0.7,10.0,0.2,0.1,0.6,0.1\n2000,0.25,0.6,20.0,0.2,0.1,0.5,0.2\n3000,0.2,nan,30.0,0.2,0.1,0.5,0.2\n",
        encoding="utf-8",
    )
    (folder / "agent.safetensors").write_bytes(b"")
    if videos:
        (folder / "videos").mkdir()
        for step in (1000, 2000, 3000):
            (folder / "videos" / f"step_{step:09}.mp4").write_bytes(MP4)
    return folder


def write_hostile(parent):
    """Writes a run folder whose names and values contain scripts, with damaged rows and odd files."""
    nested = {EVIL: EVIL, "schedule": [EVIL], "deep": {EVIL: {EVIL: EVIL}}}
    config = {
        **CONFIG,
        **dict.fromkeys(["env", "algorithm", "backend", "policy", "env_argument", EVIL], EVIL),
        "env_kwargs": {EVIL: EVIL},
        "hyperparameters": nested,
        "versions": {EVIL: EVIL},
    }
    folder = write(parent / "<img src=x onerror=window.hacked=1>", config, metrics=f"train/{EVIL}_loss")
    (folder / "warnings.txt").write_text(f"{EVIL}\n{{{{ 'not' + 'evaluated' }}}}{{% raw %}}\n", encoding="utf-8")
    (folder / "videos" / "step_'\"><img src=x onerror=window.hacked=1>.mp4").write_bytes(MP4)
    (folder / "video.mp4").write_text("<script>window.hacked=1</script>", encoding="utf-8")
    (parent / "secret.mp4").write_bytes(MP4 + b"secret")
    (folder / "videos" / "step_000009999.mp4").symlink_to(parent / "secret.mp4")
    with (folder / "episodes.csv").open("a", encoding="utf-8") as file:
        file.write(
            f"3100,0,nan,1e400,-inf,3\n3200,{EVIL},1,1,1,1\n-5,0,1,1,1,1\n3300,0,1e308,1,1,1\n3400,0,-1e308,1,1,1\n3500,0,1"
        )
    return folder
