"""Models on the hub: the package for it, against a stand-in of its server on this machine."""

import json
from pathlib import Path

import numpy as np
import pytest

import rejeu
from rejeu.core.errors import CheckpointError
from rejeu.demonstrations import record
from rejeu.lab import hub
from rejeu.lab.cli import main
from tests.lab import hub_server

SB3 = Path(__file__).parents[1] / "data" / "sb3"


@pytest.fixture
def server(tmp_path, monkeypatch):
    """The real huggingface_hub, whose server is a stand-in on this machine; returns its repositories."""
    constants = pytest.importorskip("huggingface_hub.constants")
    monkeypatch.setenv("HF_TOKEN", hub_server.TOKEN)
    monkeypatch.chdir(tmp_path)
    with hub_server.served() as (address, repos):
        monkeypatch.setattr(constants, "ENDPOINT", address)
        template = constants.HUGGINGFACE_CO_URL_TEMPLATE
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", address + template[template.index("/{") :])
        yield repos


@pytest.fixture
def run(tmp_path):
    """Returns a small run folder."""
    folder = tmp_path / "run"
    folder.mkdir()
    agent = rejeu.DQN("MlpPolicy", "CartPole-v1", policy_kwargs={"net_arch": [8]}, seed=0)
    agent.save(folder / "agent")
    rejeu.DQN("MlpPolicy", "CartPole-v1", policy_kwargs={"net_arch": [8]}, seed=1).save(folder / "best")
    (folder / "config.json").write_text(json.dumps({"env_id": "CartPole-v1", "algorithm": "DQN", "seed": 0}))
    (folder / "evaluations.csv").write_text(
        "step,episodes,mean_return,std_return,mean_length,success_rate\n100,10,20,3,20,\n200,10,30,3,30,\n"
    )
    (folder / "curve.png").write_bytes(b"a picture")
    (folder / "secrets.txt").write_text("private")
    return folder


def test_a_model_is_pushed_with_its_card_and_pulled_again(server, run, capsys, monkeypatch):
    monkeypatch.setattr(rejeu.DQN, "export", lambda agent, path: Path(path).write_bytes(b"onnx"))
    assert main(["push", str(run), "me/cart"]) == 0
    assert "/me/cart" in capsys.readouterr().out
    found = server["me/cart"]
    assert {"agent.safetensors", "config.json", "evaluations.csv", "curve.png", "README.md", "policy.onnx"} <= {*found}
    assert server.private == {"me/cart": False}
    assert "secrets.txt" not in found
    assert (
        found["agent.safetensors"]
        == (run / "best.safetensors").read_bytes()
        != (run / "agent.safetensors").read_bytes()
    )
    card = found["README.md"].decode()
    # The interval of 10 episodes: 30 -+ 2.262 * 3 / sqrt(9), with the 97.5 % quantile of Student's t at 9 degrees of freedom
    assert "return 30.00 ± 3.00 (95 % confidence interval of the mean 27.74 to 32.26), 10 episodes" in card
    assert "![Learning curve](curve.png)" in card
    metadata = dict(line.split(": ", 1) for line in card.split("---")[1].strip().splitlines())
    assert json.loads(metadata["library_name"]) == "rejeu"
    assert json.loads(metadata["model-index"])[0]["results"][0]["metrics"][0]["value"] == 30

    found |= {"train.py": b"print()", "inner/other.zip": b"PK", "../../evil.zip": b"PK"}
    assert main(["pull", "me/cart"]) == 0
    assert "rejeu evaluate cart" in capsys.readouterr().out
    pulled = {path.relative_to("cart").as_posix() for path in Path("cart").rglob("*")}
    assert pulled == {*found} - {".gitattributes", "train.py", "inner/other.zip", "../../evil.zip"}
    assert Path("cart/agent.safetensors").read_bytes() == found["agent.safetensors"]
    hub.push(run / "agent.safetensors", "me/last", private=True)
    assert server.private["me/last"]
    assert server["me/last"]["agent.safetensors"] == (run / "agent.safetensors").read_bytes()
    assert "config.json" not in server["me/last"]


def test_the_files_are_written_to_a_folder_without_an_upload(server, run, tmp_path, capsys, monkeypatch):
    """``--out``; the video of a model file is the one of its name."""
    monkeypatch.setattr(rejeu.DQN, "export", lambda agent, path: Path(path).write_bytes(b"onnx"))
    (run / "agent.mp4").write_bytes(b"film")
    assert main(["push", str(run / "agent.safetensors"), "me/cart", "--out", str(tmp_path / "files")]) == 0
    assert not server
    assert "video.mp4" in capsys.readouterr().out
    written = {one.name: one.read_bytes() for one in (tmp_path / "files").iterdir()}
    assert {*written} == {"agent.safetensors", "README.md", "policy.onnx", "video.mp4"}
    assert written["video.mp4"] == b"film"
    assert written["agent.safetensors"] == (run / "agent.safetensors").read_bytes()
    assert b'src="video.mp4"' in written["README.md"]
    assert main(["push", str(run), "me/cart", "--out", str(tmp_path / "files")]) == 2
    assert "not an empty folder" in capsys.readouterr().err
    assert main(["push", str(tmp_path / "files"), "me/cart", "--out", str(tmp_path / "again")]) == 0  # no run folder
    assert {one.name for one in (tmp_path / "again").iterdir()} == {*written}


def test_the_paths_of_this_machine_stay_on_it(run, tmp_path):
    """Only the last names of folders and files are written; the model is the same otherwise."""
    network = {"policy_kwargs": {"net_arch": [8]}, "seed": 0, "learning_starts": 20}
    record(rejeu.DDPG("MlpPolicy", "Pendulum-v1", **network), "Pendulum-v1", 1, tmp_path / "shown", seed=0)
    agent = rejeu.DDPG("MlpPolicy", "Pendulum-v1", **network, demonstrations=tmp_path / "shown")
    agent.learn(40)
    agent.save(run / "best")
    (run / "agent.safetensors").unlink()
    values = {"hyperparameters": {"demonstrations": str(tmp_path / "shown"), "gamma": 0.99}, "env": "a/Walk-v0"}
    values |= {
        "env_argument": f"{tmp_path / 'walk.py'}:Walk-v0",
        "wrappers": ["C:\\me\\slow.py:Slow", "gymnasium.wrappers:Y"],
    }
    values |= {"origin": {"run": str(tmp_path / "été 1")}}
    (run / "config.json").write_text(json.dumps(values))
    (run / "evaluations.csv").unlink()
    hub.lay_out(run, tmp_path / "files", "me/pendulum")
    for path in (tmp_path / "files").iterdir():
        assert str(tmp_path).encode() not in path.read_bytes(), path
    written = json.loads((tmp_path / "files" / "config.json").read_text())
    assert written == {
        "hyperparameters": {"demonstrations": "shown", "gamma": 0.99},
        "env": "a/Walk-v0",
        "env_argument": "walk.py:Walk-v0",
        "wrappers": ["slow.py:Slow", "gymnasium.wrappers:Y"],
        "origin": {"run": "été 1"},
    }
    pushed = rejeu.load(tmp_path / "files" / "agent.safetensors")
    assert Path(pushed.config.demonstrations) == Path("shown").absolute()
    assert pushed.num_timesteps == 40
    for name, array in agent.get_parameters().items():
        np.testing.assert_array_equal(pushed.get_parameters()[name], array)


def test_models_of_stable_baselines3_are_pulled(server, capsys, tmp_path, monkeypatch):
    server["me/theirs"] = {
        f"{name}{suffix}": (SB3 / f"ppo-normalized{suffix}").read_bytes()
        for name, suffix in (("model", ".zip"), ("vecnormalize", ".pkl"))
    }
    assert main(["pull", "me/theirs", "--out", "here"]) == 0
    assert sorted(path.name for path in Path("here").rglob("*")) == ["model.zip", "vecnormalize.pkl"]
    assert "rejeu import" in capsys.readouterr().out
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    assert main(["pull", "me/theirs", "--out", "."]) == 0
    assert sorted(path.name for path in Path().iterdir()) == ["model.zip", "vecnormalize.pkl"]


def test_refusals_are_one_line_and_leave_nothing(server, run, tmp_path, monkeypatch):
    with pytest.raises(OSError, match=r"the hub answered: .*404") as error:
        hub.pull("me/none", tmp_path / "none")
    assert "\n" not in str(error.value)
    with pytest.raises(OSError, match=r"the hub answered: .*403"):
        hub.push(run, "others/x", note=lambda text: None)
    with pytest.raises(ValueError, match="not the name of a repository, such as USER/MODEL: ") as error:
        hub.push(run, "me/a b", note=lambda text: None)
    assert "\n" not in str(error.value)
    server["me/bad"] = {"agent.safetensors": b"nothing"}
    with pytest.raises(CheckpointError, match="not a complete safetensors file"):
        hub.pull("me/bad", tmp_path / "bad")
    server["me/zip"] = {"model.zip": b"PK nothing"}
    with pytest.raises(CheckpointError, match=r"model\.zip"):
        hub.pull("me/zip", tmp_path / "bad")
    monkeypatch.setenv("HF_TOKEN", "hf_wrong")
    with pytest.raises(OSError, match=r"the hub answered: .*401"):
        hub.push(run, "me/cart", note=lambda text: None)
    assert not (tmp_path / "none").exists()
    assert not (tmp_path / "bad").exists()


def test_a_hub_that_cannot_be_reached_is_one_line(server, monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setattr("time.sleep", lambda seconds: None)  # before each retry
    with pytest.raises(OSError, match="the hub cannot be reached: ") as error:
        hub.pull("away/x")
    assert "\n" not in str(error.value)


def test_a_folder_with_content_is_not_replaced(server):
    Path("full").mkdir()
    Path("full/file").touch()
    with pytest.raises(FileExistsError, match="name another, or remove it first"):
        hub.pull("me/full")


@pytest.mark.parametrize("name", ["a\0.zip", "\ud800.zip", "a" * 300 + ".zip", "a\n.pkl", "a/b.zip", "c:x.zip"])
def test_a_name_that_no_file_should_have_is_not_wanted(name):
    assert not hub.is_wanted(name)
    assert hub.is_wanted("a b.zip")
